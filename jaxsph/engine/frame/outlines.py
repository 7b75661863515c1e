"""Frames of which several rays are cast through pixels at outlines.

Flow: frame -> [outlined: bundles -> image -> edges -> parts of bundles, finer -> painted] -> layers.

All pixels are drawn by one ray, then those at silhouettes by several.

A part (`screen.packets.Parts`) is a square of a bundle, with as many rays as a bundle has: N of them across each of its pixels.
It reads the bundle's list, which holds whatever any ray through a pixel can meet, as spheres reach half a pixel farther
(`access.view.view_particles`). So whole bundles and parts are packets of one program, and what is at edges is paid for alone.

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

from jaxsph.engine.access.grid import shard as shard_of
from jaxsph.engine.access.lists import BUNDLE, ListPlan
from jaxsph.engine.frame.frame import Frame, Told
from jaxsph.engine.frame.stages import Cast, Drawn, Layers
from jaxsph.engine.runtime.executors import Run
from jaxsph.engine.runtime.programs import stage
from jaxsph.engine.screen.packets import Parts, by_bundle
from jaxsph.model.camera.camera import Camera
from jaxsph.numerics.checks import array_of

CONTRAST = 0.06  # of a colour or of alpha, that is seen as an edge
LEAP = 3.0  # widths of a pixel, that depths of three in a row are off a straight line by, where one surface ends before another
Wanted = tuple[Int[Array, "shards parts"], Int[Array, " shards"], Int[Array, ""]]
"""Parts of the bundles of each shard, those that are wanted first; how many these are, and at most of a shard."""


@stage("number", quickly=True)
def edges(layers: Layers, camera: Camera, *, number: int) -> tuple[Bool[Array, "rows columns"], Layers]:
    """Pixels at which a silhouette is seen: alpha changes to one of the eight around them, or colour where depth leaps.

    And the layers with evaluations at full rate as if all pixels had `number` squared rays.
    """
    color, transmittance, depth = (lax.stop_gradient(layer) for layer in layers[:3])
    value = jnp.concatenate([color, transmittance[..., None]], -1)
    differs = _largest_around(value) + _largest_around(-value) > CONTRAST
    length = 2 / camera.height * camera.half_height * (depth if camera.is_perspective else 1)
    wide = jnp.pad(depth, 1, mode="edge")
    bent = jnp.stack([wide[:-2, 1:-1] + wide[2:, 1:-1], wide[1:-1, :-2] + wide[1:-1, 2:]], -1) - 2 * depth[..., None]
    leaps = _largest_around(jnp.where(jnp.isfinite(bent), jnp.abs(bent) / length[..., None], 0)) > LEAP
    return differs[..., 3] | (differs.any(-1) & leaps.any(-1)), layers._replace(full=layers.full * number**2)


def _largest_around(value: Float[Array, "rows columns channels"]) -> Float[Array, "rows columns channels"]:
    """Of each pixel and the eight around it."""
    return lax.reduce_window(value, -jnp.inf, lax.max, (3, 3, 1), (1, 1, 1), "SAME")


@stage("lists", "number", "shards", quickly=True)
def parted(
    wanted: Bool[Array, "height width"], first_row: Int[Array, ""], *, lists: ListPlan, number: int, shards: int
) -> Wanted:
    """Parts of a band's bundles that hold wanted pixels, `number` squared of each bundle."""
    side = BUNDLE // number
    part = by_bundle(lists, wanted, first_row).reshape(-1, shards, number, side, number, side).any((3, 5))
    part = jnp.moveaxis(part, 1, 0).reshape(shards, -1)
    count = part.sum(1, dtype=jnp.int32)
    return jnp.argsort(~part, 1).astype(jnp.int32), count, count.max()


@stage("packets", "number", quickly=True)
def turn(queue: Wanted, nth: Int[Array, ""], shard: Int[Array, ""], *, packets: int, number: int) -> Parts:
    """The `nth` so many parts of a shard's queue, `number` squared of which are a bundle."""
    place = nth * packets + jnp.arange(packets, dtype=jnp.int32)
    item, side = queue[0][shard, jnp.minimum(place, queue[0].shape[1] - 1)], BUNDLE // number
    bundle, part = item // number**2, item % number**2
    real, step = place < queue[1][shard], jnp.full((), 1 / number, jnp.float32)
    return Parts(bundle, part // number * side, part % number * side, real, step)


@stage("number", "shards", quickly=True)
def painted(
    layers: Layers,
    wanted: Bool[Array, "height width"],
    place: tuple[Array, ...],
    parts: Parts,
    rays: Cast,
    shard: Int[Array, ""],
    *,
    number: int,
    shards: int,
) -> Layers:
    """The layers with pixels that are wanted, by what the rays of parts of a shard have met.

    Args:
        place: row and column of all bundles, and the first row of the image.
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
    made = {
        name: of.mean(3) if name not in ends else jnp.take_along_axis(of, ends[name], 3)[:, :, :, 0] for name, of in met.items()
    }
    pixel, whole = (jnp.arange(size, dtype=jnp.int32) for size in (side, BUNDLE))
    corner_row, corner_column = shard_of((place[0] - place[2], place[1]), shard, shards)
    bundle = corner_row[:, None, None] + whole[:, None], corner_column[:, None, None] + whole
    row = (corner_row[parts.bundle] + parts.row)[:, None, None] + pixel[:, None]
    column = (corner_column[parts.bundle] + parts.column)[:, None, None] + pixel
    asked = parts.real[:, None, None] & (row < height) & (column < width)
    asked &= wanted[jnp.minimum(row, height - 1), jnp.minimum(column, width - 1)]

    at = jnp.where(asked, row, height), column
    spent = layers.evaluations.at[bundle].add(rays.evaluations[:, None, None], mode="drop")
    painted = {name: getattr(layers, name).at[at].set(value, mode="drop") for name, value in made.items()}
    return layers._replace(evaluations=spent, **painted)


def outlined(frame: Frame, run: Run, told: Told) -> Drawn:
    """All bands of a frame, and then what is at edges, band by band."""
    frame, shards, lists, number = frame.ranked(run), frame.shards, frame.plan.lists, frame.formulas.antialias
    each, packets = run.shards(shards), lists.num_bundles // shards
    every, none = (array_of(place, jnp.int32) for place in (np.arange(packets), np.zeros(packets)))
    whole = Parts(every, none, none, array_of(np.ones(packets), jnp.bool_), array_of(1, jnp.float32))
    drawn = dataclasses.replace(frame, parts=[whole] * len(each)).of_bands(run, told)
    wanted, layers = run.one("image", edges, (drawn.layers, frame.camera), number=number)
    for first in frame.first_rows:
        grid, _ = frame.grid(array_of(frame.first_row + first, jnp.int32), run)
        decided, place = frame.leave(grid, run), (grid.row, grid.column, array_of(frame.first_row, jnp.int32))
        queue = run.one("adapt", parted, (wanted, array_of(first, jnp.int32)), lists=lists, number=number, shards=shards)
        turns, together = run.turns(queue[2], packets, queue[0].shape[1])
        for nth in range(turns):
            given = [(queue, array_of(nth, jnp.int32), shard) for shard in each]
            some = [run.one("adapt", turn, one, packets=together, number=number) for one in given]
            met = run.pooled(dataclasses.replace(frame, parts=some).cast(grid, decided, None, run))
            for shard, (one, rays) in enumerate(zip(run.pooled(some), met, strict=True)):
                inputs = layers, wanted, place, one, rays, array_of(shard, jnp.int32)
                layers = run.one("image", painted, inputs, number=number, shards=shards)
    return drawn._replace(layers=layers)
