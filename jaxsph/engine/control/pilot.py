r"""The pilot estimator: which slabs are interpolated, from the lattice or between some of their rays, and how widely they sample.

Flow: lattice -> interpolation_error -> [pilot] -> schedule -> cast -> image.

Errors are treated as noise whose variances add up along a bundle, and `DEVIATIONS` standard deviations are the estimate: not a
bound. The budget goes to interpolation first (`interpolation_error`): wherever it is taken, the price of an evaluation saved is
the same. What that leaves is spent on wider spaced samples of interpolated slabs: where light bends little along the rays, fewer
tell as much.

Samples are the middles of what they stand for. With g the light that a unit of depth sends to the eye, a sample that stands
for w fine ones is off by $(w^2 - 1) g'' / 24$ from their mean. The nodes of the lattice know g, and so its second differences
along their rays, without any sample more. Rays between nodes may meet a kink that those miss: `DEVIATION_PER_BEND` times the
nodes' root mean square is one deviation.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxsph.engine.access.grid import Grid, shard_of_grid, unshard
from jaxsph.engine.access.lists import BUNDLE, ListPlan
from jaxsph.engine.control.decide import Decided, Limits, among, at_full_rate, overlap
from jaxsph.engine.control.interpolation_error import MIN_DEVIATION, InterpolationError, interpolation_error
from jaxsph.engine.field.lattice import Lattice, region_of, sum_at_nodes
from jaxsph.engine.field.tasks import (
    DENSE,
    FINEST,
    INTERPOLATED,
    MAX_SPACING_LEVEL,
    SUBSAMPLE,
    SUBSAMPLED,
    SlabSchedule,
    Spacing,
    clipped,
    full_rate,
)
from jaxsph.engine.media.shown import Shown
from jaxsph.engine.runtime.clock import Clock
from jaxsph.engine.runtime.programs import stage
from jaxsph.engine.runtime.tuning import Tuning
from jaxsph.model.camera.camera import Camera
from jaxsph.model.transfer.function import TransferFunction
from jaxsph.numerics.compiled import extent

DEVIATIONS = 6.0  # standard deviations that pixels are taken to stay within
RESOLVED = 1.5  # node spacings that a support must reach: some node is then well inside it, and its fourth differences show it
MIN_RESOLVED_SHARE = 0.25  # of a band's work, that the lattice must resolve: sampling it costs up to a tenth
HALVINGS = 10  # of the range of prices in octaves
DEVIATION_PER_BEND = 3.0  # times the root mean square bend over the nodes that rays are taken to bend by, as one deviation


@dataclasses.dataclass(frozen=True)
class PilotPlan:
    """Static choices of the pilot estimator.

    Attributes:
        nodes: how far apart they are.
        room: rows and columns of bundles that have nodes; all of a band where there is None.
    """

    nodes: Spacing = FINEST
    room: tuple[int, int] | None = None

    def decide(
        self, clock: Clock, grid: Grid, shown: Shown, limits: Limits, shards: int, lists: Any, kernel: str, **sizes: Any
    ) -> tuple[list[Decided], Lattice]:
        """What is to be marched of a band, one decision for all shards; and the lattice of nodes."""
        inputs = [(grid, shown.camera, shown.transfer, nth) for nth in clock.shards(shards)]
        static = {"shards": shards, "lists": lists, "control": self, "kernel": kernel, **sizes}
        lattices = clock.all_shards(clock.each("adapt", sum_shard, inputs, **static))
        lattice = clock.one("adapt", add_lattices, (tuple(lattices),), tuning=sizes["tuning"]) if shards > 1 else lattices[0]
        # slab by slab what is at hand stays in the cache: one program is faster than shards side by side
        return [clock.one("adapt", decide_by_pilot, (grid, shown, limits, lattice), **sizes)], lattice


@stage("shards", "lists", "slab_samples", "control", "kernel")
def sum_shard(
    grid: Grid,
    camera: Camera,
    transfer: TransferFunction,
    nth: Int[Array, ""],
    *,
    shards: int,
    lists: ListPlan,
    slab_samples: int,
    control: PilotPlan,
    kernel: str,
    tuning: Tuning,
) -> Lattice:
    """The lattice of the `nth` of `shards` of a band, for the pilot estimator."""
    grid, camera, transfer = jax.tree.map(lax.stop_gradient, (grid, camera, transfer))
    room = control.room or lists.bundles
    resolved = _resolved(grid, camera, slab_samples, control.nodes)  # whether of enough of the work to be sampled at all
    surplus = jnp.where(resolved, 1 - MIN_RESOLVED_SHARE, -MIN_RESOLVED_SHARE)
    wanted = (surplus * grid.windows.count).sum() > 0
    seen = jnp.argmax(grid.ordered.live)
    references = among(transfer, [quantity[seen] for quantity in grid.ordered.quantities], grid.half_steps.dtype)
    region = region_of(grid, *room, control.nodes)
    of_shard = shard_of_grid(grid, nth, shards)
    return sum_at_nodes(of_shard, camera, kernel, slab_samples, region, references, tuning.cells_of_nodes, wanted)


@stage(quickly=True)
def add_lattices(lattices: tuple[Lattice, ...], *, tuning: Tuning) -> Lattice:
    """That of a band, of those of its shards: the nodes of other shards' bundles are zero."""
    weight, weighted = jax.tree.map(lambda *values: sum(values[1:], values[0]), *((one.weight, one.weighted) for one in lattices))
    evaluations = unshard(tuple(one.evaluations for one in lattices))
    return dataclasses.replace(lattices[0], weight=weight, weighted=weighted, evaluations=evaluations)


@stage("slab_samples", quickly=True)
def decide_by_pilot(grid: Grid, shown: Shown, limits: Limits, lattice: Lattice, *, slab_samples: int, tuning: Tuning) -> Decided:
    """How each slab of a band is sampled, by what the lattice tells. Decisions carry no gradient.

    Slabs that a face of a clip may cross are at full rate.
    """
    grid, shown, limits = jax.tree.map(lax.stop_gradient, (grid, shown, limits))
    lies = overlap(grid, shown.camera, shown.within, slab_samples)
    schedule, full = at_full_rate(grid, shown.transfer, slab_samples, lies)
    camera, transfer, *_ = shown.of_type(grid.half_steps.dtype)
    assert transfer is not None  # error control is of particles
    found = interpolation_error(grid, lattice, camera, transfer, slab_samples)
    able = None if lies is None else lies.holds
    schedule, bound = pilot(grid, lattice, found, camera, schedule.references, limits.tolerance, slab_samples, able)
    return Decided(clipped(schedule, None if lies is None else lies.meets), bound, full)


def pilot(
    grid: Grid,
    lattice: Lattice,
    found: InterpolationError,
    camera: Camera,
    references: tuple[Float[Array, "slabs bundles"], ...],
    tolerance: Float[Array, ""],
    slab_samples: int,
    able: Bool[Array, "slabs bundles"] | None = None,
) -> tuple[SlabSchedule, Float[Array, " bundles"]]:
    """Choose the slabs that are interpolated: as many evaluations saved as the tolerance allows.

    A slab is interpolated from the lattice, marched at `SUBSAMPLE` of its rays, or marched at all. At all are those whose
    stencils leave the band's lattice, that may hold empty space, or that hold supports too small for the lattice; and those that
    are not `able`, where that is given.

    Returns:
        The work, and the estimated error of the pixels of each bundle: `DEVIATIONS` standard deviations, 0 where all is marched.
    """
    count = grid.windows.count
    allowed = (count > 0) & _resolved(grid, camera, slab_samples, lattice.region.spacing)
    allowed = allowed if able is None else allowed & able
    budget = jnp.broadcast_to((tolerance / DEVIATIONS) ** 2, count.shape[1:])
    # a slab is first marched at fewer rays, then at none: the second step has most of the variance and saves least, so its price
    # is the higher one and it is never taken without the first
    steps = jnp.concatenate([found.subsampled_share * found.variance, (1 - found.subsampled_share) * found.variance])
    gain, rays = jnp.maximum(count, 1).astype(budget.dtype), len(SUBSAMPLE) ** 2 / BUNDLE**2
    gains = jnp.concatenate([(1 - rays) * gain, rays * gain])
    chosen, total = select_under_budget(steps, gains, jnp.tile(allowed, (2, 1)), budget)
    fewer, taken = chosen[: count.shape[0]], chosen[count.shape[0] :]
    level, more = choose_spacing(taken, found.bend, budget - total, lattice.region.spacing.samples)
    estimate = jnp.where(chosen.any(0), jnp.minimum(DEVIATIONS * jnp.sqrt(total + more), tolerance), 0)
    both = zip(lattice.references, references, strict=True)
    schedule = full_rate(grid.windows, tuple(jnp.where(taken, of_nodes, own) for of_nodes, own in both))
    begins = jnp.arange(count.shape[0], dtype=jnp.int32)[:, None] & ((1 << level) - 1) == 0
    length, number = (jnp.where(taken, 0, value) for value in (schedule.length, schedule.count))
    method = jnp.where(taken, INTERPOLATED + level, jnp.where(fewer, SUBSAMPLED, DENSE))
    filled = schedule.filled & begins
    schedule = dataclasses.replace(schedule, filled=filled, level=level, length=length, count=number, method=method)
    return schedule, estimate


def _resolved(grid: Grid, camera: Camera, slab_samples: int, nodes: Spacing) -> Bool[Array, "slabs bundles"]:
    """Slabs where all classes of supports reach several nodes."""
    slabs = grid.windows.count.shape[0]
    borders = grid.borders(slabs * slab_samples)
    back = borders[slab_samples::slab_samples]
    pixel = 2 * camera.half_height / camera.height * (back if camera.is_perspective else jnp.ones_like(back))
    deep = back - borders[slab_samples - nodes.samples :: slab_samples][: back.shape[0]]
    spacing = jnp.maximum(nodes.pixels * pixel, deep)
    reach, live = grid.ordered.reach, grid.ordered.live
    classes = grid.windows.length.shape[0]
    octaves = jnp.exp2(-1.0 - jnp.arange(classes, dtype=reach.dtype))
    least, largest = extent(reach, live)
    smallest = jnp.maximum(largest * octaves, least).at[-1].set(least)
    small = smallest[:, None] < RESOLVED * spacing
    return ~((grid.windows.length > 0) & small[..., None]).any(0)


def select_under_budget(
    variance: Float[Array, "choices bundles"],
    gain: Float[Array, "choices bundles"],
    allowed: Bool[Array, "choices bundles"],
    budget: Float[Array, " bundles"],
) -> tuple[Bool[Array, "choices bundles"], Float[Array, " bundles"]]:
    """Take choices of the least variance a gain, as many as keep the budget: the highest such price is sought by bisection.

    Args:
        variance: of every choice, positive.
        gain: by every choice, positive.

    Returns:
        What is taken, and the sum of its variances, at most the budget.
    """
    price = jnp.where(allowed & (variance <= budget), jnp.log2(variance) - jnp.log2(gain), jnp.inf)
    least = price.min(0)
    span = jnp.where(price < jnp.inf, price, -jnp.inf).max(0) - least
    shares = jnp.asarray([0, 2, *0.5 ** np.arange(1, HALVINGS + 1)], price.dtype)  # tries the least price, any, then halves

    def attempt(nth: Array, found: tuple[Array, Array]) -> tuple[Array, Array]:
        highest, total = found
        tried = highest + span * shares[nth]  # NaN where nothing is allowed: no price is below that
        spent = jnp.where(price <= tried, variance, 0).sum(0)
        keeps = spent <= budget
        return jnp.where(keeps, tried, highest), jnp.where(keeps, spent, total)

    # the least price alone may be too much, and then all are
    highest, total = lax.fori_loop(0, HALVINGS + 2, attempt, (least, jnp.full_like(budget, -1)))
    return (price <= highest) & (total >= 0), jnp.maximum(total, 0)


def choose_spacing(
    taken: Bool[Array, "slabs bundles"], bend: Float[Array, "slabs bundles"], budget: Float[Array, " bundles"], node_samples: int
) -> tuple[Int[Array, "slabs bundles"], Float[Array, " bundles"]]:
    """Levels of interpolated slabs, from the widest spaced down: aligned groups of slabs, all interpolated, share samples.

    Args:
        taken: slabs that are interpolated.
        bend: root mean square over the nodes of a bundle.
        budget: variance that wider spacing may add.
        node_samples: fine samples between nodes.

    Returns:
        Level of each slab; and the variance.
    """
    level, spent = jnp.zeros(taken.shape, jnp.int32), jnp.zeros_like(budget)
    least = MIN_DEVIATION * jnp.finfo(budget.dtype).eps
    for coarse in range(MAX_SPACING_LEVEL, 0, -1):
        share = 1 << coarse
        whole = taken.shape[0] // share * share
        if not whole:
            continue
        groups = (taken & (level == 0))[:whole].reshape(-1, share, taken.shape[1])
        curved = functools.reduce(jnp.add, (bend[k:whole:share] for k in range(share)))
        deviation = DEVIATION_PER_BEND * (share**2 - 1) / (24 * node_samples**2) * curved + least
        chosen, more = select_under_budget(deviation**2, jnp.ones_like(deviation), groups.all(1), budget - spent)
        level = level.at[:whole].max(coarse * jnp.repeat(chosen, share, 0))
        spent += more
    return level, spent
