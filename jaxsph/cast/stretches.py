"""Stretches of the stacks: which slabs are marched together, and where their samples are.

Flow: worklist -> [stretches] -> points, adjoint.

The slabs of all bundles, stacked front to back (`access.stacks`), are taken `held` at a time. Within such a stretch they are
marched in order of how many particles they have, such that those of a chunk take equally long. Slabs whose sums come from a
lattice have chunks of their own, filled up with dummies: mixed ones would take as long as all that they are mixed of.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxsph.access.grid import Grid
from jaxsph.access.stacks import Stacks, stack
from jaxsph.control.spacing import WIDEST
from jaxsph.control.worklist import COARSEST, Worklist
from jaxsph.numerics.checks import require_sizes

BLOCK = 16  # particles unrolled in the inner loop
KINDS = WIDEST + 3  # of slabs, see `kind_of`


@dataclasses.dataclass(frozen=True)
class CastPlan:
    """Static sizes of the march.

    Attributes:
        chunk: slabs marched together.
        slab_samples: samples that share a window of particles.
        held: slabs whose light is held before it is put into the rays' state; a multiple of `chunk`.
    """

    chunk: int
    slab_samples: int
    held: int

    def __post_init__(self) -> None:
        require_sizes(self)
        if self.held % self.chunk:
            raise ValueError(f"`held` must be a multiple of `chunk`, got {self.held} and {self.chunk}")


@dataclasses.dataclass(frozen=True)
class Stretch:
    """Some slabs of the stacks.

    Attributes:
        items: `slab * bundles + bundle` of each, in the order of the stacks.
        marched: the same, in the order in which they are marched, and dummies such that chunks hold slabs of one kind.
        held_at: where in that order each of `items` is.
        first, number: where the stretch begins in the stacks, and how many of its slabs are real.
        chunks: how many chunks are marched.
    """

    items: Int[Array, " held"]
    marched: Int[Array, " places"]
    held_at: Int[Array, " held"]
    first: Int[Array, ""]
    number: Int[Array, ""]
    chunks: Int[Array, ""]


@dataclasses.dataclass(frozen=True)
class Stretches:
    """All stretches of a band; a slab past the last of `work` is a dummy.

    Attributes:
        half_steps: depths of samples and their borders, see `Grid`, with room for the dummy slab: what lies past the last
            sample has length zero.
        order: the items of `stacks`, and dummies up to a whole stretch.
    """

    work: Worklist
    half_steps: Float[Array, " two_samples_and_more"]
    stacks: Stacks
    order: Int[Array, " items"]
    plan: CastPlan

    @property
    def num_bundles(self) -> int:
        """How many bundles the band has."""
        return self.work.count.shape[1]

    @property
    def places(self) -> int:
        """How many slabs and dummies the chunks of a stretch can hold."""
        return self.plan.held + (0 if self.work.interpolated is None else (KINDS - 1) * self.plan.chunk)

    @property
    def number(self) -> Array:
        """How many stretches there are."""
        return (self.stacks.start[-1] + self.plan.held - 1) // self.plan.held

    def stretch(self, nth: Array) -> Stretch:
        """The slabs of one stretch, in the order of the stacks and by fullness."""
        first = nth * self.plan.held
        items = lax.dynamic_slice(self.order, (first,), (self.plan.held,))
        dummy = self.work.count.size
        inside, real = jnp.minimum(items, dummy - 1), items < dummy
        kind, number = self._kind(inside), real.sum(dtype=jnp.int32)
        order = _by_fullness(self.work.count.ravel()[inside], kind, real)
        place, end = self._places(kind, real, number)
        held_at = jnp.zeros(self.plan.held, jnp.int32).at[order].set(place)
        marched = jnp.full(self.places, dummy, jnp.int32).at[place].set(items[order])
        return Stretch(items, marched, held_at, first, number, (end + self.plan.chunk - 1) // self.plan.chunk)

    def _kind(self, items: Int[Array, " held"]) -> Int[Array, " held"] | None:
        """Of what kind items are; None where all are marched at all rays."""
        if self.work.interpolated is None:
            return None
        return kind_of(self.work).ravel()[items]

    def _places(self, kind: Int[Array, " held"] | None, real: Bool[Array, " held"], number: Array) -> tuple[Array, Array]:
        """Where the slabs are marched, kind after kind, each from the beginning of a chunk on; and where that ends."""
        each = jnp.arange(self.plan.held, dtype=jnp.int32)
        if kind is None:
            return each, number
        place, past, skipped = each, jnp.int32(0), jnp.int32(0)
        for k in range(KINDS - 1):
            some = (real & (kind == k)).sum(dtype=jnp.int32)
            past, gap = past + some, -some % self.plan.chunk
            place, skipped = jnp.where(each >= past, place + gap, place), skipped + gap
        return place, number + skipped

    def chunk(self, stretch: Stretch, nth: Array) -> tuple[Array, Array]:
        """Items of a chunk of a stretch, and where they begin in it."""
        begin = nth * self.plan.chunk
        return lax.dynamic_slice(stretch.marched, (begin,), (self.plan.chunk,)), begin

    def item(self, at: Int[Array, " some"]) -> tuple[Worklist, Array, Array]:
        """What is to be done for items, their slabs and their bundles; a dummy has no particles."""
        slab, bundle = at // self.num_bundles, at % self.num_bundles
        inside = jnp.minimum(slab, self.work.count.shape[0] - 1)
        item = jax.tree.map(lambda leaf: leaf[..., inside, bundle], self.work)
        real = inside == slab
        length, count = (jnp.where(real, value, 0) for value in (item.length, item.count))
        return dataclasses.replace(item, length=length, count=count), slab, bundle

    def depths(self, item: Worklist, slab: Int[Array, " some"], half_steps: Array | None = None) -> tuple[Array, Array]:
        """View depths of items' samples, and of the borders between them, read from `half_steps` if given.

        A coarse sample sits at the sample-space middle of its window. A super-pixel is a single sample as long as the cell.
        """
        half_steps = self.half_steps if half_steps is None else half_steps
        step, slab_samples = (1 << item.level)[:, None], self.plan.slab_samples
        first = (slab * slab_samples)[:, None]
        border = first + step * jnp.arange(slab_samples + 1, dtype=jnp.int32)
        middle = 2 * border[:, :-1] + step
        if item.painted is not None:
            border = jnp.where(item.painted[:, None], jnp.minimum(border, first + (1 << COARSEST)), border)
        last = half_steps.shape[0] - 1
        return half_steps[jnp.minimum(middle, last)], half_steps[jnp.minimum(2 * border, last)]


def stretches_of(grid: Grid, work: Worklist, plan: CastPlan) -> Stretches:
    """The stretches that `work` is marched in."""
    slabs, num_bundles = work.count.shape
    stacks = stack(work.filled)
    order = jnp.pad(stacks.item, (0, plan.held), constant_values=slabs * num_bundles)
    return Stretches(work, with_room(grid.half_steps, grid.samples, slabs, plan), stacks, order, plan)


def with_room(half_steps: Array, samples: int, slabs: int, plan: CastPlan) -> Array:
    """Half steps for a slab past the last."""
    return jnp.pad(half_steps, (0, 2 * ((slabs + 1) * plan.slab_samples - samples)), mode="edge")


def kind_of(work: Worklist) -> Int[Array, "*any"]:
    """How the sums of items are found: from particles at all rays (0), at some (1), or from the lattice (2 + level)."""
    assert work.interpolated is not None
    assert work.sparse is not None
    return jnp.where(work.interpolated, 2 + work.level, work.sparse.astype(jnp.int32))


def _by_fullness(count: Int[Array, " held"], kind: Int[Array, " held"] | None, real: Bool[Array, " held"]) -> Int[Array, " held"]:
    """Slabs in order of kind if any, then of how many blocks of particles they have; those that are not `real` last."""
    bits = (count.shape[0] - 1).bit_length()
    bits_of_rank = 32 - bits - KINDS.bit_length()
    most = (1 << bits_of_rank) - 1
    rank = (most - jnp.minimum((count + BLOCK - 1) // BLOCK, most)).astype(jnp.uint32)
    first = jnp.where(real, 0 if kind is None else kind, KINDS).astype(jnp.uint32)
    key = lax.sort((first << (bits_of_rank + bits)) | (rank << bits) | lax.iota(jnp.uint32, count.shape[0]))
    return (key & jnp.uint32((1 << bits) - 1)).astype(jnp.int32)
