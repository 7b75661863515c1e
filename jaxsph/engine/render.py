"""The verb: particles in, image out.

Flow: view_scene -> plan -> frame, band by band -> layers -> Image.
"""

from __future__ import annotations

import functools
import warnings
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh

from jaxsph.engine.frame.finish import finished
from jaxsph.engine.frame.frame import Frame
from jaxsph.engine.frame.outlines import outlined
from jaxsph.engine.frame.quadtree import refined
from jaxsph.engine.frame.stages import Drawn
from jaxsph.engine.planning.fit import PLANS
from jaxsph.engine.planning.plan import Plan
from jaxsph.engine.request import Request
from jaxsph.engine.runtime.clock import Clock
from jaxsph.engine.runtime.devices import chosen_devices, mesh_of, over_mesh
from jaxsph.engine.runtime.programs import PROGRAMS, kept_while_there_is_room
from jaxsph.model.camera.camera import Camera
from jaxsph.model.image import Image
from jaxsph.model.particles.field import ParticleField
from jaxsph.model.particles.particles import Particles
from jaxsph.model.scene import Scene
from jaxsph.model.settings import Settings
from jaxsph.numerics.checks import Progress, at_once, is_traced, require_plan

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
    faults raise. Under `jax.jit` or `jax.vmap` the function is pure, needs a `plan`, and reports faults in `image.faults`.

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
        asked = Request.of(scene, camera, settings)
        if traced:
            return _traced_picture(asked, plan, None if devices is None else mesh_of(devices))
        mesh = None if devices is None else mesh_of(chosen_devices(devices))
        image = picture(asked, Clock(mesh, progress=progress), plan)
        if asked.scene.surface is not None:
            _tell_if_unreached(scene, asked.scene.particle_set, image)
        return image


def picture(asked: Request, clock: Clock, plan: Plan | None = None) -> Image:
    """The picture that is asked for: plan and view, all bands, the image of them."""
    fitting, seen = PLANS.for_frame(asked, clock, plan)
    frame = Frame.of(asked, fitting, seen, clock)
    drawn = clock.run(draw, frame, clock)
    return asked.in_given_unit(finished(drawn, frame, asked.settings, clock, planned=plan is None))


def draw(frame: Frame, clock: Clock) -> Drawn:
    """All bands of a frame, by the rays that its screen chooses."""
    if frame.plan.quadtree is not None:
        return clock.shared(refined, frame)
    if frame.formulas.antialias > 1:
        return clock.shared(outlined, frame)
    return frame.bands(clock)


def _traced_picture(asked: Request, plan: Plan | None, mesh: Mesh | None) -> Image:
    """As one program of all that is traced: numbers of settings that are known stay so."""
    PROGRAMS.make_room()
    numbers, structure = jax.tree.flatten((asked.settings, asked.along))
    known = tuple(None if is_traced(number) else number for number in numbers)
    program = _program(plan, structure, known, mesh)
    return program(asked.scene, asked.camera, [number for number in numbers if is_traced(number)])  # type: ignore[no-any-return]


@kept_while_there_is_room
@functools.lru_cache(maxsize=MAX_TRACED)
def _program(plan: Plan | None, structure: Any, known: tuple[Any, ...], mesh: Mesh | None) -> Any:
    """One jitted function a plan: without an outer `jit`, transformations find again what they compiled for it before.

    A call of its own within one, too: inlined, what is transposed outside of a `jit` would be single operations, some 170.
    """

    def image(scene: Scene, camera: Camera, numbers: list[Any]) -> Image:
        given = iter(numbers)
        settings, along = jax.tree.unflatten(structure, [next(given) if number is None else number for number in known])

        def draw(shared: tuple[Any, ...]) -> Image:
            scene, camera, settings, along = shared
            return picture(Request(scene, camera, settings, along), Clock(mesh, traced=True), plan)

        shared = scene, camera, settings, along
        return draw(shared) if mesh is None else over_mesh(mesh, draw, shared)

    return jax.jit(image)


def _tell_if_unreached(scene: Scene, makers: Particles, image: Image) -> None:
    """Warn where no ray meets the surface, with the range of what its level is a level of, which is the coverage by `makers`."""
    if (surface := scene.surface) is None or bool((np.asarray(image.transmittance) < 1).any()):
        return
    of = "the coverage by particles" if surface.of == "coverage" else f"the particles' {surface.of}, smoothed by their kernels,"
    there = ParticleField(makers).at_centers().coverage
    told = f"{there.min():.3g} to {there.max():.3g} at particles' centres" if there.size else "0, as there are no particles"
    warnings.warn(
        f"no ray meets the surface of level {float(surface.level):g}: {of} is {told}; give a level below that, look where "
        "particles are, or give them the volumes that they fill (`jaxsph.Particles.from_arrays(volume=...)`)",
        UserWarning,
        stacklevel=3,
    )
