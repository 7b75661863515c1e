"""A frame: the calls of its stages, written once, which a `Clock` runs as programs, traces ahead by shapes, or puts into a trace.

Flow: SceneInView, Plan -> [frame: with_ranks -> band: grid, decide, cast, develop -> join_bands] -> Drawing -> finish.

A frame is drawn band by band, a band shard by shard. Bundles do not depend on each other: each has the lists, the decisions and
the estimates that it would have alone. So a shard, every n-th bundle of a band, is drawn on a thread of its own, or on a device
of its own if there is a mesh; each device then makes the lists of the whole band for itself. Devices exchange pixels, and what
error control decides for a whole band.
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
    Counts,
    Drawing,
    Layers,
    ShardResult,
    cast_shard,
    develop,
    grid_of,
    join,
    least_transmittance,
    limits_of,
    ordered_of,
    rays_may_end,
)
from jaxsph.engine.media.shown import RayLimits, Shown
from jaxsph.engine.planning.plan import Plan
from jaxsph.engine.planning.viewing import SceneInView
from jaxsph.engine.request import Request
from jaxsph.engine.runtime.clock import Clock
from jaxsph.engine.screen.packets import Parts, every_bundle, rays_of_parts
from jaxsph.model.camera.camera import Camera
from jaxsph.model.scene import Formulas
from jaxsph.model.settings import integrator_class, integrator_of
from jaxsph.numerics.checks import array_of, product
from jaxsph.numerics.trees import tree

RAY_SHARE = 0.5  # of a tolerance: what rays may be wrong by, where the rest is for interpolation between them
HALF = 0.5  # of a pixel: the farthest that one of several rays of a pixel lies from its middle


@tree(static=("plan", "formulas", "first_row", "shards"))
class Frame:
    """A scene in view, and how it is to be drawn.

    Attributes:
        in_view: particles and other media in view space.
        camera: through whose pixels rays are cast.
        allowed: how wrong a pixel may be; None at full rate.
        least: transmittance below which rays end; None where all go to far.
        plan: of the whole image; if `first_row` says so, of some rows of it.
        formulas: kernel, mixing of media and rays a pixel, as the scene asks for them.
        first_row: the row of pixels that the plan's rows begin at: 0, unless one process renders a part of the image.
        shards: how many each band is divided into, to be cast side by side.
        ordered: the particles by rank; None until `with_ranks`.
        parts: one entry a shard: the parts of its bundles that `cast` takes; None casts all bundles whole.
    """

    in_view: SceneInView
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
    def of(cls, request: Request, plan: Plan, in_view: SceneInView, clock: Clock, first_row: int = 0) -> Frame:
        """The frame of a request, whose scene is in view and whose plan is known."""
        dtype, settings, least = in_view.viewed.x.dtype, request.settings, None
        if rays_may_end(settings):
            least = array_of(least_transmittance(settings), dtype)
        elif any(medium.stops_rays for medium in in_view.media):  # behind what is opaque nothing is to be marched
            least = array_of(jnp.finfo(dtype).tiny, dtype)
        shards, limits = clock.num_shards(plan.shards), limits_of(settings, dtype)
        return cls(in_view, request.camera, limits, least, plan.dealt(shards), request.scene.formulas, first_row, shards)

    def bands(self, clock: Clock) -> Drawing:
        """Draw all bands, one after the other, and join them; each is one program of all devices, if there is a mesh."""
        frame = clock.replicate(self.with_ranks(clock))
        rows = [self.first_row + row for row in self.first_rows]
        return self.join_bands(clock, clock.over(rows, functools.partial(clock.on_all_devices, draw_band, frame)))

    def band(self, first_row: Int[Array, ""], clock: Clock) -> tuple[Drawing, list[ShardResult], list[Decided]]:
        """Draw the band that begins at a row of pixels; beside it, the results and decisions of its shards."""
        grid, counts = self.grid(first_row, clock)
        decided, lattice = self.decide(grid, clock)
        results = clock.all_shards(self.cast(grid, decided, lattice, clock))
        decided = [one._replace(schedule=None) for one in decided]  # type: ignore[arg-type]
        decided = decided if lattice is not None else clock.all_shards(decided)
        static = dataclasses.replace(self.plan, control=None)
        return Drawing(clock.one("image", develop, (tuple(results), tuple(decided)), plan=static), *counts), results, decided

    def join_bands(self, clock: Clock, bands: list[Drawing]) -> Drawing:
        """Join the bands of the image, and count over all of them."""
        layers: Layers = bands[0].layers
        if len(bands) > 1:
            layers = clock.one("image", join, (tuple(band.layers for band in bands),), height=self.plan.height)
        return Drawing.of(layers, [band[1:] for band in bands], self.in_view.viewed.faults)  # type: ignore[misc]

    def with_ranks(self, clock: Clock) -> Frame:
        """The frame with its particles ranked, which is done once for all bands."""
        if self.ordered is not None:
            return self
        in_view, plan = self.in_view, self.plan
        sizes = {"samples": plan.samples, "slab_samples": plan.cast.slab_samples, "between_samples": self._between_samples}
        ordered = ordered_of(clock, in_view.viewed, self.camera, plan.cast.tuning, in_view.order, **sizes)
        return dataclasses.replace(self, ordered=ordered)

    @property
    def limits(self) -> Limits | None:
        """How wrong a ray may be: as much as a pixel, or a share of that where pixels are interpolated between rays."""
        if self.allowed is None or self.plan.quadtree is None:
            return self.allowed
        return self.allowed._replace(tolerance=product(self.allowed.tolerance, RAY_SHARE))

    @property
    def ray_tolerance(self) -> Float[Array, ""] | None:
        """The tolerance that the integrator refines segments for; None where it refines none."""
        return self.limits.tolerance if self.limits is not None and self.plan.cast.doublings else None

    @property
    def first_rows(self) -> tuple[int, ...]:
        """Rows of pixels that bands begin at, counted from the first row of the frame."""
        return tuple(nth * self.plan.band_height for nth in range(self.plan.bands))

    @property
    def shown(self) -> Shown:
        """All that stages need besides the grid: camera, transfer function, media and clip."""
        return Shown(self.camera, self.in_view.transfer, self.in_view.media, self.in_view.within)

    @property
    def _between_samples(self) -> bool:
        """Whether rays meet spheres between samples too, as the integrator or any medium asks for."""
        integrator = integrator_class(self.plan.integrator)
        return bool(integrator.between) or any(medium.between_samples for medium in self.in_view.media)

    def grid(
        self, first_row: Int[Array, ""], clock: Clock, camera: Camera | None = None, lists: ListPlan | None = None
    ) -> tuple[Grid, Counts]:
        """Make the grid of the band that begins at a row of pixels, and count what is in it.

        With `camera` and `lists` it is that of the nodes of another camera, as of a quadtree's coarse lattice.
        """
        plan = self.plan
        sizes = {"samples": plan.samples, "beside": self._between_samples}
        assert self.ordered is not None
        return grid_of(clock, self.ordered, camera or self.camera, first_row, lists or plan.lists, plan.cast.tuning, **sizes)

    def cast(
        self, grid: Grid, decided: list[Decided], lattice: Any, clock: Clock, camera: Camera | None = None
    ) -> list[ShardResult]:
        """March the rays of a grid by what was decided, shard by shard: those of `parts`, if the frame has some, else all.

        Over a mesh these are the shards of one device: see `Clock.all_shards`.
        """
        plan, each = self.plan, clock.shards(self.shards)
        schedules = [one.schedule for one in decided] if lattice is None else [decided[0].schedule] * len(each)
        shown, limits = self.shown._replace(camera=camera or self.camera), RayLimits(self.least, self.ray_tolerance)
        parts: Sequence[Parts | None] = self.parts or [None] * len(each)
        of_shards = zip(schedules, each, parts, strict=True)
        inputs = [(grid, shown, schedule, lattice, limits, nth, part) for schedule, nth, part in of_shards]
        integrator = integrator_of(plan.integrator)
        packets_of = every_bundle if self.parts is None else rays_of_parts
        method = CastMethod(self.formulas.kernel, plan.cast, integrator, packets_of, self.formulas.mix)
        return clock.each("cast", cast_shard, inputs, shards=self.shards, method=method, tuning=plan.cast.tuning)

    def decide(self, grid: Grid, clock: Clock) -> tuple[list[Decided], Any]:
        """Decide which slabs are marched, and how finely, shard by shard: by error control, or all of them at full rate.

        With a lattice, which is the pilot's, there is one decision for the whole band; else the second of the results is None.
        """
        if self.limits is None or self.plan.control is None:
            return self.at_full_rate(grid, clock), None
        how = {"shards": self.shards, "lists": self.plan.lists, "kernel": self.formulas.kernel, **self._sizes}
        return self.plan.control.decide(clock, grid, self.shown, self.limits, **how)

    def at_full_rate(self, grid: Grid, clock: Clock, camera: Camera | None = None) -> list[Decided]:
        """Decide that all slabs are marched at full rate, shard by shard."""
        shown = self.shown._replace(camera=camera or self.camera)
        inputs = [(grid, shown, nth) for nth in clock.shards(self.shards)]
        fringe = HALF if self.formulas.antialias > 1 else 0
        return clock.each("adapt", decide_full_rate, inputs, shards=self.shards, fringe=fringe, **self._sizes)

    @property
    def _sizes(self) -> dict[str, Any]:
        return {"slab_samples": self.plan.cast.slab_samples, "tuning": self.plan.cast.tuning}


def draw_band(frame: Frame, first_row: Int[Array, ""], clock: Clock) -> Drawing:
    """Draw the band of a frame that begins at a row of pixels; arguments are those of `Clock.on_all_devices`."""
    drawing, *_ = frame.band(first_row, clock)
    return drawing
