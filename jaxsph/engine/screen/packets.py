r"""Which leaves are split next, and packets of the rays that this takes: scattered rays of a bundle, or all of it.

Flow: canvas -> [packets: leaves -> wanted pixels -> queues -> packets] -> cast.

Split are those over the tolerance, the worst of them, or the fewest that hold a share of the error. A leaf is told from those
that are split by its nodes: as long as one of the nine that splitting makes is unknown, it is whole.

A bundle of which few rays are wanted is cast as one packet of scattered rays; one of which more than `SCATTERED` are wanted is
cast whole, as a tensor product, which takes less than to cast them apart (and tells all of its pixels).
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxsph.engine.access.grid import Grid
from jaxsph.engine.access.lists import BUNDLE, ListPlan
from jaxsph.engine.field.tasks import RayPackets
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
from jaxsph.model.camera.camera import Camera
from jaxsph.numerics.checks import array_of
from jaxsph.numerics.trees import tree

HALVINGS = 32  # of the range of norms, when the least that is split is sought
FEWEST = 1000  # leaves that a stage splits, if there are so many
TWICE = 2.0  # times what is allowed, beyond which all pixels of a leaf are cast at once: it would be split again
SCATTERED = 8  # rays of a packet of scattered rays: with 16 it took nearly as long as a whole bundle, as much is read for either
PIXELS = BUNDLE * BUNDLE  # of a bundle, and rays of one that is cast whole


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
    return Leaves(norm, largest, (largest > allowed(tolerance, canvas.bound, side)) | hidden, hidden, side)


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

    least = _largest(enough, flat)
    return [some.split & (each >= least) for some, each in zip(leaves, urgency, strict=True)]


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


@tree()
class Chosen:
    """Some bundles, of which some rays are cast.

    Attributes:
        bundle: which they are.
        place: of each ray, its pixel in the bundle, row by row.
        real: rays that are cast, others are room; a packet of which none is real is room.
    """

    bundle: Int[Array, " packets"]
    place: Int[Array, "rays packets"]
    real: Bool[Array, "rays packets"]

    def pixels(self, grid: Grid, shape: tuple[int, int]) -> Int[Array, "packets rays"]:
        """Where rays are in an image of that shape, row by row; past the last pixel where there is no such ray."""
        row = grid.row[self.bundle] + self.place // BUNDLE
        column = grid.column[self.bundle] + self.place % BUNDLE
        inside = self.real & (row < shape[0]) & (column < shape[1])
        return jnp.where(inside, row * shape[1] + column, shape[0] * shape[1]).T


@tree(static=("rays", "packets"))
class Queue:
    """Bundles of which rays are wanted, one after the other; `packets` of them are cast together, from the `first` on.

    Attributes:
        wanted: of each bundle, which of its pixels.
        bundle: the bundles that are to be cast, and past `number` any.
        rays: of a packet; static, as is `packets`.
    """

    wanted: Bool[Array, "bundles 64"]
    bundle: Int[Array, " bundles"]
    number: Int[Array, ""]
    first: Int[Array, ""]
    rays: int
    packets: int = 1

    def turn(self, nth: int, packets: int) -> Queue:
        """The same, with the `nth` so many packets to be cast."""
        return dataclasses.replace(self, first=array_of(nth * packets, jnp.int32), packets=packets)

    def chosen(self) -> Chosen:
        """The packets to be cast."""
        nth = self.first + jnp.arange(self.packets, dtype=jnp.int32)
        bundle, inside = self.bundle[jnp.minimum(nth, self.bundle.shape[0] - 1)], nth < self.number
        pixel = jnp.arange(PIXELS, dtype=jnp.int32)[:, None]
        if self.rays == PIXELS:
            return Chosen(bundle, *(jnp.broadcast_to(one, (PIXELS, self.packets)) for one in (pixel, inside)))
        wanted = self.wanted[bundle].T & inside
        slot = jnp.arange(self.rays, dtype=jnp.int32)[:, None, None]
        mine = wanted & (jnp.cumsum(wanted, 0, dtype=jnp.int32) - 1 == slot)
        place, real = jnp.where(mine, pixel, 0).sum(1), mine.any(1)
        return Chosen(bundle, jnp.where(real, place, place[0]), real)


def by_bundle(lists: ListPlan, image: Bool[Array, "rows columns"]) -> Bool[Array, "bundles 64"]:
    """The pixels of a band, at least as large as its image, bundle by bundle; the opposite of `ListPlan.as_image`."""
    rows, columns = lists.bundles
    image = jnp.pad(image, ((0, max(rows * BUNDLE - image.shape[0], 0)), (0, max(columns * BUNDLE - image.shape[1], 0))))
    parts = image[: rows * BUNDLE, : columns * BUNDLE].reshape(lists.tile_rows, 2, BUNDLE, lists.tile_columns, 2, BUNDLE)
    return parts.transpose(0, 3, 1, 4, 2, 5).reshape(lists.num_bundles, PIXELS)


def queued(wanted: Bool[Array, "bundles 64"]) -> tuple[Queue, Queue]:
    """What is cast as scattered rays, and what as whole bundles."""
    count = wanted.sum(1)

    def queue(some: Bool[Array, " bundles"], rays: int) -> Queue:
        (bundle,) = jnp.nonzero(some, size=some.shape[0], fill_value=0)
        return Queue(wanted, bundle.astype(jnp.int32), some.sum(dtype=jnp.int32), jnp.int32(0), rays)

    return queue((count > 0) & (count <= SCATTERED), SCATTERED), queue(count > SCATTERED, PIXELS)


def every_bundle(grid: Grid, camera: Camera, chosen: None = None) -> RayPackets:
    """The rays of all pixels of a band, or of a shard of it: of every bundle, through the middles of its 8 x 8.

    Differentiable by the camera.
    """
    return RayPackets(*grid.rays(camera, jnp.arange(grid.row.shape[0], dtype=jnp.int32)))


def packets_of(grid: Grid, camera: Camera, chosen: Chosen) -> RayPackets:
    """Their rays: whole bundles as tensor products; of scattered ones, those that are room go where the first one does.

    Differentiable by the camera.
    """
    real = chosen.real.any(0)
    if chosen.place.shape[0] == PIXELS:
        return RayPackets(*grid.rays(camera, chosen.bundle), chosen.bundle, real)
    dtype = grid.half_steps.dtype
    u = camera.column((grid.column[chosen.bundle] + chosen.place % BUNDLE).astype(dtype) + 0.5)
    v = camera.row((grid.row[chosen.bundle] + chosen.place // BUNDLE).astype(dtype) + 0.5)
    return RayPackets(u, v, chosen.bundle, real, scattered=True)
