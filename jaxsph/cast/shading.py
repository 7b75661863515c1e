"""From sums over particles to light: what slabs of samples emit and let through.

Flow: points -> [shading] -> composite.

In few passes over memory: two colours travel as one complex number, such that XLA makes one kernel of them, and per sample only
thickness and the place in the transfer function are kept.
"""

from __future__ import annotations

import functools

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Complex

from jaxsph.cast.composite import RAYS, Light, emitted, transmitted
from jaxsph.control.worklist import Worklist
from jaxsph.model.transfer import Segments, find, read
from jaxsph.numerics.staging import computed_once

Rays = tuple[Array, Array, Array]  # u of columns, v of rows, depths of the borders of samples
EXTINCTION = slice(3, 4)


def shade(sums: Complex[Array, "chunk samples 8 8"], rays: Rays, segments: Segments, item: Worklist, perspective: bool) -> Light:
    """Light of slabs as seen from right in front of each: first paper, equation 2 and section 2.2."""
    always = item.count[0] >= 0
    thickness, *place = computed_once(always, functools.partial(_thickness, perspective=perspective), sums, rays, segments, item)
    left = computed_once(always, transmitted, thickness)
    red_green, blue = (
        computed_once(always, functools.partial(_emitted, channels=channels), left, place, segments, item)
        for channels in (slice(0, 2), slice(2, 3))
    )
    return red_green.real, red_green.imag, blue.real, left[:, -1], thickness


def _thickness(sums: Array, rays: Rays, segments: Segments, item: Worklist, *, perspective: bool) -> tuple[Array, ...]:
    """Optical thickness of samples, and their place in the transfer function."""
    u, v, border = rays
    sums = sums.reshape(*sums.shape[:2], RAYS)
    weight, weighted = sums.real, sums.imag
    inside = weight > 0
    quantity = item.origin[:, None, None] + jnp.where(inside, weighted / jnp.where(inside, weight, 1), 0)
    place = find(segments, quantity)
    (extinction,) = _optics(segments, place, item, EXTINCTION)
    step = (border[:, 1:] - border[:, :-1])[:, :, None]
    if perspective:
        step = step * jnp.sqrt(1 + u[:, None, :] ** 2 + v[:, :, None] ** 2).reshape(-1, 1, RAYS)
    if item.painted is not None:
        inside |= item.painted[:, None, None]
    return jnp.where(inside, extinction * step, 0), *place


def _emitted(left: Array, place: list[Array], segments: Segments, item: Worklist, *, channels: slice) -> Array:
    """One or two colours of slabs, as real and imaginary part."""
    first, *second, _ = emitted(_optics(segments, tuple(place), item, channels), left)
    return lax.complex(first, second[0] if second else jnp.zeros_like(first))


def _optics(segments: Segments, place: tuple[Array, ...], item: Worklist, channels: slice) -> list[Array]:
    """Some of red, green, blue and extinction at samples; of super-pixels what they are painted with."""
    optics = read(segments, place, channels)
    if item.paint is None or item.painted is None:
        return optics
    painted, paints = item.painted[:, None, None], list(item.paint)[channels]
    return [jnp.where(painted, paint[:, None, None], value) for paint, value in zip(paints, optics, strict=True)]
