"""What is known of an image so far, on a hierarchy of lattices, each with a node at every 2^l-th pixel.

Flow: cast -> [canvas: painted -> leaves -> wanted pixels] -> packets -> cast; -> [canvas: finished] -> layers.

A leaf of the quadtree is a square of nodes' distance s on each side. What is known at a node is taken as it is; what is not is
interpolated between the nodes of the next coarser lattice. So where a leaf is split and its neighbour is not, the nodes that hang
on their common side belong to both: the reconstruction is bilinear on every lattice, and continuous (the conforming closure of
Kratz et al. 2011, section 5). Nodes lie on pixels; the last of a row or a column is the last pixel, whatever the distance.

Split next are leaves over the tolerance, the worst of them, or the fewest that hold a share of the error. A leaf is told from
those that are split by its nodes: as long as one of the nine that splitting makes is unknown, it is whole.

Arrays of pixels are (channels, height, width), of nodes (channels, rows, columns).
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxsph.model.camera.camera import num_nodes
from jaxsph.numerics.trees import tree

CAUTION = 0.9  # of the largest difference around, how much a leaf may yet be wrong by: `benchmarks/calibrate_screen.py`
Lattice = Float[Array, "channels rows columns"]
OfLeaves = Float[Array, "rows columns"]
HALVINGS = 32  # of the range of norms, when the least that is split is sought
FEWEST = 1000  # leaves that a stage splits, if there are so many
TWICE = 2.0  # times what is allowed, beyond which all pixels of a leaf are cast at once: it would be split again
LIGHT = 4  # red, green, blue and transmittance: what errors are told from
ERROR = 6  # after depth where it is finite, and whether it is: how wrong rays are estimated to be, if they are


def leaf_errors(coarser: Lattice, corners: Lattice, shape: tuple[int, int], side: int) -> tuple[OfLeaves, OfLeaves]:
    r"""The difference between two approximations, $\|u_{n-1} - u_n\|_T$ (Kratz et al. 2011, equations 9 and 10).

    Either is bilinear on the leaf, so the square of their difference has an integral in closed form.

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
    """Of the bilinear function with those values at the corners: by the mass matrix of a bilinear element, which is exact."""
    upper_left, upper_right, lower_left, lower_right = corners_of(gain)
    squares = upper_left**2 + upper_right**2 + lower_left**2 + lower_right**2
    sides = (upper_left + lower_right) * (upper_right + lower_left)
    diagonals = upper_left * lower_right + upper_right * lower_left
    return (squares / 9 + sides / 9 + diagonals / 18).sum(0)


def allowed(tolerance: Array, bound: Float[Array, "height width"], side: int) -> OfLeaves:
    """What rays leave of a tolerance to the leaves, if they can be wrong by `bound`, a pixel."""
    return tolerance - of_corners(at_nodes(bound, side), jnp.maximum)


@tree()
class Canvas:
    """An image of which some pixels are known.

    Attributes:
        value: red, green, blue, transmittance, depth of half transmittance or 0, whether there is one; and how wrong each ray
            is estimated to be, where they are refined.
        known: pixels whose rays were cast, or are certain to meet nothing.
        spent: kernel evaluations of each pixel's ray.
        rays: how many were cast.
        bound: how wrong each pixel's ray can be, where that is known.
        full: kernel evaluations at full rate, where they are known.
    """

    value: Float[Array, "height width channels"]
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
    def doubt(self) -> Float[Array, "height width"]:
        """How wrong rays can be, of pixels that have one."""
        of_rays = self.value[..., ERROR] if self.value.shape[-1] > ERROR else jnp.zeros_like(self.bound)
        return self.bound + lax.stop_gradient(of_rays)

    @property
    def light(self) -> Float[Array, "4 height width"]:
        """Colour and transmittance, which decisions are made by: without a gradient."""
        return lax.stop_gradient(jnp.moveaxis(self.value[..., :LIGHT], -1, 0))


def channels_of(color: Array, transmittance: Array, depth: Array, error: Array | None) -> Float[Array, "... channels"]:
    """What a canvas holds of rays; `color` has its channels first, `error` is None of rays that are not refined."""
    seen = jnp.isfinite(depth)
    known = [*color, transmittance, jnp.where(seen, depth, 0), seen.astype(transmittance.dtype)]
    return jnp.stack(known if error is None else [*known, error], -1)


def of_lattice(
    shape: tuple[int, int], value: Float[Array, "rows columns channels"], spent: Array, cast: Array, stride: int
) -> Canvas:
    """Of that shape, with the nodes known that are `stride` apart, and those counted that had to be `cast`."""
    rows, columns = (places(size, stride) for size in shape)
    here = rows[:, None], columns[None]
    channels = value.shape[-1]
    nothing = jnp.broadcast_to(jnp.zeros((channels,), value.dtype).at[3].set(1), (*shape, channels))
    known, spent = jnp.zeros(shape, bool).at[here].set(True), jnp.zeros(shape).at[here].set(spent)
    untold = jnp.zeros(shape, value.dtype), jnp.zeros(shape, jnp.float32)
    return Canvas(nothing.at[here].set(value), known, spent, cast.sum(dtype=jnp.int32), *untold)


def painted(canvas: Canvas, pixel: Array, value: Float[Array, "rays channels"], spent: Float[Array, " rays"]) -> Canvas:
    """With what rays have met at pixels, counted row by row; past the last there is none."""
    size = canvas.known.size
    return dataclasses.replace(
        canvas,
        value=canvas.value.reshape(size, -1).at[pixel].set(value, mode="drop").reshape(canvas.value.shape),
        known=canvas.known.reshape(size).at[pixel].set(True, mode="drop").reshape(canvas.shape),
        spent=canvas.spent.reshape(size).at[pixel].add(spent, mode="drop").reshape(canvas.shape),
        rays=canvas.rays + (pixel < size).sum(dtype=jnp.int32),
    )


def finished(canvas: Canvas, coarsest: int) -> tuple[Array, Array, Array, Array]:
    """Colour, transmittance, depth and expected error of all pixels: that of the smallest leaf whose corners are all known."""
    found = lattices(jnp.moveaxis(canvas.value, -1, 0), canvas.known, 1, coarsest)
    red, green, blue, transmittance, depth, seen, *of_rays = found[-1]
    half = (seen > 0) & (transmittance <= 0.5)
    depth = jnp.where(half, depth / jnp.where(half, seen, 1), jnp.inf)
    error, side = jnp.zeros(canvas.shape, transmittance.dtype), coarsest // 2
    for coarser, corners in itertools.pairwise(found[:-1]):
        before, now = (lax.stop_gradient(lattice[:LIGHT]) for lattice in (coarser, corners))
        _, largest = leaf_errors(before, now, canvas.shape, side)
        made = over_pixels(of_corners(at_nodes(canvas.known, side), jnp.logical_and), canvas.shape, side)
        error = jnp.where(made, over_pixels(largest, canvas.shape, side), error)
        side //= 2
    error = jnp.where(canvas.known, 0, error) + canvas.bound
    for estimated in of_rays:  # interpolated as light is
        error = error + lax.stop_gradient(estimated)
    return jnp.stack([red, green, blue], -1), transmittance, depth, error


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


class Leaves(NamedTuple):
    """Leaves with sides of one length.

    Attributes:
        norm, largest: see `estimators.leaf_errors`.
        split: those that are to be: they are over the tolerance, or hidden.
        hidden: those that look empty and may not be.
        side: pixels.
    """

    norm: Float[Array, "rows columns"]
    largest: Float[Array, "rows columns"]
    split: Bool[Array, "rows columns"]
    hidden: Bool[Array, "rows columns"]
    side: int


class Quality(NamedTuple):
    """How good an image is said to be.

    Attributes:
        l2: relative L2 norm of the error (Kratz et al. 2011, equation 11).
        largest: largest error of a pixel, in any channel.
        over: leaves over the tolerance, that can be split.
    """

    l2: Float[Array, ""]
    largest: Float[Array, ""]
    over: Float[Array, ""]


def wanted_by_tolerance(canvas: Canvas, side: int, coarsest: int, tolerance: Array) -> Bool[Array, "height width"]:
    """Pixels to cast that splitting all leaves of one side asks for, whose error may be over what is allowed."""
    coarser, corners = lattices(canvas.light, canvas.known, side, coarsest)[-2:]
    leaves = _of_side(canvas, coarser, corners, side, tolerance)
    wanted = wanted_by([leaves.split], canvas, (side,))
    if side > 2:
        far = leaves.largest > TWICE * allowed(tolerance, canvas.doubt, side)
        wanted |= over_pixels(far, canvas.shape, side) & ~canvas.known
    return wanted


def leaves_of(canvas: Canvas, sides: tuple[int, ...], tolerance: Array) -> tuple[list[Leaves], Quality]:
    """All whole leaves that could be split, the largest first, and what they say of the image; errors elsewhere are 0."""
    found: list[Leaves] = []
    there = whole = jnp.ones((), bool)
    every = lattices(canvas.light, canvas.known, 1, 2 * sides[0])
    for side, (coarser, corners) in zip(sides, itertools.pairwise(every[:-1]), strict=True):
        norm, largest, split, hidden, _ = _of_side(canvas, coarser, corners, side, tolerance)
        children = jnp.repeat(jnp.repeat(there & ~whole, 2, 0), 2, 1) if found else jnp.ones(norm.shape, bool)
        there = children[: norm.shape[0], : norm.shape[1]]
        # whether any of the nine nodes is unknown that splitting makes or needs
        unknown = ~at_nodes(canvas.known, side // 2)
        missing = [(0, max(2 * count + 1 - have, 0)) for count, have in zip(norm.shape, unknown.shape, strict=True)]
        unknown = jnp.pad(unknown, missing, mode="edge")
        down = unknown[:-2:2] | unknown[1:-1:2] | unknown[2::2]
        whole = there & (down[:, :-2:2] | down[:, 1:-1:2] | down[:, 2::2])
        found.append(Leaves(jnp.where(whole, norm, 0), jnp.where(whole, largest, 0), whole & split, whole & hidden, side))
    squares = jnp.stack([(leaves.norm**2).sum() for leaves in found]).sum()
    total = jnp.maximum((every[-1] ** 2).sum(), jnp.finfo(canvas.value.dtype).tiny)
    largest = jnp.stack([leaves.largest.max() for leaves in found]).max()
    over = jnp.stack([leaves.split.sum(dtype=jnp.float32) for leaves in found]).sum()
    return found, Quality(jnp.sqrt(squares / total), largest, over)


def _of_side(canvas: Canvas, coarser: Array, corners: Array, side: int, tolerance: Array) -> Leaves:
    """Of all squares of one side, whether they are leaves or not; `coarser` and `corners`: see `estimators.leaf_errors`."""
    norm, largest = leaf_errors(coarser, corners, canvas.shape, side)
    # that look empty, though rays between their corners may meet something
    empty = of_corners(corners[3] == 1, jnp.logical_and)
    pads = [(0, count * side - size) for count, size in zip(empty.shape, canvas.shape, strict=True)]
    inside = jnp.pad(~canvas.known, [(0, max(pad, 0)) for _, pad in pads])[: empty.shape[0] * side, : empty.shape[1] * side]
    hidden = empty & inside.reshape(empty.shape[0], side, empty.shape[1], side).any((1, 3))
    return Leaves(norm, largest, (largest > allowed(tolerance, canvas.doubt, side)) | hidden, hidden, side)


def worst(leaves: list[Leaves], number: int | None, share: Array) -> list[Bool[Array, "rows columns"]]:
    """The most urgent leaves of those that are to be split: `number` of them, and all that are as urgent as the last.

    Without a number, as few as hold a share of the sum of all squared norms (Doerfler 1996); but not fewer than `FEWEST`: a stage
    takes some time however little is done in it.
    """
    # norms; leaves that look empty are taken to hide as much as others of their size show
    shown = [some.split & ~some.hidden for some in leaves]
    total = jnp.stack([jnp.where(some, each.norm**2, 0).sum() for some, each in zip(shown, leaves, strict=True)]).sum()
    area = jnp.stack([some.sum() * float(each.side) ** 2 for some, each in zip(shown, leaves, strict=True)]).sum()
    density = jnp.sqrt(total / jnp.maximum(area, 1))
    urgency = [jnp.where(some.split, jnp.where(some.hidden, density * some.side, some.norm), 0) for some in leaves]
    flat = jnp.concatenate([some.ravel() for some in urgency])
    squares = flat**2

    def enough(level: Array) -> Array:
        chosen = flat >= level
        if number is not None:
            return chosen.sum() >= number
        return (jnp.where(chosen, squares, 0).sum() >= share * squares.sum()) & (chosen.sum() >= FEWEST)

    def halve(_: Array, ends: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = ends
        middle = low + 0.5 * (high - low)
        good = enough(middle)
        return jnp.where(good, middle, low), jnp.where(good, high, middle)

    # the largest level that is enough, to rounding; 0 if none is: by bisection, as to sort takes many times as long
    low, high = jnp.zeros((), flat.dtype), flat.max() * (1 + jnp.finfo(flat.dtype).eps)
    least = lax.fori_loop(0, HALVINGS, halve, (low, high))[0]
    return [some.split & (each >= least) for some, each in zip(leaves, urgency, strict=True)]


def wanted_by(marked: list[Bool[Array, "rows columns"]], canvas: Canvas, sides: tuple[int, ...]) -> Bool[Array, "height width"]:
    """Pixels to cast for leaves that are split."""
    wanted = jnp.zeros(canvas.shape, bool)
    for split, side in zip(marked, sides, strict=True):
        wanted |= pixels_of_nodes(nodes_of_leaves(split, canvas.shape, side // 2), canvas.shape, side // 2)
    return wanted & ~canvas.known
