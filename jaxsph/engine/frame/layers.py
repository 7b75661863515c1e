"""From what the rays of bundles met to the layers of an image.

Flow: cast -> [layers] -> Image.
"""

from __future__ import annotations

import functools
import operator
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from jaxsph.engine.access.grid import unshard
from jaxsph.engine.access.lists import BUNDLE
from jaxsph.engine.frame.stages import Cast, Verdict
from jaxsph.engine.planning.plan import Plan
from jaxsph.engine.runtime.programs import compiled_quickly
from jaxsph.numerics.checks import is_traced

REFERENCE = "samples"
"""The integrator whose image at full rate is what errors are bounded against: of others none is known without an estimate."""


class OfShards(NamedTuple):
    """What the rays of a band met, and what was decided for them, shard by shard; where one decided for all, of one."""

    cast: tuple[Cast, ...]
    verdicts: tuple[Verdict, ...]


class Layers(NamedTuple):
    """Of a band, or of an image.

    Attributes:
        full: evaluations that full rate takes.
        levels: what error control gave each cell, if there is any that gives levels.
        rays: how many were cast, where pixels are interpolated.
        normal: of what ends rays, see `Image`; None where nothing does.
    """

    color: Float[Array, "rows columns 3"]
    transmittance: Float[Array, "rows columns"]
    depth: Float[Array, "rows columns"]
    evaluations: Float[Array, "rows columns"]
    bound: Float[Array, "rows columns"]
    full: Float[Array, "rows columns"]
    levels: Int[Array, "bundle_rows bundle_columns cells"] | None
    rays: Int[Array, ""] | None = None
    normal: Float[Array, "rows columns 3"] | None = None


class Band(NamedTuple):
    """What is known of a band.

    Attributes:
        of_shards: what its rays met and what was decided, shard by shard.
        faults: fault word of its lists.
        filled, pairs: slabs that a particle can touch, and (particle, bundle) pairs.
    """

    of_shards: OfShards
    faults: Int[Array, ""]
    filled: Int[Array, ""]
    pairs: Int[Array, ""]


class Drawn(NamedTuple):
    """Layers of an image; its fault word, and how many cells and pairs its grids hold: numbers, or parts of a trace."""

    layers: Any
    faults: Any
    filled: Any
    pairs: Any

    @classmethod
    def of(cls, layers: Layers | None, bands: Sequence[Band], faults: Int[Array, ""]) -> Drawn:
        """Of all bands; `faults` are those of what is seen. Of a forecast's bands, which are shapes, nothing is counted."""
        if isinstance(bands[0].faults, jax.ShapeDtypeStruct):
            return cls(layers, faults, 0, 0)
        counts: list[tuple[Any, Any, Any]] = [(faults, 0, 0), *((band.faults, band.filled, band.pairs) for band in bands)]
        if not is_traced(counts):
            counts = [(int(word), int(filled), int(pairs)) for word, filled, pairs in counts]
        words, filled, pairs = zip(*counts, strict=True)
        return cls(layers, functools.reduce(operator.or_, words), sum(filled), sum(pairs))


@compiled_quickly
@functools.partial(jax.jit, static_argnames="plan")
def develop(bands: tuple[OfShards, ...], *, plan: Plan) -> Layers:
    """The image, of all of its bands."""
    layers = [of_band(band, plan=plan) for band in bands]
    return crop(jax.tree.map(lambda *values: jnp.stack(values), *layers), plan)


def of_band(band: OfShards, *, plan: Plan) -> Layers:
    """The layers of a band."""
    as_image, over_pixels, verdict = plan.lists.as_image, plan.lists.over_pixels, unshard(band.verdicts)
    spent = unshard(tuple(shard.evaluations for shard in band.cast))
    color = unshard(tuple(shard.rays.color for shard in band.cast), 1)
    transmittance = unshard(tuple(shard.rays.transmittance for shard in band.cast), 0)
    depth = unshard(tuple(shard.rays.depth for shard in band.cast), 0)
    color, transmittance, depth = as_image(jnp.moveaxis(color, 0, -1)), as_image(transmittance), as_image(depth)
    levels = None if verdict.levels is None else as_image(jnp.moveaxis(verdict.levels, 0, -1)[:, None, None])
    bound = over_pixels(verdict.bound)
    if band.cast[0].rays.error is not None:
        bound = as_image(unshard(tuple(shard.rays.error for shard in band.cast), 0))
    normal = None
    if band.cast[0].rays.stop is not None:
        stop = unshard(tuple(shard.rays.stop for shard in band.cast), 1)
        normal = as_image(jnp.moveaxis(stop[1:], 0, -1))
    if band.cast[0].cut is not None:  # what may be left out by rays that ended is what they let through
        cut = unshard(tuple(shard.cut for shard in band.cast))
        bound = bound + jnp.where(over_pixels(cut), lax.stop_gradient(transmittance), 0)
    return Layers(color, transmittance, depth, over_pixels(spent), bound, over_pixels(verdict.full), levels, normal=normal)


def crop(bands: Layers, plan: Plan) -> Layers:
    """Join the layers of all bands, stacked, and cut off what lies beyond the image; levels of cells come first.

    No colour or alpha is off by more than 1. What error there is where nothing was compared is unknown: inf.
    """
    joined = jax.tree.map(lambda layer: layer.reshape(-1, *layer.shape[2:]), bands)
    levels, joined = joined.levels, joined._replace(levels=None)
    image: Layers = jax.tree.map(lambda layer: layer[: plan.height, : plan.width], joined)
    known = plan.integrator == REFERENCE or plan.cast.doublings
    image = image._replace(bound=jnp.minimum(image.bound, 1) if known else jnp.full_like(image.bound, jnp.inf))
    if levels is None:
        return image
    rows, columns = (-(-size // BUNDLE) for size in (plan.height, plan.width))
    return image._replace(levels=jnp.moveaxis(levels[:rows, :columns], -1, 0))
