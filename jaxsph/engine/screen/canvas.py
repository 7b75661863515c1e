"""What is known of an image so far: rays that were cast, and pixels that no ray is needed for.

Flow: cast -> [canvas: painted] -> marking -> packets -> cast; -> [canvas: finished] -> layers.
"""

from __future__ import annotations

import dataclasses
import itertools

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxsph.engine.screen.pyramid import at_nodes, corners_of, halved, lattices, of_corners, over_pixels, places
from jaxsph.numerics.trees import tree

CAUTION = 0.9  # of the largest difference around, how much a leaf may yet be wrong by: `benchmarks/calibrate_screen.py`
Lattice = Float[Array, "channels rows columns"]
OfLeaves = Float[Array, "rows columns"]
GAUSS = np.polynomial.legendre.leggauss(3)
LIGHT = 4  # red, green, blue and transmittance: what errors are told from
CHANNELS = 6  # and depth where it is finite, and whether it is


def leaf_errors(coarser: Lattice, corners: Lattice, shape: tuple[int, int], side: int) -> tuple[OfLeaves, OfLeaves]:
    r"""The difference between two approximations, $\|u_{n-1} - u_n\|_T$ (Kratz et al. 2011, equations 9 and 10).

    Either is bilinear on the leaf, so the square of their difference is a polynomial that Gauss quadrature integrates exactly.

    Args:
        coarser: the image at nodes `2 * side` apart: what it was before the leaves were made.
        corners: at nodes `side` apart.
        shape: of the image, pixels.
        side: of the leaves, pixels.

    Returns:
        The L2 norm over each leaf, of all channels, in colour times pixels; and the largest difference that a pixel of it is
        expected to have, in any channel.
    """
    gain = corners - halved(coarser, shape, side)
    return side * jnp.sqrt(_mean_square(gain)), CAUTION * _largest_around(jnp.abs(gain).max(0))


def _mean_square(gain: Lattice) -> OfLeaves:
    """Of the bilinear function with those values at the corners: by three points of Gauss along either side."""
    upper_left, upper_right, lower_left, lower_right = corners_of(gain)
    place, weight = (GAUSS[0] + 1) / 2, GAUSS[1] / 2
    total = jnp.zeros(upper_left.shape[1:], gain.dtype)
    for y, wy in zip(place, weight, strict=True):
        left, right = upper_left + y * (lower_left - upper_left), upper_right + y * (lower_right - upper_right)
        for x, wx in zip(place, weight, strict=True):
            total = total + wy * wx * ((left + x * (right - left)) ** 2).sum(0)
    return total


def _largest_around(value: Float[Array, "rows columns"]) -> OfLeaves:
    """The largest at the corners of each leaf and at the nodes next to them: what a leaf sees may reach into the next."""
    pads = [(1, 2 if have == 1 else 1) for have in value.shape]
    return lax.reduce_window(value, jnp.zeros((), value.dtype), lax.max, (4, 4), (1, 1), pads)


def allowed(tolerance: Array, bound: Float[Array, "height width"], side: int) -> OfLeaves:
    """What rays leave of a tolerance to the leaves, if they can be wrong by `bound`, a pixel."""
    return tolerance - of_corners(at_nodes(bound, side), jnp.maximum)


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
