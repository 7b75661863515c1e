"""What is known of an image so far, on a hierarchy of lattices, each with a node at every 2^l-th pixel.

Flow: cast -> [canvas: painted] -> packets -> cast; -> [canvas: finished] -> layers.

A leaf of the quadtree is a square of nodes' distance s on each side. What is known at a node is taken as it is; what is not is
interpolated between the nodes of the next coarser lattice. So where a leaf is split and its neighbour is not, the nodes that hang
on their common side belong to both: the reconstruction is bilinear on every lattice, and continuous (the conforming closure of
Kratz et al. 2011, section 5). Nodes lie on pixels; the last of a row or a column is the last pixel, whatever the distance.

Arrays of pixels are (channels, height, width), of nodes (channels, rows, columns).
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxsph.engine.access.lists import ListPlan
from jaxsph.model.camera.camera import num_nodes
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
    value = jnp.abs(gain).max(0)
    # of a leaf's corners and the nodes next to them: what it sees may reach into the next
    pads = [(1, 2 if have == 1 else 1) for have in value.shape]
    largest = lax.reduce_window(value, jnp.zeros((), value.dtype), lax.max, (4, 4), (1, 1), pads)
    return side * jnp.sqrt(_mean_square(gain)), CAUTION * largest


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


@dataclasses.dataclass(frozen=True)
class QuadtreePlan:
    """Static sizes of the refinement.

    Attributes:
        leaf: pixels on each side of the leaves that it begins with; nodes of the first lattice are half as far apart.
        lists: sizes of the lists of that lattice's bundles, which is cast in one band.
        packets: bundles that are cast together.
    """

    leaf: int
    lists: ListPlan
    packets: int

    def with_room(self, tile_capacity: int, list_capacity: int) -> QuadtreePlan:
        """With other capacities of the first lattice."""
        lists = dataclasses.replace(self.lists, tile_capacity=tile_capacity, list_capacity=list_capacity, runs=1)
        return dataclasses.replace(self, lists=lists)

    @property
    def stride(self) -> int:
        """Pixels between the nodes of the first lattice."""
        return self.leaf // 2

    @property
    def sides(self) -> tuple[int, ...]:
        """Of the leaves that may be split, the largest first."""
        return tuple(2**k for k in range(self.stride.bit_length() - 1, 0, -1))


def places(size: int, stride: int) -> np.ndarray:
    """Pixels that nodes lie on, of `size` pixels side by side."""
    return np.minimum(np.arange(num_nodes(size, stride)) * stride, size - 1)


def at_nodes(value: Array, stride: int) -> Array:
    """What an array of pixels, (..., height, width), holds at nodes."""
    if stride == 1:
        return value
    rows, columns = (jnp.asarray(places(size, stride)) for size in value.shape[-2:])
    return value[..., rows, :][..., columns]


def num_leaves(size: int, stride: int) -> int:
    """Leaves that so many pixels have side by side; a single pixel is one."""
    return max(num_nodes(size, stride) - 1, 1)


def corners_of(nodes: Array) -> list[Array]:
    """What the four corners of leaves have, of nodes (..., rows, columns); of one row or column, two of them are the others."""
    nodes = jnp.pad(nodes, [(0, 0)] * (nodes.ndim - 2) + [(0, int(size == 1)) for size in nodes.shape[-2:]], mode="edge")
    return [nodes[..., i : nodes.shape[-2] - 1 + i, j : nodes.shape[-1] - 1 + j] for i in (0, 1) for j in (0, 1)]


def of_corners(nodes: Array, join: Callable[[Array, Array], Array]) -> Array:
    """What the corners of leaves have in common, joined two by two."""
    return functools.reduce(join, corners_of(nodes))


def halved(value: Float[Array, "channels rows columns"], shape: tuple[int, int], stride: int) -> Float[Array, "channels ..."]:
    """Bilinear, from nodes `2 * stride` apart to those `stride` apart, of an image of `shape` pixels."""
    return _halved(_halved(value, 1, shape[0], stride), 2, shape[1], stride)


def _halved(value: Array, axis: int, size: int, stride: int) -> Array:
    """Along one axis: nodes stay, and what is new between two of them is weighted by its place."""
    count = num_nodes(size, stride)
    if value.shape[axis] < 2:
        return value
    fine, coarse = places(size, stride), places(size, 2 * stride)
    odd = fine[1::2]
    pairs = len(odd)
    left, right = coarse[:pairs], coarse[1 : pairs + 1]
    share = ((odd - left) / np.maximum(right - left, 1)).astype(value.dtype)
    share = share.reshape([-1 if k == axis else 1 for k in range(value.ndim)])
    first, second = (jnp.take(value, jnp.arange(start, start + pairs), axis) for start in (0, 1))
    between = first * (1 - share) + second * share
    pad = [(0, 1 if k == axis and pairs < value.shape[axis] else 0) for k in range(value.ndim)]
    both = jnp.stack([value, jnp.pad(between, pad)], axis + 1)
    both = both.reshape(*value.shape[:axis], -1, *value.shape[axis + 1 :])
    return jnp.take(both, jnp.arange(count), axis)


def lattices(
    value: Float[Array, "channels height width"], known: Bool[Array, "height width"], stride: int, coarsest: int
) -> list[Float[Array, "channels rows columns"]]:
    """The image at nodes `coarsest`, `coarsest / 2`, ... `stride` apart; all nodes `coarsest` apart must be known."""
    found = [at_nodes(value, coarsest)]
    while coarsest > stride:
        coarsest //= 2
        between = halved(found[-1], (value.shape[-2], value.shape[-1]), coarsest)
        found.append(jnp.where(at_nodes(known, coarsest), at_nodes(value, coarsest), between))
    return found


def nodes_of_leaves(leaf: Bool[Array, "rows columns"], shape: tuple[int, int], stride: int) -> Bool[Array, "rows columns"]:
    """The nodes `stride` apart that splitting leaves makes or needs: nine of each, whose sides are `2 * stride` long."""
    twice = jnp.repeat(jnp.repeat(leaf, 2, 0), 2, 1)
    rows, columns = (num_nodes(size, stride) for size in shape)
    around = jnp.pad(twice, 1)[: rows + 1, : columns + 1]
    around = jnp.pad(around, [(0, rows + 1 - around.shape[0]), (0, columns + 1 - around.shape[1])])
    down = around[:-1] | around[1:]
    return down[:, :-1] | down[:, 1:]


def pixels_of_nodes(node: Bool[Array, "rows columns"], shape: tuple[int, int], stride: int) -> Bool[Array, "height width"]:
    """The pixels that nodes lie on."""
    if stride == 1:
        return node
    rows, columns = (places(size, stride) for size in shape)
    return jnp.zeros(shape, bool).at[rows[:, None], columns[None]].set(node)


def over_pixels(leaf: Array, shape: tuple[int, int], stride: int) -> Array:
    """What leaves hold, at all of their pixels; the last row and column belong to the last leaves."""
    rows, columns = (np.minimum(np.arange(size) // stride, num_leaves(size, stride) - 1) for size in shape)
    return leaf[jnp.asarray(rows)][:, jnp.asarray(columns)]
