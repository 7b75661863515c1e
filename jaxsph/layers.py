"""From what the rays of bundles met to the layers of an image.

Flow: cast -> [layers] -> Image.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxsph.access.lists import BUNDLE
from jaxsph.access.shards import unshard
from jaxsph.cast.march import RayResult
from jaxsph.model import registry
from jaxsph.model.image import Image
from jaxsph.numerics.programs import compiled_quickly
from jaxsph.plan import Plan
from jaxsph.stages import Cast, Verdict


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
    """

    color: Float[Array, "rows columns 3"]
    transmittance: Float[Array, "rows columns"]
    depth: Float[Array, "rows columns"]
    evaluations: Float[Array, "rows columns"]
    bound: Float[Array, "rows columns"]
    full: Float[Array, "rows columns"]
    levels: Int[Array, "bundle_rows bundle_columns cells"] | None
    rays: Int[Array, ""] | None = None


@compiled_quickly
@functools.partial(jax.jit, static_argnames="plan")
def develop(bands: tuple[OfShards, ...], *, plan: Plan) -> Layers:
    """The image, of all of its bands."""
    layers = [of_band(band, plan=plan) for band in bands]
    return crop(jax.tree.map(lambda *values: jnp.stack(values), *layers), plan)


def of_band(band: OfShards, *, plan: Plan) -> Layers:
    """The layers of a band."""
    lists, verdict = plan.lists, unshard(band.verdicts)
    spent = unshard(tuple(shard.evaluations for shard in band.cast))
    color = unshard(tuple(shard.rays.color for shard in band.cast), 1)
    transmittance = unshard(tuple(shard.rays.transmittance for shard in band.cast), 0)
    depth = unshard(tuple(shard.rays.depth for shard in band.cast), 0)
    pixels = registry.screen(plan.screen).resolve(RayResult(color, transmittance, depth), lists)

    def over_pixels(value: Float[Array, " bundles"]) -> Float[Array, "rows columns"]:
        return lists.as_image(jnp.broadcast_to(value[:, None, None], (lists.num_bundles, BUNDLE, BUNDLE)))

    levels = None if verdict.levels is None else lists.as_image(jnp.moveaxis(verdict.levels, 0, -1)[:, None, None])
    bound = over_pixels(verdict.bound)
    if band.cast[0].rays.error is not None:
        error = unshard(tuple(shard.rays.error for shard in band.cast), 0)
        bound = registry.screen(plan.screen).resolve(RayResult(color, error, depth), lists)[1]
    color, transmittance, depth = pixels
    return Layers(color, transmittance, depth, over_pixels(spent), bound, over_pixels(verdict.full), levels)


def crop(bands: Layers, plan: Plan) -> Layers:
    """Join the layers of all bands, stacked, and cut off what lies beyond the image; levels of cells come first."""
    joined = jax.tree.map(lambda layer: layer.reshape(-1, *layer.shape[2:]), bands)
    levels, joined = joined.levels, joined._replace(levels=None)
    image: Layers = jax.tree.map(lambda layer: layer[: plan.height, : plan.width], joined)
    if levels is None:
        return image
    rows, columns = (-(-size // BUNDLE) for size in (plan.height, plan.width))
    return image._replace(levels=jnp.moveaxis(levels[:rows, :columns], -1, 0))


def assemble(layers: Layers, word: Array | int) -> Image:
    """The image of those layers."""
    return Image(*layers[:3], layers.bound, layers.evaluations, True, word, {}, levels=layers.levels)


def blank_if(unusable: Bool[Array, ""], image: Image) -> Image:
    """Nothing at all instead of the NaN that unusable numbers would make."""
    color = jnp.where(unusable, 0, image.color)
    transmittance = jnp.where(unusable, 1, image.transmittance)
    depth, bound = jnp.where(unusable, jnp.inf, image.depth), jnp.where(unusable, 0, image.error_bound)
    return dataclasses.replace(image, color=color, transmittance=transmittance, depth=depth, error_bound=bound)
