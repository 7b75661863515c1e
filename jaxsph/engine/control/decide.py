"""What is to be marched of a band, and how wrong that can be: what control is chosen by and ends in; and all of it, at full rate.

Flow: grid -> [decide: full rate | adapt | pilot] -> schedule -> cast. Decisions carry no gradient.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from jaxsph.engine.access.grid import Grid, shard_of_grid, slab_extents
from jaxsph.engine.field.tasks import SlabSchedule, clipped, evaluations, full_rate, reference_quantities
from jaxsph.engine.media.shown import Shown, over_slabs
from jaxsph.engine.runtime.programs import stage
from jaxsph.engine.runtime.tuning import Tuning
from jaxsph.model.camera.camera import Camera
from jaxsph.model.clips import Clip, Overlap
from jaxsph.model.transfer.function import TransferFunction


class Limits(NamedTuple):
    """What an error is held against: tolerance and relaxation."""

    tolerance: Float[Array, ""]
    relax: Float[Array, ""]


class Decided(NamedTuple):
    """What is to be marched, and what the image tells of it.

    Attributes:
        schedule: of the slabs of bundles.
        bound: how wrong each bundle's pixels can be.
        full: evaluations at full rate.
        levels: what each slab was given; None where there are no levels.
        painted: what of the bound is by super-pixels; None where there is none of these.
    """

    schedule: SlabSchedule
    bound: Float[Array, " bundles"]
    full: Float[Array, " bundles"]
    levels: Int[Array, "slabs bundles"] | None = None
    painted: Float[Array, " bundles"] | None = None


@stage("shards", "slab_samples", "fringe", quickly=True)
def decide_full_rate(
    grid: Grid, shown: Shown, nth: Int[Array, ""], *, shards: int, slab_samples: int, tuning: Tuning, fringe: float = 0
) -> Decided:
    """Every cell of the `nth` of `shards` of a band at full rate, for rays that lie so many pixels beside those of bundles."""
    grid, shown = jax.tree.map(lax.stop_gradient, (shard_of_grid(grid, nth, shards), shown))
    camera, transfer, media, within = shown
    extents = slab_extents(grid, camera, slab_samples, fringe) if media or within is not None else None
    schedule, full = at_full_rate(grid, transfer, slab_samples, None if within is None else over_slabs(within, extents))
    filled = functools.reduce(jnp.logical_or, (medium.occupied(extents) for medium in media), schedule.filled)
    bound = jnp.zeros(full.shape, grid.half_steps.dtype)
    return Decided(dataclasses.replace(schedule, filled=filled), bound, full)


def overlap(grid: Grid, camera: Camera, within: Clip | None, slab_samples: int) -> Overlap | None:
    """How a clip lies to the slabs of a band or of a shard of it; None without one."""
    return None if within is None else over_slabs(within, slab_extents(grid, camera, slab_samples))


def at_full_rate(
    grid: Grid, transfer: TransferFunction | None, slab_samples: int, lies: Overlap | None = None
) -> tuple[SlabSchedule, Float[Array, " bundles"]]:
    """The schedule of the reference image, and its evaluations."""
    references = [reference_quantities(grid.windows, grid.lists.rank, one) for one in grid.ordered.quantities]
    schedule = clipped(full_rate(grid.windows, among(transfer, references)), None if lies is None else lies.meets)
    return schedule, evaluations(schedule, grid.samples, slab_samples)


def among(transfer: TransferFunction | None, references: list[Array], dtype: Any = None) -> tuple[Array, ...]:
    """References among the control points: one far beyond what is shown would cost the digits of what is."""
    if transfer is not None:
        parts = zip(references, transfer.parts(), strict=True)
        references = [jnp.clip(reference, part.values[0], part.values[-1]) for reference, part in parts]
    return tuple(reference if dtype is None else reference.astype(dtype) for reference in references)
