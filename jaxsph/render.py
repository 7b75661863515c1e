"""The verb: particles in, image out.

Flow: order -> grid -> decide -> cast -> layers -> Image, band by band: the programs of `stages`, part by part.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Int

from jaxsph.access.grid import Grid
from jaxsph.cast.adjoint import KEPT
from jaxsph.cast.parts import parts_at_hand
from jaxsph.cast.points import Rays
from jaxsph.control.pilot import PilotPlan
from jaxsph.layers import assemble, blank_if, stacked, unbundle
from jaxsph.model.camera import Camera
from jaxsph.model.image import Image
from jaxsph.model.scene import Scene
from jaxsph.model.settings import Settings
from jaxsph.model.transfer import TransferFunction
from jaxsph.numerics import faults
from jaxsph.numerics.checks import is_traced
from jaxsph.numerics.programs import Clock
from jaxsph.plan import Plan
from jaxsph.plan import plan as make_plan
from jaxsph.stages import (
    add_lattices,
    cast_part,
    decide_part,
    grid_parts,
    in_own_units,
    input_faults,
    limits_of,
    look_part,
    order,
    rescale,
    sum_part,
)
from jaxsph.version import __version__

Progress = Callable[[int, int], None]
View = tuple[Grid, Camera, TransferFunction]
RunAll = Callable[..., list[Any]]
"""Called as `run_all(stage, function, inputs, **static)`: one call of a program for each of the inputs."""


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
    clock = Clock()
    planned = plan is None
    plan = make_plan(scene, camera, settings) if plan is None else plan
    plan.check(scene, camera, settings)
    shapes = dataclasses.replace(plan, control=None)  # what the grid and the cast are compiled for, with any error control
    clock.mark("plan")
    particles, transfer = in_own_units(scene, *clock.run("grid", rescale, (scene, camera)))
    ordered = clock.run("grid", order, (particles, camera), plan=shapes)
    bands, words = [], [input_faults(scene, camera, plan.samples) | ordered.faults]
    counts, parts = np.zeros(2), parts_at_hand(ordered.x)
    for band in range(plan.bands):
        first_row = jnp.int32(band * plan.band_height)
        grid = Grid(ordered, *clock.run("grid", grid_parts, (ordered, camera, first_row), plan=shapes))
        view = (grid, camera, transfer)
        decided, rays = _decide_and_cast(view, limits_of(settings, ordered), plan, scene.particles.kernel, parts, clock.run_all)
        words.append(grid.lists.faults)
        counts += [float(count) for count in _counts(grid)]
        bands.append(clock.run("image", unbundle, (rays, decided), plan=shapes))
        if progress is not None:
            progress(band + 1, plan.bands)
    word = int(functools.reduce(lambda a, b: a | b, words))
    _raise(word, planned)
    image, full = assemble(stacked(bands), camera, plan, jnp.int32(word))
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
    particles, transfer = in_own_units(scene, *rescale(scene, camera))
    ordered = order(particles, camera, plan=plan)

    def one_band(band: Int[Array, ""]) -> Any:
        first_row = band * plan.band_height
        grid = Grid(ordered, *grid_parts(ordered, camera, first_row, plan=plan))
        view = (grid, camera, transfer)
        decided, rays = _decide_and_cast(view, limits_of(settings, ordered), plan, scene.particles.kernel, 1, _run_traced)
        return unbundle(rays, decided, plan=plan), grid.lists.faults, _counts(grid)

    bands = jnp.arange(plan.bands, dtype=jnp.int32)
    if plan.bands > 1:  # in reverse mode the grid of a band is made again, as bands are there to spare memory
        kept = jax.checkpoint_policies.save_only_these_names(KEPT)
        results = lax.map(jax.checkpoint(one_band, prevent_cse=False, policy=kept), bands)
    else:
        results = jax.tree.map(lambda leaf: leaf[None], one_band(bands[0]))
    layers, words, counts = results
    word = functools.reduce(lambda a, b: a | b, [words[i] for i in range(plan.bands)])
    word |= input_faults(scene, camera, plan.samples) | ordered.faults
    image, full = assemble(layers, camera, plan, word)
    image = blank_if(word & faults.UNUSABLE != 0, image)
    cells_found, pairs = (count.sum() for count in counts)
    spent = image.evaluations.sum()
    stats = {"evaluations": spent, "evaluations_full": full.sum(), "cells": cells_found, "pairs": pairs}
    certified = _certifies(plan) & (jnp.asarray(plan.control is None) | (jnp.asarray(settings.relax) == 0))
    return dataclasses.replace(image, certified=certified, stats=stats)


def _decide_and_cast(
    view: View, limits: Any, plan: Plan, kernel: str, parts: int, run_all: RunAll
) -> tuple[tuple[Any, ...], tuple[Rays, ...]]:
    """What is decided for the parts of a band, as far as the image shows it; and what their rays meet."""
    each, shapes = [jnp.int32(nth) for nth in range(parts)], dataclasses.replace(plan, control=None)
    adapt, lattice = functools.partial(run_all, "adapt"), None
    if isinstance(plan.control, PilotPlan):
        lattices = adapt(sum_part, [(*view, nth) for nth in each], parts=parts, plan=plan, kernel=kernel)
        (lattice,) = adapt(add_lattices, [(tuple(lattices),)]) if parts > 1 else lattices
        # slab by slab what is at hand stays in the cache: one program is faster than parts side by side
        decided = adapt(decide_part, [(*view, limits, lattice, each[0])], parts=1, plan=plan)
        works = [decided[0].work] * parts
    else:
        seen: list[Any] = [None] * parts
        if plan.control is not None:
            grid, _, transfer = view
            probes = adapt(look_part, [(grid, transfer, limits, nth) for nth in each], parts=parts, plan=plan)
            shares = tuple((probe.held, probe.all_held) for probe in probes)
            seen = [(probe.promising, shares) for probe in probes]
        inputs = [(*view, limits, of_part, nth) for of_part, nth in zip(seen, each, strict=True)]
        decided = adapt(decide_part, inputs, parts=parts, plan=plan)
        works = [choice.work for choice in decided]
    inputs = [(*view, work, lattice, nth) for work, nth in zip(works, each, strict=True)]
    rays = run_all("cast", cast_part, inputs, parts=parts, plan=shapes, kernel=kernel)
    return tuple(choice.layers for choice in decided), tuple(rays)


def _run_traced(_: str, function: Any, inputs: list[tuple[Any, ...]], **static: Any) -> list[Any]:
    return [function(*arguments, **static) for arguments in inputs]


def _certifies(plan: Plan) -> bool:
    """Whether the error can be bounded at all."""
    return not isinstance(plan.control, PilotPlan)


def _counts(grid: Grid) -> tuple[Array, Array]:
    """Filled slabs, and (particle, bundle) pairs, of one band."""
    return (grid.cells.count > 0).sum(), grid.lists.end[-1]


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
