r"""The march as a function that can be differentiated either way.

Flow: worklist -> [adjoint: points] -> image; cotangents of the image -> [adjoint: worth -> moments] -> cotangents.

Forward, derivatives are those of the march itself. Backward, the slabs are marched again, a stretch of the stacks at a time as
in `points`: its sums over particles and its light are held, what each slab is worth follows from the rays before and behind it
(`worth`), and what it is worth is paid out to the samples, and by them to particles (`moments`). So memory is that of the march,
whatever the number of samples or of particles in a cell.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jax.ad_checkpoint import checkpoint_name
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Float

from jaxsph.access.grid import Grid
from jaxsph.access.lattice import Lattice
from jaxsph.cast.composite import RAYS, unlit
from jaxsph.cast.moments import COLUMNS, WIDTH, owe_particles
from jaxsph.cast.points import Rays, cast_points, gather_field
from jaxsph.cast.shading import shade
from jaxsph.cast.stretches import CastPlan, stretches_of, with_room
from jaxsph.cast.worth import Seen, owe_transfer, pathwise, unseen, value_samples, value_slabs
from jaxsph.control.worklist import Worklist
from jaxsph.model.camera import Camera
from jaxsph.model.transfer import TransferFunction
from jaxsph.numerics.staging import computed_once
from jaxsph.numerics.transposed import linear_map

TWICE = "second derivatives of an image are not implemented; take differences of `jax.grad`, or a method that needs first ones"
KEPT = "light"  # name of what is not to be made again where a band is, see `jax.checkpoint`
Light = tuple[Array, Array]  # colour and transmittance of an image, or what is to be said of them


@dataclasses.dataclass(frozen=True)
class Values:
    """What a march is differentiated by."""

    columns: dict[str, Float[Array, " particles"]]
    half_steps: Float[Array, " two_samples_and_one"]
    half_height: Float[Array, ""]
    transfer: TransferFunction


@dataclasses.dataclass(frozen=True)
class Held:
    """What is held fixed: which particles and samples meet, and how they are sampled."""

    grid: Grid
    work: Worklist
    camera: Camera
    lattice: Lattice | None


class Wanted(NamedTuple):
    """Which cotangents are asked for: by where samples and particles are and what those carry, and by the transfer function."""

    field: bool
    transfer: bool


def cast(
    grid: Grid,
    work: Worklist,
    camera: Camera,
    transfer: TransferFunction,
    kernel: str,
    plan: CastPlan,
    lattice: Lattice | None = None,
) -> Rays:
    """`points.cast_points`, differentiable in both modes.

    Differentiation:
        Colour and transmittance have derivatives by the particles' columns, by the depths of samples, by the camera's opening
        and by the transfer function. Lists, windows, levels and the origins of sums are held fixed; `depth` and `evaluations`
        have none.

    Raises:
        NotImplementedError: while differentiating work that has super-pixels or interpolated slabs, whose values are made
            elsewhere; and when differentiated twice.
    """
    columns = {name: getattr(grid.ordered, name) for name in COLUMNS}
    values = Values(columns, grid.half_steps, camera.half_height, transfer)
    held = jax.tree.map(lax.stop_gradient, Held(grid, work, camera, lattice))
    return _cast(kernel, plan, values, held)


@functools.partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def _cast(kernel: str, plan: CastPlan, values: Values, held: Held) -> Rays:
    return _march(kernel, plan, values, held)


def _march(kernel: str, plan: CastPlan, values: Values, held: Held) -> Rays:
    grid, camera = _of(values, held)
    return cast_points(grid, held.work, camera, values.transfer, kernel, plan, held.lattice)


def _of(values: Values, held: Held) -> tuple[Grid, Camera]:
    ordered = dataclasses.replace(held.grid.ordered, **values.columns)
    grid = dataclasses.replace(held.grid, ordered=ordered, half_steps=values.half_steps)
    return grid, dataclasses.replace(held.camera, half_height=values.half_height)


def _moved(kernel: str, plan: CastPlan, primals: tuple[Values, Held], tangents: tuple[Values, Held]) -> tuple[Rays, Rays]:
    """Image and tangent, which is a linear map of the tangents with a transpose of its own."""
    values, held = primals
    found = _cast(kernel, plan, values, held)
    color, transmittance = (checkpoint_name(layer, KEPT) for layer in (found.color, found.transmittance))
    found = dataclasses.replace(found, color=color, transmittance=transmittance)
    still = jax.tree.map(jnp.zeros_like, found)
    leaves, structure = jax.tree.flatten(values)
    moves = jax.tree.leaves(tangents[0], is_leaf=_is_zero)
    moving = [i for i, move in enumerate(moves) if not _is_zero(move)]
    if not moving:
        return found, still
    _require_values(held)
    wanted = Wanted(_moves((tangents[0].columns, tangents[0].half_steps, tangents[0].half_height)), _moves(tangents[0].transfer))

    def push(moves: list[Array]) -> Light:
        def light(parts: list[Array]) -> Light:
            there = [parts[moving.index(i)] if i in moving else leaf for i, leaf in enumerate(leaves)]
            rays = _march(kernel, plan, jax.tree.unflatten(structure, there), held)
            return rays.color, rays.transmittance

        return jax.jvp(light, ([leaves[i] for i in moving],), (moves,))[1]

    def pull(worth: Light) -> list[Array]:
        image = found.color, found.transmittance
        owed = jax.tree.leaves(_pull(kernel, plan, wanted, values, held, image, worth))
        return [owed[i] for i in moving]

    like = found.color, found.transmittance
    color, transmittance = linear_map(push, pull, [moves[i] for i in moving], like, leaves, TWICE)
    return found, dataclasses.replace(still, color=color, transmittance=transmittance)


_cast.defjvp(_moved, symbolic_zeros=True)


def _is_zero(move: Any) -> bool:
    return isinstance(move, SymbolicZero)


def _moves(part: Any) -> bool:
    return not all(_is_zero(move) for move in jax.tree.leaves(part, is_leaf=_is_zero))


def _require_values(held: Held) -> None:
    """Raise where values come from elsewhere, so that their derivatives would be missing."""
    if held.work.paint is not None:
        raise NotImplementedError(
            "an image with super-pixels has no derivatives, as their colours come from bounds; "
            "give `jaxsph.Settings(super_pixels=False)`, or render at full rate with `tolerance=None`"
        )
    if held.lattice is not None:
        raise NotImplementedError(
            "`estimator='pilot'` has no derivatives; give `estimator='interval'` with `super_pixels=False`, or `tolerance=None`"
        )


def _pull(kernel: str, plan: CastPlan, wanted: Wanted, values: Values, held: Held, image: Light, worth: Light) -> Values:
    """Cotangents of `values`, from those of the image's colour and transmittance; zero where they are not `wanted`."""
    plan = dataclasses.replace(plan, held=max(plan.held // (2 * plan.chunk), 1) * plan.chunk)  # as twice as much is held of each
    grid, camera = _of(values, held)
    stretches, segments = stretches_of(grid, held.work, plan), values.transfer.segments()
    perspective, half_steps, dtype = camera.is_perspective, stretches.half_steps, grid.half_steps.dtype

    def rays_at(bundle: Array) -> tuple[Array, Array]:
        return tuple(rays.T for rays in grid.rays(camera, bundle))  # type: ignore[return-value]

    def march(at: Array) -> tuple[list[Array], tuple[Array, Array]]:
        """What the slabs `at` emit, and the sums at their samples."""
        item, slab, bundle = stretches.item(at)
        u, v = rays_at(bundle)
        s, border = stretches.depths(item, slab)
        sums = gather_field(grid.ordered, grid.lists.rank, item, (u, v, s), perspective, kernel)
        *light, _ = shade(sums, (u, v, border), segments, item, perspective)
        sums = sums.reshape(*sums.shape[:2], RAYS)
        return light, (sums.real, sums.imag)

    def settle(at: Array, sums: tuple[Array, Array], worth: Array, owed: tuple[Array, ...]) -> tuple[Array, ...]:
        """Add what the slabs `at` owe, being `worth` that much."""
        table, opening, depths, control = owed
        item, slab, bundle = stretches.item(at)
        u, v = rays_at(bundle)
        (s, border), pull_depths = jax.vjp(lambda depths: stretches.depths(item, slab, depths), half_steps)
        square = (u[:, None, :] ** 2 + v[:, :, None] ** 2).reshape(-1, RAYS)
        slant = jnp.sqrt(1 + square) if perspective else jnp.ones_like(square)
        path = pathwise(border, slant)
        samples = computed_once(slab[0] >= 0, value_samples, sums, path, segments, item, worth)
        if wanted.transfer:
            control = control + owe_transfer(samples, segments)
        if not wanted.field:
            return table, opening, depths, control
        worths = samples.weight, samples.weighted
        paid = owe_particles(table, grid.ordered, grid.lists.rank, item, (u, v, s), worths, perspective, kernel)
        of_step = (samples.path * slant[:, None]).sum(2)
        of_border = jnp.pad(of_step, ((0, 0), (1, 0))) - jnp.pad(of_step, ((0, 0), (0, 1)))
        of_s, of_opening = paid.along, paid.lateral.sum()
        if perspective:
            # lateral coordinates are u s and v s; the slant grows with the opening as (u^2 + v^2) / slant
            of_s = of_s + paid.lateral / s.T
            of_opening += (samples.path * (border[:, 1:] - border[:, :-1])[:, :, None] * (square / slant)[:, None]).sum()
        return paid.table, opening + of_opening, depths + pull_depths((of_s.T, of_border))[0], control

    def pull_stretch(nth: Array, carry: tuple[Seen, Any, tuple[Array, ...]]) -> tuple[Seen, Any, tuple[Array, ...]]:
        seen, (light, sums), owed = carry
        stretch = stretches.stretch(nth)

        def march_chunk(chunk: Array, store: Any) -> Any:
            at, begin = stretches.chunk(stretch, chunk)
            return jax.tree.map(lambda old, new: lax.dynamic_update_slice_in_dim(old, new, begin, 0), store, march(at))

        light, sums = lax.fori_loop(0, stretch.chunks, march_chunk, (light, sums))
        seen, worth = value_slabs(seen, tuple(light), stretch.held_at, stretches.stacks.start, stretch.first, stretch.number)

        def settle_chunk(chunk: Array, owed: tuple[Array, ...]) -> tuple[Array, ...]:
            at, begin = stretches.chunk(stretch, chunk)
            here = [lax.dynamic_slice_in_dim(value, begin, plan.chunk) for value in sums]
            worths = lax.dynamic_slice_in_dim(worth, begin, plan.chunk, 1)
            return settle(at, (here[0], here[1]), worths, owed)

        return seen, (light, sums), lax.fori_loop(0, stretch.chunks, settle_chunk, owed)

    *light, thickness = unlit(stretches.places + 1, plan.slab_samples, dtype)
    owed = (
        jnp.zeros((grid.ordered.x.shape[0], WIDTH), dtype),
        jnp.zeros((), dtype),
        jnp.zeros_like(half_steps),
        jnp.zeros((5, segments.start.shape[0]), dtype),
    )
    carry = unseen(image, worth, stretches.stacks.place), (light, (thickness, thickness)), owed
    table, opening, depths, control = lax.fori_loop(0, stretches.number, pull_stretch, carry)[2]
    _, pull_room = jax.vjp(lambda steps: with_room(steps, grid.samples, held.work.count.shape[0], plan), grid.half_steps)
    columns = {name: table[:, i] for i, name in enumerate(COLUMNS)}
    transfer = TransferFunction(control[4], control[:3].T, control[3])
    half_height = opening / camera.half_height.astype(dtype)
    total = Values(columns, pull_room(depths)[0], half_height, transfer)
    return jax.tree.map(lambda value, like: value.astype(like.dtype), total, values)


for _kind in (Values, Held):
    jax.tree_util.register_dataclass(_kind, data_fields=[field.name for field in dataclasses.fields(_kind)], meta_fields=[])
