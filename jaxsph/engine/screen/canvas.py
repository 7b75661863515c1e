"""What is known of an image so far: rays that were cast, and pixels that no ray is needed for.

Flow: cast -> [canvas: painted] -> marking -> packets -> cast; -> [canvas: finished] -> layers.
"""

from __future__ import annotations

import dataclasses
import itertools

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxsph.engine.screen.estimators import leaf_errors
from jaxsph.engine.screen.pyramid import at_nodes, lattices, of_corners, over_pixels, places
from jaxsph.numerics.trees import tree

LIGHT = 4  # red, green, blue and transmittance: what errors are told from
CHANNELS = 6  # and depth where it is finite, and whether it is


@tree()
class Canvas:
    """An image of which some pixels are known.

    Attributes:
        value: red, green, blue, transmittance, depth of half transmittance or 0, and whether there is one.
        known: pixels whose rays were cast, or are certain to meet nothing.
        spent: kernel evaluations of each pixel's ray.
        rays: how many were cast.
        bound: how wrong each pixel's ray can be, where that is known.
        full: kernel evaluations at full rate, where they are known.
    """

    value: Float[Array, "height width 6"]
    known: Bool[Array, "height width"]
    spent: Float[Array, "height width"]
    rays: Int[Array, ""]
    bound: Float[Array, "height width"]
    full: Float[Array, "height width"]

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width."""
        return self.known.shape  # type: ignore[return-value]

    @property
    def light(self) -> Float[Array, "4 height width"]:
        """Colour and transmittance, which decisions are made by: without a gradient."""
        return lax.stop_gradient(jnp.moveaxis(self.value[..., :LIGHT], -1, 0))


def channels_of(color: Array, transmittance: Array, depth: Array) -> Float[Array, "... 6"]:
    """What a canvas holds of rays; `color` has its channels first."""
    seen = jnp.isfinite(depth)
    return jnp.stack([*color, transmittance, jnp.where(seen, depth, 0), seen.astype(transmittance.dtype)], -1)


def of_lattice(shape: tuple[int, int], value: Float[Array, "rows columns 6"], spent: Array, cast: Array, stride: int) -> Canvas:
    """Of that shape, with the nodes known that are `stride` apart, and those counted that had to be `cast`."""
    rows, columns = (places(size, stride) for size in shape)
    here = rows[:, None], columns[None]
    nothing = jnp.broadcast_to(jnp.zeros((CHANNELS,), value.dtype).at[3].set(1), (*shape, CHANNELS))
    known, spent = jnp.zeros(shape, bool).at[here].set(True), jnp.zeros(shape).at[here].set(spent)
    untold = jnp.zeros(shape, value.dtype), jnp.zeros(shape, jnp.float32)
    return Canvas(nothing.at[here].set(value), known, spent, cast.sum(dtype=jnp.int32), *untold)


def painted(canvas: Canvas, pixel: Array, value: Float[Array, "rays 6"], spent: Float[Array, " rays"]) -> Canvas:
    """With what rays have met at pixels, counted row by row; past the last there is none."""
    size = canvas.known.size
    return dataclasses.replace(
        canvas,
        value=canvas.value.reshape(size, CHANNELS).at[pixel].set(value, mode="drop").reshape(canvas.value.shape),
        known=canvas.known.reshape(size).at[pixel].set(True, mode="drop").reshape(canvas.shape),
        spent=canvas.spent.reshape(size).at[pixel].add(spent, mode="drop").reshape(canvas.shape),
        rays=canvas.rays + (pixel < size).sum(dtype=jnp.int32),
    )


def finished(canvas: Canvas, coarsest: int) -> tuple[Array, Array, Array, Array]:
    """Colour, transmittance, depth and expected error of all pixels: that of the smallest leaf whose corners are all known."""
    found = lattices(jnp.moveaxis(canvas.value, -1, 0), canvas.known, 1, coarsest)
    red, green, blue, transmittance, depth, seen = found[-1]
    half = (seen > 0) & (transmittance <= 0.5)
    depth = jnp.where(half, depth / jnp.where(half, seen, 1), jnp.inf)
    error, side = jnp.zeros(canvas.shape, transmittance.dtype), coarsest // 2
    for coarser, corners in itertools.pairwise(found[:-1]):
        before, now = (lax.stop_gradient(lattice[:LIGHT]) for lattice in (coarser, corners))
        _, largest = leaf_errors(before, now, canvas.shape, side)
        made = over_pixels(of_corners(at_nodes(canvas.known, side), jnp.logical_and), canvas.shape, side)
        error = jnp.where(made, over_pixels(largest, canvas.shape, side), error)
        side //= 2
    return jnp.stack([red, green, blue], -1), transmittance, depth, jnp.where(canvas.known, 0, error)
