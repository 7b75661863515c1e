"""From what the rays of bundles met to the layers of an image.

Flow: cast -> [layers] -> Image.
"""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from jaxsph.access.lists import BUNDLE
from jaxsph.access.parts import gathered
from jaxsph.cast.parts import joined
from jaxsph.cast.points import Rays
from jaxsph.model.image import Image
from jaxsph.numerics.programs import light
from jaxsph.plan import Plan

OfParts = tuple[tuple[Rays, ...], tuple[tuple[Array, ...], ...]]
"""Of all parts of a band: what their rays met; and error bound, full evaluations, and levels if there are any."""


@light
@functools.partial(jax.jit, static_argnames="plan")
def develop(bands: tuple[OfParts, ...], *, plan: Plan) -> tuple[Array, ...]:
    """Layers of the image, see `crop`, of all of its bands."""
    layers = [unbundle(*band, plan=plan) for band in bands]
    return crop(tuple(jnp.stack(layer) for layer in zip(*layers, strict=True)), plan)


def unbundle(cast: tuple[Rays, ...], decided: tuple[tuple[Array, ...], ...], *, plan: Plan) -> tuple[Array, ...]:
    """Layers of a band as images: color (h, w, 3), transmittance, depth, evaluations, error bound and full evaluations (h, w);
    and levels of bundles.
    """
    (bound, full, *levels), rays = gathered(decided), joined(cast)
    rows, columns = plan.lists.tile_rows, plan.lists.tile_columns

    def lay_out(value: Array) -> Array:
        """(bundles, 8, 8, ...) or (bundles, 1, 1, ...) to rows and columns."""
        down, across = value.shape[1:3]
        value = value.reshape(rows, columns, 2, 2, *value.shape[1:])
        value = jnp.moveaxis(value, (0, 2, 4, 1, 3, 5), (0, 1, 2, 3, 4, 5))
        return value.reshape(rows * 2 * down, columns * 2 * across, *value.shape[6:])

    of_bundles = (rays.evaluations, bound, full)
    of_rays = [jnp.broadcast_to(value[:, None, None], rays.transmittance.shape) for value in of_bundles]
    layers = [lay_out(v) for v in (jnp.moveaxis(rays.color, 0, -1), rays.transmittance, rays.depth, *of_rays)]
    return (*layers, *(lay_out(jnp.moveaxis(v, 0, -1)[:, None, None]) for v in levels))


def crop(layers: tuple[Array, ...], plan: Plan) -> tuple[Array, ...]:
    """Join the layers of all bands, and cut off what lies beyond the image."""
    joined = [layer.reshape(-1, *layer.shape[2:]) for layer in layers]
    images = [layer[: plan.height, : plan.width] for layer in joined[:6]]
    rows, columns = (-(-size // BUNDLE) for size in (plan.height, plan.width))
    return *images, *(jnp.moveaxis(levels[:rows, :columns], -1, 0) for levels in joined[6:])


def assemble(layers: tuple[Array, ...], word: Array | int) -> tuple[Image, Array]:
    """The image of those layers, and the evaluations that full rate takes."""
    color, transmittance, depth, spent, bound, full, *levels = layers
    return Image(color, transmittance, depth, bound, spent, True, word, {}, levels=levels[0] if levels else None), full


def blank_if(unusable: Bool[Array, ""], image: Image) -> Image:
    """Nothing at all instead of the NaN that unusable numbers would make."""
    color = jnp.where(unusable, 0, image.color)
    transmittance = jnp.where(unusable, 1, image.transmittance)
    depth, bound = jnp.where(unusable, jnp.inf, image.depth), jnp.where(unusable, 0, image.error_bound)
    return dataclasses.replace(image, color=color, transmittance=transmittance, depth=depth, error_bound=bound)
