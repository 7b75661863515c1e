"""The verb: particles in, image out.

Flow: view_scene -> plan -> frame, band by band -> layers -> Image.
"""

from __future__ import annotations

from typing import Any

from jaxsph.engine.frame.bands import Progress, Work
from jaxsph.engine.frame.traced import traced_image
from jaxsph.engine.planning.fit import PLANS, seen_by
from jaxsph.engine.planning.plan import Plan
from jaxsph.engine.request import Request
from jaxsph.engine.runtime.device_executors import OnDevices
from jaxsph.engine.runtime.devices import chosen_devices
from jaxsph.engine.runtime.executors import Clock
from jaxsph.model.camera.camera import Camera
from jaxsph.model.image import Image
from jaxsph.model.scene import Scene
from jaxsph.model.settings import Settings
from jaxsph.numerics.checks import is_traced


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
    if plan is not None and not isinstance(plan, Plan):
        raise ValueError(f"`plan` must be a `jaxsph.Plan`, got {type(plan).__name__}; make one with `jaxsph.plan`")
    if is_traced(scene, camera, settings):
        return traced_image(scene, camera, settings, plan, devices)
    clock, asked = Clock() if devices is None else OnDevices(chosen_devices(devices)), Request.of(scene, camera, settings)
    made, seen = PLANS.for_frame(asked, clock) if plan is None else seen_by(plan, asked, clock)
    return Work(seen, camera, settings, made, asked.scene.formulas).image(clock, progress, planned=plan is None)
