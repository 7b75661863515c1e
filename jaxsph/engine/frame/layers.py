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
from jaxsph.engine.control.decide import Decided
from jaxsph.engine.frame.stages import Cast
from jaxsph.engine.planning.plan import Plan
from jaxsph.engine.runtime.programs import compiled_quickly
from jaxsph.numerics.checks import is_traced

REFERENCE = "samples"
"""The integrator whose image at full rate is what errors are bounded against: of others none is known without an estimate."""


class Layers(NamedTuple):
    """Of a band, as far as it lies in the image; or of an image.

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
    levels: Int[Array, "cells bundle_rows bundle_columns"] | None
    rays: Int[Array, ""] | None = None
    normal: Float[Array, "rows columns 3"] | None = None


class Drawn(NamedTuple):
    """Layers of a band, or of an image; the fault word of its lists; slabs that a particle can touch, and pairs with bundles."""

    layers: Layers
    faults: Any
    filled: Any
    pairs: Any

    @classmethod
    def of(cls, layers: Layers, counts: Sequence[tuple[Any, Any, Any]], faults: Int[Array, ""]) -> Drawn:
        """The image, of what there is of all its grids; `faults` are those of what is seen. What is foreseen is not counted."""
        if isinstance(counts[0][0], jax.ShapeDtypeStruct):
            return cls(layers, faults, 0, 0)
        if not is_traced(faults, counts):
            faults, counts = int(faults), [(int(word), int(filled), int(pairs)) for word, filled, pairs in counts]  # type: ignore[assignment]
        words, filled, pairs = zip(*counts, strict=True)
        return cls(layers, functools.reduce(operator.or_, words, faults), sum(filled), sum(pairs))


@compiled_quickly
@functools.partial(jax.jit, static_argnames="plan")
def develop(cast: tuple[Cast, ...], decided: tuple[Decided, ...], *, plan: Plan) -> Layers:
    """The layers of a band, of its shards; of decisions of one where that decided for all.

    No colour or alpha is off by more than 1. What error there is where nothing was compared is unknown: inf.
    """
    rays, chosen, as_image, over_pixels = unshard(cast, 0), unshard(decided), plan.lists.as_image, plan.lists.over_pixels
    color, transmittance, depth = map(as_image, rays[:3])
    bound = over_pixels(chosen.bound) if rays.error is None else as_image(rays.error)
    if rays.cut is not None:  # what may be left out by rays that ended is what they let through
        bound = bound + jnp.where(over_pixels(rays.cut), lax.stop_gradient(transmittance), 0)
    known = plan.integrator == REFERENCE or plan.cast.doublings
    bound = jnp.minimum(bound, 1) if known else jnp.full_like(bound, jnp.inf)
    normal = None if rays.normal is None else as_image(rays.normal)
    spent, full = over_pixels(rays.evaluations), over_pixels(chosen.full)
    layers = Layers(color, transmittance, depth, spent, bound, full, None, normal=normal)
    layers = jax.tree.map(lambda layer: layer[: plan.height, : plan.width], layers)
    if chosen.levels is None:
        return layers
    rows, columns = (-(-size // BUNDLE) for size in (plan.height, plan.width))
    levels = as_image(jnp.moveaxis(chosen.levels, 0, -1)[:, None, None])[:rows, :columns]
    return layers._replace(levels=jnp.moveaxis(levels, -1, 0))


@compiled_quickly
@functools.partial(jax.jit, static_argnames="height")
def join(bands: tuple[Layers, ...], *, height: int) -> Layers:
    """The image, of all of its bands, of which the last may end beyond it."""
    image: Layers = jax.tree.map(lambda *rows: jnp.concatenate(rows)[:height], *(one._replace(levels=None) for one in bands))
    if bands[0].levels is None:
        return image
    levels = jnp.concatenate([one.levels for one in bands], 1)  # type: ignore[misc]
    return image._replace(levels=levels[:, : -(-height // BUNDLE)])
