"""The stages by which rays are chosen as a frame is drawn, each a program of its own: what `refinement` runs one by one.

Flow: frame -> [refinement stages: begin -> (choose or mark) -> shoot -> paint -> finish] -> layers.
"""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxsph.engine.access.grid import Grid
from jaxsph.engine.access.lists import BUNDLE, ListPlan
from jaxsph.engine.access.shards import unshard
from jaxsph.engine.cast.adjoint import CastMethod, cast
from jaxsph.engine.cast.batches import CastPlan
from jaxsph.engine.field.lattice import Lattice
from jaxsph.engine.field.schedule import SlabSchedule, evaluations
from jaxsph.engine.frame.layers import Layers
from jaxsph.engine.frame.stages import Cast, Decided, Verdict, stage
from jaxsph.engine.runtime.tuning import Tuning
from jaxsph.engine.screen import canvas as canvases
from jaxsph.engine.screen.canvas import Canvas
from jaxsph.engine.screen.estimators import ESTIMATORS
from jaxsph.engine.screen.marking import Quality, holding, leaves_of, wanted_by, worst
from jaxsph.engine.screen.packets import Queue, by_bundle, queued, scattered, scattered_packets, whole, whole_packets
from jaxsph.engine.screen.quadtree import QuadtreePlan
from jaxsph.model import registry
from jaxsph.model.camera.camera import Camera
from jaxsph.model.clips.clips import Clip
from jaxsph.model.medium import Medium
from jaxsph.model.scene import Formulas
from jaxsph.model.transfer.function import TransferFunction

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
    min_transmittance: Float[Array, ""] | None,
    first: Int[Array, ""],
    within: Clip | None = None,
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
    rays = cast(grid, schedule, camera, transfer, media, method, lattice, chosen, min_transmittance, None, within)
    color, *others = (field.reshape(*field.shape[:-2], -1) for field in (rays.color, rays.transmittance, rays.depth))
    spent = evaluations(schedule, grid.samples, cast_plan.slab_samples, made.halo)[chosen.bundle]
    if rays.left_out is not None:
        spent = spent - rays.left_out
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
