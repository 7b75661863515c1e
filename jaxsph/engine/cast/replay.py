r"""Cotangents of slabs, from those of an image: the transpose of `cast.composite`, as the slabs are met again.

Flow: cotangents of an image -> adjoint -> [replay] -> integrator, media.

Let $\bar C$ and $\bar T$ be the cotangents of a ray's colour and transmittance. Hochstetter et al. 2016, equation 3,
$C = \sum_k T_k e_k$ with $e_k$ what slab k emits as seen from right in front of it and $T_k$ what is let through before, gives
$e_k$ the cotangent $T_k \bar C$. More optical thickness in slab k dims all that comes from behind it, so its cotangent is
$-(\bar C \cdot C_{>k} + \bar T T)$, with $C_{>k}$ what the slabs behind add to the ray. That is at most what is let through,
which bounds its rounding.
"""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from jaxsph.engine.cast.batches import Batch
from jaxsph.engine.cast.composite import Together, over_layers, rows
from jaxsph.numerics.fusion import fusion_barrier
from jaxsph.numerics.trees import tree


@tree()
class ReplayState:
    """Rays of packets in order of height: the image, its cotangents, and how far it is made again.

    Attributes:
        color, transmittance: of the image.
        cotangent: of its red, green, blue and transmittance.
        color_so_far, transmittance_so_far: of the slabs met so far.
    """

    color: Float[Array, "3 packets rays"]
    transmittance: Float[Array, "packets rays"]
    cotangent: Float[Array, "4 packets rays"]
    color_so_far: Float[Array, "3 packets rays"]
    transmittance_so_far: Float[Array, "packets rays"]


def fresh_replay(
    image: tuple[Array, Array], cotangent: tuple[Array, Array], rank: Int[Array, " packets"], together: Together
) -> ReplayState:
    """Rays that have met nothing, with room past the last; `image` and `cotangent` are of colour and transmittance."""

    def by_rank(value: Array) -> Array:
        value = value.reshape(*value.shape[:-2], -1)
        room = (*value.shape[:-2], value.shape[-2] + together.packets, value.shape[-1])
        return jnp.zeros(room, value.dtype).at[..., rank, :].set(value)

    color, transmittance = (by_rank(value) for value in image)
    cotangents = by_rank(jnp.concatenate([cotangent[0], cotangent[1][None]]))
    return ReplayState(color, transmittance, cotangents, jnp.zeros_like(color), jnp.ones_like(transmittance))


def pull_composite(
    state: ReplayState, light: tuple[Array, ...], batch: Batch, starts: Int[Array, " layers_and_one"], together: Together
) -> tuple[ReplayState, Float[Array, "4 slots rays"]]:
    """Cotangents of the slabs of a batch: of red, green, blue and optical thickness. See `composite.composite`.

    Args:
        light: red, green, blue and transmittance of the slabs, by slot; and of nothing at the end.
    """
    nothing = light[3].shape[0] - 1

    def put(carry: tuple[ReplayState, Array], place: Array, inside: Array, packet: Array) -> tuple[ReplayState, Array]:
        state, cotangents = carry
        slot = jnp.where(inside, batch.slot[place], nothing)
        # at hand before any is put back, see `composite`
        rays = fusion_barrier(packet >= 0, lambda: rows(state, packet, together.packets))
        color, transmittance, found = _pull_slabs(rays, [field[slot] for field in light])
        color = lax.dynamic_update_slice_in_dim(state.color_so_far, color, packet, 1)
        transmittance = lax.dynamic_update_slice_in_dim(state.transmittance_so_far, transmittance, packet, 0)
        state = dataclasses.replace(state, color_so_far=color, transmittance_so_far=transmittance)
        return state, cotangents.at[:, slot].set(found)

    start = jnp.zeros((4, *light[3].shape), light[3].dtype)
    return over_layers(put, (state, start), starts, batch, together)


def _pull_slabs(rays: ReplayState, light: list[Array]) -> tuple[Array, Array, Array]:
    """Colour and transmittance of rays behind one more slab each, and the cotangents of those slabs."""
    *emission, left = light
    behind = rays.transmittance_so_far * left
    color = rays.color_so_far + rays.transmittance_so_far * jnp.stack(emission)
    remaining = jnp.clip(rays.color - color, 0, behind)
    hidden = (rays.cotangent[:3] * remaining).sum(0) + rays.cotangent[3] * rays.transmittance
    return color, behind, jnp.concatenate([rays.cotangent[:3] * rays.transmittance_so_far, -hidden[None]])
