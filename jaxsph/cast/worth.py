r"""What light is worth to an image: from cotangents of pixels to those of slabs, and of the sums at their samples.

Flow: image cotangents -> [worth] -> moments -> cotangents of particles.

Let $\bar C$ and $\bar T$ be the cotangents of a ray's colour and transmittance. Equation 3 of the first paper, $C = \sum_k T_k
e_k$ with $e_k$ what slab k emits as seen from right in front of it and $T_k$ what is let through before, gives $e_k$ the worth
$T_k \bar C$. More optical thickness in slab k dims all that comes from behind it, so it has the worth $-(\bar C \cdot C_{>k} +
\bar T T)$, with $C_{>k}$ what the slabs behind add to the ray. That is at most what is let through, which bounds its rounding.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from jaxsph.cast.composite import RAYS, TOGETHER, Light, emitted, transmitted
from jaxsph.control.worklist import Worklist
from jaxsph.model.transfer import SELECT_ALL, Segments, locate, look_up
from jaxsph.numerics.staging import computed_once

SMALLEST_WEIGHT = 2.0**20  # times the least normal number: below it a sample owes nothing, as one over it could overflow


@dataclasses.dataclass(frozen=True)
class Seen:
    """Rays in the order of the stacks: the image, its cotangents, and how far it is made again.

    Attributes:
        color, transmittance: of the image.
        worth: cotangents of its red, green, blue and transmittance.
        color_so_far, transmittance_so_far: of the slabs met so far.
    """

    color: Float[Array, "3 bundles 64"]
    transmittance: Float[Array, "bundles 64"]
    worth: Float[Array, "4 bundles 64"]
    color_so_far: Float[Array, "3 bundles 64"]
    transmittance_so_far: Float[Array, "bundles 64"]


def unseen(image: tuple[Array, Array], worth: tuple[Array, Array], place: Int[Array, " bundles"]) -> Seen:
    """Rays that have met nothing, with room for a chunk past the last; `image` and `worth` are colour and transmittance."""

    def stacked(value: Array) -> Array:
        value = value.reshape(*value.shape[:-3], -1, RAYS)
        room = (*value.shape[:-2], value.shape[-2] + TOGETHER, RAYS)
        return jnp.zeros(room, value.dtype).at[..., place, :].set(value)

    color, transmittance = (stacked(value) for value in image)
    worths = stacked(jnp.concatenate([worth[0], worth[1][None]]))
    return Seen(color, transmittance, worths, jnp.zeros_like(color), jnp.ones_like(transmittance))


def value_slabs(
    seen: Seen,
    light: Light,
    held_at: Int[Array, " held"],
    starts: Int[Array, " layers_and_one"],
    first: Int[Array, ""],
    number: Int[Array, ""],
) -> tuple[Seen, Float[Array, "4 held 64"]]:
    """What the slabs of a stretch of the stacks are worth: red, green, blue and optical thickness. See `composite.composite`."""

    def put_layer(layer: Array, carry: tuple[Seen, Array]) -> tuple[Seen, Array]:
        begin = jnp.maximum(starts[layer] - first, 0)
        past = jnp.minimum(starts[layer + 1] - first, number)
        bundle = first + begin - starts[layer]

        def put_chunk(chunk: Array, carry: tuple[Seen, Array]) -> tuple[Seen, Array]:
            seen, worth = carry
            place = begin + chunk * TOGETHER + jnp.arange(TOGETHER, dtype=jnp.int32)
            inside = place < past
            at = jnp.where(inside, held_at[jnp.where(inside, place, 0)], light[0].shape[0] - 1)
            here = bundle + chunk * TOGETHER
            # at hand before any is put back, see `composite`
            rays = computed_once(here >= 0, _slice_of, seen, here)
            color, transmittance, found = _value(rays, [field[at] for field in light[:4]])
            color = lax.dynamic_update_slice_in_dim(seen.color_so_far, color, here, 1)
            transmittance = lax.dynamic_update_slice_in_dim(seen.transmittance_so_far, transmittance, here, 0)
            seen = dataclasses.replace(seen, color_so_far=color, transmittance_so_far=transmittance)
            return seen, worth.at[:, at].set(found)

        return lax.fori_loop(0, (past - begin + TOGETHER - 1) // TOGETHER, put_chunk, carry)

    top = (starts <= first).sum(dtype=jnp.int32) - 1
    bottom = (starts < first + number).sum(dtype=jnp.int32)
    return lax.fori_loop(top, bottom, put_layer, (seen, jnp.zeros((4, *light[0].shape), light[0].dtype)))


def _slice_of(seen: Seen, begin: Array) -> Seen:
    return jax.tree.map(lambda field: lax.dynamic_slice_in_dim(field, begin, TOGETHER, field.ndim - 2), seen)


def _value(rays: Seen, light: list[Array]) -> tuple[Array, Array, Array]:
    """Colour and transmittance of rays behind one more slab each, and what the slabs are worth."""
    *emission, left = light
    behind = rays.transmittance_so_far * left
    color = rays.color_so_far + rays.transmittance_so_far * jnp.stack(emission)
    remaining = jnp.clip(rays.color - color, 0, behind)
    hidden = (rays.worth[:3] * remaining).sum(0) + rays.worth[3] * rays.transmittance
    return color, behind, jnp.concatenate([rays.worth[:3] * rays.transmittance_so_far, -hidden[None]])


@dataclasses.dataclass(frozen=True)
class Samples:
    """What the samples of a chunk are worth.

    Attributes:
        weight, weighted: of the sums of `gather_field`.
        optics: of red, green, blue and extinction.
        quantity: of the field.
        path: of the path lengths.
        found: the field itself.
    """

    weight: Float[Array, "chunk samples 64"]
    weighted: Float[Array, "chunk samples 64"]
    optics: list[Float[Array, "chunk samples 64"]]
    quantity: Float[Array, "chunk samples 64"]
    path: Float[Array, "chunk samples 64"]
    found: Float[Array, "chunk samples 64"]


def value_samples(
    sums: tuple[Array, Array],
    path: Float[Array, "chunk samples 64"],
    segments: Segments,
    item: Worklist,
    worth: Float[Array, "4 chunk 64"],
) -> Samples:
    """Pull what slabs are `worth` back through `shading.shade`."""
    weight, weighted = sums
    inside = weight > 0
    inverse = 1 / jnp.where(inside, weight, 1)
    ratio = jnp.where(inside, weighted * inverse, 0)
    quantity = item.origin[:, None, None] + ratio
    optics, slopes = jax.jvp(lambda q: look_up(segments, q), (quantity,), (jnp.ones_like(quantity),))
    thickness = jnp.where(inside, optics[3] * path, 0)
    pull = jax.vjp(lambda colors, thickness: emitted(colors, transmitted(thickness))[:3], optics[:3], thickness)[1]
    of_colors, within = pull(list(worth[:3]))
    of_thickness = jnp.where(inside, worth[3][:, None] + within, 0)
    of_optics = [*(jnp.where(inside, value, 0) for value in of_colors), of_thickness * path]
    of_quantity = sum(value * slope for value, slope in zip(of_optics, slopes, strict=True))
    solid = weight > SMALLEST_WEIGHT * jnp.finfo(weight.dtype).tiny
    of_weighted = jnp.where(solid, of_quantity * inverse, 0)
    return Samples(-ratio * of_weighted, of_weighted, of_optics, of_quantity, of_thickness * optics[3], quantity)


def owe_transfer(samples: Samples, segments: Segments) -> Float[Array, "5 points"]:
    """Cotangents of the control points of a transfer function: red, green, blue, extinction, and where the points lie.

    A sample's optics are those of the points at the ends of its segment, in shares that add up to 1. To move an end is to
    move the field the other way by the same share.
    """
    points = segments.start.shape[0]
    segment, part = locate(segments, samples.found)
    worth = jnp.stack([*samples.optics, -samples.quantity]).reshape(5, -1)
    segment, part = segment.reshape(-1), part.reshape(-1)
    if points <= SELECT_ALL:
        each = jnp.arange(points, dtype=jnp.int32)[:, None]
        share = jnp.where(each == segment, 1 - part, jnp.where(each == segment + 1, part, 0))
        return jnp.matmul(worth, share.T, precision=lax.Precision.HIGHEST)
    rows = jnp.concatenate([worth * (1 - part), worth * part]).T
    added = jnp.zeros((points, 10), worth.dtype).at[segment].add(rows, mode="promise_in_bounds").T
    return added[:5] + jnp.pad(added[5:, :-1], ((0, 0), (1, 0)))


def pathwise(border: Array, slant: Array) -> Float[Array, "chunk samples 64"]:
    """Path lengths of samples between `border`s, for rays that are `slant` long a unit of depth."""
    return (border[:, 1:] - border[:, :-1])[:, :, None] * slant[:, None]


for _kind in (Seen, Samples):
    jax.tree_util.register_dataclass(_kind, data_fields=[field.name for field in dataclasses.fields(_kind)], meta_fields=[])
