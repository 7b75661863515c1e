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
from jaxsph.model.camera import Camera
from jaxsph.model.image import Image
from jaxsph.plan import Plan


@functools.partial(jax.jit, static_argnames="plan")
def unbundle(cast: tuple[Rays, ...], decided: tuple[tuple[Array, ...], ...], *, plan: Plan) -> tuple[Array, ...]:
    """Layers of a band as images: color (h, w, 3), transmittance, depth, evaluations, error bound and full evaluations (h, w);
    and levels of bundles.

    Args:
        cast: of all parts of the band.
        decided: the same; error bound, full evaluations, and levels if there are any.
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


def stacked(bands: list[tuple[Array, ...]]) -> tuple[Array, ...]:
    """The layers of all bands, band by band."""
    return tuple(jnp.stack(layers) for layers in zip(*bands, strict=True))


def assemble(layers: tuple[Array, ...], camera: Camera, plan: Plan, word: Array) -> tuple[Image, Array]:
    """Join the bands, cut off what lies beyond the image; and the evaluations that full rate takes."""
    joined = [layer.reshape(-1, *layer.shape[2:]) for layer in layers]
    color, transmittance, depth, spent, bound, full = (layer[: camera.height, : camera.width] for layer in joined[:6])
    image = Image(color, transmittance, depth, bound, spent, True, word, {})
    if len(joined) == 6:
        return image, full
    rows, columns = (-(-size // BUNDLE) for size in (camera.height, camera.width))
    return dataclasses.replace(image, levels=jnp.moveaxis(joined[6][:rows, :columns], -1, 0)), full


def blank_if(unusable: Bool[Array, ""], image: Image) -> Image:
    """Nothing at all instead of the NaN that unusable numbers would make."""
    color = jnp.where(unusable, 0, image.color)
    transmittance = jnp.where(unusable, 1, image.transmittance)
    depth, bound = jnp.where(unusable, jnp.inf, image.depth), jnp.where(unusable, 0, image.error_bound)
    return dataclasses.replace(image, color=color, transmittance=transmittance, depth=depth, error_bound=bound)
