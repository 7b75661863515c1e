"""Marching: from schedule and media to what all rays have met.

Flow: schedule, packets -> batches -> [march: media -> integrator -> composite] -> screen.

What a slab of samples does to light does not depend on what lies in front of it. So a batch of slabs is marched in any order,
chunk by chunk; what they emit and absorb is held, and then put into the rays' state layer by layer.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxsph.engine.access.grid import Grid
from jaxsph.engine.cast.batches import Batches, CastPlan, batches_of
from jaxsph.engine.cast.composite import RayState, Together, composite, empty_segments, fresh_rays
from jaxsph.engine.cast.integrator import Integrator, Segment
from jaxsph.engine.cast.refine import CAUTION, errors_seen, refine, shares_of
from jaxsph.engine.field.schedule import SlabSchedule, evaluations_of_slabs
from jaxsph.engine.field.tasks import RayPackets
from jaxsph.model.medium import Medium
from jaxsph.numerics.trees import tree

STEPS = 32  # roundings of the thickness of a sample, from sums over particles to the mean of its extinction


@tree()
class RayResult:
    """What all rays of a band have met: premultiplied colour, transmittance, depth of half transmittance.

    `error` is what colours and transmittance are estimated to be wrong by; None where nothing is estimated. Kernel evaluations a
    ray of each packet: `refined` is what marching slabs again took, `left_out` what rays that ended would have; None without.
    `cut` is how many slabs they left out, whatever those would have taken. `stop` are the depths at which rays first end at
    something opaque, infinite where they do not, and x, y and z of its normal, in view space until `adjoint.cast` turns them into
    the world; None where nothing is.
    """

    color: Float[Array, "3 packets rows columns"]
    transmittance: Float[Array, "packets rows columns"]
    depth: Float[Array, "packets rows columns"]
    left_out: Float[Array, " packets"] | None = None
    error: Float[Array, "packets rows columns"] | None = None
    refined: Float[Array, " packets"] | None = None
    cut: Float[Array, " packets"] | None = None
    stop: Float[Array, "4 packets rows columns"] | None = None


class Marched(NamedTuple):
    """What is known between batches: what rays have met, the light of the last batch by slot, and see `RayResult`."""

    rays: RayState
    light: Segment
    left_out: Float[Array, "packets 2"] | None
    refined: Array | None


def march(
    grid: Grid,
    schedule: SlabSchedule,
    packets: RayPackets,
    medium: Medium,
    integrator: Integrator,
    plan: CastPlan,
    perspective: bool,
    min_transmittance: Float[Array, ""] | None = None,
    tolerance: Float[Array, ""] | None = None,
) -> RayResult:
    """March all packets of a band, by a schedule of bundles.

    Packets all of whose rays let less through than `min_transmittance` end between batches; for a tolerance slabs are refined.
    """
    batches = batches_of(grid, schedule, packets, plan, perspective, min_transmittance, integrator.between)
    together, ending = Together.of(batches.num_packets, plan.tuning), min_transmittance is not None
    refining = tolerance is not None
    spent = evaluations_of_slabs(batches.schedule, grid.samples, plan.slab_samples) if ending else None
    starts = batches.compacted.start

    def march_batch(nth: Array, state: Marched) -> Marched:
        rays, light, left_out, refined = state
        batch = batches.batch(nth, batches.ended(rays.transmittance))
        if spent is not None and left_out is not None:
            left_out = left_out + batches.left_out(batch, spent)

        def march_chunk(chunk: Array, light: Segment) -> Segment:
            items, begin = batches.chunk(batch, chunk)
            found = segments_of(batches, items, medium, integrator)
            return jax.tree.map(lambda old, new: lax.dynamic_update_slice_in_dim(old, new, begin, 0), light, found)

        def borders(place: Array) -> Array:
            return batches.borders(batch.items[place])

        def seen(light: Segment) -> Array:
            return errors_seen(batch, light, rays.transmittance, starts, together)

        if tolerance is None or refined is None:
            light = lax.fori_loop(0, batch.chunks, march_chunk, light)
        else:
            again = functools.partial(refined_segments, batches, medium, integrator)
            light, refined = refine(batches, batch, light, refined, seen, shares_of(batches, tolerance), again)
        return Marched(composite(rays, light, batch, borders, starts, together), light, left_out, refined)

    dtype, nothing = grid.half_steps.dtype, jnp.zeros(batches.num_packets, jnp.float32)
    rays = fresh_rays(batches.num_packets, packets.num_rays, dtype, together, refining, medium.stops_rays)
    light = empty_segments(batches.num_slots + 1, plan.slab_samples, packets.num_rays, dtype, refining, medium.stops_rays)
    start = Marched(rays, light, jnp.stack([nothing, nothing], 1) if ending else None, nothing if refining else None)
    found = lax.fori_loop(0, batches.number, march_batch, start)
    left_out, cut = (None, None) if found.left_out is None else found.left_out.T
    return dataclasses.replace(result_of(found.rays, batches), left_out=left_out, refined=found.refined, cut=cut)


def segments_of(batches: Batches, items: Array, medium: Medium, integrator: Integrator) -> Segment:
    """What slabs emit and let through."""
    task = batches.task(items)
    gathered = medium.gather(task)
    light = integrator(medium, gathered, task)
    return dataclasses.replace(light, stop=jnp.stack(medium.stops(gathered, task), 1)) if medium.stops_rays else light


def refined_segments(batches: Batches, medium: Medium, integrator: Integrator, items: Array, level: Array) -> Segment:
    """The same of slabs with `2 ** level` times as many samples, and how wrong that may be: errors of parts are independent."""
    task, samples = batches.task(items), batches.plan.slab_samples

    def march_part(nth: Array, front: Segment) -> Segment:
        part = task.refined(level, nth)
        light = integrator.compared(medium, medium.gather(part), part)
        left, (red, green, blue) = front.transmittance, light.color
        color = tuple(met + left * new for met, new in zip(front.color, (red, green, blue), strict=True))
        sample = (nth * samples + jnp.arange(samples, dtype=jnp.int32)) >> level
        thickness = front.thickness.at[:, sample].add(light.thickness)
        assert front.error is not None and light.error is not None
        error = jnp.hypot(front.error, left * light.error)
        return Segment(color, left * light.transmittance, thickness, error)  # type: ignore[arg-type]

    nothing = jnp.zeros(task.shape[::2], task.depth.dtype)
    start = Segment((nothing,) * 3, jnp.ones_like(nothing), jnp.zeros(task.shape, nothing.dtype), nothing)
    return lax.fori_loop(0, 1 << level, march_part, start)


def rounding_of(batches: Batches) -> Float[Array, "packets 1 1"]:
    """What rounding may add to the errors of the rays of packets; nothing where nothing is marched.

    A slab that is put into a ray rounds colour and transmittance by a half of eps, which are at most 1, and so does its product
    with the light in front. Its thickness is wrong by a half of eps of itself for each sample that is added up, and for `STEPS`
    before: of all slabs together that is as much of the light, as thicknesses take no more of it than there is.
    """
    dtype, plan = batches.half_steps.dtype, batches.plan
    filled = batches.schedule.filled.sum(0).astype(dtype)
    halves = 2 * filled + (plan.slab_samples << plan.doublings) + STEPS
    return jnp.where(filled > 0, halves, 0)[:, None, None] * (jnp.finfo(dtype).eps / 2)


def result_of(rays: RayState, batches: Batches) -> RayResult:
    """Rays in the order of packets, as rows and columns."""
    rank, shape = batches.compacted.bundle_rank, batches.packets.shape
    color, transmittance, depth = (
        field[..., rank, :].reshape(*field.shape[:-2], -1, *shape) for field in (rays.color, rays.transmittance, rays.depth)
    )
    error = None if rays.square is None else CAUTION * jnp.sqrt(rays.square[rank].reshape(-1, *shape)) + rounding_of(batches)
    stop = None if rays.stop is None else rays.stop[:, rank].reshape(4, -1, *shape)
    return RayResult(color, transmittance, depth, error=error, stop=stop)
