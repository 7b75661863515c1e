"""The verb: particles in, image out.

Flow: view_scene -> plan -> frame, band by band -> layers -> Image.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import operator
import threading
import warnings
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.sharding import AxisType, Mesh, NamedSharding
from jax.sharding import PartitionSpec as Spec
from jaxtyping import Array

from jaxsph.engine.frame.frame import Frame, Told, image_of, traced_image_of
from jaxsph.engine.frame.outlines import outlined
from jaxsph.engine.frame.quadtree import refined
from jaxsph.engine.frame.stages import Drawn
from jaxsph.engine.planning.fit import see
from jaxsph.engine.planning.plan import Plan
from jaxsph.engine.planning.viewing import measure
from jaxsph.engine.request import Request, along_rays, as_drawn
from jaxsph.engine.runtime.executors import Dealing, Eager, Run, Traced, chosen_devices, mesh_of
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
            the image is the same bit for bit (with segments for a tolerance, and where rays end, within the estimate); under a
            trace a mesh of any axes, automatic or explicit, makes the same image to rounding. Each device holds all particles.
            None is where the particles are.

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
        if traced:
            return _traced_image(scene, camera, settings, plan, devices)
        run, asked = Eager(() if devices is None else chosen_devices(devices)), Request.of(scene, camera, settings)
        frame = Frame.begun(asked, run, plan)
        image = asked.in_given_unit(image_of(draw_bands(frame, run, progress), frame, run, planned=plan is None))
        if asked.scene.surface is not None:
            _tell_if_unreached(scene, asked.scene.particle_set, image)
        return image


def draw_bands(frame: Frame, run: Run, progress: Progress | None = None) -> Drawn:
    """Draw all bands on the devices of a run; `progress(done, total)` is called after each."""
    plan, done, lock = frame.plan, itertools.count(1), threading.Lock()
    chooses = refined if plan.quadtree is not None else outlined if frame.formulas.antialias > 1 else None

    def pairs() -> list[int]:
        """Particles and bundles that meet, band by band; at most so many."""
        if plan.bands == 1:
            return [0]
        rows, tiles = measure(frame.seen.viewed, frame.camera, plan.samples).bundle_pairs, plan.lists.tile_rows
        return [int(rows[first : first + tiles].sum()) for first in range(0, plan.bands * tiles, tiles)]

    def told(run: Run) -> None:
        """How many bands are done, on whichever thread; those that are foreseen are not."""
        if progress is not None and not run.foreseeing:
            with lock:
                progress(next(done), plan.bands)

    dealt = run.dealt(pairs, plan.shards, chooses is not None)
    shared = dataclasses.replace(frame, plan=plan.dealt(dealt.shards), shards=dealt.shards)
    if len(dealt.groups) > 1:
        return shared.joined(run, _side_by_side(shared, dealt, run, told))  # type: ignore[arg-type]
    whole = shared.of_bands if chooses is None else functools.partial(chooses, shared)
    return run.foreseen(functools.partial(whole, run, told))


def _side_by_side(frame: Frame, dealt: Dealing, run: Eager, told: Told) -> list[Drawn]:
    """All bands in order, those of each group drawn on a thread of its own."""
    runs, wide = [Eager(group) for group in dealt.groups], jax.config.read("jax_enable_x64")
    run.mark("plan")

    def draw(run: Eager, numbers: tuple[int, ...]) -> list[Drawn]:
        with jax.enable_x64(wide):  # which a thread does not inherit
            return run.foreseen(lambda: frame.bands(run, numbers, told))

    with ThreadPoolExecutor(len(runs)) as threads:
        drawn = threads.map(draw, runs, dealt.bands)
        pairs = [zip(numbers, bands, strict=True) for numbers, bands in zip(dealt.bands, drawn, strict=True)]
    run.absorb(runs)
    places = dict(itertools.chain(*pairs))
    return [places[number] for number in range(frame.plan.bands)]


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


def _traced_image(scene: Scene, camera: Camera, settings: Settings, plan: Plan | None, devices: Any) -> Image:
    """As one program of all that is traced: numbers of settings that are known stay so.

    Raises:
        ValueError: no plan, one for another image, or a quadtree over a mesh.
    """
    scene, camera = as_drawn(scene, camera, settings)
    if plan is None:
        raise ValueError("`plan` is needed under jit, vmap or grad; make it outside with `jaxsph.plan(scene, camera, settings)`")
    plan.check(scene, camera, along_rays(scene, settings))
    if plan.quadtree is not None and devices is not None:
        raise ValueError('`devices` must be None under jit with `screen="quadtree"`; call it eagerly, or take "pixels"')
    PROGRAMS.make_room()
    numbers, structure = jax.tree.flatten(settings)
    known = tuple(None if is_traced(number) else number for number in numbers)
    program = _program(plan, structure, known, None if devices is None else mesh_of(devices))
    return program(scene, camera, [number for number in numbers if is_traced(number)])  # type: ignore[no-any-return]


@kept_while_there_is_room
@functools.lru_cache(maxsize=MAX_TRACED)
def _program(plan: Plan, structure: Any, known: tuple[Any, ...], mesh: Any) -> Any:
    """One jitted function a plan: without an outer `jit`, transformations find again what they compiled for it before.

    A call of its own within one, too: inlined, what is transposed outside of a `jit` would be single operations, some 170.
    """

    def image(scene: Scene, camera: Camera, numbers: list[Any]) -> Image:
        given = iter(numbers)
        settings = jax.tree.unflatten(structure, [next(given) if number is None else number for number in known])
        run = Traced(mesh)

        def draw(shared: tuple[Scene, Camera, Settings]) -> Image:
            scene, camera, settings = shared
            frame = Frame(see(scene, camera, plan, run), camera, settings, plan, scene.formulas)
            return traced_image_of(draw_bands(frame, run), frame)

        return draw((scene, camera, settings)) if mesh is None else _over(mesh, draw, (scene, camera, settings))

    return jax.jit(image)


def _over(mesh: Mesh, function: Callable[[Any], Any], shared: Any) -> Any:
    """`function(shared)`, which all devices of a mesh then hold: each runs it, for its own shards.

    Each holds all particles and makes the lists of a band; the bundles are dealt out as they are to the shards of one device.
    Nothing is exchanged but what rays met, and with error control what decisions for a whole band need. In reverse mode
    cotangents of what all devices share are added up.

    Args:
        shared: what all hold before. What of it is no array is no argument: numbers that are known while tracing remain so.
    """
    leaves, structure = jax.tree.flatten(shared)
    given = [nth for nth, leaf in enumerate(leaves) if isinstance(leaf, jax.Array)]

    def of_arrays(arrays: list[Array]) -> Any:
        there = [arrays[given.index(nth)] if nth in given else leaf for nth, leaf in enumerate(leaves)]
        return jax.tree.map(lambda leaf: leaf[None], function(jax.tree.unflatten(structure, there)))

    mapped = jax.shard_map(of_arrays, mesh=mesh, in_specs=Spec(), out_specs=Spec(mesh.axis_names), check_vma=False)
    # copied, as their tangents may be NumPy's, which `shard_map` takes for constants
    found, place = mapped([jnp.copy(leaves[nth]) for nth in given]), NamedSharding(mesh, Spec())
    if all(kind is AxisType.Explicit for kind in mesh.axis_types):
        found = jax.reshard(found, place)
    else:
        found = jax.tree.map(lambda leaf: lax.with_sharding_constraint(leaf, place), found)
    return jax.tree.map(operator.itemgetter(0), found)
