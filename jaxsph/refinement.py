"""A frame whose rays are chosen as it is drawn: a coarse lattice first, then the corners of leaves that are not good enough.

Flow: frame -> coarse grid, cast -> [refinement: estimate -> split -> cast] for each size of leaves -> layers.

The loop is that of Kratz et al. 2011, section 5; rays go through the same grid, media and integrator as those of all pixels.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxsph.access.grid import Grid
from jaxsph.access.lists import BUNDLE, ListPlan
from jaxsph.access.shards import unshard
from jaxsph.cast.adjoint import CastMethod, cast
from jaxsph.cast.batches import CastPlan
from jaxsph.field.lattice import Lattice
from jaxsph.field.schedule import SlabSchedule, evaluations
from jaxsph.frame import Band, Frame
from jaxsph.layers import Layers, OfShards
from jaxsph.model import registry
from jaxsph.model.camera import Camera
from jaxsph.model.medium import Medium
from jaxsph.model.scene import Formulas
from jaxsph.model.transfer import TransferFunction
from jaxsph.numerics.executors import Executor
from jaxsph.numerics.tuning import Tuning
from jaxsph.screen import canvas as canvases
from jaxsph.screen.canvas import Canvas
from jaxsph.screen.estimators import ESTIMATORS
from jaxsph.screen.marking import Quality, holding, leaves_of, wanted_by, worst
from jaxsph.screen.packets import SCATTERED, Queue, by_bundle, queued, scattered, scattered_packets, whole, whole_packets
from jaxsph.screen.quadtree import QuadtreePlan
from jaxsph.stages import BandGrid, Cast, Decided, Verdict, stage

MAX_SHOTS = 8  # painted together
KINDS = {"scattered": (scattered, scattered_packets), "whole": (whole, whole_packets)}


class Shot(NamedTuple):
    """What some rays have met, and where they are in the image."""

    pixel: Int[Array, "packets rays"]
    value: Float[Array, "packets rays 6"]
    spent: Float[Array, "packets rays"]

    def nowhere(self, pixels: int) -> Shot:
        """As many rays beyond the last of so many pixels."""
        pixel, *others = (jnp.zeros(part.shape, part.dtype) for part in self)
        return Shot(pixel + pixels, *others)


class Decisions(NamedTuple):
    """How rays of a band are marched: those of whole bundles, and single ones, for which no lattice of nodes serves."""

    grid: Grid
    of_bundles: Decided
    of_rays: Decided
    lattice: Lattice | None

    @property
    def verdict(self) -> Verdict:
        """What the image tells of them."""
        return self.of_bundles.verdict

    @property
    def of_nodes(self) -> Float[Array, " bundles"]:
        """Evaluations of the lattice of nodes, a pixel of each bundle."""
        return jnp.zeros_like(self.verdict.full) if self.lattice is None else self.lattice.evaluations


@stage("lists", quickly=True)
def begin(rays: tuple[Cast, ...], filled: tuple[Array, ...], camera: Camera, *, lists: ListPlan, tuning: Tuning) -> Canvas:
    """The canvas on which a coarse lattice is known, shard by shard of its bundles."""
    color = unshard(tuple(one.rays.color for one in rays), 1)
    transmittance, depth = (unshard(tuple(getattr(one.rays, name) for one in rays), 0) for name in ("transmittance", "depth"))
    spent, cast = unshard(tuple(one.evaluations for one in rays)), unshard(filled).any(0)
    value = lists.as_image(canvases.channels_of(color, transmittance, depth))
    spent, cast = _at_pixels(lists, spent), _at_pixels(lists, cast)
    rows, columns = camera.nodes
    made = canvases.blank((camera.height, camera.width), value.dtype)
    value, spent, cast = (one[:rows, :columns] for one in (value, spent, cast))
    return canvases.painted_on_lattice(made, value, spent, cast, camera.stride)


class BandView(NamedTuple):
    """Where a band lies in an image of some shape."""

    lists: ListPlan
    shape: tuple[int, int]
    first_row: Int[Array, ""]

    @property
    def rows(self) -> int:
        """Of its pixels, as many as its bundles have."""
        return self.lists.bundles[0] * BUNDLE

    def in_band(self, image: Array) -> Array:
        """The rows of an image that it has."""
        return lax.dynamic_slice_in_dim(jnp.pad(image, ((0, self.rows), (0, 0))), self.first_row, self.rows, 0)

    def seen(self, canvas: Canvas, filled: Array, bound: Array) -> tuple[Canvas, Float[Array, "height width"]]:
        """The canvas, on which rays are known that are certain to meet nothing; and how wrong rays can be, a pixel."""
        empty = self.over_image(~filled.any(0), False)
        return dataclasses.replace(canvas, known=canvas.known | empty), self.over_image(lax.stop_gradient(bound), 0)

    def over_image(self, of_bundles: Array, beyond: Any) -> Array:
        """What its bundles have, at their pixels; and something else beyond."""
        pixels = _at_pixels(self.lists, of_bundles)[:, : self.shape[1]]
        image = jnp.full((self.shape[0] + self.rows, self.shape[1]), beyond, pixels.dtype)
        return lax.dynamic_update_slice_in_dim(image, pixels, self.first_row, 0)[: self.shape[0]]


def _at_pixels(lists: ListPlan, of_bundles: Array) -> Array:
    return lists.as_image(jnp.broadcast_to(of_bundles[:, None, None], (of_bundles.shape[0], BUNDLE, BUNDLE)))


@stage("lists", "side", "coarsest", "estimator", quickly=True)
def choose(
    canvas: Canvas,
    filled: Bool[Array, "slabs bundles"],
    bound: Float[Array, " bundles"],
    first_row: Int[Array, ""],
    tolerance: Float[Array, ""],
    *,
    lists: ListPlan,
    side: int,
    coarsest: int,
    estimator: str,
    tuning: Tuning,
) -> tuple[Canvas, Queue, Queue]:
    """Rays that leaves of one side want, of a band; pixels whose rays are certain to be empty are known without."""
    view = BandView(lists, canvas.shape, first_row)
    canvas, of_pixels = view.seen(canvas, filled, bound)
    wanted = canvases.wanted_by_tolerance(canvas, side, coarsest, ESTIMATORS[estimator], tolerance, of_pixels)
    return canvas, *queued(by_bundle(lists, view.in_band(wanted)))


@stage("lists", "sizes", "number", quickly=True)
def mark(
    canvas: Canvas,
    filled: Bool[Array, "slabs bundles"],
    bound: Float[Array, " bundles"],
    first_row: Int[Array, ""],
    tolerance: Float[Array, ""],
    share: Float[Array, ""],
    *,
    lists: ListPlan,
    sizes: QuadtreePlan,
    number: int | None,
    tuning: Tuning,
) -> tuple[Canvas, Queue, Queue, Quality]:
    """Rays that the worst leaves want, so many or as few as hold a share of the error; and how good the image is."""
    view = BandView(lists, canvas.shape, first_row)
    canvas, of_pixels = view.seen(canvas, filled, bound)
    leaves, quality = leaves_of(canvas, sizes.sides, sizes.leaf, ESTIMATORS[sizes.estimator], tolerance, of_pixels)
    marked = holding(leaves, share) if number is None else worst(leaves, number)
    wanted = wanted_by(marked, canvas, sizes.sides)
    return canvas, *queued(by_bundle(lists, view.in_band(wanted))), quality


@stage("sizes", quickly=True)
def judge(
    canvas: Canvas, bound: Float[Array, "height width"], tolerance: Array, *, sizes: QuadtreePlan, tuning: Tuning
) -> Quality:
    """How good a canvas is said to be."""
    return leaves_of(canvas, sizes.sides, sizes.leaf, ESTIMATORS[sizes.estimator], tolerance, bound)[1]


@stage("shape", "packets", "kind", "cast_plan", "integrator", "formulas")
def shoot(
    grid: Grid,
    camera: Camera,
    transfer: TransferFunction | None,
    media: tuple[Medium, ...],
    schedule: SlabSchedule,
    lattice: Lattice | None,
    queue: Queue,
    first: Int[Array, ""],
    *,
    shape: tuple[int, int],
    packets: int,
    kind: str,
    cast_plan: CastPlan,
    integrator: tuple[Any, ...],
    formulas: Formulas,
    tuning: Tuning,
) -> Shot:
    """Cast the rays of so many bundles of a queue."""
    transfer = jax.tree.map(lambda leaf: leaf.astype(grid.half_steps.dtype), transfer)
    pick, packets_of = KINDS[kind]
    chosen, made = pick(queue, first, packets), registry.integrator(*integrator)
    method = CastMethod(formulas.kernel, cast_plan, made, packets_of, formulas.mix)
    rays = cast(grid, schedule, camera, transfer, media, method, lattice, chosen)
    color, *others = (field.reshape(*field.shape[:-2], -1) for field in (rays.color, rays.transmittance, rays.depth))
    spent = evaluations(schedule, grid.samples, cast_plan.slab_samples, made.halo)[chosen.bundle]
    spent = jnp.where(chosen.real.T, spent[:, None], 0)
    return Shot(chosen.pixels(grid, shape), canvases.channels_of(color, *others), spent)


@stage(quickly=True)
def paint(canvas: Canvas, shots: tuple[Shot, ...], *, tuning: Tuning) -> Canvas:
    """Put what rays have met on the canvas."""
    together = [jnp.concatenate([part.reshape(-1, *part.shape[2:]) for part in parts]) for parts in zip(*shots, strict=True)]
    return canvases.painted(canvas, *together)


@stage("coarsest", "estimator", quickly=True)
def finish(canvas: Canvas, told: Told, *, coarsest: int, estimator: str, tuning: Tuning) -> Layers:
    """The layers of the image."""
    color, transmittance, depth, error = canvases.finished(canvas, coarsest, ESTIMATORS[estimator])
    spent = canvas.spent + told.of_nodes
    return Layers(color, transmittance, depth, spent, told.bound + error, told.full, None, canvas.rays)


@stage(quickly=True)
def join(decided: tuple[Decided, ...], *, tuning: Tuning) -> Decided:
    """What was decided for all bundles of a band, of what was for its shards."""
    return unshard(decided)  # type: ignore[no-any-return]


class Told(NamedTuple):
    """What is told of each pixel besides its light: how wrong its ray can be; evaluations at full rate, and those of nodes."""

    bound: Float[Array, "height width"]
    full: Float[Array, "height width"]
    of_nodes: Float[Array, "height width"]


@stage("height", "width", "lists", quickly=True)
def spread_over(
    verdicts: tuple[Verdict, ...],
    of_nodes: tuple[Float[Array, " bundles"], ...],
    *,
    height: int,
    width: int,
    lists: ListPlan,
    tuning: Tuning,
) -> Told:
    """What is told of all pixels, of the bundles of bands."""

    def image(of_bands: tuple[Array, ...]) -> Array:
        return jnp.concatenate([_at_pixels(lists, one) for one in of_bands])[:height, :width]

    return Told(image(tuple(one.bound for one in verdicts)), image(tuple(one.full for one in verdicts)), image(of_nodes))


@dataclasses.dataclass(frozen=True)
class Refinement:
    """How a frame's canvas is filled."""

    frame: Frame
    sizes: QuadtreePlan
    run: Executor

    @classmethod
    def of(cls, frame: Frame, run: Executor) -> Refinement:
        """That of a frame whose plan has one."""
        assert frame.plan.quadtree is not None
        return cls(frame, frame.plan.quadtree, run)

    def begun(self) -> tuple[Canvas, BandGrid]:
        """The canvas with the first lattice cast, and the grid of that."""
        frame, run, lists = self.frame, self.run, self.sizes.lists
        camera = frame.camera.strided(self.sizes.stride)
        made = frame.grid(jnp.int32(0), run, camera, lists)
        grid = made.of(frame.ordered)
        decided = frame.leave(grid, run, with_levels=False, camera=camera)
        rays = tuple(frame.cast(grid, decided, None, run, camera))
        filled = tuple(one.schedule.filled for one in decided)
        canvas: Canvas = run.one("adapt", begin, (rays, filled, camera), lists=lists, **self._tuned)
        return canvas, made

    def band(self, canvas: Canvas, first_row: Int[Array, ""]) -> tuple[Canvas, BandGrid, Decisions]:
        """With the leaves of a band split as long as they are not good enough."""
        decisions, made = self.decided(first_row)
        for side in self.sizes.sides:
            canvas, *queues = self._choose(canvas, decisions.of_bundles, first_row, side)
            canvas = self.shot(canvas, decisions, *queues)
        return canvas, made, decisions

    def decided(self, first_row: Int[Array, ""]) -> tuple[Decisions, BandGrid]:
        """The grid of a band, and how rays are to be marched there."""
        frame, run = self.frame, self.run
        made = frame.grid(first_row, run)
        grid = made.of(frame.ordered)
        decided, lattice = frame.decide(grid, run)
        of_bundles = of_rays = self._joined(decided)
        if lattice is not None:
            of_rays = self._joined(frame.leave(grid, run, with_levels=False))
        return Decisions(grid, of_bundles, of_rays, lattice), made

    def marked(
        self, canvas: Canvas, decisions: Decisions, first_row: Int[Array, ""], number: int | None, share: float
    ) -> tuple[Canvas, Queue, Queue, Quality]:
        """Rays that the worst leaves want, and how good the canvas is said to be."""
        filled, bound = decisions.of_bundles.schedule.filled, decisions.of_bundles.verdict.bound
        inputs = canvas, filled, bound, first_row, self._allowed(bound.dtype), jnp.asarray(share, bound.dtype)
        static = {"lists": self.frame.plan.lists, "sizes": self.sizes.with_room(1, 1), "number": number}
        return self.run.one("adapt", mark, inputs, **static, **self._tuned)  # type: ignore[no-any-return]

    def judged(self, canvas: Canvas) -> Quality:
        """How good the canvas is said to be, before any band is known."""
        bound = self._told([]).bound
        inputs = canvas, bound, self._allowed(bound.dtype)
        quality: Quality = self.run.one("adapt", judge, inputs, sizes=self.sizes.with_room(1, 1), **self._tuned)
        return quality

    def _allowed(self, dtype: Any) -> Float[Array, ""]:
        return jnp.asarray(-1, dtype) if self.frame.allowed is None else self.frame.allowed

    def _told(self, bands: list[Decisions]) -> Told:
        """What is told of all pixels; nothing where no band is known yet."""
        plan = self.frame.plan
        if not bands:
            nothing = jnp.zeros((plan.height, plan.width), self.frame.ordered.x.dtype)
            return Told(nothing, nothing, nothing)
        size = {"height": plan.height, "width": plan.width, "lists": plan.lists}
        inputs = tuple(one.verdict for one in bands), tuple(one.of_nodes for one in bands)
        told: Told = self.run.one("image", spread_over, inputs, **size, **self._tuned)
        return told

    def shot(self, canvas: Canvas, decisions: Decisions, scattered: Queue, whole: Queue) -> Canvas:
        """With the rays cast that are queued."""
        apart = self._shoot("scattered", scattered, decisions.grid, decisions.of_rays.schedule, None)
        whole_ones = self._shoot("whole", whole, decisions.grid, decisions.of_bundles.schedule, decisions.lattice)
        return self._paint(self._paint(canvas, apart), whole_ones)

    def finished(self, canvas: Canvas, bands: list[Decisions]) -> Layers:
        """The layers of the image."""
        static = {"coarsest": self.sizes.leaf, "estimator": self.sizes.estimator, **self._tuned}
        layers: Layers = self.run.one("image", finish, (canvas, self._told(bands)), **static)
        return layers

    @property
    def _tuned(self) -> dict[str, Any]:
        return {"tuning": self.frame.plan.cast.tuning}

    def _choose(self, canvas: Canvas, decision: Decided, first_row: Array, side: int) -> tuple[Any, ...]:
        bound = decision.verdict.bound
        inputs = canvas, decision.schedule.filled, bound, first_row, self._allowed(bound.dtype)
        static = {"lists": self.frame.plan.lists, "side": side, "coarsest": self.sizes.leaf, "estimator": self.sizes.estimator}
        return self.run.one("adapt", choose, inputs, **static, **self._tuned)  # type: ignore[no-any-return]

    def _joined(self, decided: list[Decided]) -> Decided:
        joined: Decided = decided[0] if len(decided) == 1 else self.run.one("adapt", join, (tuple(decided),), **self._tuned)
        return joined

    def _shoot(self, kind: str, queue: Queue, grid: Grid, schedule: SlabSchedule, lattice: Lattice | None) -> list[Shot]:
        """Cast what a queue holds, some bundles at a time."""
        frame, plan = self.frame, self.frame.plan
        turns, packets = self.run.turns(queue.number, self.sizes.packets, plan.lists.num_bundles)
        cast_plan = plan.cast.of_shard(frame.shards)
        if kind == "scattered":
            cast_plan = cast_plan.for_rays(SCATTERED)
        scene = grid, frame.camera, frame.transfer, frame.media, schedule, lattice, queue
        inputs = [(*scene, jnp.int32(turn * packets)) for turn in range(turns)]
        static = {"shape": (plan.height, plan.width), "packets": packets, "kind": kind, "cast_plan": cast_plan}
        method = {"integrator": plan.chosen_integrator, "formulas": frame.formulas, **self._tuned}
        return [
            shot
            for first in range(0, turns, frame.shards)
            for shot in self.run.each("cast", shoot, inputs[first : first + frame.shards], **static, **method)
        ]

    def _paint(self, canvas: Canvas, shots: list[Shot]) -> Canvas:
        """In groups of one size, as each size is a program: filled up with such as paint nothing."""
        plan = self.frame.plan
        size = min(-(-plan.lists.num_bundles // shots[0].pixel.shape[0]), MAX_SHOTS) if shots else 1
        for first in range(0, len(shots), size):
            some = shots[first : first + size]
            room = (some[0].nowhere(plan.width * plan.height),) * (size - len(some))
            canvas = self.run.one("adapt", paint, (canvas, (*some, *room)), **self._tuned)
        return canvas


def refined(frame: Frame, run: Executor, progress: Callable[[int, int], None] | None) -> tuple[list[Band], Layers]:
    """All bands of a frame, of which the first is that of its coarse lattice; and the layers of the image."""
    filling = Refinement.of(frame, run)
    canvas, coarse = filling.begun()
    bands, decided, plan = [_counted(coarse)], [], frame.plan
    for nth in range(plan.bands):
        canvas, made, decisions = filling.band(canvas, jnp.int32(nth * plan.band_height))
        bands.append(_counted(made))
        decided.append(decisions)
        if progress is not None:
            progress(nth + 1, plan.bands)
    return bands, filling.finished(canvas, decided)


def _counted(made: BandGrid) -> Band:
    return Band(OfShards((), ()), made.lists.faults, made.filled, made.pairs)
