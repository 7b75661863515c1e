r"""The pilot estimator: which slabs are interpolated, from the lattice or between some of their rays, and how widely they sample.

Flow: lattice -> interpolation_error -> [pilot] -> schedule -> cast -> image.

Errors are treated as noise whose variances add up along a bundle, and `DEVIATIONS` standard deviations are the estimate: not a
bound. The budget goes to interpolation first (`interpolation_error`): wherever it is taken, the price of an evaluation saved is
the same. What that leaves is spent on wider spaced samples (`spacing`).
"""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxsph.engine.access.grid import Grid
from jaxsph.engine.access.lists import BUNDLE
from jaxsph.engine.control.interpolation_error import InterpolationError
from jaxsph.engine.control.spacing import choose_spacing, select_under_budget
from jaxsph.engine.field.lattice import Lattice
from jaxsph.engine.field.schedule import DENSE, FINEST, INTERPOLATED, SUBSAMPLE, SUBSAMPLED, SlabSchedule, Spacing, full_rate
from jaxsph.model.camera.camera import Camera

DEVIATIONS = 6.0  # standard deviations that pixels are taken to stay within
RESOLVED = 1.5  # node spacings that a support must reach: some node is then well inside it, and its fourth differences show it
MIN_RESOLVED_SHARE = 0.25  # of a band's work, that the lattice must resolve: sampling it costs up to a tenth


@dataclasses.dataclass(frozen=True)
class PilotPlan:
    """Static choices of the pilot estimator.

    Attributes:
        nodes: how far apart they are.
        room: rows and columns of bundles that have nodes; all of a band where there is None.
    """

    nodes: Spacing = FINEST
    room: tuple[int, int] | None = None


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
        The work, and the estimated error of the pixels of each bundle: `DEVIATIONS` standard deviations, 0 where all is
        marched.
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


def worth_a_lattice(grid: Grid, camera: Camera, slab_samples: int, nodes: Spacing) -> Bool[Array, ""]:
    """Whether the lattice resolves enough of a band's work to be sampled at all."""
    surplus = jnp.where(_resolved(grid, camera, slab_samples, nodes), 1 - MIN_RESOLVED_SHARE, -MIN_RESOLVED_SHARE)
    return (surplus * grid.windows.count).sum() > 0


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
    least = jnp.where(live, reach, jnp.inf).min(initial=jnp.inf)
    smallest = jnp.maximum(jnp.where(live, reach, 0).max(initial=0) * octaves, least).at[-1].set(least)
    small = smallest[:, None] < RESOLVED * spacing
    return ~((grid.windows.length > 0) & small[..., None]).any(0)
