"""The schedule of slabs: which samples every bundle is to march, how widely spaced, how, and with which particles.

Flow: slab windows -> (control) -> [schedule] -> cast.

At full rate there is an entry for every slab that a medium can touch. Error control replaces entries by wider spaced ones, and
by super-pixels, that need no particles. One cast serves both, so that where control asks for full rate the image is the
reference image bit for bit.
"""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxsph.engine.access.grid import SlabWindows
from jaxsph.engine.access.lists import BUNDLE
from jaxsph.engine.field.fetch import position
from jaxsph.numerics.trees import tree

SUBSAMPLE = 0, 2, 5, 7  # of the rays along either side of a bundle, those that a subsampled slab is marched at
MAX_SPACING_LEVEL = 2  # level of the most widely spaced samples of interpolated slabs
DENSE, SUBSAMPLED, INTERPOLATED = 0, 1, 2  # methods, see `media.particles`; to the last, the level is added
NUM_METHODS = INTERPOLATED + MAX_SPACING_LEVEL + 1


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
class SlabSchedule:
    """Entries by the slab that they begin at; a slab that begins none is not `filled`.

    Attributes:
        filled: whether an entry begins here.
        level: its samples are `2**level` fine samples apart; a super-pixel is one sample of the coarsest level.
        begin, length: windows of the bundle's list, for each class of supports.
        count: sum of `length` over classes; 0 for super-pixels and interpolated slabs.
        references: what the entry's sums are taken relative to, each quantity of a particle near by: so that their rounding is
            a share of how much quantities differ, and a constant is rendered as that constant.
        painted: super-pixels; None where there can be none.
        paint: their red, green, blue and extinction.
        method: how sums are found (`DENSE`, ...); None where all are found from all particles at all rays.
    """

    filled: Bool[Array, "slabs bundles"]
    level: Int[Array, "slabs bundles"]
    begin: Int[Array, "classes slabs bundles"]
    length: Int[Array, "classes slabs bundles"]
    count: Int[Array, "slabs bundles"]
    references: tuple[Float[Array, "slabs bundles"], ...]
    painted: Bool[Array, "slabs bundles"] | None = None
    paint: Float[Array, "4 slabs bundles"] | None = None
    method: Int[Array, "slabs bundles"] | None = None


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
