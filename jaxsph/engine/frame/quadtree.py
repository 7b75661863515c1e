"""Frames whose rays a quadtree chooses: a coarse lattice first, then the corners of leaves that are not good enough.

Flow: frame -> [begin_canvas -> open_band -> choose or mark -> shoot_queues: shoot, paint -> finish] -> layers.

The loop is that of Kratz et al. 2011, section 5; rays go through the same grid, media and integrator as those of all pixels.
`draw_by_quadtree` splits all leaves over the tolerance, band by band. `progressive` splits the worst leaves of all bands, stage
by stage, and yields an image after each, until the tolerance is met or every pixel has its ray.
"""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from jaxsph.engine.access.grid import Grid, unshard
from jaxsph.engine.access.lists import ListPlan
from jaxsph.engine.cast.march import CastMethod, cast
from jaxsph.engine.control.decide import Decided
from jaxsph.engine.field.tasks import evaluations
from jaxsph.engine.frame.finish import finish_image
from jaxsph.engine.frame.frame import Frame
from jaxsph.engine.frame.stages import Counts, Drawing, Layers, ShardResult
from jaxsph.engine.media.shown import RayLimits, Shown
from jaxsph.engine.planning.fit import PLANS
from jaxsph.engine.request import Request
from jaxsph.engine.runtime.clock import Clock
from jaxsph.engine.runtime.programs import stage
from jaxsph.engine.runtime.tuning import Tuning
from jaxsph.engine.screen import canvas as canvases
from jaxsph.engine.screen.canvas import Canvas, Quality, leaves_of, wanted_by, wanted_by_tolerance, worst
from jaxsph.engine.screen.packets import (
    PIXELS,
    SCATTERED,
    SHARING,
    Apart,
    QuadtreePlan,
    Queue,
    by_bundle,
    queued,
    scattered_rays,
    whole_bundles,
)
from jaxsph.model.camera.camera import Camera
from jaxsph.model.image import Image
from jaxsph.model.scene import Scene
from jaxsph.model.settings import Settings, integrator_of
from jaxsph.numerics.checks import array_of, at_once
from jaxsph.numerics.trees import on_host

MAX_SHOTS = 8  # painted together
Shot = tuple[Int[Array, "packets rays"], Float[Array, "packets rays channels"], Float[Array, "packets rays"]]
"""Pixels that some rays go through, what they have met, and the kernel evaluations that they took."""
SHARE = 0.5  # of the squared error: what the leaves hold together that a stage splits
JOIN = stage(quickly=True)(unshard)  # joins the decisions for the shards of a band

Decisions = tuple[Grid, Decided, Decided, Any]
"""Of a band: its grid, decisions for whole bundles and for scattered rays, and the lattice, which serves whole bundles alone."""
Bands = tuple[Decisions, ...]
Queues = tuple[tuple[Queue, Queue], ...]


@stage("lists", "estimated", quickly=True)
def begin(
    rays: tuple[ShardResult, ...], filled: tuple[Array, ...], camera: Camera, *, lists: ListPlan, estimated: bool
) -> Canvas:
    """Make a canvas on which the nodes of a coarse lattice are known, from the results of its shards.

    `estimated`: the canvas has a channel for how wrong rays are.
    """
    met, cast = unshard(rays, 0), unshard(filled).any(0)
    error = met.error if estimated else None
    value = lists.as_image(canvases.channels_of(jnp.moveaxis(met.color, -1, 0), met.transmittance, met.depth, error))
    rows, columns = camera.nodes
    value, spent, cast = (one[:rows, :columns] for one in (value, *map(lists.over_pixels, (met.evaluations, cast))))
    return canvases.of_lattice((camera.height, camera.width), value, spent, cast, camera.stride)


@stage("lists", quickly=True)
def enter_decisions(
    canvas: Canvas, decided: Decided, of_nodes: Float[Array, " bundles"] | None, first_row: Int[Array, ""], *, lists: ListPlan
) -> Canvas:
    """Enter into the canvas what was decided for a band's bundles; pixels whose rays are certain to meet nothing become known."""
    height, width = canvas.shape

    def over_image(of_bundles: Array) -> Array:
        pixels = lists.over_pixels(of_bundles)[:, :width]
        image = jnp.zeros((height + pixels.shape[0], width), pixels.dtype)
        return lax.dynamic_update_slice_in_dim(image, pixels, first_row, 0)[:height]

    return dataclasses.replace(
        canvas,
        known=canvas.known | over_image(~decided.schedule.filled.any(0)),
        spent=canvas.spent if of_nodes is None else canvas.spent + over_image(of_nodes),
        bound=canvas.bound + over_image(jnp.where(decided.bound < jnp.inf, decided.bound, 0)),  # estimated, whatever a jump does
        full=canvas.full + over_image(decided.full),
    )


@stage("lists", "apart", "side", "coarsest", quickly=True)
def choose(
    canvas: Canvas,
    first_row: Int[Array, ""],
    tolerance: Float[Array, ""],
    *,
    lists: ListPlan,
    apart: Apart,
    side: int,
    coarsest: int,
) -> tuple[Queue, Queue]:
    """Queue the rays of a band that leaves of one size want, as their error is over the tolerance."""
    return queued(by_bundle(lists, wanted_by_tolerance(canvas, side, coarsest, tolerance), first_row), apart)


@stage("first_rows", "lists", "apart", "sides", "number", quickly=True)
def mark(
    canvas: Canvas,
    tolerance: Float[Array, ""],
    share: Float[Array, ""],
    *,
    first_rows: tuple[int, ...],
    lists: ListPlan,
    apart: Apart,
    sides: tuple[int, ...],
    number: int | None,
) -> tuple[tuple[tuple[Queue, Queue], ...], Quality]:
    """Queue the rays that the worst leaves want, band by band: `number` leaves, or as few as hold a `share` of the error.

    The second result says how good the image is.
    """
    leaves, quality = leaves_of(canvas, sides, tolerance)
    wanted = wanted_by(worst(leaves, number, share), canvas, sides)
    return tuple(queued(by_bundle(lists, wanted, row), apart) for row in first_rows), quality


@stage("method")
def shoot(band: Decisions, shown: Shown, limits: RayLimits, queue: Queue, *, method: CastMethod, tuning: Tuning) -> Shot:
    """Cast the packets of a queue whose turn it is."""
    (grid, of_bundles, of_rays, lattice), chosen = band, queue.chosen()
    schedule, lattice = (of_bundles.schedule, lattice) if queue.rays == PIXELS else (of_rays.schedule, None)
    shown = shown.of_type(grid.half_steps.dtype)
    rays = cast(grid, schedule, shown, method, lattice=lattice, chosen=chosen, limits=limits)
    color, transmittance, depth = (field.reshape(*field.shape[:-2], -1) for field in (rays.color, rays.transmittance, rays.depth))
    error = None if limits.tolerance is None or rays.error is None else rays.error.reshape(transmittance.shape)
    spent = evaluations(schedule, grid.samples, method.plan.slab_samples)[chosen.bundle]
    if rays.left_out is not None:
        spent = spent - rays.left_out
    if rays.refined is not None:
        spent = spent + rays.refined
    pixel = chosen.pixels(grid, (shown.camera.height, shown.camera.width))
    return pixel, canvases.channels_of(color, transmittance, depth, error), jnp.where(chosen.real.T, spent[:, None], 0)


@stage(quickly=True)
def paint(canvas: Canvas, shots: tuple[Shot, ...], number: Int[Array, ""]) -> Canvas:
    """Paint the pixels of the first `number` shots on the canvas; the other shots are padding."""
    pixel, value, spent = (jnp.stack(parts) for parts in zip(*shots, strict=True))
    real = jnp.arange(len(shots))[:, None, None] < number
    pixel = jnp.where(real, pixel, canvas.known.size)
    return canvases.painted(canvas, pixel.ravel(), value.reshape(-1, value.shape[-1]), spent.ravel())


@stage("coarsest", quickly=True)
def finish(canvas: Canvas, *, coarsest: int) -> Layers:
    """Make the layers of the image, with pixels interpolated where they have no ray."""
    color, transmittance, depth, error = canvases.finished(canvas, coarsest)
    return Layers(color, transmittance, depth, canvas.spent, error, canvas.full, None, canvas.rays)


def draw_by_quadtree(frame: Frame, clock: Clock) -> Drawing:
    """Draw a frame: cast its coarse lattice; then split leaves over the tolerance, band by band, the largest leaves first."""
    frame = frame.with_ranks(clock)
    plan, sizes = frame.plan, sizes_of(frame)
    canvas, *counts = begin_canvas(frame, clock)
    for number, row in enumerate((array_of(first, jnp.int32) for first in frame.first_rows), 1):
        canvas, decisions, counted = open_band(canvas, frame, row, clock)
        counts.append(counted)
        for side in sizes.sides:
            static = {"lists": plan.lists, "apart": apart_of(frame), "side": side, "coarsest": sizes.leaf}
            queues = clock.one("adapt", choose, (canvas, row, tolerance_of(frame)), **static)
            canvas = shoot_queues(canvas, frame, decisions, queues, clock)
        clock.report(number, plan.bands)
    layers = clock.one("image", finish, (canvas,), coarsest=sizes.leaf)
    return Drawing.of(layers, counts, frame.in_view.viewed.faults)


def sizes_of(frame: Frame) -> QuadtreePlan:
    """Sizes of the refinement, in the plan of a frame whose screen is a quadtree."""
    assert frame.plan.quadtree is not None
    return frame.plan.quadtree


def apart_of(frame: Frame) -> Apart:
    """How bundles are cast apart: in few packets where spheres are read, as their rays share that."""
    reads = frame.shown.transfer is not None or any(medium.between_samples for medium in frame.shown.media)
    return SHARING if reads else SCATTERED


def tolerance_of(frame: Frame) -> Float[Array, ""]:
    """The largest error that a pixel may have; without a tolerance -1, so that every leaf is over it."""
    return array_of(-1, frame.in_view.viewed.x.dtype) if frame.allowed is None else frame.allowed.tolerance


def begin_canvas(frame: Frame, clock: Clock) -> tuple[Canvas, Counts]:
    """Cast the coarse lattice, as the pixels of a camera with a stride; return the canvas and the counts of its grid."""
    sizes = sizes_of(frame)
    camera = frame.camera.strided(sizes.stride)
    grid, counts = frame.grid(array_of(0, jnp.int32), clock, camera, sizes.lists)
    decided = frame.at_full_rate(grid, clock, camera)
    rays = tuple(clock.all_shards(frame.cast(grid, decided, None, clock, camera)))
    filled = tuple(clock.all_shards([one.schedule.filled for one in decided]))
    static = {"lists": sizes.lists, "estimated": frame.ray_tolerance is not None}
    canvas: Canvas = clock.one("adapt", begin, (rays, filled, camera), **static)
    return canvas, counts


def open_band(canvas: Canvas, frame: Frame, first_row: Int[Array, ""], clock: Clock) -> tuple[Canvas, Decisions, Counts]:
    """Make a band's grid and decisions, and enter them into the canvas, before any ray of the band is cast.

    Returns:
        The canvas, the decisions, and the counts of the grid.
    """

    def join_shards(decided: list[Decided]) -> Decided:
        shards = clock.all_shards(decided)
        return shards[0] if len(shards) == 1 else clock.one("adapt", JOIN, (tuple(shards),))  # type: ignore[no-any-return]

    grid, counts = frame.grid(first_row, clock)
    decided, lattice = frame.decide(grid, clock)
    of_nodes = None
    if lattice is None:
        of_bundles = of_rays = join_shards(decided)
    else:  # one decision for all shards
        of_bundles, of_rays, of_nodes = decided[0], join_shards(frame.at_full_rate(grid, clock)), lattice.evaluations
    entered: Canvas = clock.one("adapt", enter_decisions, (canvas, of_bundles, of_nodes, first_row), lists=frame.plan.lists)
    return entered, (grid, of_bundles, of_rays, lattice), counts


def shoot_queues(canvas: Canvas, frame: Frame, decisions: Decisions, queues: tuple[Queue, ...], clock: Clock) -> Canvas:
    """Cast the rays of the queues, some bundles at a time, and paint them on the canvas."""
    plan = frame.plan
    scene = decisions, frame.shown, RayLimits(frame.least, frame.ray_tolerance)
    integrator, tuning = integrator_of(plan.integrator), plan.cast.tuning
    for queue in queues:
        cast_plan, most = plan.cast.of_shard(frame.shards).for_rays(queue.rays), queue.bundle.shape[0]
        packets_of = whole_bundles if queue.rays == PIXELS and apart_of(frame) == SHARING else scattered_rays
        method = CastMethod(frame.formulas.kernel, cast_plan, integrator, packets_of, frame.formulas.mix)
        turns, packets = clock.turns(queue.number, sizes_of(frame).packets, -(-most // frame.shards))
        shots = []
        for first in range(0, turns, frame.shards):
            here = clock.shards(min(frame.shards, turns - first))
            inputs = [(*scene, queue.turn(first + nth, packets)) for nth in here]
            shots += clock.all_shards(clock.each("cast", shoot, inputs, method=method, tuning=tuning))
        together = min(-(-most // packets), MAX_SHOTS)  # padded to one length, as each length would be a program
        for first in range(0, len(shots), together):
            some = shots[first : first + together]
            padding = some[-1:] * (together - len(some))
            canvas = clock.one("adapt", paint, (canvas, (*some, *padding), array_of(len(some), jnp.int32)))
    return canvas


@on_host
def progressive(
    scene: Scene, camera: Camera, settings: Settings | None = None, *, worst: int | None = None, share: float = SHARE
) -> Progressive:
    """Render in stages: `for image in jaxsph.progressive(scene, camera, settings): ...`

    The first image is interpolated between the rays of a coarse lattice; each stage splits the leaves of a quadtree that are
    estimated to be worst, casts the rays that are new, and yields a better image (Kratz et al. 2011, section 5). It ends when no
    leaf is expected to be over `settings.tolerance`, or without one when every pixel has a ray that is not certain to be empty.

    Args:
        scene, camera, settings: as for `jaxsph.render`; `settings.leaf_pixels` chooses the first leaves, and `settings.screen` is
            taken to be `"quadtree"`.
        worst: leaves that a stage splits, m of the paper; all with an error as large as the last of them.
        share: if `worst` is not given, each stage splits as few leaves as hold this share in (0, 1] of the sum of all squared
            errors.

    Returns:
        An iterator of images that can be left and gone on with at any time, and begun anew: see `Progressive`.

    Raises:
        ValueError: for a `worst` < 1, a `share` outside (0, 1], traced arguments, and what `jaxsph.render` raises it for.
    """
    if worst is not None and not worst >= 1:
        raise ValueError(f"`worst` must be at least 1 leaf a stage, got {worst}; None splits by `share`")
    if not 0 < share <= 1:
        raise ValueError(f"`share` must lie in (0, 1], got {share}; 1 splits all leaves that are over the tolerance")
    return Progressive(scene, camera, settings or Settings(), worst, share)


class Progressive:
    """Images of one view, each better than the one before; an iterator that ends when the image is good enough.

    What is known of the image is kept when a stage is interrupted: the next call begins that stage again. The grids of all bands
    are kept, too: memory is that of a whole frame, however many bands it has.
    `image.stats` of each holds `stage`, `rays` cast so far, `rays_left` at most until every pixel has its own, `l2_error` (the
    estimated relative L2 norm of the error), `max_error` (the largest error that a pixel is expected to have), `leaves_over`
    the tolerance, and `seconds` of all stages; `image.error_bound` is the error that each pixel is expected to have.
    """

    def __init__(self, scene: Scene, camera: Camera, settings: Settings, worst: int | None, share: float) -> None:
        self._scene, self._camera, self._settings = scene, camera, settings
        self._worst, self._share = worst, share
        self.restart()

    def restart(self, scene: Scene | None = None, camera: Camera | None = None, settings: Settings | None = None) -> Progressive:
        """Begin anew, with another scene, view or settings if given; for a similar frame nothing is compiled."""
        self._scene, self._camera = scene or self._scene, camera or self._camera
        self._settings = dataclasses.replace(settings or self._settings, screen="quadtree")
        self._stage: _Stage | None = None
        return self

    def __iter__(self) -> Progressive:
        return self

    @at_once()
    def __next__(self) -> Image:
        if self._stage is None:
            stage = self._begin()
        elif self._stage.number > 0 and not float(self._stage.quality.over) > 0:  # nothing is left to split
            raise StopIteration
        else:
            stage = self._refine(self._stage, self._frame, self._clock)
        image = self._image(stage)
        self._stage = stage
        return image

    def _begin(self) -> _Stage:
        """Cast the coarse lattice of a new frame; meanwhile the programs of later stages are compiled."""
        clock, request = Clock(), Request.of(self._scene, self._camera, self._settings)
        frame = Frame.of(request, *PLANS.for_frame(request, clock), clock)

        def coarse() -> tuple[Frame, _Stage]:
            ranked = frame.with_ranks(clock)
            canvas, grid = begin_canvas(ranked, clock)
            return ranked, _Stage(0, canvas, (grid,), (), *self._mark(canvas, (), ranked, clock))

        def ahead() -> None:
            ranked, first = coarse()
            canvas = self._refine(first, ranked, clock).canvas
            clock.one("image", finish, (canvas,), coarsest=sizes_of(ranked).leaf)

        self._clock, self._request = clock, request
        self._frame, first = clock.run(coarse, ahead=ahead)
        return first

    def _refine(self, stage: _Stage, frame: Frame, clock: Clock) -> _Stage:
        """Run another stage: split the worst leaves and cast their rays. Before the first one all bands are opened."""
        number, canvas, grids, bands, queues, _ = stage
        if not bands:
            for row in frame.first_rows:
                canvas, decisions, grid = open_band(canvas, frame, array_of(row, jnp.int32), clock)
                grids, bands = (*grids, grid), (*bands, decisions)
            queues, _ = self._mark(canvas, bands, frame, clock)
        for decisions, wanted in zip(bands, queues, strict=True):
            canvas = shoot_queues(canvas, frame, decisions, wanted, clock)
        return _Stage(number + 1, canvas, grids, bands, *self._mark(canvas, bands, frame, clock))

    def _mark(self, canvas: Canvas, bands: Bands, frame: Frame, clock: Clock) -> tuple[Queues, Quality]:
        """Queue the rays that the worst leaves want, for bands that are open; and say how good the image is."""
        tolerance, plan = tolerance_of(frame), frame.plan
        inputs = canvas, tolerance, array_of(self._share, tolerance.dtype)
        static = {"lists": plan.lists, "apart": apart_of(frame), "sides": sizes_of(frame).sides, "number": self._worst}
        return clock.one("adapt", mark, inputs, first_rows=frame.first_rows if bands else (), **static)  # type: ignore[no-any-return]

    def _image(self, stage: _Stage) -> Image:
        layers = self._clock.one("image", finish, (stage.canvas,), coarsest=sizes_of(self._frame).leaf)
        drawing = Drawing.of(layers, stage.grids, self._frame.in_view.viewed.faults)
        stats: dict[str, Any] = {
            "stage": stage.number,
            "rays_left": int((~np.asarray(stage.canvas.known)).sum()),
            "l2_error": float(stage.quality.l2),
            "max_error": float(stage.quality.largest),
            "leaves_over": int(stage.quality.over),
        }
        image = finish_image(drawing, self._frame, self._request.settings, self._clock, **stats)
        return self._request.in_given_unit(image)


class _Stage(NamedTuple):
    """What is known after a stage; `bands` and `queues` are empty after stage 0, which casts the coarse lattice."""

    number: int
    canvas: Canvas
    grids: tuple[Counts, ...]
    bands: Bands
    queues: Queues
    quality: Quality
