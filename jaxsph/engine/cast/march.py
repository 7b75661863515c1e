"""Marching: from schedule and media to what all rays have met, as a function that can be differentiated either way.

Flow: schedule, packets -> batches -> [march: media -> integrator -> composite] -> screen; cotangents of the image -> [march:
replay -> integrator -> media] -> cotangents.

What a slab of samples does to light does not depend on what lies in front of it. So a batch of slabs is marched in any order,
chunk by chunk; what they emit and absorb is held, and then put into the rays' state layer by layer.

Forward, derivatives are those of the march itself. Backward, the slabs are marched again, a batch at a time: what media gather
and the light are held, the cotangents of each slab follow from the rays before and behind it (`composite`), and are pulled
through the integrator by `jax.vjp` and through each medium by `Medium.pull`. So neither needs an adjoint of its own, but where a
gather is worth one; and memory is that of the march, whatever the number of samples or of particles in a cell.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jax import lax
from jax.ad_checkpoint import checkpoint_name
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Float, Int

from jaxsph.engine.access.grid import Grid
from jaxsph.engine.cast.batches import Batch, Batches, CastPlan, batches_of, with_room
from jaxsph.engine.cast.composite import (
    RayLayers,
    RayState,
    ReplayState,
    SlabLight,
    Together,
    composite,
    empty_segments,
    fresh_rays,
    fresh_replay,
    no_stops,
    pull_composite,
)
from jaxsph.engine.cast.integrator import Integrator, Optics, Segment
from jaxsph.engine.cast.segments import Refinement
from jaxsph.engine.field.gather import COLUMNS, WIDTH
from jaxsph.engine.field.lattice import Lattice
from jaxsph.engine.field.tasks import RayPackets, SlabSchedule, SlabTask, evaluations_of_slabs
from jaxsph.engine.media.between import ParticlesBetween
from jaxsph.engine.media.particles import ParticleMedium
from jaxsph.engine.media.shown import Band, Mixture, RayLimits, Shown, Within
from jaxsph.engine.runtime.clock import CHECKPOINT_NAME
from jaxsph.model.camera.camera import Camera
from jaxsph.model.medium import Cotangents, Medium, optics, pull_path
from jaxsph.numerics.checks import as_usual
from jaxsph.numerics.compiled import barriers, fusion_barrier
from jaxsph.numerics.transposed import tangent_of
from jaxsph.numerics.trees import tree

TWICE = "second derivatives of an image are not implemented; take differences of `jax.grad`, or a method that needs first ones"
NO_LIMITS = RayLimits()
State = TypeVar("State")


class MarchState(NamedTuple):
    """Between batches: rays by rank, light of the last batch by slot; of `left_out` and `refined` see `RayResult`."""

    rays: RayState
    light: Segment
    left_out: Float[Array, "packets 2"] | None
    refined: Float[Array, " packets"] | None


class InputCotangents(NamedTuple):
    """Of what media are made of, of half steps, and of a common factor of all u and v."""

    media: Cotangents
    half_steps: Float[Array, " two_samples_and_more"]
    factor: Float[Array, ""]


class PullState(NamedTuple):
    """Between batches, backward: rays by rank, light and what media gathered of the last batch by slot, cotangents so far."""

    rays: ReplayState
    light: SlabLight
    gathered: Any
    total: InputCotangents


class Wanted(NamedTuple):
    """Whether cotangents are wanted by where samples and particles are and what these carry; and by what each medium is."""

    field: bool
    media: tuple[bool, ...]


@tree()
class RayResult:
    """What all rays of a band have met: premultiplied colour, transmittance, depth of half transmittance.

    `error` is what colours and transmittance are estimated to be wrong by; of point samples it is above 0 where rounding may
    choose what they show, and no error is known (`Medium.doubtful`); None where nothing is estimated. Kernel evaluations a ray
    of each packet: `refined` is what marching slabs again took, `left_out` what rays that ended would have; None without. `cut`
    is how many slabs they left out, whatever those would have taken. `stop` are the depths at which rays first end at something
    opaque, infinite where they do not, and x, y and z of its normal, in view space until `cast` turns them into the world; None
    where nothing is.
    """

    color: Float[Array, "3 packets rows columns"]
    transmittance: Float[Array, "packets rows columns"]
    depth: Float[Array, "packets rows columns"]
    left_out: Float[Array, " packets"] | None = None
    error: Float[Array, "packets rows columns"] | None = None
    refined: Float[Array, " packets"] | None = None
    cut: Float[Array, " packets"] | None = None
    stop: Float[Array, "4 packets rows columns"] | None = None


@dataclasses.dataclass(frozen=True)
class CastMethod:
    """How rays are cast, static: by which kernel, sizes, integrator and mixing of media, and through which packets of rays."""

    kernel: str
    plan: CastPlan
    integrator: Integrator
    packets_of: Callable[..., RayPackets]
    mix: str = "extinction"


@tree()
class DiffInputs:
    """What a march is differentiated by; particles come first of the media, if there are any."""

    columns: dict[str, Float[Array, " particles"]]
    half_steps: Float[Array, " two_samples_and_one"]
    half_height: Float[Array, ""]
    media: tuple[Medium, ...]


@tree()
class NonDiffInputs:
    """What is held fixed: which particles and samples meet, and how they are sampled."""

    grid: Grid
    schedule: SlabSchedule
    camera: Camera
    lattice: Lattice | None
    chosen: Any
    limits: RayLimits


def cast(
    grid: Grid,
    schedule: SlabSchedule,
    shown: Shown,
    method: CastMethod,
    *,
    lattice: Lattice | None = None,
    chosen: Any = None,
    limits: RayLimits = NO_LIMITS,
) -> RayResult:
    """March, differentiable in both modes; `chosen` is for `CastMethod.packets_of`.

    Differentiation:
        Colour and transmittance have derivatives by the particles' columns, by the depths of samples, by the camera's opening,
        by the transfer function and by what other media are made of. Lists, windows, levels and the references of sums are
        held fixed; so has `stop`, and `depth` where that is it.

    Raises:
        NotImplementedError: while differentiating a schedule that has super-pixels or interpolated slabs, whose values are made
            elsewhere; and when differentiated twice.
    """
    given = {name: getattr(grid.ordered, name) for name in COLUMNS}
    columns = {name: column for name, column in given.items() if column is not None}
    camera, transfer, media, within = shown
    if transfer is not None:
        particles = ParticlesBetween if method.integrator.between else ParticleMedium
        media = Within.of(particles(transfer, method.kernel), within), *media
    inputs = DiffInputs(columns, grid.half_steps, camera.half_height, media)
    fixed = NonDiffInputs(grid, schedule, camera, lattice, chosen, limits)
    found = _cast(method, inputs, jax.tree.map(lax.stop_gradient, fixed))
    if found.stop is None:
        return found
    depth, *normal = found.stop
    in_world = [sum(n * axis[k] for n, axis in zip(normal, camera.axes, strict=True)) for k in range(3)]
    there = jnp.where(found.depth == depth, depth, found.depth)
    return dataclasses.replace(found, depth=there, stop=jnp.stack([depth, *in_world]))


def _march(method: CastMethod, inputs: DiffInputs, fixed: NonDiffInputs) -> RayResult:
    """March all packets of a band, by a schedule of bundles.

    Packets all of whose rays let less through than is asked for end between batches; for a tolerance slabs are refined.
    """
    with barriers(method.plan.tuning.fusion_barriers):  # rules of derivatives are traced after the stage that they are of
        batches, medium = _batches(method, method.plan, inputs, fixed)
        samples, packets, plan, integrator = fixed.grid.samples, batches.packets, batches.plan, method.integrator
        together, ending = Together.of(batches.num_packets, plan.tuning), batches.min_transmittance is not None
        tolerance = fixed.limits.tolerance
        refining, refinement = tolerance is not None, None
        doubting = not (refining or integrator.between or medium.only_stops or fixed.lattice)
        if tolerance is not None:
            refinement = Refinement(batches, medium, integrator, tolerance)
        spent = evaluations_of_slabs(batches.schedule, samples, plan.slab_samples) if ending else None
        starts = batches.compacted.start

        def march(items: Array) -> Segment:
            task = batches.task(items)
            gathered = medium.gather(task)
            light = (_opaque if medium.only_stops else integrator)(medium, gathered, task)
            if doubting:
                doubt = fusion_barrier(task.slab[0] >= 0, medium.doubtful, gathered, task)
                light = dataclasses.replace(light, error=doubt.any(1).astype(dtype))
            if medium.stops_rays:
                light = dataclasses.replace(light, stop=jnp.stack(medium.stops(gathered, task), 1))
            return light

        def march_batch(batch: Batch, state: MarchState) -> MarchState:
            rays, light, left_out, refined = state
            if spent is not None and left_out is not None:
                left_out = left_out + batches.left_out(batch, spent)

            def borders(place: Array) -> Array:
                return batches.depths(batch.items[place], batches.half_steps)[1]

            if refinement is None or refined is None:
                light = lax.fori_loop(0, batch.unpainted, each_chunk(batches, batch, march), light)
                if batches.schedule.span is not None:
                    paint = functools.partial(_painted, batches, doubting)
                    light = lax.fori_loop(batch.unpainted, batch.chunks, each_chunk(batches, batch, paint), light)
            else:
                light, refined = refinement.march(batch, light, refined, rays.transmittance)
            rays = composite(rays, light, batch, None if medium.only_stops else borders, starts, together)
            return MarchState(rays, light, left_out, refined)

        dtype, nothing = inputs.half_steps.dtype, jnp.zeros(batches.num_packets, jnp.float32)
        more = refining or doubting, medium.stops_rays
        rays = fresh_rays(batches.num_packets, packets.num_rays, dtype, together, *more)
        light = empty_segments(batches.num_slots + 1, plan.slab_samples, packets.num_rays, dtype, *more)
        left_out = jnp.stack([nothing, nothing], 1) if ending else None
        start = MarchState(rays, light, left_out, nothing if refining else None)
        body = each_batch(batches, march_batch, lambda state: state.rays.transmittance)
        rays, _, left_out, refined = lax.fori_loop(0, batches.number, body, start)
        rank, shape = batches.compacted.bundle_rank, packets.shape
        # rays in the order of packets, as rows and columns
        rays = jax.tree.map(lambda field: field[..., rank, :].reshape(*field.shape[:-2], -1, *shape), rays)
        error = rays.square if refinement is None else refinement.error(rays.square)
        left_out, cut = (None, None) if left_out is None else left_out.T
        return RayResult(rays.color, rays.transmittance, rays.depth, left_out, error, refined, cut, rays.stop)


def each_batch(
    batches: Batches, step: Callable[[Batch, State], State], front: Callable[[State], Float[Array, "_ rays"]]
) -> Callable[[Array, State], State]:
    """The body of a loop over all batches, front to back.

    Args:
        step: what a batch makes of the state.
        front: what rays let through of all that a state has met, by rank.
    """

    def next_batch(nth: Array, state: State) -> State:
        return step(batches.batch(nth, batches.ended(front(state))), state)

    return next_batch


def each_chunk(batches: Batches, batch: Batch, march: Callable[[Int[Array, " chunk"]], Any]) -> Callable[[Array, Any], Any]:
    """The body of a loop over the chunks of a batch: what `march` makes of a chunk's items is put into the rows of its slots."""

    def next_chunk(nth: Array, slots: Any) -> Any:
        items, begin = batches.chunk(batch, nth)
        return jax.tree.map(lambda old, new: lax.dynamic_update_slice_in_dim(old, new, begin, 0), slots, march(items))

    return next_chunk


def _painted(batches: Batches, doubting: bool, items: Int[Array, " chunk"]) -> Segment:
    """Light of painted entries: nothing is gathered, and the first of their samples is as long as they are."""

    def light(task: SlabTask) -> Segment:
        assert task.entry.paint is not None
        red, green, blue, extinction = task.entry.paint[..., None]
        thickness = jnp.broadcast_to(extinction[..., None] * task.path(), task.shape)
        through = jnp.exp(-thickness[:, 0])
        color = red * (1 - through), green * (1 - through), blue * (1 - through)
        return Segment(color, through, thickness, jnp.zeros_like(through) if doubting else None)

    task = batches.task(items)
    return fusion_barrier(task.slab[0] >= 0, light, task)  # type: ignore[no-any-return]


def _opaque(medium: Medium, gathered: Any, task: Any) -> Segment:
    """Light of slabs as any integrator has it, where there is nothing but what stops rays."""
    extinction, samples = medium.extinction(gathered, task)
    met = jnp.isfinite(medium.stops(gathered, task)[0])
    red, green, blue = (jnp.where(met, color[:, 0], 0) for color in medium.colors(samples, task, slice(0, 3)))
    return Segment((red, green, blue), jnp.where(met, 0, jnp.ones_like(red)), jnp.zeros_like(extinction))


def _batches(
    method: CastMethod, plan: CastPlan, inputs: DiffInputs, fixed: NonDiffInputs, wanted: Wanted | None = None
) -> tuple[Batches, Medium]:
    """What is marched, and what media there are as one; `wanted`: see `_pull`."""
    ordered = dataclasses.replace(fixed.grid.ordered, **inputs.columns)
    grid = dataclasses.replace(fixed.grid, ordered=ordered, half_steps=inputs.half_steps)
    camera, between = dataclasses.replace(fixed.camera, half_height=inputs.half_height), method.integrator.between
    wanted = wanted or Wanted(True, (True,) * len(inputs.media))
    bands = (Band(grid, fixed.lattice, between, wanted.field, own) for own in wanted.media)
    medium = Mixture.of(tuple(one.in_band(band) for one, band in zip(inputs.media, bands, strict=True)), method.mix)
    packets, limits = method.packets_of(grid, camera, fixed.chosen), fixed.limits
    return batches_of(grid, fixed.schedule, packets, plan, camera.is_perspective, limits.min_transmittance, between), medium


@as_usual()
def _moved(
    method: CastMethod, primals: tuple[DiffInputs, NonDiffInputs], tangents: tuple[DiffInputs, NonDiffInputs]
) -> tuple[RayResult, RayResult]:
    """Image and tangent, which is a linear map of the tangents with a transpose of its own."""
    inputs, fixed = primals
    found = _cast(method, inputs, fixed)
    found = _with_layers(found, jax.tree.map(lambda layer: checkpoint_name(layer, CHECKPOINT_NAME), _layers(found)))
    still = jax.tree.map(jnp.zeros_like, found)
    if not _moves(tangents[0]):
        return found, still
    _require_values(fixed)
    wanted = Wanted(_moves(dataclasses.replace(tangents[0], media=())), tuple(map(_moves, tangents[0].media)))

    def light(inputs: DiffInputs) -> RayLayers:
        return _layers(_march(method, inputs, fixed))

    layers = _layers(found)
    pull = functools.partial(_pull, method, wanted, inputs, fixed, layers)
    tangent = tangent_of(light, pull, inputs, tangents[0], layers, TWICE)
    return found, _with_layers(still, tangent)


_cast = jax.custom_jvp(_march, nondiff_argnums=(0,))
_cast.defjvp(_moved, symbolic_zeros=True)


def _layers(rays: RayResult) -> RayLayers:
    return RayLayers(rays.color, rays.transmittance, rays.stop)


def _with_layers(rays: RayResult, layers: RayLayers) -> RayResult:
    return dataclasses.replace(rays, **layers._asdict())


def _moves(part: Any) -> bool:
    return not all(isinstance(move, SymbolicZero) for move in jax.tree.leaves(part))


def _require_values(fixed: NonDiffInputs) -> None:
    """Raise where values come from elsewhere, so that their derivatives would be missing."""
    refused = (
        "an image with super-pixels has no derivatives, as their colours come from bounds; "
        "give `jaxsph.Settings(super_pixels=False)`, or render at full rate with `tolerance=None`",
        "an image whose segments are refined for a tolerance has no derivatives; give `tolerance=None` and as many `samples` as "
        "it needs",
        "`estimator='pilot'` has no derivatives; give `estimator='interval'` with `super_pixels=False`, or `tolerance=None`",
    )
    for other, why in zip((fixed.schedule.paint, fixed.limits.tolerance, fixed.lattice), refused, strict=True):
        if other is not None:
            raise NotImplementedError(why)


def _pull(
    method: CastMethod, wanted: Wanted, inputs: DiffInputs, fixed: NonDiffInputs, image: RayLayers, cotangent: RayLayers
) -> DiffInputs:
    """Cotangents of `inputs`, from those of the image's layers; what is not `wanted` may be 0."""
    plan = method.plan.of_shard(2)  # as twice as much is held of each slab
    with barriers(plan.tuning.fusion_barriers):
        batches, medium = _batches(method, plan, inputs, fixed, wanted)
        x, own, several = fixed.grid.ordered.x, jax.tree.map(jnp.zeros_like, inputs.media), len(inputs.media) > 1
        cotangents = Cotangents(jnp.zeros((x.shape[0], WIDTH), x.dtype), own if several else own[0])
        start = InputCotangents(cotangents, jnp.zeros_like(batches.half_steps), jnp.zeros((), inputs.half_steps.dtype))
        found, of_steps, factor = _pull_batches(batches, medium, method, wanted, image, cotangent, start)
    columns = {name: found.table[:, k] for k, name in enumerate(COLUMNS) if name in inputs.columns}
    room = functools.partial(with_room, samples=fixed.grid.samples, slabs=fixed.schedule.count.shape[0], plan=plan)
    (half_steps,) = jax.vjp(room, inputs.half_steps)[1](of_steps)
    half_height = factor / inputs.half_height.astype(half_steps.dtype)
    total = DiffInputs(columns, half_steps, half_height, found.own if several else (found.own,))
    return jax.tree.map(lambda value, like: value.astype(like.dtype), total, inputs)


def _pull_batches(
    batches: Batches,
    medium: Medium,
    method: CastMethod,
    wanted: Wanted,
    image: RayLayers,
    cotangent: RayLayers,
    start: InputCotangents,
) -> InputCotangents:
    """Batch by batch: march its slabs again, then find their cotangents and pull them back."""
    together, integrator = Together.of(batches.num_packets, batches.plan.tuning), method.integrator
    most, chunk_slabs = 1 if method.mix == "extinction" else len(wanted.media), batches.plan.chunk

    def march(items: Array) -> tuple[SlabLight, Any]:
        """Light of slabs, and what is gathered there."""
        task = batches.task(items)
        gathered = medium.gather(task)
        light = integrator(medium, gathered, task)
        stop = tuple(medium.stops(gathered, task)) if medium.stops_rays else ()
        return SlabLight(light.color, light.transmittance, stop), gathered

    marched = jax.jit(march, inline=True)  # so that it is traced once
    light, gathered = jax.tree.map(
        lambda leaf: jnp.zeros((batches.num_slots + 1, *leaf.shape[1:]), leaf.dtype),
        marched.eval_shape(jnp.zeros(chunk_slabs, jnp.int32)),
    )
    through = light.transmittance
    no_stop = tuple(no_stops(through.shape, through.dtype)) if light.stop else ()
    light = SlabLight(light.color, jnp.ones_like(through), no_stop)

    def pull_batch(batch: Batch, state: PullState) -> PullState:
        light, gathered = lax.fori_loop(0, batch.chunks, each_chunk(batches, batch, marched), (state.light, state.gathered))
        rays, of_slabs = pull_composite(state.rays, light, batch, batches.compacted.start, together, most)

        def pull_chunk(nth: Array, total: InputCotangents) -> InputCotangents:
            items, begin = batches.chunk(batch, nth)
            here = jax.tree.map(lambda value: lax.dynamic_slice_in_dim(value, begin, chunk_slabs), gathered)
            of_some, task = lax.dynamic_slice_in_dim(of_slabs, begin, chunk_slabs, 1), batches.task(items)

            def through() -> tuple[Optics, Array]:
                """Cotangents of red, green, blue and extinction at samples, and of path lengths."""
                (_, thickness), pull = jax.vjp(integrator.segment, optics(medium, here, task), task.path())
                return pull((list(of_some[:3]), jnp.broadcast_to(of_some[3][:, None], thickness.shape)))  # type: ignore[no-any-return]

            of_optics, of_path = fusion_barrier(task.slab[0] >= 0, through)
            of_stops = (tuple(of_some[4:]),) if medium.stops_rays else ()
            of_medium, places = medium.pull(total.media, here, task, of_optics, *of_stops)
            if not wanted.field:  # by where samples are nothing is asked for
                return total._replace(media=of_medium)
            depth, border, factor = jax.tree.map(jnp.add, places, pull_path(task, of_path))
            (of_half_steps,) = jax.vjp(functools.partial(batches.depths, items), batches.half_steps)[1]((depth, border))
            return InputCotangents(of_medium, total.half_steps + of_half_steps, total.factor + factor)

        return PullState(rays, light, gathered, lax.fori_loop(0, batch.chunks, pull_chunk, state.total))

    rays = fresh_replay(image, cotangent, batches.compacted.bundle_rank, together)
    first = PullState(rays, light, gathered, start)
    body = each_batch(batches, pull_batch, lambda state: state.rays.transmittance_so_far)
    return lax.fori_loop(0, batches.number, body, first).total
