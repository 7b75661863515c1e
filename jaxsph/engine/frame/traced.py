"""A frame as part of a trace, by one device or by each device of a mesh for its own shards.

Flow: scene, plan -> [traced: Frame -> bands] -> layers -> Image.

Over a mesh every device holds all particles and makes the lists of a band; the bundles are dealt out as they are to the shards of
one device, and each device decides and marches its own. Nothing is exchanged but what rays met, and with error control by bounds
or the pilot what decisions for a whole band need. In reverse mode cotangents of what all devices share are added up.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jax.sharding import AxisType, Mesh, NamedSharding
from jax.sharding import PartitionSpec as Spec
from jaxtyping import Array

from jaxsph.engine.asked import require_asked
from jaxsph.engine.control.pilot import PilotPlan
from jaxsph.engine.frame.frame import Frame
from jaxsph.engine.frame.images import traced_image_of
from jaxsph.engine.frame.layers import Drawn, Layers, OfShards, crop, of_band
from jaxsph.engine.frame.refinement import refined
from jaxsph.engine.planning.fit import see
from jaxsph.engine.planning.plan import Plan
from jaxsph.engine.request import along_rays
from jaxsph.engine.runtime.device_executors import OnMesh
from jaxsph.engine.runtime.devices import mesh_of
from jaxsph.engine.runtime.executors import Traced
from jaxsph.engine.runtime.programs import PROGRAMS, kept_while_there_is_room
from jaxsph.model.camera.camera import Camera
from jaxsph.model.image import Image
from jaxsph.model.scene import Scene
from jaxsph.model.settings import Settings
from jaxsph.numerics.checks import is_traced

MAX_TRACED = 16  # plans whose traced programs are kept for calls outside of any `jit`


def traced_image(scene: Scene, camera: Camera, settings: Settings, plan: Plan | None, devices: Any) -> Image:
    """As one program of all that is traced: numbers of settings that are known stay so.

    Raises:
        ValueError: no plan, one for another image, or a quadtree over a mesh.
    """
    require_asked(scene, camera, settings)
    if plan is None:
        raise ValueError("`plan` is needed under jit, vmap or grad; make it outside with `jaxsph.plan(scene, camera, settings)`")
    plan.check(scene, camera, along_rays(scene, settings))
    if plan.quadtree is not None and devices is not None:
        raise ValueError('`devices` must be None under jit with `screen="quadtree"`; call it eagerly, or take "pixels"')
    PROGRAMS.make_room()
    numbers, structure = jax.tree.flatten(settings)
    known = tuple(None if is_traced(number) else number for number in numbers)
    program = _program(plan, structure, known, None if devices is None else mesh_of(devices))
    image: Image = program(scene, camera, [number for number in numbers if is_traced(number)])
    return image


@kept_while_there_is_room
@functools.lru_cache(maxsize=MAX_TRACED)
def _program(plan: Plan, structure: Any, known: tuple[Any, ...], mesh: Mesh | None) -> Any:
    """One jitted function a plan: without an outer `jit`, transformations find again what they compiled for it before.

    Within one, it is no call of its own.
    """

    def image(scene: Scene, camera: Camera, numbers: list[Any]) -> Image:
        given = iter(numbers)
        settings = jax.tree.unflatten(structure, [next(given) if number is None else number for number in known])
        drawn = _drawn(scene, camera, settings, plan) if mesh is None else _drawn_over(mesh, scene, camera, settings, plan)
        return traced_image_of(drawn, settings, plan)

    return jax.jit(image, inline=True)


def _drawn(scene: Scene, camera: Camera, settings: Settings, plan: Plan) -> Drawn:
    """All bands."""
    run = Traced()
    seen = see(scene, camera, plan, run)
    frame = Frame.begun(seen, camera, settings, plan, scene.formulas, 1, run)
    if plan.quadtree is not None:
        return refined(frame, run, seen.viewed.faults)
    found = frame.all_bands(run, lambda band: of_band(band.of_shards, plan=plan))
    return found._replace(layers=crop(found.layers, plan), faults=found.faults | seen.viewed.faults)


def _drawn_over(mesh: Mesh, scene: Scene, camera: Camera, settings: Settings, plan: Plan) -> Drawn:
    """On every device of a mesh, each for its own bundles; what is returned they all hold."""
    plan = plan.dealt(mesh.size)

    def of_device(shared: tuple[Scene, Camera, Settings]) -> Drawn:
        (scene, camera, settings), run = shared, OnMesh(mesh)
        seen = see(scene, camera, plan, run)
        frame = Frame.begun(seen, camera, settings, plan, scene.formulas, mesh.size, run)
        found = frame.all_bands(run, lambda band: band.of_shards)
        return found._replace(faults=found.faults | seen.viewed.faults)

    found = over(mesh, of_device, (scene, camera, settings))
    bands: OfShards = found.layers

    def joined(band: OfShards) -> Layers:
        whole = isinstance(plan.control, PilotPlan)  # one decision for all
        verdicts = apart(band.verdicts[0], 1 if whole else mesh.size)
        return of_band(OfShards(apart(band.cast[0], mesh.size), verdicts), plan=plan)

    layers = jax.vmap(joined, in_axes=1)(bands)
    return Drawn(crop(layers, plan), *(count[0] for count in found[1:]))


def over(mesh: Mesh, function: Callable[[Any], Any], shared: Any) -> Any:
    """`function(shared)` of each device side by side along the first axis, which all then hold.

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
    return placed_on(mapped([jnp.copy(leaves[nth]) for nth in given]), mesh, Spec())


def placed_on(tree: Any, mesh: Mesh, where: Spec) -> Any:
    """Arrays of a trace, on the devices of a mesh."""
    place = NamedSharding(mesh, where)
    if all(kind is AxisType.Explicit for kind in mesh.axis_types):
        return jax.reshard(tree, place)
    return jax.tree.map(lambda leaf: lax.with_sharding_constraint(leaf, place), tree)


def apart(tree: Any, number: int) -> tuple[Any, ...]:
    """The first so many along the first axis, one by one."""
    leaves, structure = jax.tree.flatten(tree)
    return tuple(jax.tree.unflatten(structure, [leaf[nth] for leaf in leaves]) for nth in range(number))
