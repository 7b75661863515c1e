"""A frame, as the calls of its stages, written once: for compiled programs, for what is traced ahead of them, and for traces.

Flow: seen, plan -> [frame: ranked -> band: grid -> decide -> cast -> develop -> Drawn] -> Image.

Bundles are independent of each other, and so are bands: each has the lists, the decisions and the estimates that it has on one
device. So the bundles of a band are shared out in shards, which run side by side: on threads, or on the devices of a mesh, each
of which makes the lists of the whole band for itself. Nothing is exchanged but pixels, and decisions for a whole band.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxsph.engine.access.grid import Grid
from jaxsph.engine.access.lists import ListPlan
from jaxsph.engine.access.view import Ordered
from jaxsph.engine.cast.march import CastMethod
from jaxsph.engine.control.decide import Decided, Limits, decide_full_rate
from jaxsph.engine.frame.stages import (
    Cast,
    Counts,
    Drawn,
    Layers,
    cast_shard,
    develop,
    ends,
    grid_of,
    join,
    least_transmittance,
    limits_of,
    ordered_of,
)
from jaxsph.engine.media.shown import RayLimits, Shown
from jaxsph.engine.planning.plan import Plan
from jaxsph.engine.planning.viewing import Seen
from jaxsph.engine.request import Request
from jaxsph.engine.runtime.clock import Clock
from jaxsph.engine.screen.packets import Parts, every_bundle, rays_of_parts
from jaxsph.model.camera.camera import Camera
from jaxsph.model.scene import Formulas
from jaxsph.model.settings import integrator_class, integrator_of
from jaxsph.numerics.checks import array_of, product
from jaxsph.numerics.trees import tree

RAY_SHARE = 0.5  # of a tolerance, what the samples of a ray may take where pixels are interpolated between rays
HALF = 0.5  # a pixel, by which rays may lie beside its middle where there are several of one


@tree(static=("plan", "formulas", "first_row", "shards"))
class Frame:
    """What is seen, and how it is drawn.

    Attributes:
        plan: of the frame, or of those of its rows that begin at `first_row`.
        allowed: how wrong a pixel may be; None at full rate.
        least: transmittance below which rays end; None where they do not.
        shards: of each band, cast side by side.
        ordered: the particles by rank, once for all bands: see `ranked`.
        parts: that are cast of each shard; None casts all of its bundles.
    """

    seen: Seen
    camera: Camera
    allowed: Limits | None
    least: Float[Array, ""] | None
    plan: Plan
    formulas: Formulas
    first_row: int = 0
    shards: int = 1
    ordered: Ordered | None = None
    parts: list[Parts] | None = None

    @classmethod
    def of(cls, asked: Request, plan: Plan, seen: Seen, clock: Clock, first_row: int = 0) -> Frame:
        """What is asked for, as it is seen, with a plan for it."""
        dtype, settings, least = seen.viewed.x.dtype, asked.settings, None
        if ends(settings):
            least = array_of(least_transmittance(settings), dtype)
        elif any(medium.stops_rays for medium in seen.media):  # what lets nothing through hides all behind it
            least = array_of(jnp.finfo(dtype).tiny, dtype)
        shards, limits = clock.num_shards(plan.shards), limits_of(settings, dtype)
        return cls(seen, asked.camera, limits, least, plan.dealt(shards), asked.scene.formulas, first_row, shards)

    def bands(self, clock: Clock) -> Drawn:
        """All bands, one after the other."""
        frame = clock.replicated(self.ranked(clock))
        rows = [self.first_row + row for row in self.first_rows]
        return self.joined(clock, clock.over(rows, functools.partial(clock.shared, drawn_band, frame)))

    def band(self, first_row: Int[Array, ""], clock: Clock) -> tuple[Drawn, list[Cast], list[Decided]]:
        """That which begins at a row of pixels; and what its rays met and what was decided, shard by shard."""
        grid, counts = self.grid(first_row, clock)
        decided, lattice = self.decide(grid, clock)
        rays = clock.pooled(self.cast(grid, decided, lattice, clock))
        decided = [one._replace(schedule=None) for one in decided]  # type: ignore[arg-type]
        decided = decided if lattice is not None else clock.pooled(decided)
        static = dataclasses.replace(self.plan, control=None)
        return Drawn(clock.one("image", develop, (tuple(rays), tuple(decided)), plan=static), *counts), rays, decided

    def joined(self, clock: Clock, bands: list[Drawn]) -> Drawn:
        """The image, of all of its bands."""
        layers: Layers = bands[0].layers
        if len(bands) > 1:
            layers = clock.one("image", join, (tuple(band.layers for band in bands),), height=self.plan.height)
        return Drawn.of(layers, [band[1:] for band in bands], self.seen.viewed.faults)  # type: ignore[misc]

    def ranked(self, clock: Clock) -> Frame:
        """With the particles ranked, which is done once for all bands."""
        if self.ordered is not None:
            return self
        seen, plan = self.seen, self.plan
        sizes = {"samples": plan.samples, "slab_samples": plan.cast.slab_samples, "between_samples": self._beside}
        ordered = ordered_of(clock, seen.viewed, self.camera, plan.cast.tuning, seen.order, **sizes)
        return dataclasses.replace(self, ordered=ordered)

    @property
    def limits(self) -> Limits | None:
        """What rays keep to, a share of what is allowed where pixels are interpolated, too."""
        if self.allowed is None or self.plan.quadtree is None:
            return self.allowed
        return self.allowed._replace(tolerance=product(self.allowed.tolerance, RAY_SHARE))

    @property
    def ray_tolerance(self) -> Float[Array, ""] | None:
        """What segments are refined for; None where they are not."""
        return self.limits.tolerance if self.limits is not None and self.plan.cast.doublings else None

    @property
    def first_rows(self) -> tuple[int, ...]:
        """Of pixels that bands begin at, from that of the frame on."""
        return tuple(nth * self.plan.band_height for nth in range(self.plan.bands))

    @property
    def shown(self) -> Shown:
        """All but the particles."""
        return Shown(self.camera, self.seen.transfer, self.seen.media, self.seen.within)

    @property
    def _beside(self) -> bool:
        """Whether any medium meets spheres between samples."""
        integrator = integrator_class(self.plan.integrator)
        return bool(integrator.between) or any(medium.between_samples for medium in self.seen.media)

    def grid(
        self, first_row: Int[Array, ""], clock: Clock, camera: Camera | None = None, lists: ListPlan | None = None
    ) -> tuple[Grid, Counts]:
        """Of the band that begins at a row of pixels, or of another camera's nodes; and how much is in it."""
        plan = self.plan
        sizes = {"samples": plan.samples, "beside": self._beside}
        assert self.ordered is not None
        return grid_of(clock, self.ordered, camera or self.camera, first_row, lists or plan.lists, plan.cast.tuning, **sizes)

    def cast(self, grid: Grid, decided: list[Decided], lattice: Any, clock: Clock, camera: Camera | None = None) -> list[Cast]:
        """What the rays of all packets of a grid meet, or those of parts that are chosen, shard by shard."""
        plan, each = self.plan, clock.shards(self.shards)
        schedules = [one.schedule for one in decided] if lattice is None else [decided[0].schedule] * len(each)
        shown, limits = self.shown._replace(camera=camera or self.camera), RayLimits(self.least, self.ray_tolerance)
        some: Sequence[Parts | None] = self.parts or [None] * len(each)
        parts = zip(schedules, each, some, strict=True)
        inputs = [(grid, shown, schedule, lattice, limits, nth, part) for schedule, nth, part in parts]
        integrator = integrator_of(plan.integrator)
        packets_of = every_bundle if self.parts is None else rays_of_parts
        method = CastMethod(self.formulas.kernel, plan.cast, integrator, packets_of, self.formulas.mix)
        return clock.each("cast", cast_shard, inputs, shards=self.shards, method=method, tuning=plan.cast.tuning)

    def decide(self, grid: Grid, clock: Clock) -> tuple[list[Decided], Any]:
        """What is to be marched, shard by shard; and a lattice, where there is one, of which there is one decision for all."""
        if self.limits is None or self.plan.control is None:
            return self.leave(grid, clock), None
        how = {"shards": self.shards, "lists": self.plan.lists, "kernel": self.formulas.kernel, **self._sizes}
        return self.plan.control.decide(clock, grid, self.shown, self.limits, **how)

    def leave(self, grid: Grid, clock: Clock, camera: Camera | None = None) -> list[Decided]:
        """All slabs at full rate, shard by shard."""
        shown = self.shown._replace(camera=camera or self.camera)
        inputs = [(grid, shown, nth) for nth in clock.shards(self.shards)]
        fringe = HALF if self.formulas.antialias > 1 else 0
        return clock.each("adapt", decide_full_rate, inputs, shards=self.shards, fringe=fringe, **self._sizes)

    @property
    def _sizes(self) -> dict[str, Any]:
        return {"slab_samples": self.plan.cast.slab_samples, "tuning": self.plan.cast.tuning}


def drawn_band(frame: Frame, first_row: Int[Array, ""], clock: Clock) -> Drawn:
    """That of a frame which begins at a row of pixels."""
    drawn, *_ = frame.band(first_row, clock)
    return drawn
