"""The image as a function that is known at some pixels: a hierarchy of lattices, each with a node at every 2^l-th pixel.

Flow: rays -> [pyramid: values where known] -> estimators -> quadtree; -> pixels.

A leaf of the quadtree is a square of nodes' distance s on each side. What is known at a node is taken as it is; what is not is
interpolated between the nodes of the next coarser lattice. So where a leaf is split and its neighbour is not, the nodes that hang
on their common side belong to both: the reconstruction is bilinear on every lattice, and continuous (the conforming closure of
Kratz et al. 2011, section 5). Nodes lie on pixels; the last of a row or a column is the last pixel, whatever the distance.

Arrays of pixels are (channels, height, width), of nodes (channels, rows, columns).
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxsph.engine.access.lists import ListPlan
from jaxsph.model.camera.camera import num_nodes


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
