"""What is known of an image so far: rays that were cast, and pixels that no ray is needed for.

Flow: cast -> [canvas: paint] -> estimators -> [canvas: wanted] -> packets -> cast; -> [canvas: finished] -> layers.
"""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxsph.screen.estimators import Estimator, allowed, spread
from jaxsph.screen.pyramid import (
    at_nodes,
    lattices,
    nodes_of_leaves,
    over_pixels,
    pixels_of_nodes,
    places,
    reconstructed,
)

LIGHT = 4  # red, green, blue and transmittance: what errors are told from
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
    rays: Float[Array, ""]

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
    return Canvas(jnp.broadcast_to(nothing, (*shape, CHANNELS)), jnp.zeros(shape, bool), jnp.zeros(shape), jnp.float32(0))


def painted_on_lattice(canvas: Canvas, value: Float[Array, "rows columns 6"], spent: Array, cast: Array, stride: int) -> Canvas:
    """With all nodes known that are `stride` apart, and those counted that had to be `cast`."""
    rows, columns = (places(size, stride) for size in canvas.shape)
    here = rows[:, None], columns[None]
    number = cast.sum(dtype=jnp.float32)
    return Canvas(
        canvas.value.at[here].set(value), canvas.known.at[here].set(True), canvas.spent.at[here].set(spent), canvas.rays + number
    )


def painted(canvas: Canvas, pixel: Array, value: Float[Array, "rays 6"], spent: Float[Array, " rays"]) -> Canvas:
    """With what rays have met at pixels, counted row by row; past the last there is none."""
    size = canvas.known.size
    flat = canvas.value.reshape(size, CHANNELS).at[pixel].set(value, mode="drop").reshape(canvas.value.shape)
    known = canvas.known.reshape(size).at[pixel].set(True, mode="drop").reshape(canvas.shape)
    spent = canvas.spent.reshape(size).at[pixel].add(spent, mode="drop").reshape(canvas.shape)
    return Canvas(flat, known, spent, canvas.rays + (pixel < size).sum(dtype=jnp.float32))


def wanted_by_tolerance(
    canvas: Canvas, side: int, coarsest: int, estimator: Estimator, tolerance: Array, bound: Float[Array, "height width"]
) -> Bool[Array, "height width"]:
    """Pixels to cast that splitting all leaves of one side asks for, whose error may be over what is allowed."""
    light = jax.lax.stop_gradient(canvas.light)
    coarser, corners = lattices(light, canvas.known, side, coarsest)[-2:]
    errors = estimator(coarser, corners, canvas.shape, side)
    split = errors.largest > allowed(tolerance, bound, side)
    wanted = pixels_of_nodes(nodes_of_leaves(split, canvas.shape, side // 2), canvas.shape, side // 2)
    return wanted & ~canvas.known


def largest_errors(canvas: Canvas, coarsest: int, estimator: Estimator) -> Float[Array, "height width"]:
    """The error that each pixel is expected to have: that of the smallest leaf that has a corner which was not interpolated."""
    light, shape = jax.lax.stop_gradient(canvas.light), canvas.shape
    found = lattices(light, canvas.known, 1, coarsest)
    error = jnp.zeros(shape, light.dtype)
    side = coarsest // 2
    for coarser, corners in zip(found[:-2], found[1:-1], strict=True):
        here = estimator(coarser, corners, shape, side)
        finer = at_nodes(canvas.known, side)
        made = functools.reduce(jnp.logical_and, (finer[i : finer.shape[0] - 1 + i, j : finer.shape[1] - 1 + j] for i in (0, 1) for j in (0, 1)))
        error = jnp.where(over_pixels(made, shape, side), spread(here.largest, shape, side), error) if min(made.shape) else error
        side //= 2
    return jnp.where(canvas.known, 0, error)


def finished(canvas: Canvas, coarsest: int) -> tuple[Array, Array, Array]:
    """Colour, transmittance and depth of all pixels."""
    red, green, blue, transmittance, depth, seen = reconstructed(
        jnp.moveaxis(canvas.value, -1, 0), canvas.known, 1, coarsest
    )
    half = (seen > 0) & (transmittance <= 0.5)
    return jnp.stack([red, green, blue], -1), transmittance, jnp.where(half, depth / jnp.where(half, seen, 1), jnp.inf)


jax.tree_util.register_dataclass(
    Canvas, data_fields=[field.name for field in dataclasses.fields(Canvas)], meta_fields=[]
)
