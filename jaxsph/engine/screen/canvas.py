"""What is known of an image so far: rays that were cast, and pixels that no ray is needed for.

Flow: cast -> [canvas: paint] -> estimators -> [canvas: wanted] -> packets -> cast; -> [canvas: finished] -> layers.
"""

from __future__ import annotations

import dataclasses
import itertools

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxsph.engine.screen.estimators import Estimator, allowed
from jaxsph.engine.screen.pyramid import at_nodes, lattices, nodes_of_leaves, of_corners, over_pixels, pixels_of_nodes, places

LIGHT = 4  # red, green, blue and transmittance: what errors are told from
TWICE = 2.0  # times what is allowed, beyond which all pixels of a leaf are cast at once: it would be split again
CHANNELS = 6  # and depth where it is finite, and whether it is


@dataclasses.dataclass(frozen=True)
class Canvas:
    """An image of which some pixels are known.

    Attributes:
        value: red, green, blue, transmittance, depth of half transmittance or 0, and whether there is one.
        known: pixels whose rays were cast, or are certain to meet nothing.
        spent: kernel evaluations of each pixel's ray.
        rays: how many were cast.
    """

    value: Float[Array, "height width 6"]
    known: Bool[Array, "height width"]
    spent: Float[Array, "height width"]
    rays: Int[Array, ""]

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width."""
        return self.known.shape  # type: ignore[return-value]

    @property
    def light(self) -> Float[Array, "4 height width"]:
        """Colour and transmittance."""
        return jnp.moveaxis(self.value[..., :LIGHT], -1, 0)


def channels_of(color: Array, transmittance: Array, depth: Array) -> Float[Array, "... 6"]:
    """What a canvas holds of rays; `color` has its channels first."""
    seen = jnp.isfinite(depth)
    return jnp.stack([*color, transmittance, jnp.where(seen, depth, 0), seen.astype(transmittance.dtype)], -1)


def blank(shape: tuple[int, int], dtype: jnp.dtype) -> Canvas:
    """Nothing is known."""
    nothing = jnp.zeros((CHANNELS,), dtype).at[3].set(1)
    return Canvas(jnp.broadcast_to(nothing, (*shape, CHANNELS)), jnp.zeros(shape, bool), jnp.zeros(shape), jnp.int32(0))


def painted_on_lattice(canvas: Canvas, value: Float[Array, "rows columns 6"], spent: Array, cast: Array, stride: int) -> Canvas:
    """With all nodes known that are `stride` apart, and those counted that had to be `cast`."""
    rows, columns = (places(size, stride) for size in canvas.shape)
    here = rows[:, None], columns[None]
    number = cast.sum(dtype=jnp.int32)
    return Canvas(
        canvas.value.at[here].set(value), canvas.known.at[here].set(True), canvas.spent.at[here].set(spent), canvas.rays + number
    )


def painted(canvas: Canvas, pixel: Array, value: Float[Array, "rays 6"], spent: Float[Array, " rays"]) -> Canvas:
    """With what rays have met at pixels, counted row by row; past the last there is none."""
    size = canvas.known.size
    flat = canvas.value.reshape(size, CHANNELS).at[pixel].set(value, mode="drop").reshape(canvas.value.shape)
    known = canvas.known.reshape(size).at[pixel].set(True, mode="drop").reshape(canvas.shape)
    spent = canvas.spent.reshape(size).at[pixel].add(spent, mode="drop").reshape(canvas.shape)
    return Canvas(flat, known, spent, canvas.rays + (pixel < size).sum(dtype=jnp.int32))


def wanted_by_tolerance(
    canvas: Canvas, side: int, coarsest: int, estimator: Estimator, tolerance: Array, bound: Float[Array, "height width"]
) -> Bool[Array, "height width"]:
    """Pixels to cast that splitting all leaves of one side asks for, whose error may be over what is allowed."""
    light = lax.stop_gradient(canvas.light)
    coarser, corners = lattices(light, canvas.known, side, coarsest)[-2:]
    errors = estimator(coarser, corners, canvas.shape, side)
    room = allowed(tolerance, bound, side)
    split = (errors.largest > room) | unseen(canvas, corners, side)
    wanted = pixels_of_nodes(nodes_of_leaves(split, canvas.shape, side // 2), canvas.shape, side // 2)
    if side > 2:
        wanted |= over_pixels(errors.largest > TWICE * room, canvas.shape, side)
    return wanted & ~canvas.known


def unseen(canvas: Canvas, corners: Float[Array, "4 rows columns"], side: int) -> Bool[Array, "rows columns"]:
    """Leaves that look empty, though rays between their corners may meet something."""
    empty = of_corners(corners[3] == 1, jnp.logical_and)
    pads = [(0, count * side - size) for count, size in zip(empty.shape, canvas.shape, strict=True)]
    inside = jnp.pad(~canvas.known, [(0, max(pad, 0)) for _, pad in pads])[: empty.shape[0] * side, : empty.shape[1] * side]
    return empty & inside.reshape(empty.shape[0], side, empty.shape[1], side).any((1, 3))


def finished(canvas: Canvas, coarsest: int, estimator: Estimator) -> tuple[Array, Array, Array, Array]:
    """Colour, transmittance, depth and expected error of all pixels: that of the smallest leaf whose corners are all known."""
    found = lattices(jnp.moveaxis(canvas.value, -1, 0), canvas.known, 1, coarsest)
    red, green, blue, transmittance, depth, seen = found[-1]
    half = (seen > 0) & (transmittance <= 0.5)
    depth = jnp.where(half, depth / jnp.where(half, seen, 1), jnp.inf)
    error, side = jnp.zeros(canvas.shape, transmittance.dtype), coarsest // 2
    for coarser, corners in itertools.pairwise(found[:-1]):
        before, now = (lax.stop_gradient(lattice[:LIGHT]) for lattice in (coarser, corners))
        here = estimator(before, now, canvas.shape, side)
        made = over_pixels(of_corners(at_nodes(canvas.known, side), jnp.logical_and), canvas.shape, side)
        error = jnp.where(made, over_pixels(here.largest, canvas.shape, side), error)
        side //= 2
    return jnp.stack([red, green, blue], -1), transmittance, depth, jnp.where(canvas.known, 0, error)


jax.tree_util.register_dataclass(Canvas, data_fields=[field.name for field in dataclasses.fields(Canvas)], meta_fields=[])
