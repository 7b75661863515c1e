r"""Which leaves are split next: those over the tolerance, the worst of them, or the fewest that hold a share of the error.

Flow: canvas, estimators -> [marking] -> wanted pixels -> packets.

A leaf is told from those that are split by its nodes: as long as one of the nine that splitting makes is unknown, it is whole.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxsph.engine.screen.canvas import (
    Canvas,
    allowed,
    at_nodes,
    lattices,
    leaf_errors,
    nodes_of_leaves,
    of_corners,
    over_pixels,
    pixels_of_nodes,
)

HALVINGS = 32  # of the range of norms, when the least that is split is sought
FEWEST = 1000  # leaves that a stage splits, if there are so many
TWICE = 2.0  # times what is allowed, beyond which all pixels of a leaf are cast at once: it would be split again


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
        far = leaves.largest > TWICE * allowed(tolerance, canvas.bound, side)
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
        whole = there & _has_unknown(canvas, norm.shape, side)
        found.append(Leaves(jnp.where(whole, norm, 0), jnp.where(whole, largest, 0), whole & split, whole & hidden, side))
    squares = jnp.stack([(leaves.norm**2).sum() for leaves in found]).sum()
    total = jnp.maximum((every[-1] ** 2).sum(), jnp.finfo(canvas.value.dtype).tiny)
    largest = jnp.stack([leaves.largest.max() for leaves in found]).max()
    over = jnp.stack([leaves.split.sum(dtype=jnp.float32) for leaves in found]).sum()
    return found, Quality(jnp.sqrt(squares / total), largest, over)


def _of_side(canvas: Canvas, coarser: Array, corners: Array, side: int, tolerance: Array) -> Leaves:
    """Of all squares of one side, whether they are leaves or not; `coarser` and `corners`: see `estimators.leaf_errors`."""
    norm, largest = leaf_errors(coarser, corners, canvas.shape, side)
    hidden = _unseen(canvas, corners, side)
    return Leaves(norm, largest, (largest > allowed(tolerance, canvas.bound, side)) | hidden, hidden, side)


def _unseen(canvas: Canvas, corners: Float[Array, "4 rows columns"], side: int) -> Bool[Array, "rows columns"]:
    """Leaves that look empty, though rays between their corners may meet something."""
    empty = of_corners(corners[3] == 1, jnp.logical_and)
    pads = [(0, count * side - size) for count, size in zip(empty.shape, canvas.shape, strict=True)]
    inside = jnp.pad(~canvas.known, [(0, max(pad, 0)) for _, pad in pads])[: empty.shape[0] * side, : empty.shape[1] * side]
    return empty & inside.reshape(empty.shape[0], side, empty.shape[1], side).any((1, 3))


def worst(leaves: list[Leaves], number: int | None, share: Array) -> list[Bool[Array, "rows columns"]]:
    """The most urgent leaves of those that are to be split: `number` of them, and all that are as urgent as the last.

    Without a number, as few as hold a share of the sum of all squared norms (Doerfler 1996); but not fewer than `FEWEST`: a stage
    takes some time however little is done in it.
    """
    urgency = _urgency(leaves)
    flat = jnp.concatenate([some.ravel() for some in urgency])
    squares = flat**2

    def enough(level: Array) -> Array:
        chosen = flat >= level
        if number is not None:
            return chosen.sum() >= number
        return (jnp.where(chosen, squares, 0).sum() >= share * squares.sum()) & (chosen.sum() >= FEWEST)

    least = _largest(enough, flat)
    return [some.split & (each >= least) for some, each in zip(leaves, urgency, strict=True)]


def _urgency(leaves: list[Leaves]) -> list[Float[Array, "rows columns"]]:
    """Norms of leaves that are to be split; those that look empty are taken to hide as much as others of their size show."""
    shown = [some.split & ~some.hidden for some in leaves]
    squares = jnp.stack([jnp.where(some, each.norm**2, 0).sum() for some, each in zip(shown, leaves, strict=True)]).sum()
    area = jnp.stack([some.sum() * float(each.side) ** 2 for some, each in zip(shown, leaves, strict=True)]).sum()
    density = jnp.sqrt(squares / jnp.maximum(area, 1))
    return [jnp.where(some.split, jnp.where(some.hidden, density * some.side, some.norm), 0) for some in leaves]


def _largest(enough: Callable[[Array], Array], values: Float[Array, " leaves"]) -> Float[Array, ""]:
    """The largest level that is `enough`, to rounding; 0 if none is. By bisection, as to sort takes many times as long."""

    def halve(_: Array, ends: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = ends
        middle = low + 0.5 * (high - low)
        good = enough(middle)
        return jnp.where(good, middle, low), jnp.where(good, high, middle)

    low = jnp.zeros((), values.dtype)
    return lax.fori_loop(0, HALVINGS, halve, (low, values.max() * (1 + jnp.finfo(values.dtype).eps)))[0]


def wanted_by(marked: list[Bool[Array, "rows columns"]], canvas: Canvas, sides: tuple[int, ...]) -> Bool[Array, "height width"]:
    """Pixels to cast for leaves that are split."""
    wanted = jnp.zeros(canvas.shape, bool)
    for split, side in zip(marked, sides, strict=True):
        wanted |= pixels_of_nodes(nodes_of_leaves(split, canvas.shape, side // 2), canvas.shape, side // 2)
    return wanted & ~canvas.known


def _has_unknown(canvas: Canvas, leaves: tuple[int, ...], side: int) -> Bool[Array, "rows columns"]:
    """Whether any of the nine nodes is unknown that splitting leaves of one side makes or needs."""
    unknown = ~at_nodes(canvas.known, side // 2)
    rows, columns = (max(2 * count + 1 - have, 0) for count, have in zip(leaves, unknown.shape, strict=True))
    unknown = jnp.pad(unknown, ((0, rows), (0, columns)), mode="edge")
    down = unknown[:-2:2] | unknown[1:-1:2] | unknown[2::2]
    return down[:, :-2:2] | down[:, 1:-1:2] | down[:, 2::2]
