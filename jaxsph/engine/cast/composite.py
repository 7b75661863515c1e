r"""Front to back: the light of slabs put into the state of rays, Hochstetter et al. 2016, equation 3; and the transpose of that.

Flow: integrator -> [composite] -> image; cotangents of an image -> [composite: replay] -> integrator, media.

A slab that emits colour C and lets through t, both as seen from right in front of it, adds T C to a ray and leaves it T t.

Let $\bar C$ and $\bar T$ be the cotangents of a ray's colour and transmittance. $C = \sum_k T_k e_k$, with $e_k$ what slab k
emits and $T_k$ what is let through before, gives $e_k$ the cotangent $T_k \bar C$. More optical thickness in slab k dims all that
comes from behind it, so its cotangent is $-(\bar C \cdot C_{>k} + \bar T T)$, with $C_{>k}$ what the slabs behind add to the ray,
which is found as they are met again. That is at most what is let through (times how many media show all of their light, where
they are mixed so), which bounds its rounding. Cotangents of where a ray ends are of the slab that ends it.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxsph.engine.cast.batches import Batch
from jaxsph.engine.cast.integrator import Segment, transmitted
from jaxsph.engine.runtime.tuning import Tuning
from jaxsph.numerics.compiled import clamped, fusion_barrier, lesser
from jaxsph.numerics.trees import tree

Carry = TypeVar("Carry")
Borders = Callable[[Array], Array]


@dataclasses.dataclass(frozen=True)
class Together:
    """What is composited together.

    Attributes:
        packets: of a layer.
        half_depths: packets among them whose half depths are found together.
        whole: whether that is all of any layer.
    """

    packets: int
    half_depths: int
    whole: bool

    @classmethod
    def of(cls, packets: int, tuning: Tuning) -> Together:
        """No more than there are."""
        together = min(tuning.bundles_composited, packets)
        return cls(together, min(tuning.half_depths_found, together), together == packets)


@tree()
class RayState:
    """Rays of packets in order of height, and room for as many as are composited together past the last.

    Attributes:
        color: red, green and blue met so far, premultiplied.
        transmittance: of all that was met so far.
        depth: where that fell to one half, infinite where it has not.
        square: sum of the squared errors that slabs are estimated to have, as they are seen; None where none are.
        stop: where they first end at something opaque, see `Medium.stops`; None where nothing is.
    """

    color: Float[Array, "3 packets rays"]
    transmittance: Float[Array, "packets rays"]
    depth: Float[Array, "packets rays"]
    square: Float[Array, "packets rays"] | None = None
    stop: Float[Array, "4 packets rays"] | None = None


class RayLayers(NamedTuple):
    """What has derivatives of all that rays have met, see `RayState`; or the cotangents of it."""

    color: Float[Array, "3 packets rows columns"]
    transmittance: Float[Array, "packets rows columns"]
    stop: Float[Array, "4 packets rows columns"] | None = None


class SlabLight(NamedTuple):
    """Slabs as seen from right in front of each, without what no derivative needs: see `Segment`; `stop` has its axes apart."""

    color: tuple[Array, ...]
    transmittance: Float[Array, "slots rays"]
    stop: tuple[Array, ...] = ()


def empty_segments(slots: int, samples: int, rays: int, dtype: Any, estimated: bool = False, stopping: bool = False) -> Segment:
    """Slabs with nothing in them; `estimated`: and with no error; `stopping`: and where nothing ends rays."""
    red, green, blue, error = (jnp.zeros((slots, rays), dtype) for _ in range(4))
    through, thickness = jnp.ones((slots, rays), dtype), jnp.zeros((slots, samples, rays), dtype)
    stop = jnp.moveaxis(no_stops((slots, rays), dtype), 0, 1) if stopping else None
    return Segment((red, green, blue), through, thickness, error if estimated else None, stop)


def no_stops(shape: tuple[int, ...], dtype: Any) -> Float[Array, "4 ..."]:
    """Of rays that nothing ends."""
    return jnp.broadcast_to(np.reshape([np.inf, 0, 0, 0], (4, *[1] * len(shape))).astype(dtype), (4, *shape))


def fresh_rays(
    packets: int, rays: int, dtype: Any, together: Together, estimated: bool = False, stopping: bool = False
) -> RayState:
    """Rays that have met nothing; of `estimated` and `stopping` see `empty_segments`."""
    room = packets + together.packets, rays
    square, transmittance, depth = (jnp.full(room, value, dtype) for value in (0, 1, jnp.inf))
    stop = no_stops(room, dtype) if stopping else None
    return RayState(jnp.zeros((3, *room), dtype), transmittance, depth, square if estimated else None, stop)


def over_layers(
    put: Callable[[Carry, Array, Array, Array], Carry], carry: Carry, starts: Int[Array, " _"], batch: Batch, together: Together
) -> Carry:
    """Take all slabs of a batch front to back, some of a layer of the compacted slabs at a time.

    Args:
        put: `put(carry, place, inside, packet)`: places in the batch, whether each is of the layer, and the packet of the first;
            packets follow one another.
        starts: where the layers of the compacted slabs begin.
    """

    def put_layer(layer: Array, carry: Carry) -> Carry:
        begin = jnp.maximum(starts[layer] - batch.first, 0)
        past = jnp.minimum(starts[layer + 1] - batch.first, batch.number)
        packet = batch.first + begin - starts[layer]

        def put_some(nth: Array, carry: Carry) -> Carry:
            place = begin + nth * together.packets + jnp.arange(together.packets, dtype=jnp.int32)
            inside = place < past
            return put(carry, jnp.where(inside, place, 0), inside, packet + nth * together.packets)

        if together.whole:
            return put_some(jnp.int32(0), carry)
        return lax.fori_loop(0, (past - begin + together.packets - 1) // together.packets, put_some, carry)

    top = (starts <= batch.first).sum(dtype=jnp.int32) - 1
    bottom = (starts < batch.first + batch.number).sum(dtype=jnp.int32)
    return lax.fori_loop(top, bottom, put_layer, carry)


def composite(
    state: RayState, light: Segment, batch: Batch, borders: Borders | None, starts: Int[Array, " _"], together: Together
) -> RayState:
    """Put the light of a batch into the rays, whose packets are in order of height.

    Args:
        light: of the slabs of the batch by slot, and of nothing at the end.
        borders: of places in the batch, the depths of the borders of their samples; None where all light ends at a `stop`.
        starts: where the layers of the compacted slabs begin.
    """
    nothing = light.transmittance.shape[0] - 1

    def put(state: RayState, place: Array, inside: Array, packet: Array) -> RayState:
        slot = jnp.where(inside, batch.slot[place], nothing)
        # at hand before any is put back: XLA would read it from the whole state again, and copy all of that to do so
        rays = fusion_barrier(packet >= 0, lambda: rows(state, packet, together.packets))
        emitted, left = jnp.stack([channel[slot] for channel in light.color]), light.transmittance[slot]
        behind = rays.transmittance * left
        crossed = (rays.transmittance > 0.5) & (behind <= 0.5)
        color, square, stop = rays.color + rays.transmittance * emitted, rays.square, rays.stop
        if square is not None and light.error is not None:
            square = square + (rays.transmittance * light.error[slot]) ** 2
        if stop is not None and light.stop is not None:
            behind_it = jnp.moveaxis(light.stop[slot], 1, 0)
            stop = jnp.where(stop[0] <= behind_it[0], stop, behind_it)
        depth = stop[0] if borders is None else _with_half_depth(rays, crossed, light, slot, borders(place), together.half_depths)
        rays = RayState(color, behind, depth, square, stop)
        return jax.tree.map(lambda old, new: lax.dynamic_update_slice_in_dim(old, new, packet, old.ndim - 2), state, rays)

    return over_layers(put, state, starts, batch, together)


def rows(state: Any, first: Array, number: int) -> Any:
    """Some rows of arrays whose last but one axis is packets, or slabs."""
    return jax.tree.map(lambda field: lax.dynamic_slice_in_dim(field, first, number, field.ndim - 2), state)


def _with_half_depth(
    rays: RayState, crossed: Array, light: Segment, slot: Array, border: Array, together: int
) -> Float[Array, "packets rays"]:
    """`depth` of rays, found for a few packets at a time of those where any ray has crossed one half: others cost nothing."""
    number = crossed.shape[0]
    if together >= number:
        return _half_depth(rays.depth, crossed, rays.transmittance, light, slot, border)
    some = crossed.any(1)
    packets = lax.sort(jnp.where(some, jnp.arange(number, dtype=jnp.int32), number))

    def find_some(state: tuple[Array, Array]) -> tuple[Array, Array]:
        first, depth = state
        packet = lax.dynamic_slice_in_dim(packets, first, together)
        here = jnp.minimum(packet, number - 1)
        of_rays = [value[here] for value in (depth, crossed, rays.transmittance)]
        found = fusion_barrier(first >= 0, _half_depth, *of_rays, light, slot[here], border[here])
        return first + together, depth.at[packet].set(found, mode="drop")

    def more(state: tuple[Array, Array]) -> Array:
        return (state[0] < number) & (packets[jnp.minimum(state[0], number - 1)] < number)

    return lax.while_loop(more, find_some, (jnp.int32(0), rays.depth))[1]


def _half_depth(depth: Array, crossed: Array, transmittance: Array, light: Segment, slot: Array, border: Array) -> Array:
    """Where rays that enter slabs with `transmittance` fall to one half; `depth` where they have not `crossed` it.

    In a sample in which something ends them, that is where. Whatever the products of the samples round to here, one that has
    crossed does so at the last sample if not before.
    """
    thickness, stop = light.thickness[slot], None if light.stop is None else light.stop[slot, 0]
    left, reached = transmitted(thickness), transmittance
    here = [jnp.zeros_like(depth)] * 4  # of the sample: what enters it, its thickness, and its borders
    found = ~crossed
    for k in range(thickness.shape[1]):
        behind = transmittance * left[:, k]
        at = ~found & ((behind <= 0.5) | (k == thickness.shape[1] - 1))
        of_sample = reached, thickness[:, k], border[:, k, None], border[:, k + 1, None]
        here = [jnp.where(at, new, old) for new, old in zip(of_sample, here, strict=True)]
        found, reached = found | at, behind
    entering, thick, start, end = here
    share = jnp.where(thick > 0, jnp.log(2 * entering) / jnp.where(thick > 0, thick, 1), 1)
    place = start + lesser(1, share) * (end - start)
    if stop is not None:
        place = jnp.where((stop >= start) & (stop <= end), stop, place)
    return jnp.where(crossed, place, depth)


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


def fresh_replay(image: RayLayers, cotangent: RayLayers, rank: Int[Array, " packets"], together: Together) -> ReplayState:
    """Rays that have met nothing, with room past the last."""

    def by_rank(value: Array) -> Array:
        value = value.reshape(*value.shape[:-2], -1)
        room = (*value.shape[:-2], value.shape[-2] + together.packets, value.shape[-1])
        return jnp.zeros(room, value.dtype).at[..., rank, :].set(value)

    color, transmittance = by_rank(image.color), by_rank(image.transmittance)
    of_stop = () if cotangent.stop is None else (cotangent.stop,)
    cotangents = by_rank(jnp.concatenate([cotangent.color, cotangent.transmittance[None], *of_stop]))
    goes_on = None if image.stop is None else jnp.ones(transmittance.shape, bool)
    return ReplayState(color, transmittance, goes_on, cotangents, jnp.zeros_like(color), jnp.ones_like(transmittance))


def pull_composite(
    state: ReplayState, light: SlabLight, batch: Batch, starts: Int[Array, " _"], together: Together, most: int = 1
) -> tuple[ReplayState, Float[Array, "4_or_8 slots rays"]]:
    """Cotangents of the slabs of a batch: of red, green, blue and optical thickness, and of their stops if rays have any.

    See `composite.composite`.

    Args:
        light: of the slabs of the batch by slot, and of nothing at the end.
        most: times what a slab takes of the light, that it emits at most.
    """
    nothing = light.transmittance.shape[0] - 1

    def put(carry: tuple[ReplayState, Array], place: Array, inside: Array, packet: Array) -> tuple[ReplayState, Array]:
        state, cotangents = carry
        slot = jnp.where(inside, batch.slot[place], nothing)
        # at hand before any is put back, see `composite`
        rays = fusion_barrier(packet >= 0, lambda: rows(state, packet, together.packets))
        emission, left = [channel[slot] for channel in light.color], light.transmittance[slot]
        stops = [axis[slot] for axis in light.stop]
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
        put_back = functools.partial(lax.dynamic_update_slice_in_dim, start_index=packet, axis=-2)
        state = dataclasses.replace(state, **{name: put_back(getattr(state, name), rows) for name, rows in made.items()})
        return state, cotangents.at[:, slot].set(jnp.concatenate(found))

    rows_of_cotangents = len(light.color) + 1 + len(light.stop)
    start = jnp.zeros((rows_of_cotangents, *light.transmittance.shape), light.transmittance.dtype)
    return over_layers(put, (state, start), starts, batch, together)
