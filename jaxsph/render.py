"""The verb: particles in, image out.

Flow: view_scene -> plan -> frame, band by band -> layers -> Image.
"""

from __future__ import annotations

import dataclasses
import functools
import operator
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxsph.claims import certified, disclaimed, faults_of_settings, missed, tell, with_ended_rays
from jaxsph.field.in_octree import reachable
from jaxsph.frame import Band, Drawn, Frame
from jaxsph.layers import Layers, assemble, crop, develop, of_band
from jaxsph.model.asked import require_asked
from jaxsph.model.camera import Camera
from jaxsph.model.image import Image
from jaxsph.model.registry import ESTIMATING
from jaxsph.model.scene import Formulas, Scene
from jaxsph.model.settings import Settings
from jaxsph.numerics import faults
from jaxsph.numerics.checks import is_traced
from jaxsph.numerics.device_executors import OnDevices
from jaxsph.numerics.devices import chosen_devices, mesh_of
from jaxsph.numerics.executors import Clock, Executor, Forecast, Traced
from jaxsph.numerics.programs import PROGRAMS, kept_while_there_is_room
from jaxsph.numerics.tuning import shards_at_hand
from jaxsph.over_devices import draw_over_devices
from jaxsph.over_mesh import drawn_over_mesh
from jaxsph.plan import Plan
from jaxsph.planning import PLANS, see
from jaxsph.refinement import refined
from jaxsph.version import __version__
from jaxsph.viewing import Seen

Progress = Callable[[int, int], None]
MAX_TRACED = 16  # plans whose traced programs are kept for calls outside of any `jit`


def render(
    scene: Scene,
    camera: Camera,
    settings: Settings | None = None,
    *,
    plan: Plan | None = None,
    progress: Progress | None = None,
    devices: Any = None,
) -> Image:
    """Render a scene.

    Eagerly, capacities are planned for the frame (or those of an earlier, similar frame taken), stages are timed apart, and
    faults raise. Under `jax.jit` or `jax.vmap` the
    function is pure, needs a `plan`, and reports faults in `image.faults`.

    Args:
        scene: particles and transfer function.
        camera: where from, and how large the image is.
        settings: samples, memory limit; default `Settings()`.
        plan: capacities from `jaxsph.plan`, for this scene or a similar one; particles are padded to it.
        progress: eager only; called as `progress(done, total)` after every band.
        devices: what the work is shared among: `"all"`, a number, a sequence of `jax.Device`, or a `jax.sharding.Mesh`. Eagerly
            the image is the same bit for bit (with segments for a tolerance, and where rays end, within the estimate); under a
            trace a mesh of any axes, automatic or explicit, makes the same image to rounding. Each device holds all particles.
            None is where the particles are.

    Returns:
        Image with dtype of the particles.

    Differentiation:
        `color` and `transmittance` have derivatives in both modes by everything that floats in particles, transfer function and
        camera (its axes need not stay orthonormal: a tangent of rotations keeps them so). Decisions are held fixed: plan,
        grid, lists, windows, levels, merges and the image's other layers. In reverse mode the slabs are marched again, so
        memory does not grow with samples or particles in a cell. Images with super-pixels or of the pilot estimator have no
        derivatives and raise `NotImplementedError`, as do second derivatives.

    Raises:
        ValueError: bad data (NaN positions, a camera that sees nothing, ...), a plan for other shapes, no plan under a trace,
            more devices than there are.
        CapacityError: eager, when a given `plan` is too small for this frame.

    Warns:
        UserWarning: eager, where segments cannot keep a tolerance everywhere; `error_bound` says where.

    References:
        Hochstetter, Orthmann & Kolb 2016, sections 3 and 6.
    """
    settings = Settings() if settings is None else settings
    require_asked(scene, camera, settings)
    if plan is not None and not isinstance(plan, Plan):
        raise ValueError(f"`plan` must be a `jaxsph.Plan`, got {type(plan).__name__}; make one with `jaxsph.plan`")
    if is_traced(scene, camera, settings):
        if plan is None:
            raise ValueError(
                "`plan` is needed under jit, vmap or grad; make it outside with `jaxsph.plan(scene, camera, settings)`"
            )
        plan.check(scene, camera, settings)
        PROGRAMS.make_room()
        return _render_traced(scene, camera, settings, plan, devices)
    return _render_eager(scene, camera, settings, plan, progress, devices)


def _render_eager(
    scene: Scene, camera: Camera, settings: Settings, plan: Plan | None, progress: Progress | None, devices: Any
) -> Image:
    clock = Clock() if devices is None else OnDevices(chosen_devices(devices))
    planned, scene = plan is None, reachable(scene, settings)
    if plan is None:
        plan, seen = PLANS.for_frame(scene, camera, settings, clock)
    else:
        plan.check(scene, camera, settings)
        clock.mark("plan")
        seen = see(scene, camera, plan, clock)
    return image_of(seen, camera, settings, plan, scene.formulas, clock, progress, planned=planned)


def image_of(
    seen: Seen,
    camera: Camera,
    settings: Settings,
    plan: Plan,
    formulas: Formulas,
    clock: Clock,
    progress: Progress | None,
    *,
    planned: bool,
    first_row: int = 0,
) -> Image:
    """The image of what is seen, or those of its rows, from `first_row` on, that the plan is for; faults raise.

    `planned`: whether capacities were made for this very frame.
    """
    if isinstance(clock, OnDevices):
        bands, layers = draw_over_devices(seen, camera, settings, plan, formulas, clock, progress)
    else:
        draw = functools.partial(_draw, seen, camera, settings, plan, formulas, first_row)
        clock.foresee(lambda known: draw(Forecast(known), None))
        bands, layers = draw(clock, progress)
    word = functools.reduce(operator.or_, [int(seen.viewed.faults), *(int(band.faults) for band in bands)])
    faults.raise_for(word, planned)
    image = assemble(layers, word)
    if plan.quadtree is not None:
        image = with_ended_rays(image, settings)
    word |= int(missed(image, settings))
    tell(word, image, settings)
    stats = {
        "evaluations": int(np.asarray(image.evaluations, np.float64).sum()),
        "evaluations_full": int(np.asarray(layers.full, np.float64).sum()),
        "cells": sum(int(band.filled) for band in bands),
        "pairs": sum(int(band.pairs) for band in bands),
        "seconds": clock.seconds,
    }
    if layers.rays is not None:
        stats["rays"] = int(layers.rays)
    clock.mark("image")
    proven = bool(certified(plan, settings))
    metadata = metadata_of(camera, settings, proven)
    return dataclasses.replace(image, certified=proven, faults=word, stats=stats, metadata=metadata)


def _draw(
    seen: Seen,
    camera: Camera,
    settings: Settings,
    plan: Plan,
    formulas: Formulas,
    first_row: int,
    run: Executor,
    progress: Progress | None,
) -> tuple[list[Band], Layers]:
    """All bands one by one, and the layers of the image."""
    shards: int = shards_at_hand(plan.cast.tuning)
    frame, bands = Frame.begun(seen, camera, settings, plan, formulas, shards, run), []
    if plan.quadtree is not None:
        return refined(frame, run, progress)
    for band in range(plan.bands):
        bands.append(frame.band(jnp.int32(first_row + band * plan.band_height), run))
        if progress is not None:
            progress(band + 1, plan.bands)
    return bands, run.one(
        "image", develop, (tuple(band.of_shards for band in bands),), plan=dataclasses.replace(plan, control=None)
    )


def _render_traced(scene: Scene, camera: Camera, settings: Settings, plan: Plan, devices: Any) -> Image:
    """As one program of all that is traced: numbers of settings that are known stay so."""
    if plan.quadtree is not None and devices is not None:
        raise ValueError('`devices` must be None under jit with `screen="quadtree"`; call it eagerly, or take "pixels"')
    numbers, structure = jax.tree.flatten(settings)
    known = tuple(None if is_traced(number) else number for number in numbers)
    program = _program(plan, structure, known, None if devices is None else mesh_of(devices))
    image: Image = program(scene, camera, [number for number in numbers if is_traced(number)])
    return image


@kept_while_there_is_room
@functools.lru_cache(maxsize=MAX_TRACED)
def _program(plan: Plan, structure: Any, known: tuple[Any, ...], mesh: Any) -> Any:
    """One jitted function a plan: without an outer `jit`, transformations find again what they compiled for it before.

    Within one, it is no call of its own.
    """

    def drawn(scene: Scene, camera: Camera, numbers: list[Any]) -> Image:
        given = iter(numbers)
        settings = jax.tree.unflatten(structure, [next(given) if number is None else number for number in known])
        if plan.quadtree is not None:
            return _refined_traced(scene, camera, settings, plan)
        return _image_traced(scene, camera, settings, plan, mesh)

    return jax.jit(drawn, inline=True)


def _image_traced(scene: Scene, camera: Camera, settings: Settings, plan: Plan, mesh: Any) -> Image:
    if mesh is None:
        found = _drawn(scene, camera, settings, plan)
    else:
        found = drawn_over_mesh(scene, camera, settings, plan, mesh)
    image, full = assemble(found.layers, found.faults), found.layers.full
    stats = {"evaluations": image.evaluations.sum(), "evaluations_full": full.sum(), "cells": found.filled, "pairs": found.pairs}
    image = dataclasses.replace(image, certified=jnp.asarray(certified(plan, settings)), stats=stats)
    return disclaimed(image, found.faults | faults_of_settings(settings) | missed(image, settings))


def _drawn(scene: Scene, camera: Camera, settings: Settings, plan: Plan) -> Drawn:
    run = Traced()
    seen = see(scene, camera, plan, run)
    frame = Frame.begun(seen, camera, settings, plan, scene.formulas, 1, run)
    found = frame.all_bands(run, lambda band: of_band(band.of_shards, plan=plan))
    return found._replace(layers=crop(found.layers, plan), faults=found.faults | seen.viewed.faults)


def _refined_traced(scene: Scene, camera: Camera, settings: Settings, plan: Plan) -> Image:
    run = Traced()
    seen = see(scene, camera, plan, run)
    bands, layers = refined(Frame.begun(seen, camera, settings, plan, scene.formulas, 1, run), run, None)
    word = functools.reduce(operator.or_, [band.faults for band in bands]) | seen.viewed.faults
    image = with_ended_rays(assemble(layers, word), settings)
    counts = {"cells": sum(band.filled for band in bands), "pairs": sum(band.pairs for band in bands)}
    stats = {"evaluations": image.evaluations.sum(), "evaluations_full": layers.full.sum(), **counts, "rays": layers.rays}
    image = dataclasses.replace(image, certified=jnp.asarray(False), stats=stats)
    return disclaimed(image, word | faults_of_settings(settings))


def metadata_of(camera: Camera, settings: Settings, certified: bool) -> tuple[tuple[str, Any], ...]:
    """What a file says of how its image was made."""
    exact = settings.tolerance is None
    estimator = settings.integrator if settings.integrator in ESTIMATING else settings.estimator
    return (
        ("jaxsph.version", __version__),
        ("jaxsph.integrator", settings.integrator),
        ("jaxsph.tolerance", "none" if exact else float(settings.tolerance)),
        ("jaxsph.estimator", "none" if exact else estimator),
        ("jaxsph.relax", "none" if exact else float(settings.relax)),
        ("jaxsph.certified", float(certified)),
        ("jaxsph.camera", camera.describe()),
    )
