"""The stages by which rays are chosen as a frame is drawn, each a program of its own: what `refinement` runs one by one.

Flow: frame -> [refinement stages: begin -> tell -> (choose or mark) -> shoot -> paint -> finish] -> layers.
"""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxsph.engine.access.grid import Grid, unshard
from jaxsph.engine.access.lists import BUNDLE, ListPlan
from jaxsph.engine.cast.adjoint import CastMethod, cast
from jaxsph.engine.field.lattice import Lattice
from jaxsph.engine.field.schedule import evaluations
from jaxsph.engine.frame.layers import Layers
from jaxsph.engine.frame.stages import Cast, Decided, stage
from jaxsph.engine.media.shown import RayLimits, Shown
from jaxsph.engine.runtime.tuning import Tuning
from jaxsph.engine.screen import canvas as canvases
from jaxsph.engine.screen.canvas import Canvas
from jaxsph.engine.screen.marking import Quality, leaves_of, wanted_by, wanted_by_tolerance, worst
from jaxsph.engine.screen.packets import PIXELS, Queue, by_bundle, queued
from jaxsph.model.camera.camera import Camera

Shot = tuple[Int[Array, "packets rays"], Float[Array, "packets rays 6"], Float[Array, "packets rays"]]
"""Where some rays are in the image, what they have met, and the evaluations that they took."""


class Decisions(NamedTuple):
    """How rays of a band are marched: those of whole bundles, and single ones, for which no lattice of nodes serves."""

    grid: Grid
    of_bundles: Decided
    of_rays: Decided
    lattice: Lattice | None


@stage("lists", quickly=True)
def begin(rays: tuple[Cast, ...], filled: tuple[Array, ...], camera: Camera, *, lists: ListPlan, tuning: Tuning) -> Canvas:
    """The canvas on which a coarse lattice is known, shard by shard of its bundles."""
    color = unshard(tuple(one.rays.color for one in rays), 1)
    transmittance, depth = (unshard(tuple(getattr(one.rays, name) for one in rays), 0) for name in ("transmittance", "depth"))
    spent, cast = unshard(tuple(one.evaluations for one in rays)), unshard(filled).any(0)
    value = lists.as_image(canvases.channels_of(color, transmittance, depth))
    rows, columns = camera.nodes
    value, spent, cast = (one[:rows, :columns] for one in (value, lists.over_pixels(spent), lists.over_pixels(cast)))
    return canvases.of_lattice((camera.height, camera.width), value, spent, cast, camera.stride)


@stage(quickly=True)
def join(decided: tuple[Decided, ...], *, tuning: Tuning) -> Decided:
    """What was decided for all bundles of a band, of what was for its shards."""
    return unshard(decided)  # type: ignore[no-any-return]


@stage("lists", quickly=True)
def tell(
    canvas: Canvas,
    decided: Decided,
    of_nodes: Float[Array, " bundles"] | None,
    first_row: Int[Array, ""],
    *,
    lists: ListPlan,
    tuning: Tuning,
) -> Canvas:
    """The canvas with what was decided of a band's bundles; pixels whose rays are certain to meet nothing are known."""
    height, width = canvas.shape

    def over_image(of_bundles: Array) -> Array:
        pixels = lists.over_pixels(of_bundles)[:, :width]
        image = jnp.zeros((height + pixels.shape[0], width), pixels.dtype)
        return lax.dynamic_update_slice_in_dim(image, pixels, first_row, 0)[:height]

    return dataclasses.replace(
        canvas,
        known=canvas.known | over_image(~decided.schedule.filled.any(0)),
        spent=canvas.spent if of_nodes is None else canvas.spent + over_image(of_nodes),
        bound=canvas.bound + over_image(decided.verdict.bound),
        full=canvas.full + over_image(decided.verdict.full),
    )


@stage("lists", "side", "coarsest", quickly=True)
def choose(
    canvas: Canvas,
    first_row: Int[Array, ""],
    tolerance: Float[Array, ""],
    *,
    lists: ListPlan,
    side: int,
    coarsest: int,
    tuning: Tuning,
) -> tuple[Queue, Queue]:
    """Rays that leaves of one side want, of a band."""
    return _queues(wanted_by_tolerance(canvas, side, coarsest, tolerance), first_row, lists)


def _queues(wanted: Bool[Array, "height width"], first_row: Any, lists: ListPlan) -> tuple[Queue, Queue]:
    """Of the wanted rays that are a band's."""
    rows = lists.bundles[0] * BUNDLE
    band = lax.dynamic_slice_in_dim(jnp.pad(wanted, ((0, rows), (0, 0))), first_row, rows, 0)
    return queued(by_bundle(lists, band))


@stage("first_rows", "lists", "sides", "number", quickly=True)
def mark(
    canvas: Canvas,
    tolerance: Float[Array, ""],
    share: Float[Array, ""],
    *,
    first_rows: tuple[int, ...],
    lists: ListPlan,
    sides: tuple[int, ...],
    number: int | None,
    tuning: Tuning,
) -> tuple[tuple[tuple[Queue, Queue], ...], Quality]:
    """Rays that the worst leaves want, so many or as few as hold a share of the error, band by band; how good the image is."""
    leaves, quality = leaves_of(canvas, sides, tolerance)
    wanted = wanted_by(worst(leaves, number, share), canvas, sides)
    return tuple(_queues(wanted, row, lists) for row in first_rows), quality


@stage("method")
def shoot(
    band: Decisions,
    shown: Shown,
    limits: RayLimits,
    queue: Queue,
    *,
    method: CastMethod,
    tuning: Tuning,
) -> Shot:
    """Cast the packets of a queue whose turn it is."""
    grid, chosen = band.grid, queue.chosen()
    schedule, lattice = (band.of_bundles.schedule, band.lattice) if queue.rays == PIXELS else (band.of_rays.schedule, None)
    shown = shown.of_type(grid.half_steps.dtype)
    rays = cast(grid, schedule, shown, method, lattice=lattice, chosen=chosen, limits=limits)
    color, *others = (field.reshape(*field.shape[:-2], -1) for field in (rays.color, rays.transmittance, rays.depth))
    spent = evaluations(schedule, grid.samples, method.plan.slab_samples)[chosen.bundle]
    if rays.left_out is not None:
        spent = spent - rays.left_out
    pixel = chosen.pixels(grid, (shown.camera.height, shown.camera.width))
    return pixel, canvases.channels_of(color, *others), jnp.where(chosen.real.T, spent[:, None], 0)


@stage(quickly=True)
def paint(canvas: Canvas, shots: tuple[Shot, ...], number: Int[Array, ""], *, tuning: Tuning) -> Canvas:
    """Put on the canvas what so many of some shots have met; others are room."""
    pixel, value, spent = (jnp.stack(parts) for parts in zip(*shots, strict=True))
    real = jnp.arange(len(shots))[:, None, None] < number
    pixel = jnp.where(real, pixel, canvas.known.size)
    return canvases.painted(canvas, pixel.ravel(), value.reshape(-1, value.shape[-1]), spent.ravel())


@stage("coarsest", quickly=True)
def finish(canvas: Canvas, *, coarsest: int, tuning: Tuning) -> Layers:
    """The layers of the image."""
    color, transmittance, depth, error = canvases.finished(canvas, coarsest)
    return Layers(color, transmittance, depth, canvas.spent, canvas.bound + error, canvas.full, None, canvas.rays)
