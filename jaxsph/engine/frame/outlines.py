"""Frames that cast several rays through pixels at outlines (antialiasing).

Flow: frame -> [draw_outlines: all bundles -> layers -> edges -> queue_parts -> parts_of_turn -> cast -> paint_parts] -> layers.

All pixels are drawn by one ray, then those at silhouettes by several. A part (`screen.packets.Parts`) is a square of a bundle,
with as many rays as a bundle has: N of them across each of its pixels. It reads the bundle's list, which holds whatever any ray
through a pixel can meet, as spheres reach half a pixel farther (`access.view.view_particles`). So whole bundles and parts are
packets of one program, and what is at edges is paid for alone.

Of a pixel that several rays are cast through, colour and transmittance are the mean of them all; depth and normal are those of
the ray at whose depth half of them have met something, where transmittance falls to 1/2. Along one straight edge the share of
a pixel that is covered is counted to about 1 / (2 N). What is narrower than a pixel and lies between the middles of all of them
is not seen.
"""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxsph.engine.access.grid import Grid, shard as shard_of, shard_of_grid
from jaxsph.engine.access.lists import BUNDLE, ListPlan
from jaxsph.engine.cast.batches import CastPlan, batches_of
from jaxsph.engine.field.tasks import SlabSchedule
from jaxsph.engine.frame.frame import Frame
from jaxsph.engine.frame.stages import Drawing, Layers, ShardResult
from jaxsph.engine.media.shown import Band, Mixture, Shown
from jaxsph.engine.runtime.clock import Clock
from jaxsph.engine.runtime.programs import stage
from jaxsph.engine.runtime.tuning import Tuning
from jaxsph.engine.screen.packets import Parts, by_bundle, rays_of_parts
from jaxsph.model.camera.camera import Camera
from jaxsph.numerics.checks import array_of

CONTRAST = 0.06  # of a colour or of alpha, that is seen as an edge
LEAP = 1.5  # widths of a pixel, that depths of three in a row are off a straight line by, where one surface ends before another
PartQueue = tuple[Int[Array, "shards parts"], Int[Array, " shards"], Int[Array, ""]]
"""Numbers of the parts of each shard's bundles, wanted ones first; how many are wanted of each shard; the largest of these."""


@stage("number", quickly=True)
def edges(layers: Layers, camera: Camera, *, number: int) -> tuple[Bool[Array, "rows columns"], Layers]:
    """Find pixels at silhouettes: alpha differs from that of one of the four around, or colour differs and depth leaps.

    A straight edge that crosses a pixel lies between its middle and one of theirs. The layers are returned too, with `full` as if
    all pixels had `number` squared rays.
    """
    color, transmittance, depth = (lax.stop_gradient(layer) for layer in layers[:3])
    value = jnp.concatenate([color, transmittance[..., None]], -1)
    length = 2 / camera.height * camera.half_height * (depth if camera.is_perspective else jnp.ones_like(depth))
    given = value, depth, length
    wanted = _edges_down(*given) | _edges_down(*(jnp.swapaxes(of, 0, 1) for of in given)).T
    return wanted, layers._replace(full=layers.full * number**2)


def _edges_down(
    value: Float[Array, "rows columns 4"], depth: Float[Array, "rows columns"], length: Float[Array, "rows columns"]
) -> Bool[Array, "rows columns"]:
    """Pixels with an edge to the one above or below. Depths leap between two that bend opposite ways there."""
    wide = jnp.pad(depth, ((1, 1), (0, 0)), mode="edge")
    bent = (wide[:-2] + wide[2:] - 2 * depth) / length
    unknown = ~jnp.isfinite(bent)  # next to nothing: it may bend either way
    bends = [unknown | (sign * bent > LEAP) for sign in (1, -1)]
    leaps = (bends[0][1:] & bends[1][:-1]) | (bends[1][1:] & bends[0][:-1])
    differs = jnp.abs(value[1:] - value[:-1]) > CONTRAST
    edge = differs[..., 3] | (differs.any(-1) & leaps)
    return jnp.pad(edge, ((1, 0), (0, 0))) | jnp.pad(edge, ((0, 1), (0, 0)))


@stage("lists", "number", "shards", quickly=True)
def queue_parts(
    wanted: Bool[Array, "height width"], first_row: Int[Array, ""], *, lists: ListPlan, number: int, shards: int
) -> PartQueue:
    """Queue the parts of a band's bundles that hold wanted pixels; a bundle has `number` squared parts."""
    side = BUNDLE // number
    part = by_bundle(lists, wanted, first_row).reshape(-1, shards, number, side, number, side).any((3, 5))
    part = jnp.moveaxis(part, 1, 0).reshape(shards, -1)
    count = part.sum(1, dtype=jnp.int32)
    return jnp.argsort(~part, 1).astype(jnp.int32), count, count.max()


@stage("packets", "shards", "number", "plan", quickly=True)
def parts_of_turn(
    queue: PartQueue,
    nth: Int[Array, ""],
    shard: Int[Array, ""],
    grid: Grid,
    schedule: SlabSchedule,
    shown: Shown,
    *,
    packets: int,
    shards: int,
    number: int,
    plan: CastPlan,
    tuning: Tuning,
) -> Parts:
    """Take the `nth` lot of `packets` parts from a shard's queue, and find the slabs in which their rays may meet anything."""
    place = nth * packets + jnp.arange(packets, dtype=jnp.int32)
    item, side = queue[0][shard, jnp.minimum(place, queue[0].shape[1] - 1)], BUNDLE // number
    bundle, part = item // number**2, item % number**2
    real, step = place < queue[1][shard], jnp.full((), 1 / number, jnp.float32)
    parts = Parts(bundle, part // number * side, part % number * side, real, step)
    grid, media = lax.stop_gradient((shard_of_grid(grid, shard, shards), shown.media))
    medium = Mixture.of(tuple(one.in_band(Band(grid)) for one in media))
    rays = rays_of_parts(grid, shown.camera, parts)
    batches = batches_of(grid, schedule, rays, plan.of_shard(shards), shown.camera.is_perspective)
    return dataclasses.replace(parts, filled=batches.where(medium.meets))


@stage("number", "shards", quickly=True)
def paint_parts(
    layers: Layers,
    wanted: Bool[Array, "height width"],
    place: tuple[Array, ...],
    parts: Parts,
    rays: ShardResult,
    shard: Int[Array, ""],
    *,
    number: int,
    shards: int,
) -> Layers:
    """Paint wanted pixels of the layers with what the rays of some parts of a shard have met.

    Args:
        place: rows and columns of all bundles of the band, and the frame's first row.
    """
    height, width = wanted.shape
    side = BUNDLE // number

    def of_pixels(layer: Array) -> Array:
        """(packets, pixels down, pixels across, rays, ...)"""
        apart = layer.reshape(-1, side, number, side, number, *layer.shape[3:])
        return jnp.moveaxis(apart, 3, 2).reshape(-1, side, side, number**2, *layer.shape[3:])

    met = {name: of_pixels(getattr(rays, name)) for name in ("color", "transmittance", "depth", "normal")}
    half = jnp.argsort(lax.stop_gradient(met["depth"]), 3)[..., (number**2 - 1) // 2, None]
    ends = {"depth": half, "normal": half[..., None]}
    of_pixel = {
        name: of.mean(3) if name not in ends else jnp.take_along_axis(of, ends[name], 3)[:, :, :, 0] for name, of in met.items()
    }
    pixel, whole = (jnp.arange(size, dtype=jnp.int32) for size in (side, BUNDLE))
    corner_row, corner_column = shard_of((place[0] - place[2], place[1]), shard, shards)
    bundle = corner_row[:, None, None] + whole[:, None], corner_column[:, None, None] + whole
    row = (corner_row[parts.bundle] + parts.row)[:, None, None] + pixel[:, None]
    column = (corner_column[parts.bundle] + parts.column)[:, None, None] + pixel
    inside = parts.real[:, None, None] & (row < height) & (column < width)
    inside &= wanted[jnp.minimum(row, height - 1), jnp.minimum(column, width - 1)]

    at = jnp.where(inside, row, height), column
    spent = layers.evaluations.at[bundle].add(rays.evaluations[:, None, None], mode="drop")
    layer_values = {name: getattr(layers, name).at[at].set(value, mode="drop") for name, value in of_pixel.items()}
    return layers._replace(evaluations=spent, **layer_values)


def draw_outlines(frame: Frame, clock: Clock) -> Drawing:
    """Draw all bands of a frame by one ray a pixel, then pixels at edges by several, band by band and turn by turn."""
    frame, shards, lists, number = frame.with_ranks(clock), frame.shards, frame.plan.lists, frame.formulas.antialias
    each, packets, plan = clock.shards(shards), lists.num_bundles // shards, frame.plan.cast
    sizes = {"shards": shards, "number": number}
    every, none = (array_of(place, jnp.int32) for place in (np.arange(packets), np.zeros(packets)))
    slabs = -(-frame.plan.samples // plan.slab_samples)
    real, filled = (array_of(np.ones(shape), jnp.bool_) for shape in (packets, (slabs, packets)))
    whole = Parts(every, none, none, real, array_of(1, jnp.float32), filled)
    drawing = dataclasses.replace(frame, parts=[whole] * len(each)).bands(clock)
    wanted, layers = clock.one("image", edges, (drawing.layers, frame.camera), number=number)
    for first in frame.first_rows:
        grid, _ = frame.grid(array_of(frame.first_row + first, jnp.int32), clock)
        decided, place = frame.at_full_rate(grid, clock), (grid.row, grid.column, array_of(frame.first_row, jnp.int32))
        queue = clock.one("adapt", queue_parts, (wanted, array_of(first, jnp.int32)), lists=lists, **sizes)
        turns, together = clock.turns(queue[2], packets, queue[0].shape[1])
        for nth in range(turns):
            of_shards = [(shard, grid, one.schedule, frame.shown) for shard, one in zip(each, decided, strict=True)]
            given = [(queue, array_of(nth, jnp.int32), *one) for one in of_shards]
            some = clock.each("adapt", parts_of_turn, given, packets=together, plan=plan, tuning=plan.tuning, **sizes)
            met = clock.all_shards(dataclasses.replace(frame, parts=some).cast(grid, decided, None, clock))
            for shard, (one, rays) in enumerate(zip(clock.all_shards(some), met, strict=True)):
                inputs = layers, wanted, place, one, rays, array_of(shard, jnp.int32)
                layers = clock.one("image", paint_parts, inputs, **sizes)
    return drawing._replace(layers=layers)
