"""`jaxsph.render`: a scene, a camera and settings go in, an image comes out.

Flow: Request.of -> PLANS.for_frame (view_scene, plan) -> Frame.of -> draw, band by band -> finish_image -> Image.

`picture` is that whole way, for arrays and under a trace alike; `_picture_in_trace` has it traced as one program.
"""

from __future__ import annotations

import functools
import warnings
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh

from jaxsph.engine.frame.finish import finish_image
from jaxsph.engine.frame.frame import Frame
from jaxsph.engine.frame.outlines import draw_outlines
from jaxsph.engine.frame.quadtree import draw_by_quadtree
from jaxsph.engine.frame.stages import Drawing
from jaxsph.engine.planning.fit import PLANS
from jaxsph.engine.planning.plan import Plan
from jaxsph.engine.request import Request
from jaxsph.engine.runtime.clock import Clock
from jaxsph.engine.runtime.devices import chosen_devices, mesh_of, over_mesh
from jaxsph.engine.runtime.programs import PROGRAMS, clear_when_crowded
from jaxsph.model.camera.camera import Camera
from jaxsph.model.image import Image
from jaxsph.model.particles.field import ParticleField
from jaxsph.model.particles.particles import Particles
from jaxsph.model.scene import Scene
from jaxsph.model.settings import Settings
from jaxsph.numerics.checks import Progress, at_once, is_traced, require_plan

MAX_TRACED = 16  # jitted functions of `_jitted_picture` that are cached, one for each plan and choice of settings


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

    Eagerly, the function plans capacities for the frame (or takes those of an earlier, similar frame), times each stage, and
    raises on faults. Under `jax.jit` or `jax.vmap` the function is pure, needs a `plan`, and reports faults in `image.faults`.

    Args:
        scene: particles and transfer function.
        camera: where from, and how large the image is.
        settings: samples, memory limit; default `Settings()`.
        plan: capacities from `jaxsph.plan`, for this scene or a similar one; particles are padded to it.
        progress: eager only; called as `progress(done, total)` after every band.
        devices: what the work is shared among: `"all"`, a number, a sequence of `jax.Device`, or a `jax.sharding.Mesh`. Eagerly
            and under a trace, over a mesh of any axes, automatic or explicit, the image is the same to rounding. Each device
            holds all particles. None is where the particles are.

    Returns:
        Image with dtype of the particles.

    Differentiation:
        `color` and `transmittance` have derivatives in both modes by everything that floats in particles, transfer function and
        camera (its axes need not stay orthonormal: a tangent of rotations keeps them so). Decisions are held fixed: plan,
        grid, lists, windows, levels, merges and the image's other layers. In reverse mode the slabs are marched again, so
        memory does not grow with samples or particles in a cell. Of a surface of particles `normal` and `depth` have
        derivatives as well, silhouettes none. Images with super-pixels or of the pilot estimator have no derivatives and
        raise `NotImplementedError`, as do second derivatives.

    Raises:
        ValueError: bad data (NaN positions, leaves of other lengths, a camera that sees nothing, ...), a plan for other shapes,
            no plan under a trace, more devices than there are.
        CapacityError: eager, when a given `plan` is too small for this frame.

    Warns:
        UserWarning: eager, where no ray meets a surface of particles, with the range of their coverage; and where segments
            cannot keep a tolerance everywhere: `error_bound` says where.

    References:
        Hochstetter, Orthmann & Kolb 2016, sections 3 and 6.
    """
    settings = Settings() if settings is None else settings
    require_plan("plan", plan, Plan, "plan")
    with at_once(scene, camera, settings) as traced:
        request = Request.of(scene, camera, settings)
        if traced:
            return _picture_in_trace(request, plan, None if devices is None else mesh_of(devices))
        mesh = None if devices is None else mesh_of(chosen_devices(devices))
        image = picture(request, Clock(mesh, progress=progress), plan)
        if request.scene.surface is not None:
            _warn_if_unreached(scene, request.scene.particle_set, image)
        return image


def picture(request: Request, clock: Clock, plan: Plan | None = None) -> Image:
    """Make the image of a request: find its plan, view the scene, draw all bands, and finish them.

    A `plan` that is None is found for the frame, which needs values and so is refused under a trace.
    """
    frame_plan, in_view = PLANS.for_frame(request, clock, plan)
    frame = Frame.of(request, frame_plan, in_view, clock)
    drawing = clock.run(draw, frame, clock)
    return request.in_given_unit(finish_image(drawing, frame, request.settings, clock, planned=plan is None))


def draw(frame: Frame, clock: Clock) -> Drawing:
    """Draw all bands of a frame: by the rays that a quadtree chooses, by several rays at outlines, or by one ray a pixel.

    Bands of the last kind go to the devices of a mesh one by one (`Frame.bands`), so that `progress` hears of each.
    """
    if frame.plan.quadtree is not None:
        return clock.on_all_devices(draw_by_quadtree, frame)
    if frame.formulas.antialias > 1:
        return clock.on_all_devices(draw_outlines, frame)
    return frame.bands(clock)


def _picture_in_trace(request: Request, plan: Plan | None, mesh: Mesh | None) -> Image:
    """Make the image of a request that holds tracers, by a call of one jitted function.

    Numbers of the settings that are known are not passed as arguments, so that they stay known within it.
    """
    PROGRAMS.make_room()
    numbers, structure = jax.tree.flatten((request.settings, request.along))
    known = tuple(None if is_traced(number) else number for number in numbers)
    jitted = _jitted_picture(plan, structure, known, mesh)
    traced = [number for number in numbers if is_traced(number)]
    return jitted(request.scene, request.camera, traced)  # type: ignore[no-any-return]


@clear_when_crowded
@functools.lru_cache(maxsize=MAX_TRACED)
def _jitted_picture(plan: Plan | None, structure: Any, known: tuple[Any, ...], mesh: Mesh | None) -> Any:
    """The jitted function of a plan, always the same object, so that JAX finds what it compiled for it before.

    `structure` and `known` are the settings: their pytree, and their leaves with None in place of each that is traced. Within an
    outer `jit` the function is a call of its own, too: were it inlined, what is transposed outside of a `jit` would be some 170
    single operations.
    """

    def image(scene: Scene, camera: Camera, traced: list[Any]) -> Image:
        rest = iter(traced)
        settings, along = jax.tree.unflatten(structure, [next(rest) if number is None else number for number in known])

        def on_device(inputs: tuple[Any, ...]) -> Image:
            return picture(Request(*inputs), Clock(mesh, traced=True), plan)

        inputs = scene, camera, settings, along
        return on_device(inputs) if mesh is None else over_mesh(mesh, on_device, inputs)

    return jax.jit(image)


def _warn_if_unreached(scene: Scene, particles: Particles, image: Image) -> None:
    """Warn where no ray meets the surface of a scene: with the level, and with the range of what it is a level of.

    `scene` is as it was given, as its surface says which quantity the level is of; `particles` are those of the request, which
    `widened` has made for the surface.
    """
    if (surface := scene.surface) is None or bool((np.asarray(image.transmittance) < 1).any()):
        return
    of = "the coverage by particles" if surface.of == "coverage" else f"the particles' {surface.of}, smoothed by their kernels,"
    there = ParticleField(particles).at_centers().coverage
    span = f"{there.min():.3g} to {there.max():.3g} at particles' centres" if there.size else "0, as there are no particles"
    warnings.warn(
        f"no ray meets the surface of level {float(surface.level):g}: {of} is {span}; give a level below that, look where "
        "particles are, or give them the volumes that they fill (`jaxsph.Particles.from_arrays(volume=...)`)",
        UserWarning,
        stacklevel=3,
    )
