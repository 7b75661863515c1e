"""The verb: particles in, image out.

Flow: order_particles -> build_lists -> find_cells -> adapt -> cast_points -> Image, band by band.
"""

from __future__ import annotations

import dataclasses
import functools
import time
from collections.abc import Callable, Hashable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Int

from jaxsph.access.cells import Cells, find_cells
from jaxsph.access.grid import Grid
from jaxsph.access.lattice import Lattice
from jaxsph.access.lists import BUNDLE, BundleLists, build_lists, bundle_origins
from jaxsph.access.ordering import Ordered, order_particles
from jaxsph.access.quantities import rescaled, too_small
from jaxsph.access.resolution import too_fine
from jaxsph.cast.adjoint import KEPT, cast
from jaxsph.cast.nodes import sum_at_nodes
from jaxsph.cast.parts import joined, part, parts_at_hand, plan_of_part
from jaxsph.cast.points import Rays, evaluations
from jaxsph.control.adapt import adapt
from jaxsph.control.pilot import PilotPlan, pilot, worthwhile
from jaxsph.control.worklist import Worklist, full_rate, origins
from jaxsph.model.camera import Camera
from jaxsph.model.image import Image
from jaxsph.model.particles import Particles
from jaxsph.model.scene import Scene
from jaxsph.model.settings import Settings
from jaxsph.model.transfer import TransferFunction
from jaxsph.numerics import faults
from jaxsph.numerics.checks import is_traced
from jaxsph.plan import Plan
from jaxsph.plan import plan as make_plan
from jaxsph.version import __version__

Progress = Callable[[int, int], None]


class CapacityError(ValueError):
    """A given plan has no room for this frame: make a new one with `jaxsph.plan`."""


def render(
    scene: Scene,
    camera: Camera,
    settings: Settings | None = None,
    *,
    plan: Plan | None = None,
    progress: Progress | None = None,
) -> Image:
    """Render a scene.

    Eagerly, capacities are planned for the frame, stages are timed apart, and faults raise. Under `jax.jit` or `jax.vmap` the
    function is pure, needs a `plan`, and reports faults in `image.faults`.

    Args:
        scene: particles and transfer function.
        camera: where from, and how large the image is.
        settings: samples, memory limit; default `Settings()`.
        plan: capacities from `jaxsph.plan`, for this scene or a similar one.
        progress: eager only; called as `progress(done, total)` after every band.

    Returns:
        Image with dtype of the particles.

    Differentiation:
        `color` and `transmittance` have derivatives in both modes by everything that floats in particles, transfer function and
        camera (its axes need not stay orthonormal: a tangent of rotations keeps them so). Decisions are held fixed: plan,
        grid, lists, windows, levels, merges and the image's other layers. In reverse mode the slabs are marched again, so
        memory does not grow with samples or particles in a cell. Images with super-pixels or of the pilot estimator have no
        derivatives and raise `NotImplementedError`, as do second derivatives.

    Raises:
        ValueError: bad data (NaN positions, a camera that sees nothing, ...), a plan for other shapes, no plan under a trace.
        CapacityError: eager, when a given `plan` is too small for this frame.

    References:
        Hochstetter, Orthmann & Kolb 2016, sections 3 and 6.
    """
    settings = settings or Settings()
    if is_traced(scene, camera, settings):
        if plan is None:
            raise ValueError(
                "`plan` is needed under jit, vmap or grad; make it outside with `jaxsph.plan(scene, camera, settings)`"
            )
        plan.check(scene, camera, settings)
        return _render_traced(scene, camera, settings, plan)
    return _render_eager(scene, camera, settings, plan, progress)


def _render_eager(scene: Scene, camera: Camera, settings: Settings, plan: Plan | None, progress: Progress | None) -> Image:
    clock = _Clock()
    planned = plan is None
    plan = make_plan(scene, camera, settings) if plan is None else plan
    plan.check(scene, camera, settings)
    shapes = dataclasses.replace(plan, control=None)  # what the grid and the cast are compiled for, with any error control
    clock.mark("plan")
    particles, transfer = _in_own_units(scene, *clock.run("grid", _rescaled, (scene, camera)))
    ordered = clock.run("grid", _order, (particles, camera), plan=shapes)
    bands, words = [], [_input_faults(scene, camera, plan.samples) | ordered.faults]
    counts, parts = np.zeros(2), parts_at_hand(ordered.x)
    for band in range(plan.bands):
        first_row = jnp.int32(band * plan.band_height)
        grid = Grid(ordered, *clock.run("grid", _grid, (ordered, camera, first_row), plan=shapes))
        view = (grid, camera, transfer)
        decided = clock.run("adapt", _adapt, (*view, _limits(settings, ordered)), plan=plan, kernel=scene.particles.kernel)
        inputs = [(*view, decided.work, decided.lattice, jnp.int32(nth)) for nth in range(parts)]
        rays = clock.run_all("cast", _cast_part, inputs, parts=parts, plan=shapes, kernel=scene.particles.kernel)
        words.append(grid.lists.faults)
        counts += [float(count) for count in _counts(grid)]
        bands.append(clock.run("image", _unbundle, (tuple(rays), decided.bound, decided.full, decided.levels), plan=shapes))
        if progress is not None:
            progress(band + 1, plan.bands)
    word = int(functools.reduce(lambda a, b: a | b, words))
    _raise(word, planned)
    image, full = _assemble(_stack(bands), camera, plan, jnp.int32(word))
    clock.mark("image")
    stats = {
        "evaluations": int(np.asarray(image.evaluations, np.float64).sum()),
        "evaluations_full": int(np.asarray(full, np.float64).sum()),
        "cells": int(counts[0]),
        "pairs": int(counts[1]),
        "seconds": clock.seconds,
    }
    certified = _certifies(plan) and (plan.control is None or float(settings.relax) == 0)
    metadata = _metadata(camera, settings, certified)
    return dataclasses.replace(image, certified=certified, faults=word, stats=stats, metadata=metadata)


def _render_traced(scene: Scene, camera: Camera, settings: Settings, plan: Plan) -> Image:
    particles, transfer = _in_own_units(scene, *_rescaled(scene, camera))
    ordered = _order(particles, camera, plan=plan)

    def one_band(band: Int[Array, ""]) -> Any:
        first_row = band * plan.band_height
        grid = Grid(ordered, *_grid(ordered, camera, first_row, plan=plan))
        view = (grid, camera, transfer)
        decided = _adapt(*view, _limits(settings, ordered), plan=plan, kernel=scene.particles.kernel)
        rays = _cast(*view, decided.work, decided.lattice, plan=plan, kernel=scene.particles.kernel)
        return _unbundle((rays,), decided.bound, decided.full, decided.levels, plan=plan), grid.lists.faults, _counts(grid)

    bands = jnp.arange(plan.bands, dtype=jnp.int32)
    if plan.bands > 1:  # in reverse mode the grid of a band is made again, as bands are there to spare memory
        kept = jax.checkpoint_policies.save_only_these_names(KEPT)
        results = lax.map(jax.checkpoint(one_band, prevent_cse=False, policy=kept), bands)
    else:
        results = jax.tree.map(lambda leaf: leaf[None], one_band(bands[0]))
    layers, words, counts = results
    word = functools.reduce(lambda a, b: a | b, [words[i] for i in range(plan.bands)])
    word |= _input_faults(scene, camera, plan.samples) | ordered.faults
    image, full = _assemble(layers, camera, plan, word)
    image = _blank_if(word & faults.UNUSABLE != 0, image)
    cells_found, pairs = (count.sum() for count in counts)
    spent = image.evaluations.sum()
    stats = {"evaluations": spent, "evaluations_full": full.sum(), "cells": cells_found, "pairs": pairs}
    certified = _certifies(plan) & (jnp.asarray(plan.control is None) | (jnp.asarray(settings.relax) == 0))
    return dataclasses.replace(image, certified=certified, stats=stats)


def _certifies(plan: Plan) -> bool:
    """Whether the error can be bounded at all."""
    return not isinstance(plan.control, PilotPlan)


def _counts(grid: Grid) -> tuple[Array, Array]:
    """Filled slabs, and (particle, bundle) pairs, of one band."""
    return (grid.cells.count > 0).sum(), grid.lists.start[-1]


def _limits(settings: Settings, like: Ordered) -> tuple[Array, Array] | None:
    """Tolerance and relaxation in the dtype of the particles, the tolerance rounded down; None at full rate."""
    if settings.tolerance is None:
        return None
    dtype, tolerance = like.x.dtype, settings.tolerance
    if not is_traced(tolerance):
        rounded = np.asarray(tolerance, dtype)  # with NumPy, as all that JAX makes under jit is traced
        tolerance = np.nextafter(rounded, np.zeros_like(rounded)) if float(rounded) > float(tolerance) else rounded
    tolerance = jnp.asarray(tolerance, dtype)
    return tolerance, jnp.asarray(settings.relax, dtype)


@dataclasses.dataclass(frozen=True)
class _Decided:
    """What is to be marched, what would be at full rate, how wrong each bundle's pixels can be, what each cell was given."""

    work: Worklist
    full: Array
    bound: Array
    levels: Array | None
    lattice: Lattice | None = None


jax.tree_util.register_dataclass(_Decided, data_fields=["work", "full", "bound", "levels", "lattice"], meta_fields=[])


@jax.jit
def _rescaled(scene: Scene, camera: Camera) -> tuple[Array, TransferFunction]:
    """Quantities and transfer function in the units that all later stages see, in the dtype of view space."""
    dtype = jnp.promote_types(scene.particles.dtype, camera.dtype)
    transfer = jax.tree.map(lambda leaf: leaf.astype(dtype), scene.transfer)
    return rescaled(scene.particles.quantity.astype(dtype), transfer)


def _in_own_units(scene: Scene, quantity: Array, transfer: TransferFunction) -> tuple[Particles, TransferFunction]:
    return dataclasses.replace(scene.particles, quantity=quantity), transfer


@functools.partial(jax.jit, static_argnames="plan")
def _order(particles: Particles, camera: Camera, *, plan: Plan) -> Ordered:
    depths = _half_steps(camera, particles, plan)[1::2]
    return order_particles(particles, camera, depths, plan.cast.slab_samples, plan.num_classes)


@functools.partial(jax.jit, static_argnames="plan")
def _grid(
    ordered: Ordered, camera: Camera, first_row: Int[Array, ""], *, plan: Plan
) -> tuple[BundleLists, Cells, Array, Array, Array]:
    """What a `Grid` holds besides the particles, which are the same for all bands."""
    half_steps = _half_steps(camera, ordered.x, plan)
    ordered, camera, depths = jax.tree.map(lax.stop_gradient, (ordered, camera, half_steps[1::2]))
    lists = build_lists(ordered, camera, depths, plan.lists, first_row)
    return lists, find_cells(ordered, lists), *bundle_origins(plan.lists, first_row), half_steps


@functools.partial(jax.jit, static_argnames=("plan", "kernel"))
def _adapt(
    grid: Grid, camera: Camera, transfer: TransferFunction, limits: tuple[Array, Array] | None, *, plan: Plan, kernel: str
) -> _Decided:
    """How each cell is sampled. Decisions carry no gradient."""
    grid, camera, transfer = jax.tree.map(lax.stop_gradient, (grid, camera, transfer))
    limits = None if limits is None else (lax.stop_gradient(limits[0]), lax.stop_gradient(limits[1]))
    origin = origins(grid.cells, grid.lists.rank, grid.ordered.quantity)
    # an origin far beyond what is shown would cost the digits of what is
    origin = jnp.clip(origin, transfer.values[0], transfer.values[-1])
    work = full_rate(grid.cells, origin)
    full = evaluations(work, plan.samples, plan.cast)
    dtype = grid.half_steps.dtype
    if limits is None or plan.control is None:
        return _Decided(work, full, jnp.zeros(full.shape, dtype), None)
    transfer = jax.tree.map(lambda leaf: leaf.astype(dtype), transfer)
    if isinstance(plan.control, PilotPlan):
        wanted = worthwhile(grid, camera, plan.cast.slab_samples)
        amid = jnp.clip(grid.ordered.quantity[jnp.argmax(grid.ordered.live)], transfer.values[0], transfer.values[-1])
        lattice = sum_at_nodes(grid, camera, kernel, plan.cast.slab_samples, plan.lists.tile_columns, amid, wanted)
        work, bound = pilot(grid, lattice, camera, transfer, origin, limits[0], plan.cast.slab_samples)
        return _Decided(work, full, bound, None, lattice)
    work, bound, levels = adapt(grid, camera, transfer, origin, *limits, plan.cast.slab_samples, plan.control)
    return _Decided(work, full, bound, levels)


@functools.partial(jax.jit, static_argnames=("plan", "kernel"))
def _cast(
    grid: Grid,
    camera: Camera,
    transfer: TransferFunction,
    work: Worklist,
    lattice: Lattice | None = None,
    *,
    plan: Plan,
    kernel: str,
) -> Rays:
    transfer = jax.tree.map(lambda leaf: leaf.astype(grid.half_steps.dtype), transfer)
    return cast(grid, work, camera, transfer, kernel, plan.cast, lattice)


@functools.partial(jax.jit, static_argnames=("parts", "plan", "kernel"))
def _cast_part(
    grid: Grid,
    camera: Camera,
    transfer: TransferFunction,
    work: Worklist,
    lattice: Lattice | None,
    nth: Int[Array, ""],
    *,
    parts: int,
    plan: Plan,
    kernel: str,
) -> Rays:
    grid, work, lattice = part(grid, work, lattice, nth, parts)
    plan = dataclasses.replace(plan, cast=plan_of_part(plan.cast, parts))
    return _cast(grid, camera, transfer, work, lattice, plan=plan, kernel=kernel)


def _half_steps(camera: Camera, like: Any, plan: Plan) -> Array:
    """View depths s(0), s(1/2), ... s(N): fine samples sit at the odd entries, between borders at the even ones."""
    u = jnp.arange(2 * plan.samples + 1, dtype=like.dtype) / 2
    return camera.depth(u, plan.samples).astype(like.dtype)


@functools.partial(jax.jit, static_argnames="plan")
def _unbundle(parts: tuple[Rays, ...], bound: Array, full: Array, levels: Array | None, *, plan: Plan) -> tuple[Array, ...]:
    """Layers of a band as images: color (h, w, 3), transmittance, depth, evaluations, error bound and full evaluations (h, w);
    and levels of bundles.
    """
    rays, rows, columns = joined(parts), plan.lists.tile_rows, plan.lists.tile_columns

    def lay_out(value: Array) -> Array:
        """(bundles, 8, 8, ...) or (bundles, 1, 1, ...) to rows and columns."""
        down, across = value.shape[1:3]
        value = value.reshape(rows, columns, 2, 2, *value.shape[1:])
        value = jnp.moveaxis(value, (0, 2, 4, 1, 3, 5), (0, 1, 2, 3, 4, 5))
        return value.reshape(rows * 2 * down, columns * 2 * across, *value.shape[6:])

    of_bundles = (rays.evaluations, bound, full)
    of_rays = [jnp.broadcast_to(value[:, None, None], rays.transmittance.shape) for value in of_bundles]
    layers = [lay_out(v) for v in (jnp.moveaxis(rays.color, 0, -1), rays.transmittance, rays.depth, *of_rays)]
    return (*layers, *(lay_out(jnp.moveaxis(v, 0, -1)[:, None, None]) for v in [levels] if v is not None))


def _stack(bands: list[tuple[Array, ...]]) -> tuple[Array, ...]:
    return tuple(jnp.stack(layers) for layers in zip(*bands, strict=True))


def _assemble(layers: tuple[Array, ...], camera: Camera, plan: Plan, word: Array) -> tuple[Image, Array]:
    """Join the bands, cut off what lies beyond the image; and the evaluations that full rate takes."""
    joined = [layer.reshape(-1, *layer.shape[2:]) for layer in layers]
    color, transmittance, depth, spent, bound, full = (layer[: camera.height, : camera.width] for layer in joined[:6])
    image = Image(color, transmittance, depth, bound, spent, True, word, {})
    if len(joined) == 6:
        return image, full
    rows, columns = (-(-size // BUNDLE) for size in (camera.height, camera.width))
    return dataclasses.replace(image, levels=jnp.moveaxis(joined[6][:rows, :columns], -1, 0)), full


def _blank_if(unusable: Bool[Array, ""], image: Image) -> Image:
    """Nothing at all instead of the NaN that unusable numbers would make."""
    color = jnp.where(unusable, 0, image.color)
    transmittance = jnp.where(unusable, 1, image.transmittance)
    depth, bound = jnp.where(unusable, jnp.inf, image.depth), jnp.where(unusable, 0, image.error_bound)
    return dataclasses.replace(image, color=color, transmittance=transmittance, depth=depth, error_bound=bound)


@functools.partial(jax.jit, static_argnames="samples")
def _input_faults(scene: Scene, camera: Camera, samples: int) -> Int[Array, ""]:
    """Fault bits of camera and transfer function, whose numbers may have been changed under jit."""
    numbers = jnp.concatenate([camera.eye, camera.axes.ravel(), jnp.stack([camera.half_height, camera.near, camera.far])])
    usable = jnp.isfinite(numbers).all() & (camera.half_height > 0) & (camera.near < camera.far)
    if camera.is_perspective:
        usable &= camera.near > 0
    transfer = scene.transfer
    shown = (transfer.values[1:] >= transfer.values[:-1]).all() & jnp.isfinite(transfer.values).all()
    shown &= ((transfer.colors >= 0) & (transfer.colors <= 1)).all()
    shown &= ((transfer.extinction >= 0) & jnp.isfinite(transfer.extinction)).all() & ~too_small(transfer.values)
    unresolved = faults.raised(faults.UNRESOLVED, usable & too_fine(camera, samples))
    return unresolved | faults.raised(faults.BAD_CAMERA, ~usable) | faults.raised(faults.BAD_TRANSFER, ~shown)


def _raise(word: int, planned: bool) -> None:
    if word & faults.OVERFLOWS and not planned:
        raise CapacityError(f"`plan` is too small for this frame: {faults.describe(word)}")
    if word:
        raise ValueError(f"this frame cannot be rendered: {faults.describe(word)}")


def _metadata(camera: Camera, settings: Settings, certified: bool) -> tuple[tuple[str, Any], ...]:
    exact = settings.tolerance is None
    return (
        ("jaxsph.version", __version__),
        ("jaxsph.tolerance", "none" if exact else float(settings.tolerance)),
        ("jaxsph.estimator", "none" if exact else settings.estimator),
        ("jaxsph.relax", "none" if exact else float(settings.relax)),
        ("jaxsph.certified", float(certified)),
        ("jaxsph.camera", camera.describe()),
    )


class _Clock:
    """Seconds by stage, with compile time apart."""

    def __init__(self) -> None:
        self.seconds = {"plan": 0.0, "compile": 0.0, "grid": 0.0, "adapt": 0.0, "cast": 0.0, "image": 0.0}
        self._last = time.perf_counter()

    def mark(self, stage: str) -> None:
        now = time.perf_counter()
        self.seconds[stage] += now - self._last
        self._last = now

    def run(self, stage: str, function: Any, arguments: tuple[Any, ...], **static: Hashable) -> Any:
        """Compile `function` for `arguments` if need be, run it, and book both."""
        return self.run_all(stage, function, [arguments], **static)[0]

    def run_all(self, stage: str, function: Any, inputs: list[tuple[Any, ...]], **static: Hashable) -> list[Any]:
        """The same for several arguments of the same shapes, side by side."""
        program = _compiled(function, inputs[0], static)
        self.mark("compile")
        if len(inputs) == 1:
            results = [jax.block_until_ready(program(*inputs[0]))]
        else:
            with ThreadPoolExecutor(len(inputs)) as threads:
                results = list(threads.map(lambda arguments: jax.block_until_ready(program(*arguments)), inputs))
        self.mark(stage)
        return results


_PROGRAMS: dict[Hashable, Any] = {}
MOST_PROGRAMS = 24  # compiled stages that are kept, the oldest goes first: each takes up to 2000 of the 65530 memory maps


def _compiled(function: Any, arguments: tuple[Any, ...], static: dict[str, Hashable]) -> Any:
    leaves, structure = jax.tree_util.tree_flatten(arguments)
    shapes = tuple((leaf.shape, str(leaf.dtype), leaf.weak_type, str(leaf.sharding)) for leaf in leaves)
    key = (function, tuple(static.items()), structure, shapes, jax.config.read("jax_enable_x64"))
    if key not in _PROGRAMS:
        while len(_PROGRAMS) >= MOST_PROGRAMS:
            del _PROGRAMS[next(iter(_PROGRAMS))]
        _PROGRAMS[key] = function.lower(*arguments, **static).compile()
    return _PROGRAMS[key]
