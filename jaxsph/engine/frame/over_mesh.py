"""A frame as part of a trace over a mesh of devices, each of which runs the same program for its own shards.

Flow: scene, mesh -> [over_mesh: Frame -> bands] -> layers.

Every device holds all particles and makes the lists of a band; the bundles are dealt out as they are to the shards of
one device, and each device decides and marches its own. Nothing is exchanged but what rays met, and with error control by bounds
or the pilot what decisions for a whole band need. In reverse mode cotangents of what all devices share are added up.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jax.sharding import AxisType, Mesh, NamedSharding
from jax.sharding import PartitionSpec as Spec
from jaxtyping import Array

from jaxsph.engine.control.pilot import PilotPlan
from jaxsph.engine.frame.frame import Frame
from jaxsph.engine.frame.layers import Drawn, Layers, OfShards, crop, of_band
from jaxsph.engine.planning.fit import see
from jaxsph.engine.planning.plan import Plan
from jaxsph.engine.runtime.executors import OnMesh
from jaxsph.model.camera.camera import Camera
from jaxsph.model.scene import Scene
from jaxsph.model.settings import Settings


def drawn_over_mesh(scene: Scene, camera: Camera, settings: Settings, plan: Plan, mesh: Mesh) -> Drawn:
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
    found, place = mapped([jnp.copy(leaves[nth]) for nth in given]), NamedSharding(mesh, Spec())
    if all(kind is AxisType.Explicit for kind in mesh.axis_types):
        return jax.reshard(found, place)
    return jax.tree.map(lambda leaf: lax.with_sharding_constraint(leaf, place), found)


def apart(tree: Any, number: int) -> tuple[Any, ...]:
    """The first so many along the first axis, one by one."""
    leaves, structure = jax.tree.flatten(tree)
    return tuple(jax.tree.unflatten(structure, [leaf[nth] for leaf in leaves]) for nth in range(number))
