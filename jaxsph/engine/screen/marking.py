r"""Which leaves are split next: the worst, or the fewest that hold a share of the error.

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

from jaxsph.engine.screen.canvas import LIGHT, Canvas, unseen
from jaxsph.engine.screen.estimators import Estimator, allowed
from jaxsph.engine.screen.pyramid import at_nodes, lattices, nodes_of_leaves, pixels_of_nodes

HALVINGS = 32  # of the range of norms, when the least that is split is sought
FEWEST = 1000  # leaves that a stage splits, if there are so many


class Leaves(NamedTuple):
    """Whole leaves with sides of one length that could be split.

    Attributes:
        norm, largest: see `estimators.LeafErrors`; 0 where there is no such leaf.
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


def leaves_of(
    canvas: Canvas,
    sides: tuple[int, ...],
    coarsest: int,
    estimator: Estimator,
    tolerance: Array,
    bound: Float[Array, "height width"],
) -> tuple[list[Leaves], Quality]:
    """All leaves, the largest first, and what they say of the image."""
    light = lax.stop_gradient(canvas.light)
    found: list[Leaves] = []
    there = whole = jnp.ones((), bool)
    every = lattices(light, canvas.known, 1, coarsest)
    for side, (coarser, corners) in zip(sides, itertools.pairwise(every[:-1]), strict=True):
        errors = estimator(coarser, corners, canvas.shape, side)
        there = _children(there & ~whole, _two(errors.norm)) if found else jnp.ones(errors.norm.shape, bool)
        whole = there & _has_unknown(canvas, _two(errors.norm), side)
        norm, largest = (jnp.where(whole, error, 0) for error in errors.both)
        hidden = whole & unseen(canvas, corners, side)
        over = (whole & (errors.largest > allowed(tolerance, bound, side))) | hidden
        found.append(Leaves(norm, largest, over, hidden, side))
    squares = jnp.stack([(leaves.norm**2).sum() for leaves in found]).sum()
    total = jnp.maximum((every[-1][:LIGHT] ** 2).sum(), jnp.finfo(light.dtype).tiny)
    largest = jnp.stack([leaves.largest.max() for leaves in found]).max()
    over = jnp.stack([leaves.split.sum(dtype=jnp.float32) for leaves in found]).sum()
    return found, Quality(jnp.sqrt(squares / total), largest, over)


def worst(leaves: list[Leaves], number: int) -> list[Bool[Array, "rows columns"]]:
    """The most urgent leaves, so many of those that are to be split (and all that are as urgent as the last)."""
    urgency = _urgency(leaves)
    flat = jnp.concatenate([some.ravel() for some in urgency])
    least = _largest(lambda level: (flat >= level).sum() >= number, flat)
    return [some.split & (each >= least) for some, each in zip(leaves, urgency, strict=True)]


def holding(leaves: list[Leaves], share: Array) -> list[Bool[Array, "rows columns"]]:
    """As few as hold a share of the sum of all squared norms (Doerfler 1996), of those that are to be split.

    But not fewer than `FEWEST`: a stage takes some time however little is done in it.
    """
    urgency = _urgency(leaves)
    flat = jnp.concatenate([some.ravel() for some in urgency])
    squares = flat**2

    def enough(level: Array) -> Array:
        chosen = flat >= level
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


def _two(leaves: Array) -> tuple[int, int]:
    return leaves.shape[0], leaves.shape[1]


def _children(split: Bool[Array, "rows columns"], shape: tuple[int, int]) -> Bool[Array, "rows columns"]:
    """The leaves that split ones were split into."""
    return jnp.repeat(jnp.repeat(split, 2, 0), 2, 1)[: shape[0], : shape[1]]


def _has_unknown(canvas: Canvas, leaves: tuple[int, int], side: int) -> Bool[Array, "rows columns"]:
    """Whether any of the nine nodes is unknown that splitting leaves of one side makes or needs."""
    unknown = ~at_nodes(canvas.known, side // 2)
    rows, columns = (max(2 * count + 1 - have, 0) for count, have in zip(leaves, unknown.shape, strict=True))
    unknown = jnp.pad(unknown, ((0, rows), (0, columns)), mode="edge")
    down = unknown[:-2:2] | unknown[1:-1:2] | unknown[2::2]
    return down[:, :-2:2] | down[:, 1:-1:2] | down[:, 2::2]
