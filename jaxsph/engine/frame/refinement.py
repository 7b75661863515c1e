"""A frame whose rays are chosen as it is drawn: a coarse lattice first, then the corners of leaves that are not good enough.

Flow: frame -> coarse grid, cast -> [refinement: estimate -> split -> cast] for each size of leaves -> layers.

The loop is that of Kratz et al. 2011, section 5; rays go through the same grid, media and integrator as those of all pixels.
`refined` splits whatever is over the tolerance, band by band; `progressive` the worst leaves of all bands, by the same steps.
"""

from __future__ import annotations

from collections.abc import Callable

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxsph.engine.cast.adjoint import CastMethod
from jaxsph.engine.frame.frame import Frame
from jaxsph.engine.frame.layers import Band, Drawn, Layers, OfShards
from jaxsph.engine.frame.refinement_stages import Decisions, begin, choose, finish, join, paint, shoot, tell
from jaxsph.engine.frame.stages import BandGrid, Decided
from jaxsph.engine.media.shown import RayLimits
from jaxsph.engine.runtime.executors import Executor
from jaxsph.engine.screen.canvas import Canvas
from jaxsph.engine.screen.packets import Queue, packets_of
from jaxsph.engine.screen.pyramid import QuadtreePlan
from jaxsph.model import registry
from jaxsph.numerics.checks import array_of

MAX_SHOTS = 8  # painted together


def refined(frame: Frame, run: Executor, faults: Int[Array, ""], progress: Callable[[int, int], None] | None = None) -> Drawn:
    """All bands of a frame, after its coarse lattice; `faults` are those of what is seen."""
    plan, sizes = frame.plan, sizes_of(frame)
    canvas, coarse = begun(frame, run)
    bands = [coarse]
    for nth in range(plan.bands):
        row = array_of(nth * plan.band_height, jnp.int32)
        canvas, decisions, band = opened(canvas, frame, row, run)
        bands.append(band)
        for side in sizes.sides:
            static = {"lists": plan.lists, "side": side, "coarsest": sizes.leaf, "tuning": plan.cast.tuning}
            queues = run.one("adapt", choose, (canvas, row, tolerance_of(frame)), **static)
            canvas = shot(canvas, frame, decisions, queues, run)
        if progress is not None:
            progress(nth + 1, plan.bands)
    return Drawn.of(finished(canvas, frame, run), bands, faults)


def sizes_of(frame: Frame) -> QuadtreePlan:
    """Of the refinement of a frame whose plan has one."""
    assert frame.plan.quadtree is not None
    return frame.plan.quadtree


def tolerance_of(frame: Frame) -> Float[Array, ""]:
    """What a pixel may be wrong by; without a tolerance less than nothing, so that every leaf is over it."""
    return array_of(-1, frame.ordered.x.dtype) if frame.allowed is None else frame.allowed


def begun(frame: Frame, run: Executor) -> tuple[Canvas, Band]:
    """The canvas with the first lattice cast, and what is known of its grid."""
    sizes = sizes_of(frame)
    camera = frame.camera.strided(sizes.stride)
    made = frame.grid(array_of(0, jnp.int32), run, camera, sizes.lists)
    grid = made.of(frame.ordered)
    decided = frame.leave(grid, run, camera)
    rays = tuple(frame.cast(grid, decided, None, run, camera))
    filled = tuple(one.schedule.filled for one in decided)
    canvas: Canvas = run.one("adapt", begin, (rays, filled, camera), lists=sizes.lists, tuning=frame.plan.cast.tuning)
    return canvas, _counted(made)


def opened(canvas: Canvas, frame: Frame, first_row: Int[Array, ""], run: Executor) -> tuple[Canvas, Decisions, Band]:
    """The canvas with what is known of a band before a ray is cast; how rays are to be marched there; and its grid's counts."""
    tuning = frame.plan.cast.tuning

    def joined(decided: list[Decided]) -> Decided:
        return decided[0] if len(decided) == 1 else run.one("adapt", join, (tuple(decided),), tuning=tuning)  # type: ignore[no-any-return]

    made = frame.grid(first_row, run)
    grid = made.of(frame.ordered)
    decided, lattice = frame.decide(grid, run)
    of_bundles = of_rays = joined(decided)
    of_nodes = None
    if lattice is not None:
        of_rays, of_nodes = joined(frame.leave(grid, run)), lattice.evaluations
    told: Canvas = run.one("adapt", tell, (canvas, of_bundles, of_nodes, first_row), lists=frame.plan.lists, tuning=tuning)
    return told, Decisions(grid, of_bundles, of_rays, lattice), _counted(made)


def shot(canvas: Canvas, frame: Frame, decisions: Decisions, queues: tuple[Queue, ...], run: Executor) -> Canvas:
    """With the rays cast that are queued, some bundles at a time."""
    plan, most = frame.plan, frame.plan.lists.num_bundles
    scene = decisions, frame.shown, RayLimits(frame.min_transmittance)
    integrator, tuning = registry.integrator(*plan.chosen_integrator), plan.cast.tuning
    for queue in queues:
        cast_plan = plan.cast.of_shard(frame.shards).for_rays(queue.rays)
        method = CastMethod(frame.formulas.kernel, cast_plan, integrator, packets_of, frame.formulas.mix)
        turns, packets = run.turns(queue.number, sizes_of(frame).packets, most)
        shots = []
        for first in range(0, turns, frame.shards):
            inputs = [(*scene, queue.turn(nth, packets)) for nth in range(first, min(first + frame.shards, turns))]
            shots += run.each("cast", shoot, inputs, method=method, tuning=tuning)
        together = min(-(-most // packets), MAX_SHOTS)  # filled up with room, as each number is a program
        for first in range(0, turns, together):
            some = shots[first : first + together]
            room = some[-1:] * (together - len(some))
            canvas = run.one("adapt", paint, (canvas, (*some, *room), array_of(len(some), jnp.int32)), tuning=tuning)
    return canvas


def finished(canvas: Canvas, frame: Frame, run: Executor) -> Layers:
    """The layers of the image."""
    layers: Layers = run.one("image", finish, (canvas,), coarsest=sizes_of(frame).leaf, tuning=frame.plan.cast.tuning)
    return layers


def _counted(made: BandGrid) -> Band:
    """What is known of a band whose rays are those of the whole canvas."""
    return Band(OfShards((), ()), made.lists.faults, made.filled, made.pairs)
