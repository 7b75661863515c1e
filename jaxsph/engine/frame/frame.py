"""A frame, as the calls of its stages: written once for eager rendering, for the forecast of its programs, and for traces.

Flow: viewing, plan -> [frame: order -> make_grid -> decide -> cast_shard] -> layers.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from jaxsph.engine.access.grid import Grid
from jaxsph.engine.access.host_lists import build_lists_on_host, depth_order, find_sides, find_touched, list_shapes, pair_shapes
from jaxsph.engine.access.lists import BundleLists, ListPlan
from jaxsph.engine.access.view import Ordered, Spheres, Viewed
from jaxsph.engine.cast.adjoint import KEPT, CastMethod
from jaxsph.engine.control import PilotPlan
from jaxsph.engine.field.lattice import Lattice
from jaxsph.engine.frame.layers import Band, Drawn, OfShards
from jaxsph.engine.frame.stages import (
    BandGrid,
    Cast,
    Decided,
    Limits,
    add_lattices,
    cast_shard,
    decide_by_bounds,
    decide_by_pilot,
    decide_full_rate,
    ends,
    grid_of_lists,
    least_transmittance,
    limits_of,
    make_grid,
    make_lists,
    order,
    stage,
    sum_shard,
)
from jaxsph.engine.media.shown import RayLimits, Shown
from jaxsph.engine.planning.plan import Plan
from jaxsph.engine.planning.viewing import Seen
from jaxsph.engine.runtime.executors import Executor, HostStage
from jaxsph.engine.runtime.tuning import Tuning, cores_at_hand
from jaxsph.engine.screen.packets import every_bundle
from jaxsph.model import registry
from jaxsph.model.camera.camera import Camera
from jaxsph.model.clips.clips import Clip
from jaxsph.model.medium import Medium
from jaxsph.model.scene import Formulas
from jaxsph.model.settings import Settings
from jaxsph.model.transfer.function import TransferFunction
from jaxsph.numerics.checks import array_of, product

Found = Int[Array, " particles"] | None
RAY_SHARE = 0.5  # of a tolerance, what the samples of a ray may take where pixels are interpolated between rays


@stage("lists", "samples", "beside", quickly=True)
def find_windows(
    ordered: Ordered,
    made: BundleLists,
    camera: Camera,
    first_row: Int[Array, ""],
    *,
    lists: ListPlan,
    samples: int,
    beside: bool,
    tuning: Tuning,
) -> BandGrid:
    """All but the lists of the grid of the band that begins at a row of pixels; what a program returns it would copy."""
    return grid_of_lists(ordered, made, camera, first_row, lists, samples, beside)._replace(lists=None)  # type: ignore[arg-type]


def _order(run: Any, stage: str, viewed: Viewed, camera: Camera, found: Found, **static: Any) -> Ordered:
    if found is None:
        shape = jax.ShapeDtypeStruct(viewed.key.shape, jnp.int32)
        found = run.by_host(stage, lambda: depth_order(viewed, cores_at_hand()), shape)
    ordered: Ordered = run.one(stage, order, (viewed, camera, found), **static)
    return ordered


def _lists(
    run: Any, stage: str, spheres: Spheres, camera: Camera, first_row: Int[Array, ""], *, lists: ListPlan, **_: Any
) -> BundleLists:
    sides = run.one(stage, find_sides, (spheres, camera, first_row), lists=lists)
    view = (sides.spheres, sides.bundles, camera, first_row)
    touched = run.program(stage, find_touched, (*view, pair_shapes(lists)))
    test, threads = (lambda pairs: touched(*view, pairs)), cores_at_hand()
    made: BundleLists = run.by_host(stage, lambda: build_lists_on_host(sides, test, lists, threads), list_shapes(lists))
    return made


def _grid(run: Any, stage: str, *seen: Any, **static: Any) -> BandGrid:
    made = _lists(run, stage, *seen, **static)
    grid: BandGrid = run.one(stage, find_windows, (seen[0], made, *seen[1:]), **static)
    return grid._replace(lists=made)


ORDER = HostStage(order, _order)
LISTS = HostStage(make_lists, _lists)
MAKE_GRID = HostStage(make_grid, _grid)


@dataclasses.dataclass(frozen=True)
class Frame:
    """What all bands of a frame have in common; `shards` of each are cast side by side.

    `limits` are what rays keep to, of which each may take a share of what is `allowed` where pixels are interpolated too.
    Particles are shown `within` a clip, or everywhere.
    """

    ordered: Ordered
    camera: Camera
    transfer: TransferFunction | None
    media: tuple[Medium, ...]
    limits: Limits | None
    plan: Plan
    formulas: Formulas
    shards: int
    allowed: Float[Array, ""] | None
    min_transmittance: Float[Array, ""] | None
    within: Clip | None = None

    @classmethod
    def begun(
        cls, seen: Seen, camera: Camera, settings: Settings, plan: Plan, formulas: Formulas, shards: int, run: Executor
    ) -> Frame:
        """With the particles ranked, which is done once for all bands."""
        static: dict[str, Any] = {"samples": plan.samples, "slab_samples": plan.cast.slab_samples, "tuning": plan.cast.tuning}
        static["between_samples"] = _between_samples(seen.media, plan)
        ordered = run.with_host("grid", ORDER, (seen.viewed, camera, seen.order), **static)
        limits, dtype = limits_of(settings, seen.viewed.x.dtype), seen.viewed.x.dtype
        allowed = None if limits is None else limits.tolerance
        least = array_of(least_transmittance(settings), dtype) if ends(settings) else None
        if least is None and any(medium.stops_rays for medium in seen.media):  # what lets nothing through hides all behind it
            least = array_of(jnp.finfo(dtype).tiny, dtype)
        if limits is not None and plan.quadtree is not None:
            limits = limits._replace(tolerance=product(limits.tolerance, RAY_SHARE))
        return cls(ordered, camera, seen.transfer, seen.media, limits, plan, formulas, shards, allowed, least, seen.within)

    def band(self, first_row: Int[Array, ""], run: Executor) -> Band:
        """The band that begins at a row of pixels."""
        made = self.grid(first_row, run)
        grid = made.of(self.ordered)
        decided, lattice = self.decide(grid, run)
        rays = self.cast(grid, decided, lattice, run)
        of_shards = OfShards(tuple(rays), tuple(one.verdict for one in decided))
        return Band(of_shards, made.lists.faults, made.filled, made.pairs)

    def all_bands(self, run: Executor, kept: Callable[[Band], Any]) -> Drawn:
        """All of them as part of a trace, see `over_bands`; of each, what is `kept`."""

        def draw(first_row: Int[Array, ""]) -> Drawn:
            found = self.band(first_row, run)
            return Drawn(kept(found), found.faults, found.filled, found.pairs)

        return over_bands(self.plan, draw)

    def grid(
        self, first_row: Int[Array, ""], run: Executor, camera: Camera | None = None, lists: ListPlan | None = None
    ) -> BandGrid:
        """Of the band that begins at a row of pixels, or of another camera's nodes."""
        plan = self.plan
        sizes: dict[str, Any] = {"lists": lists or plan.lists, "samples": plan.samples, "tuning": plan.cast.tuning}
        sizes["beside"] = _between_samples(self.media, plan)
        made: BandGrid = run.with_host("grid", MAKE_GRID, (self.ordered, camera or self.camera, first_row), **sizes)
        return made

    def cast(
        self,
        grid: Grid,
        decided: list[Decided],
        lattice: Lattice | None,
        run: Executor,
        camera: Camera | None = None,
    ) -> list[Cast]:
        """What the rays of all packets of a grid meet, shard by shard."""
        plan = self.plan
        each = self._each(run)
        schedules = [one.schedule for one in decided] if lattice is None else [decided[0].schedule] * len(each)
        tolerance = self.limits.tolerance if self.limits is not None and plan.cast.doublings else None
        shown, limits = self.shown._replace(camera=camera or self.camera), RayLimits(self.min_transmittance, tolerance)
        inputs = [(grid, shown, schedule, lattice, limits, nth) for schedule, nth in zip(schedules, each, strict=True)]
        integrator = registry.integrator(*plan.chosen_integrator)
        method = CastMethod(self.formulas.kernel, plan.cast, integrator, every_bundle, self.formulas.mix)
        rays: list[Cast] = run.each("cast", cast_shard, inputs, shards=self.shards, method=method, tuning=plan.cast.tuning)
        return rays

    def _each(self, run: Executor) -> list[Int[Array, ""]]:
        return run.own([array_of(nth, jnp.int32) for nth in range(self.shards)])

    @property
    def shown(self) -> Shown:
        """All but the particles."""
        return Shown(self.camera, self.transfer, self.media, self.within)

    @property
    def _cast(self) -> dict[str, Any]:
        """What most stages are compiled for."""
        return {"cast": self.plan.cast, "tuning": self.plan.cast.tuning}

    def decide(self, grid: Grid, run: Executor) -> tuple[list[Decided], Lattice | None]:
        """What is to be marched, shard by shard; and the lattice, of which there is one decision for all shards."""
        if isinstance(self.plan.control, PilotPlan):
            return self._ask_pilot(grid, self.plan.control, run)
        if self.limits is None or self.plan.control is None:
            return self.leave(grid, run), None
        inputs = [(grid, self.shown, self.limits, nth) for nth in self._each(run)]
        static = {"shards": self.shards, "control": self.plan.control, **self._cast}
        return run.each("adapt", decide_by_bounds, inputs, **static), None

    def leave(self, grid: Grid, run: Executor, camera: Camera | None = None) -> list[Decided]:
        """All slabs at full rate, shard by shard."""
        shown = self.shown._replace(camera=camera or self.camera)
        inputs = [(grid, shown, nth) for nth in self._each(run)]
        return run.each("adapt", decide_full_rate, inputs, shards=self.shards, **self._cast)

    def _ask_pilot(self, grid: Grid, control: PilotPlan, run: Executor) -> tuple[list[Decided], Lattice]:
        view = (grid, self.camera, self.transfer)
        inputs = [(*view, nth) for nth in self._each(run)]
        static = {
            "shards": self.shards,
            "lists": self.plan.lists,
            "control": control,
            "kernel": self.formulas.kernel,
            **self._cast,
        }
        lattices = run.pooled(run.each("adapt", sum_shard, inputs, **static))
        several, tuning = self.shards > 1, self.plan.cast.tuning
        lattice = run.one("adapt", add_lattices, (tuple(lattices),), tuning=tuning) if several else lattices[0]
        # slab by slab what is at hand stays in the cache: one program is faster than shards side by side
        return [run.one("adapt", decide_by_pilot, (grid, self.shown, self.limits, lattice), **self._cast)], lattice


def _between_samples(media: tuple[Medium, ...], plan: Plan) -> bool:
    """Whether any medium meets spheres between samples."""
    return registry.integrator_class(plan.integrator).between or any(medium.between_samples for medium in media)


def over_bands(plan: Plan, draw: Callable[[Int[Array, ""]], Drawn]) -> Drawn:
    """All bands one after the other, given what draws that of a first row; layers lie along a first axis."""
    rows = jnp.arange(plan.bands, dtype=jnp.int32) * plan.band_height
    if plan.bands > 1:  # in reverse mode the grid of a band is made again, as bands are there to spare memory
        policy = jax.checkpoint_policies.save_only_these_names(KEPT)
        found = lax.map(jax.checkpoint(draw, prevent_cse=False, policy=policy), rows)
    else:
        found = jax.tree.map(lambda leaf: leaf[None], draw(rows[0]))
    word = functools.reduce(lambda a, b: a | b, [found.faults[i] for i in range(plan.bands)])
    return Drawn(found.layers, word, found.filled.sum(), found.pairs.sum())
