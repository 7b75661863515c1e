"""Front to back: the light of slabs put into the state of rays, first paper, equation 3.

Flow: points -> [composite] -> image.

A slab that emits colour C and lets through t, both as seen from right in front of it, adds T C to a ray and leaves it T t. In a
slab a sample adds its colour times the light it takes away, $t_{k-1} - t_k$: however thin the samples, colours then add up to
the alpha that is lost. And $t_k$ is the exponential of the thickness up to there: one rounding, where a product would round
at every sample, and always the same way in a uniform medium.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Int

from jaxsph.access.lists import BUNDLE
from jaxsph.numerics.staging import computed_once

RAYS = BUNDLE * BUNDLE  # of a bundle, in one row: short rows do not vectorise
TOGETHER = 256  # bundles of a layer that are composited together
FEW = 32  # bundles among them whose depths of half transmittance are found together
Light = tuple[Array, ...]  # of slabs: red, green, blue, transmittance (slabs, 64); optical thickness (slabs, samples, 64)
State = tuple[Array, ...]  # of rays: red, green, blue, transmittance, and depth where that is one half (bundles, 64)


def unlit(slabs: int, samples: int, dtype: Any) -> Light:
    """Slabs with nothing in them."""
    return *(jnp.full((slabs, RAYS), value, dtype) for value in (0, 0, 0, 1)), jnp.zeros((slabs, samples, RAYS), dtype)


def fresh(bundles: int, dtype: Any) -> State:
    """Rays that have met nothing, with room for a chunk past the last."""
    return tuple(jnp.full((bundles + TOGETHER, RAYS), value, dtype) for value in (0, 0, 0, 1, jnp.inf))


def transmitted(thickness: Array) -> Array:
    """What is left behind each sample of slabs of what enters them."""
    through = [thickness[:, 0]]
    for k in range(1, thickness.shape[1]):
        through.append(through[-1] + thickness[:, k])
    return jnp.exp(-jnp.stack(through, 1))


def emitted(colors: list[Array], left_behind: Array) -> list[Array]:
    """Colours of slabs of samples, as seen from right in front, and their transmittance."""
    left, total = jnp.ones_like(left_behind[:, 0]), [jnp.zeros_like(left_behind[:, 0])] * len(colors)
    for k in range(left_behind.shape[1]):
        behind = left_behind[:, k]
        total = [added + (left - behind) * color[:, k] for added, color in zip(total, colors, strict=True)]
        left = behind
    return [*total, left]


def composite(
    state: State,
    light: Light,
    held_at: Int[Array, " held"],
    borders: Callable[[Array], Array],
    starts: Int[Array, " layers_and_one"],
    first: Int[Array, ""],
    number: Int[Array, ""],
) -> State:
    """Put the light of a stretch of the stacks into the rays, whose bundles are in order of height.

    Args:
        light: of the slabs of the stretch, in any order, and of nothing at the end.
        held_at: where in `light` each slab of the stretch is held.
        borders: of slabs by place in the stretch, the depths of the borders of their samples.
        starts: where the layers of the stacks begin.
        first, number: where the stretch begins in the stacks, and how long it is.
    """

    def put_layer(layer: Array, state: State) -> State:
        begin = jnp.maximum(starts[layer] - first, 0)
        past = jnp.minimum(starts[layer + 1] - first, number)
        bundle = first + begin - starts[layer]

        def put_chunk(chunk: Array, state: State) -> State:
            place = begin + chunk * TOGETHER + jnp.arange(TOGETHER, dtype=jnp.int32)
            inside = place < past
            place = jnp.where(inside, place, 0)
            at = jnp.where(inside, held_at[place], light[0].shape[0] - 1)
            here = bundle + chunk * TOGETHER
            # at hand before any is put back: XLA would read it from the whole state again, and copy all of that to do so
            rays = computed_once(here >= 0, _slice_of, state, here)
            rays = _put(rays, light, at, borders(place))
            return tuple(lax.dynamic_update_slice_in_dim(old, new, here, 0) for old, new in zip(state, rays, strict=True))

        return lax.fori_loop(0, (past - begin + TOGETHER - 1) // TOGETHER, put_chunk, state)

    top = (starts <= first).sum(dtype=jnp.int32) - 1
    bottom = (starts < first + number).sum(dtype=jnp.int32)
    return lax.fori_loop(top, bottom, put_layer, state)


def _slice_of(state: State, begin: Array) -> State:
    return tuple(lax.dynamic_slice_in_dim(field, begin, TOGETHER) for field in state)


def _put(rays: State, light: Light, at: Array, border: Array) -> State:
    """Rays behind one more slab each."""
    *colors, transmittance, depth = rays
    *emission, left = (field[at] for field in light[:-1])
    behind = transmittance * left
    crossed = (transmittance > 0.5) & (behind <= 0.5)
    depth = _with_half_depth(depth, crossed, transmittance, light[-1], at, border)
    return *(color + transmittance * added for color, added in zip(colors, emission, strict=True)), behind, depth


def _with_half_depth(depth: Array, crossed: Array, transmittance: Array, thickness: Array, at: Array, border: Array) -> Array:
    """`depth` of rays, found for a few bundles at a time of those where any ray has crossed one half: others cost nothing."""
    each = jnp.arange(TOGETHER, dtype=jnp.int32)
    some = crossed.any(1)
    bundles = lax.sort(jnp.where(some, each, TOGETHER))

    def settle(nth: Array, depth: Array) -> Array:
        bundle = lax.dynamic_slice_in_dim(bundles, nth * FEW, FEW)
        here = jnp.minimum(bundle, TOGETHER - 1)
        rays = [value[here] for value in (depth, crossed, transmittance)]
        found = computed_once(nth >= 0, _half_depth, *rays, thickness, at[here], border[here])
        return depth.at[bundle].set(found, mode="drop")

    return lax.fori_loop(0, (some.sum(dtype=jnp.int32) + FEW - 1) // FEW, settle, depth)


def _half_depth(depth: Array, crossed: Array, transmittance: Array, thickness: Array, at: Array, border: Array) -> Array:
    """Where rays that enter slabs with `transmittance` fall to one half; `depth` where they have not `crossed` it.

    Whatever the products of the samples round to here, one that has crossed does so at the last sample if not before.
    """
    thickness = thickness[at]
    left, reached = transmitted(thickness), transmittance
    for k in range(thickness.shape[1]):
        behind = transmittance * left[:, k]
        start, end = border[:, k, None], border[:, k + 1, None]
        filled = thickness[:, k] > 0
        share = jnp.where(filled, jnp.log(2 * reached) / jnp.where(filled, thickness[:, k], 1), 1)
        here = crossed & ((behind <= 0.5) | (k == thickness.shape[1] - 1))
        depth = jnp.where(here, start + jnp.minimum(share, 1) * (end - start), depth)
        crossed = crossed & ~here
        reached = behind
    return depth
