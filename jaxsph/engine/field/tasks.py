"""Packets of rays, what of them is to be marched, and the slabs of samples that are marched together.

Flow: screen -> [tasks: RayPackets]; slab windows -> (control) -> [tasks: SlabSchedule] -> cast -> [tasks: SlabTask] -> media.

At full rate the schedule has an entry for every slab that a medium can touch. Error control replaces entries by wider spaced
ones, and by painted ones, which need no particles. One cast serves both, so that where control asks for full rate the image is
the reference image bit for bit.

Between what is painted and how that is marched there is one seam, `Painting`. Whoever analyses errors, by whatever bounds, says
which slabs are painted and with what, and answers for how wrong that is; it knows nothing of entries. `painted_over` makes
entries of it, and batches and march know nothing of errors. That neighbours of one paint are one entry changes nothing: light
falls off by the product of what they let through, and what they emit telescopes (`control.errors`).
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxsph.engine.access.grid import SlabWindows
from jaxsph.engine.access.lists import BUNDLE
from jaxsph.engine.field.sums import position
from jaxsph.numerics.trees import tree

Sums = TypeVar("Sums")
FEWEST = 256  # slabs of a task that are worth more than one loop: each is compiled
SUBSAMPLE = 0, 2, 5, 7  # of the rays along either side of a bundle, those that a subsampled slab is marched at
MAX_SPACING_LEVEL = 2  # level of the most widely spaced samples of interpolated slabs
DENSE, SUBSAMPLED, INTERPOLATED = 0, 1, 2  # methods, see `media.particles`; to the last, the level is added
NUM_METHODS = INTERPOLATED + MAX_SPACING_LEVEL + 1
PAINTED = 1  # beside `DENSE`, where slabs can be painted


@tree(static=("scattered",))
class RayPackets:
    """Rays in tensor products: of a packet, through all pairs of a column and a row; or one by one.

    Attributes:
        u, v: ray coordinates of columns and rows: a ray's view coordinates at depth 1 (perspective) or any depth.
        list_id: bundle whose list of particles a packet reads, and whose schedule it keeps; None where packet k reads list k.
        real: packets that are cast, others are room; None where all are.
        filled: slabs that are certain to be of use to a packet, of those that its bundle has; None where all may be.
        scattered: whether ray k goes through (u[k], v[k]), such that there are as many "rows" as "columns", and rays.
    """

    u: Float[Array, "columns packets"]
    v: Float[Array, "rows packets"]
    list_id: Int[Array, " packets"] | None = None
    real: Bool[Array, " packets"] | None = None
    scattered: bool = False
    filled: Bool[Array, "slabs packets"] | None = None

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of a packet; scattered rays are one row."""
        return 1 if self.scattered else self.v.shape[0], self.u.shape[0]

    @property
    def num_rays(self) -> int:
        """Rays of a packet."""
        rows, columns = self.shape
        return rows * columns

    def reading(self, of_bundles: Array) -> Array:
        """Of an array whose last axis is bundles, those that packets read."""
        return of_bundles if self.list_id is None else of_bundles[..., self.list_id]

    def schedule_of(self, of_bundles: SlabSchedule) -> SlabSchedule:
        """That of packets, of the one of bundles: packets that are room have nothing to march."""
        schedule = jax.tree.map(self.reading, of_bundles)
        if self.filled is not None:
            filled = schedule.filled & self.filled
            schedule = dataclasses.replace(schedule, filled=filled, count=jnp.where(self.filled, schedule.count, 0))
        if self.real is None:
            return schedule
        return dataclasses.replace(schedule, filled=schedule.filled & self.real)

    def sum_per_pixel(self, of_packets: Float[Array, " packets"], bundles: int, pixels: int) -> Float[Array, " bundles"]:
        """Of what a ray of each packet takes, what rays take in all, a pixel of each bundle."""
        share = of_packets * (self.num_rays / pixels)
        share = share if self.real is None else jnp.where(self.real, share, 0)
        return share if self.list_id is None else jnp.zeros(bundles, share.dtype).at[self.list_id].add(share)


class Part(NamedTuple):
    """What counts of what each sample stands for, as shares of its length.

    Attributes:
        begin, end: where it begins and ends.
        share: how much that is in all; less than what lies between where it has gaps.
    """

    begin: Float[Array, "tasks samples rays"]
    end: Float[Array, "tasks samples rays"]
    share: Float[Array, "tasks samples rays"]


@tree(static=("perspective", "scattered", "between"))
class SlabTask:
    """Slabs that are marched together, and where their samples are.

    Attributes:
        entry: what the schedule says of each.
        slab, bundle: which slabs they are, and whose lists they read.
        u, v: ray coordinates of columns and rows, see `RayPackets`.
        depth: view depths of the samples, in the middle between borders.
        border: view depths of the borders of what samples stand for.
        perspective: whether rays spread with depth.
        scattered: whether u and v are of rays, see `RayPackets`.
        between: whether means over what samples stand for are asked for, from border to border, as good as media know them.
        part: what part of each counts; None where all of it does. Media that look at it say `in_parts`.
    """

    entry: SlabSchedule
    slab: Int[Array, " tasks"]
    bundle: Int[Array, " tasks"]
    u: Float[Array, "tasks columns"]
    v: Float[Array, "tasks rows"]
    depth: Float[Array, "tasks samples"]
    border: Float[Array, "tasks samples_and_one"]
    perspective: bool
    scattered: bool = False
    between: bool = False
    part: Part | None = None

    @property
    def shape(self) -> tuple[int, int, int]:
        """Tasks, samples of each, and rays."""
        rows = 1 if self.scattered else self.v.shape[1]
        return self.depth.shape[0], self.depth.shape[1], rows * self.u.shape[1]

    def part_ends(self) -> tuple[Float[Array, "tasks rays"], Float[Array, "tasks rays"]]:
        """Depths at which, of each ray, the first part that counts begins and the last one ends: of none, in wrong order."""
        assert self.part is not None
        begin, length = self.border[:, :-1, None], (self.border[:, 1:] - self.border[:, :-1])[..., None]
        counts, far = self.part.share > 0, jnp.finfo(self.depth.dtype).max
        first, last = (begin + length * share for share in (self.part.begin, self.part.end))
        return jnp.where(counts, first, far).min(1), jnp.where(counts, last, -far).max(1)

    def on_borders(self) -> SlabTask:
        """The same with samples on the borders of what samples stand for, one more."""
        return dataclasses.replace(self, depth=self.border, between=False, part=None)

    def stretched(self, factor: Float[Array, ""]) -> SlabTask:
        """With `factor` times the coordinates of rays."""
        return dataclasses.replace(self, u=self.u * factor, v=self.v * factor)

    def positions(self) -> tuple[Float[Array, "tasks samples rays"], ...]:
        """View coordinates x, y, z of all samples."""
        lateral_scale = self.depth if self.perspective else jnp.ones_like(self.depth)
        z = jnp.broadcast_to(self.depth[..., None], self.shape)
        if self.scattered:
            return self.u[:, None] * lateral_scale[..., None], self.v[:, None] * lateral_scale[..., None], z
        x = (self.u[:, None, None, :] * lateral_scale[..., None, None]) * jnp.ones_like(self.v)[:, None, :, None]
        y = (self.v[:, None, :, None] * lateral_scale[..., None, None]) * jnp.ones_like(self.u)[:, None, None, :]
        return x.reshape(self.shape), y.reshape(self.shape), z

    def ray_coordinates(self) -> tuple[Float[Array, "tasks rays"], Float[Array, "tasks rays"]]:
        """U and v of each ray."""
        if self.scattered:
            return self.u, self.v
        both = self.u.shape[0], self.v.shape[1], self.u.shape[1]
        u, v = jnp.broadcast_to(self.u[:, None, :], both), jnp.broadcast_to(self.v[:, :, None], both)
        return u.reshape(both[0], -1), v.reshape(both[0], -1)

    def path(self) -> Float[Array, "tasks samples rays"]:
        """Path lengths between borders; of one ray for all where rays do not spread."""
        step = (self.border[:, 1:] - self.border[:, :-1])[:, :, None]
        if not self.perspective:
            return step
        if self.scattered:
            return step * jnp.sqrt(1 + self.u**2 + self.v**2)[:, None]
        slant = jnp.sqrt(1 + self.u[:, None, :] ** 2 + self.v[:, :, None] ** 2)
        return step * slant.reshape(-1, 1, self.u.shape[1] * self.v.shape[1])

    def turns(self, block: int, parts: tuple[int, ...]) -> Iterator[tuple[SlabTask, Int[Array, ""], Int[Array, ""]]]:
        """All blocks of `block` spheres of all slabs, in order for each slab; of `parts` 4 is the first quarter of the slabs.

        The slabs come in order of how many spheres their windows hold. Where those are clustered the first may hold a thousand
        times as many as the last, and a loop over the blocks of all would mostly add nothing: all slabs are looped over until
        only a part of them has anything left, then that part alone, and so on. Out of order it takes longer.

        Returns:
            The first so many slabs, the first of their blocks and the one past the last, turn by turn.
        """
        blocks = (self.entry.length.sum(0, dtype=jnp.int32) + block - 1) // block
        tasks = blocks.shape[0]
        numbers = [tasks, *(tasks // part for part in parts if tasks >= FEWEST), 0]
        begin = jnp.int32(0)
        for number, fewer in itertools.pairwise(numbers):
            end = jnp.maximum(blocks[fewer:number].max(), begin)
            yield self.at(slice(number)), begin, end
            begin = end

    def over_blocks(self, block: int, parts: tuple[int, ...], add: Callable[[SlabTask, Array, Sums], Sums], sums: Sums) -> Sums:
        """Sums with all blocks of all slabs, see `turns`: `add(some, nth, sums)`, of some slabs and their sums."""
        for some, begin, end in self.turns(block, parts):
            number = some.depth.shape[0]
            own = jax.tree.map(lambda value, number=number: value[:number], sums)
            own = lax.fori_loop(begin, end, functools.partial(add, some), own)
            sums = jax.tree.map(lambda new, old, number=number: jnp.concatenate([new, old[number:]]), own, sums)
        return sums

    def nth_block(self, block: int, nth: Int[Array, ""]) -> tuple[Array, Array, Int[Array, " block"]]:
        """Windows of the slabs, and which of their particles are the nth `block`: for `particle_at`."""
        return self.entry.begin[..., None], self.entry.length[..., None], nth * block + jnp.arange(block, dtype=jnp.int32)

    @property
    def references(self) -> tuple[Float[Array, "tasks one"], ...]:
        """What the quantities of a block's particles are held against."""
        return tuple(one[:, None] for one in self.entry.references)

    def at(self, chosen: Any) -> SlabTask:
        """Those slabs of it: numbers, or a slice."""
        entry = jax.tree.map(lambda leaf: leaf[..., chosen], self.entry)
        names = "slab", "bundle", "u", "v", "depth", "border"
        part = jax.tree.map(lambda leaf: leaf[chosen], self.part)
        return dataclasses.replace(self, entry=entry, part=part, **{name: getattr(self, name)[chosen] for name in names})

    def refined(self, level: Array, nth: Array) -> SlabTask:
        """Of slabs cut into `2 ** level` of as many samples each, evenly spaced in what a sample stood for, the `nth`."""
        samples, dtype = self.depth.shape[1], self.depth.dtype
        half = 2 * samples * nth + jnp.arange(2 * samples + 1, dtype=jnp.int32)  # of borders and middles, in half samples
        place = half.astype(dtype) / (2 << level).astype(dtype)
        sample = jnp.minimum(half >> (level + 1), samples - 1)
        begin, end = self.border[:, sample], self.border[:, sample + 1]
        depth = begin + (place - sample.astype(dtype)) * (end - begin)
        return dataclasses.replace(self, depth=depth[:, 1::2], border=depth[:, ::2])


@dataclasses.dataclass(frozen=True)
class Spacing:
    """How far apart nodes are, static.

    Attributes:
        pixels: across, a divisor of `BUNDLE`.
        samples: fine samples in depth, a divisor of the samples of a slab.
    """

    pixels: int
    samples: int

    @property
    def across(self) -> int:
        """Nodes of a bundle, down and across."""
        return BUNDLE // self.pixels


FINEST = Spacing(4, 2)


@tree()
class Painting:
    """Which slabs are painted, each of one colour and extinction for all rays; and with what: red, green, blue and extinction."""

    here: Bool[Array, "slabs bundles"]
    paint: Float[Array, "4 slabs bundles"]


@tree()
class SlabSchedule:
    """Entries by the slab that they begin at; a slab that begins none is not `filled`.

    Attributes:
        filled: whether an entry begins here.
        level: its samples are `2**level` fine samples apart.
        begin, length: windows of the bundle's list, for each class of supports.
        count: sum of `length` over classes; 0 for painted and interpolated slabs.
        references: what the entry's sums are taken relative to, each quantity of a particle near by: so that their rounding is
            a share of how much quantities differ, and a constant is rendered as that constant.
        span: slabs that a painted entry is long, 0 of one that is marched; None where nothing can be painted.
        paint: red, green, blue and extinction of painted entries.
        method: how sums are found (`DENSE`, ...); None where all are found from all particles at all rays.
    """

    filled: Bool[Array, "slabs bundles"]
    level: Int[Array, "slabs bundles"]
    begin: Int[Array, "classes slabs bundles"]
    length: Int[Array, "classes slabs bundles"]
    count: Int[Array, "slabs bundles"]
    references: tuple[Float[Array, "slabs bundles"], ...]
    span: Int[Array, "slabs bundles"] | None = None
    paint: Float[Array, "4 slabs bundles"] | None = None
    method: Int[Array, "slabs bundles"] | None = None

    @property
    def num_methods(self) -> int:
        """How many kinds of chunks there are."""
        return 2 if self.span is not None else 1 if self.method is None else NUM_METHODS


def full_rate(windows: SlabWindows, references: tuple[Float[Array, "slabs bundles"], ...]) -> SlabSchedule:
    """Every filled slab at level 0: the reference image."""
    filled = windows.count > 0
    level = jnp.zeros_like(windows.count)
    return SlabSchedule(filled, level, windows.begin, windows.length, windows.count, references)


def clipped(schedule: SlabSchedule, meets: Bool[Array, "slabs bundles"] | None) -> SlabSchedule:
    """With only those slabs at level 0 that a clip may have anything in common with; None is everywhere.

    Wider spaced samples are of cells that a clip holds all of.
    """
    if meets is None:
        return schedule
    meets = jnp.pad(meets, ((0, schedule.level.shape[0] - meets.shape[0]), (0, 0))) | (schedule.level > 0)
    length, count = (jnp.where(meets, value, 0) for value in (schedule.length, schedule.count))
    return dataclasses.replace(schedule, filled=schedule.filled & meets, length=length, count=count)


def painted_over(schedule: SlabSchedule, painting: Painting) -> SlabSchedule:
    """The schedule with paint in place of entries of single slabs; neighbours that are painted alike are one entry."""
    room = schedule.count.shape[0] - painting.here.shape[0]
    here = schedule.filled & jnp.pad(painting.here, ((0, room), (0, 0)))
    paint = jnp.pad(painting.paint, ((0, 0), (0, room), (0, 0)))
    alike = here[1:] & here[:-1] & (paint[:, 1:] == paint[:, :-1]).all(0)
    follows, goes_on = jnp.pad(alike, ((1, 0), (0, 0))), jnp.pad(alike, ((0, 1), (0, 0)))

    def extend(behind: Array, slab: tuple[Array, Array]) -> tuple[Array, Array]:
        length = jnp.where(slab[0], 1 + jnp.where(slab[1], behind, 0), 0)
        return length, length

    _, length = lax.scan(extend, jnp.zeros_like(schedule.count[0]), (here, goes_on), reverse=True)
    begin, windows, count = (jnp.where(here, 0, value) for value in (schedule.begin, schedule.length, schedule.count))
    span = jnp.where(follows, 0, length)
    filled = (schedule.filled & ~here) | (span > 0)
    return dataclasses.replace(schedule, filled=filled, begin=begin, length=windows, count=count, span=span, paint=paint)


def reference_quantities(
    windows: SlabWindows, rank: Int[Array, " pairs"], quantity: Float[Array, " particles"]
) -> Float[Array, "slabs bundles"]:
    """The quantity of the particle in the middle of each slab's window; 0 where there is none."""
    place = position(windows.count // 2, windows.begin, windows.length)
    return jnp.where(windows.count > 0, quantity[rank[jnp.clip(place, 0, rank.shape[0] - 1)]], 0)


def evaluations(schedule: SlabSchedule, samples: int, slab_samples: int) -> Float[Array, " bundles"]:
    """Kernel evaluations that a schedule takes for each ray of a bundle, if all are marched."""
    return evaluations_of_slabs(schedule, samples, slab_samples).sum(0)


def evaluations_of_slabs(schedule: SlabSchedule, samples: int, slab_samples: int) -> Float[Array, "slabs bundles"]:
    """The same slab by slab."""
    beyond = (jnp.arange(schedule.count.shape[0]) + 1) * slab_samples - samples
    in_slab = slab_samples - jnp.maximum(beyond, 0)[:, None] * (schedule.level == 0)
    rays = 1 if schedule.method is None else jnp.where(schedule.method == SUBSAMPLED, len(SUBSAMPLE) ** 2 / BUNDLE**2, 1)
    return schedule.count.astype(jnp.float32) * rays * in_slab.astype(jnp.float32)
