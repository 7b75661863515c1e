r"""Cotangents of slabs, from those of an image: the transpose of `cast.composite`, as the slabs are met again.

Flow: cotangents of an image -> adjoint -> [replay] -> integrator, media.

Let $\bar C$ and $\bar T$ be the cotangents of a ray's colour and transmittance. Hochstetter et al. 2016, equation 3,
$C = \sum_k T_k e_k$ with $e_k$ what slab k emits as seen from right in front of it and $T_k$ what is let through before, gives
$e_k$ the cotangent $T_k \bar C$. More optical thickness in slab k dims all that comes from behind it, so its cotangent is
$-(\bar C \cdot C_{>k} + \bar T T)$, with $C_{>k}$ what the slabs behind add to the ray. That is at most what is let through
(times how many media show all of their light, where they are mixed so), which bounds its rounding. Cotangents of where a ray ends
are of the slab that ends it.
"""

from __future__ import annotations

import dataclasses
import functools

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxsph.engine.cast.batches import Batch
from jaxsph.engine.cast.composite import Together, over_layers, rows
from jaxsph.numerics.extremes import clamped
from jaxsph.numerics.fusion import fusion_barrier
from jaxsph.numerics.trees import tree


@tree()
class ReplayState:
    """Rays of packets in order of height: the image, its cotangents, and how far it is made again.

    Attributes:
        color, transmittance: of the image.
        goes_on: whether nothing opaque has ended a ray so far; None where nothing does. Its depth would not tell: it is found
            again, and rounded otherwise.
        cotangent: of red, green, blue and transmittance; and of all that `Medium.stops` tells, if it does.
        color_so_far, transmittance_so_far: of the slabs met so far.
    """

    color: Float[Array, "3 packets rays"]
    transmittance: Float[Array, "packets rays"]
    goes_on: Bool[Array, "packets rays"] | None
    cotangent: Float[Array, "4_or_8 packets rays"]
    color_so_far: Float[Array, "3 packets rays"]
    transmittance_so_far: Float[Array, "packets rays"]


def fresh_replay(
    image: tuple[Array, ...], cotangent: tuple[Array, ...], rank: Int[Array, " packets"], together: Together
) -> ReplayState:
    """Rays that have met nothing, with room past the last.

    Args:
        image, cotangent: of colour and transmittance; and of where rays end, if anything ends them.
    """

    def by_rank(value: Array) -> Array:
        value = value.reshape(*value.shape[:-2], -1)
        room = (*value.shape[:-2], value.shape[-2] + together.packets, value.shape[-1])
        return jnp.zeros(room, value.dtype).at[..., rank, :].set(value)

    color, transmittance = (by_rank(value) for value in image[:2])
    cotangents = by_rank(jnp.concatenate([cotangent[0], cotangent[1][None], *cotangent[2:]]))
    goes_on = jnp.ones(transmittance.shape, bool) if image[2:] else None
    return ReplayState(color, transmittance, goes_on, cotangents, jnp.zeros_like(color), jnp.ones_like(transmittance))


def pull_composite(
    state: ReplayState, light: tuple[Array, ...], batch: Batch, starts: Int[Array, " _"], together: Together, most: int = 1
) -> tuple[ReplayState, Float[Array, "4_or_8 slots rays"]]:
    """Cotangents of the slabs of a batch: of red, green, blue and optical thickness, and of their stops if rays have any.

    See `composite.composite`.

    Args:
        light: red, green, blue and transmittance of the slabs, by slot, and their stops; and of nothing at the end.
        most: times what a slab takes of the light, that it emits at most.
    """
    nothing = light[3].shape[0] - 1

    def put(carry: tuple[ReplayState, Array], place: Array, inside: Array, packet: Array) -> tuple[ReplayState, Array]:
        state, cotangents = carry
        slot = jnp.where(inside, batch.slot[place], nothing)
        # at hand before any is put back, see `composite`
        rays = fusion_barrier(packet >= 0, lambda: rows(state, packet, together.packets))
        made, found = _pull_slabs(rays, [field[slot] for field in light], most)
        put_back = functools.partial(lax.dynamic_update_slice_in_dim, start_index=packet, axis=-2)
        state = dataclasses.replace(state, **{name: put_back(getattr(state, name), rows) for name, rows in made.items()})
        return state, cotangents.at[:, slot].set(found)

    start = jnp.zeros((len(light), *light[3].shape), light[3].dtype)
    return over_layers(put, (state, start), starts, batch, together)


def _pull_slabs(rays: ReplayState, light: list[Array], most: int) -> tuple[dict[str, Array], Array]:
    """What is made again of rays behind one more slab each, and the cotangents of those slabs."""
    (*emission, left), stops = light[:4], light[4:]
    behind = rays.transmittance_so_far * left
    color = rays.color_so_far + rays.transmittance_so_far * jnp.stack(emission)
    remaining = clamped(rays.color - color, 0, most * behind)
    hidden = (rays.cotangent[:3] * remaining).sum(0) + rays.cotangent[3] * rays.transmittance
    found = [rays.cotangent[:3] * rays.transmittance_so_far, -hidden[None]]
    made = {"color_so_far": color, "transmittance_so_far": behind}
    if rays.goes_on is not None:
        ends = jnp.isfinite(stops[0])
        found.append(jnp.where(rays.goes_on & ends, rays.cotangent[4:], 0))
        made["goes_on"] = rays.goes_on & ~ends
    return made, jnp.concatenate(found)
