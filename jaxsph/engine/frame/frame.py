"""A frame, as the calls of its stages: written once for eager rendering, what is foreseen of it, and traces; and its image.

Flow: seen, plan -> [frame: dealing -> ranked -> band: grid -> decide -> cast -> develop -> Drawn] -> Image.

Bundles are independent of each other, and so are bands: each has the lists, the decisions and the estimates that it has on one
device. So devices form groups of one size: every group ranks the particles for itself and draws the bands that are dealt to it,
the fullest first; within a group, each device decides and casts the bundles of its shard. Nothing is exchanged but the lists of a
band within a group, and pixels. One device is a group of its own.
"""

from __future__ import annotations

import dataclasses
import functools
import sys
import warnings
from collections.abc import Callable, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxsph.engine.access.grid import Grid
from jaxsph.engine.access.lists import ListPlan
from jaxsph.engine.access.view import Ordered
from jaxsph.engine.cast.march import CastMethod
from jaxsph.engine.control.decide import Decided, Limits, decide_full_rate
from jaxsph.engine.control.pilot import PilotPlan
from jaxsph.engine.frame.stages import (
    REFERENCE,
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
from jaxsph.engine.planning.fit import PLANS
from jaxsph.engine.planning.plan import Plan
from jaxsph.engine.planning.viewing import Seen
from jaxsph.engine.request import Request
from jaxsph.engine.runtime.executors import Eager, Run
from jaxsph.engine.screen.packets import Parts, every_bundle, rays_of_parts
from jaxsph.model.camera.camera import Camera
from jaxsph.model.image import Image
from jaxsph.model.scene import Formulas
from jaxsph.model.settings import Settings, estimates, integrator_class, integrator_of
from jaxsph.numerics import __version__, faults
from jaxsph.numerics.checks import array_of, at_hand, is_traced, product

Told = Callable[[Run], None]  # when one band more is done
RAY_SHARE = 0.5  # of a tolerance, what the samples of a ray may take where pixels are interpolated between rays
HALF = 0.5  # a pixel, by which rays may lie beside its middle where there are several of one


@dataclasses.dataclass(frozen=True)
class Frame:
    """What is seen, and how it is drawn.

    Attributes:
        plan: of the frame, or of those of its rows that begin at `first_row`.
        shards: of each band, cast side by side.
        ordered: the particles by rank, once for all bands: see `ranked`.
        parts: that are cast of each shard; None casts all of its bundles.
    """

    seen: Seen
    camera: Camera
    settings: Settings
    plan: Plan
    formulas: Formulas
    first_row: int = 0
    shards: int = 1
    ordered: Ordered = None  # type: ignore[assignment]
    parts: list[Parts] | None = None

    @classmethod
    def begun(cls, asked: Request, run: Eager, plan: Plan | None = None) -> Frame:
        """What is asked for, with the plan that is given, else one that is kept or new."""
        made, seen = PLANS.for_frame(asked, run, plan)
        return cls(seen, asked.camera, asked.settings, made, asked.scene.formulas, shards=made.shards)

    def of_bands(self, run: Run, told: Told) -> Drawn:
        """All bands, one after the other."""
        return self.joined(run, self.bands(run, range(self.plan.bands), told))

    def bands(self, run: Run, numbers: Sequence[int], told: Told) -> list[Drawn]:
        """Those of some numbers."""
        frame = self.ranked(run) if self.ordered is None else self

        def draw(first_row: Int[Array, ""]) -> Drawn:
            drawn, *_ = frame.band(first_row, run)
            told(run)
            return drawn

        return run.over([self.first_row + self.first_rows[number] for number in numbers], draw)

    def band(self, first_row: Int[Array, ""], run: Run) -> tuple[Drawn, list[Cast], list[Decided]]:
        """That which begins at a row of pixels; and what its rays met and what was decided, shard by shard."""
        grid, counts = self.grid(first_row, run)
        decided, lattice = self.decide(grid, run)
        rays = run.pooled(self.cast(grid, decided, lattice, run))
        decided = [one._replace(schedule=None) for one in decided]  # type: ignore[arg-type]
        decided = decided if lattice is not None else run.pooled(decided)
        static = dataclasses.replace(self.plan, control=None)
        return Drawn(run.one("image", develop, (tuple(rays), tuple(decided)), plan=static), *counts), rays, decided

    def joined(self, run: Run, bands: list[Drawn]) -> Drawn:
        """The image, of all of its bands."""
        layers: Layers = bands[0].layers
        if len(bands) > 1:
            layers = run.one("image", join, (tuple(band.layers for band in bands),), height=self.plan.height)
        return Drawn.of(layers, [band[1:] for band in bands], self.seen.viewed.faults)  # type: ignore[misc]

    def ranked(self, run: Run) -> Frame:
        """With the particles ranked, which is done once for all bands."""
        seen, plan = self.seen, self.plan
        sizes = {"samples": plan.samples, "slab_samples": plan.cast.slab_samples, "between_samples": self._beside}
        ordered = ordered_of(run, seen.viewed, self.camera, plan.cast.tuning, seen.order, **sizes)
        return dataclasses.replace(self, ordered=ordered)

    @functools.cached_property
    def limits(self) -> Limits | None:
        """What rays keep to, a share of what is allowed where pixels are interpolated, too."""
        limits = limits_of(self.settings, self.seen.viewed.x.dtype)
        if limits is None or self.plan.quadtree is None:
            return limits
        return limits._replace(tolerance=product(limits.tolerance, RAY_SHARE))

    @property
    def ray_tolerance(self) -> Float[Array, ""] | None:
        """What segments are refined for; None where they are not."""
        return self.limits.tolerance if self.limits is not None and self.plan.cast.doublings else None

    @functools.cached_property
    def least(self) -> Float[Array, ""] | None:
        """Of transmittance, below which rays end; None where they do not."""
        dtype = self.seen.viewed.x.dtype
        if ends(self.settings):
            return array_of(least_transmittance(self.settings), dtype)
        if any(medium.stops_rays for medium in self.seen.media):  # what lets nothing through hides all behind it
            return array_of(jnp.finfo(dtype).tiny, dtype)
        return None

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
        self, first_row: Int[Array, ""], run: Run, camera: Camera | None = None, lists: ListPlan | None = None
    ) -> tuple[Grid, Counts]:
        """Of the band that begins at a row of pixels, or of another camera's nodes; and how much is in it."""
        plan = self.plan
        sizes = {"samples": plan.samples, "beside": self._beside}
        return grid_of(run, self.ordered, camera or self.camera, first_row, lists or plan.lists, plan.cast.tuning, **sizes)

    def cast(self, grid: Grid, decided: list[Decided], lattice: Any, run: Run, camera: Camera | None = None) -> list[Cast]:
        """What the rays of all packets of a grid meet, or those of parts that are chosen, shard by shard."""
        plan, each = self.plan, run.shards(self.shards)
        schedules = [one.schedule for one in decided] if lattice is None else [decided[0].schedule] * len(each)
        shown, limits = self.shown._replace(camera=camera or self.camera), RayLimits(self.least, self.ray_tolerance)
        some: Sequence[Parts | None] = self.parts or [None] * len(each)
        parts = zip(schedules, each, some, strict=True)
        inputs = [(grid, shown, schedule, lattice, limits, nth, part) for schedule, nth, part in parts]
        integrator = integrator_of(plan.integrator)
        packets_of = every_bundle if self.parts is None else rays_of_parts
        method = CastMethod(self.formulas.kernel, plan.cast, integrator, packets_of, self.formulas.mix)
        return run.each("cast", cast_shard, inputs, shards=self.shards, method=method, tuning=plan.cast.tuning)

    def decide(self, grid: Grid, run: Run) -> tuple[list[Decided], Any]:
        """What is to be marched, shard by shard; and a lattice, where there is one, of which there is one decision for all."""
        if self.limits is None or self.plan.control is None:
            return self.leave(grid, run), None
        how = {"shards": self.shards, "lists": self.plan.lists, "kernel": self.formulas.kernel, **self._sizes}
        return self.plan.control.decide(run, grid, self.shown, self.limits, **how)

    def leave(self, grid: Grid, run: Run, camera: Camera | None = None) -> list[Decided]:
        """All slabs at full rate, shard by shard."""
        shown = self.shown._replace(camera=camera or self.camera)
        inputs = [(grid, shown, nth) for nth in run.shards(self.shards)]
        fringe = HALF if self.formulas.antialias > 1 else 0
        return run.each("adapt", decide_full_rate, inputs, shards=self.shards, fringe=fringe, **self._sizes)

    @property
    def _sizes(self) -> dict[str, Any]:
        return {"slab_samples": self.plan.cast.slab_samples, "tuning": self.plan.cast.tuning}


def certified(plan: Plan, settings: Settings, formulas: Formulas) -> Bool[Array, ""] | bool:
    """Whether `error_bound` is proven, without faults: by strict bounds, of point samples of no surface, a ray a pixel."""
    if plan.integrator != REFERENCE or plan.quadtree is not None or isinstance(plan.control, PilotPlan) or formulas.surfaces:
        return False
    if plan.control is None:
        return True
    relax = settings.relax
    return relax == 0 if is_traced(relax) else float(relax) == 0


def disclaimed(image: Image, word: Int[Array, ""]) -> Image:
    """After a fault an image is not certified, and no bound less than 1 holds; where its numbers mean nothing, it is blank.

    A tolerance that was missed leaves all else as it is: `error_bound` says where.
    """
    faulty, unusable = word & ~faults.TOLD != 0, word & faults.UNUSABLE != 0
    return dataclasses.replace(
        image,
        color=jnp.where(unusable, 0, image.color),
        transmittance=jnp.where(unusable, 1, image.transmittance),
        depth=jnp.where(unusable, jnp.inf, image.depth),
        normal=None if image.normal is None else jnp.where(unusable, 0, image.normal),
        error_bound=jnp.where(faulty, 1, image.error_bound),
        certified=image.certified & ~faulty,
        faults=word,
    )


def faults_of_settings(settings: Settings) -> Int[Array, ""]:
    """Fault bit of traced numbers of `settings` that are out of range; what is known has been checked before."""
    tolerance, relax, least = settings.tolerance, settings.relax, settings.min_transmittance
    usable = jnp.asarray(True)
    if is_traced(tolerance):
        usable &= jnp.isfinite(tolerance) & (tolerance >= 0)
    if is_traced(relax):
        usable &= (relax >= 0) & (relax <= 1)
    if is_traced(least):
        usable &= (least >= 0) & (least < 0.5)
    if tolerance is not None and is_traced(tolerance, least):
        usable &= ~(jnp.asarray(least) >= tolerance) | (jnp.asarray(least) == 0) | (jnp.asarray(tolerance) == 0)
    return faults.raised(faults.BAD_SETTINGS, ~usable)


def tell(word: int, image: Image, settings: Settings) -> None:
    """Warn whoever called this package of what is no reason to raise."""
    if word & faults.TOLD:
        number = int((np.asarray(image.error_bound) > settings.tolerance).sum())
        pixels = f"{number} of {image.error_bound.size} pixels"
        level, frame = 1, sys._getframe()
        while frame.f_back is not None and frame.f_globals.get("__name__", "").partition(".")[0] == __name__.partition(".")[0]:
            level, frame = level + 1, frame.f_back
        warnings.warn(f"{pixels}: {faults.describe(word & faults.TOLD)}", stacklevel=level)


def image_of(drawn: Drawn, frame: Frame, run: Eager, *, planned: bool = True, **stats: Any) -> Image:
    """The image that is drawn of a frame, by a run that was timed; faults raise, and warned is where a tolerance cannot be kept.

    `planned` is whether capacities were made for this very frame; `stats` have what else is known of it.
    """
    faults.raise_for(int(drawn.faults), planned)
    image, word = _image(drawn, frame)
    word = int(word)
    tell(word, image, frame.settings)
    counted: dict[str, Any] = {
        "evaluations": int(np.asarray(image.evaluations, np.float64).sum()),
        "evaluations_full": int(np.asarray(drawn.layers.full, np.float64).sum()),
        **{name: int(count) for name, count in image.stats.items()},
    }
    run.mark("image")
    proven = bool(certified(frame.plan, frame.settings, frame.formulas)) and bool(np.isfinite(image.error_bound).all())
    counted |= {"seconds": dict(run.seconds), **stats}
    metadata = metadata_of(frame.camera, frame.settings, proven)
    return dataclasses.replace(image, certified=proven, faults=word, stats=counted, metadata=metadata)


def traced_image_of(drawn: Drawn, frame: Frame) -> Image:
    """The image that is drawn of a frame within a trace: after a fault it claims nothing."""
    image, word = _image(drawn, frame)
    sums = {"evaluations": image.evaluations.sum(), "evaluations_full": drawn.layers.full.sum(), **image.stats}
    proven = certified(frame.plan, frame.settings, frame.formulas) & jnp.isfinite(image.error_bound).all()
    image = dataclasses.replace(image, certified=proven, stats=sums)
    return disclaimed(image, word | faults_of_settings(frame.settings))


def _image(drawn: Drawn, frame: Frame) -> tuple[Image, Any]:
    """The layers as an image, with what was counted, and its fault word."""
    layers, plan, settings, formulas = drawn.layers, frame.plan, frame.settings, frame.formulas
    of_pixels = *layers[:3], layers.bound, layers.evaluations
    counts = {"cells": drawn.filled, "pairs": drawn.pairs} | ({} if layers.rays is None else {"rays": layers.rays})
    image = Image(*of_pixels, True, drawn.faults, counts, levels=layers.levels, normal=layers.normal)
    if plan.quadtree is not None:
        if ends(settings):  # what interpolated rays that may have ended can have left out; of rays of pixels `develop` knows it
            let_through = lax.stop_gradient(image.transmittance)
            left_out = jnp.where(let_through < least_transmittance(settings), let_through, 0)
            image = dataclasses.replace(image, error_bound=image.error_bound + left_out)
    elif formulas.surfaces and not plan.cast.doublings:  # of surfaces where nothing is compared no error is known
        unknown = array_of(np.full(image.error_bound.shape, np.inf), image.error_bound.dtype)
        image = dataclasses.replace(image, error_bound=unknown)
    word = drawn.faults
    if settings.is_refined:  # for a tolerance, that the estimate may be above somewhere
        xp, bound = at_hand(lax.stop_gradient(image.error_bound))
        word = word | xp.where((bound > settings.tolerance).any(), faults.TOLERANCE_MISSED, faults.NONE)
    return image, word


def metadata_of(camera: Camera, settings: Settings, certified: bool) -> tuple[tuple[str, Any], ...]:
    """What a file says of how its image was made."""
    exact = settings.tolerance is None
    estimator = settings.integrator_used if estimates(settings.integrator_used) else settings.estimator or "interval"
    return (
        ("jaxsph.version", __version__),
        ("jaxsph.integrator", settings.integrator_used),
        ("jaxsph.tolerance", "none" if exact else float(settings.tolerance)),
        ("jaxsph.estimator", "none" if exact else estimator),
        ("jaxsph.relax", "none" if exact else float(settings.relax)),
        ("jaxsph.certified", float(certified)),
        ("jaxsph.camera", camera.describe()),
    )
