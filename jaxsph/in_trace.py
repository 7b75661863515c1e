"""The bands of a frame as part of a trace: one after the other, on one device or on each of a mesh for its own shards.

Flow: seen -> [in_trace: Frame -> bands] -> layers.

Over a mesh every device holds all particles and makes the lists of a band; the bundles are dealt out as they are to the shards of
one device, and each device decides and marches its own. Nothing is exchanged but what rays met, and with error control by bounds
or the pilot what decisions for a whole band need. In reverse mode cotangents of what all devices share are added up.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jax.sharding import AxisType, Mesh, NamedSharding
from jax.sharding import PartitionSpec as Spec
from jaxtyping import Array, Int

from jaxsph.cast.adjoint import KEPT
from jaxsph.control.pilot import PilotPlan
from jaxsph.frame import Band, Frame
from jaxsph.layers import Layers, OfShards, crop, of_band
from jaxsph.model.camera import Camera
from jaxsph.model.scene import Scene
from jaxsph.model.settings import Settings
from jaxsph.numerics.device_executors import OnMesh
from jaxsph.numerics.executors import Executor, Traced
from jaxsph.plan import Plan
from jaxsph.planning import see


class Drawn(NamedTuple):
    """Layers of an image; its fault word, and how many cells and pairs its grids hold."""

    layers: Any
    faults: Int[Array, ""]
    filled: Int[Array, ""]
    pairs: Int[Array, ""]


def drawn(scene: Scene, camera: Camera, settings: Settings, plan: Plan) -> Drawn:
    """On one device."""
    run = Traced()
    seen = see(scene, camera, plan, run)
    frame = Frame.begun(seen, camera, settings, plan, scene.formulas, 1, run)
    found = over_bands(plan, functools.partial(drawn_band, frame, run, lambda band: of_band(band.of_shards, plan=plan)))
    return found._replace(layers=crop(found.layers, plan), faults=found.faults | seen.viewed.faults)


def drawn_over_mesh(scene: Scene, camera: Camera, settings: Settings, plan: Plan, mesh: Mesh) -> Drawn:
    """The same on every device of a mesh, each for its own bundles; what is returned they all hold."""
    plan = plan.dealt(mesh.size)

    def of_device(shared: tuple[Scene, Camera, Settings], _: Any) -> Drawn:
        (scene, camera, settings), run = shared, OnMesh(mesh)
        seen = see(scene, camera, plan, run)
        frame = Frame.begun(seen, camera, settings, plan, scene.formulas, mesh.size, run)
        found = over_bands(plan, functools.partial(drawn_band, frame, run, lambda band: band.of_shards))
        return found._replace(faults=found.faults | seen.viewed.faults)

    found = over(mesh, of_device, (scene, camera, settings))
    bands: OfShards = found.layers

    def joined(band: OfShards) -> Layers:
        whole = isinstance(plan.control, PilotPlan)  # one decision for all
        verdicts = apart(band.verdicts[0], 1 if whole else mesh.size)
        return of_band(OfShards(apart(band.cast[0], mesh.size), verdicts), plan=plan)

    layers = jax.vmap(joined, in_axes=1)(bands)
    return Drawn(crop(layers, plan), *(count[0] for count in found[1:]))


def over(mesh: Mesh, function: Callable[..., Any], shared: Any, parts: Any = ()) -> Any:
    """`function(shared, part)` of each device side by side along the first axis, which all then hold; see `on_each`."""
    return placed_on(on_each(mesh, function, shared, parts), mesh, Spec())


def on_each(mesh: Mesh, function: Callable[..., Any], shared: Any, parts: Any = ()) -> Any:
    """`function(shared, part)` of each device side by side along the first axis, of which each holds its own.

    Args:
        shared: what all hold before. What of it is no array is no argument: numbers that are known while tracing remain so.
        parts: what each holds for itself, side by side along the first axis.
    """
    leaves, structure = jax.tree.flatten(shared)
    given = [nth for nth, leaf in enumerate(leaves) if isinstance(leaf, jax.Array)]

    def of_arrays(arrays: list[Array], parts: Any) -> Any:
        there = [arrays[given.index(nth)] if nth in given else leaf for nth, leaf in enumerate(leaves)]
        found = function(jax.tree.unflatten(structure, there), jax.tree.map(lambda leaf: leaf[0], parts))
        return jax.tree.map(lambda leaf: leaf[None], found)

    each = Spec(mesh.axis_names)
    mapped = jax.shard_map(of_arrays, mesh=mesh, in_specs=(Spec(), each), out_specs=each, check_vma=False)
    shared = [jnp.copy(leaves[nth]) for nth in given]  # whose tangents may be NumPy's, which `shard_map` takes for constants
    return mapped(shared, placed_on(parts, mesh, each))


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


def drawn_band(frame: Frame, run: Executor, kept: Callable[[Band], Any], first_row: Int[Array, ""]) -> Drawn:
    """The band that begins at a row of pixels, and what is `kept` of it."""
    found = frame.band(first_row, run)
    return Drawn(kept(found), found.faults, found.filled, found.pairs)


def over_bands(plan: Plan, draw: Callable[[Int[Array, ""]], Drawn]) -> Drawn:
    """All bands one after the other, given what draws that of a first row; layers lie along a first axis."""
    rows = jnp.arange(plan.bands, dtype=jnp.int32) * plan.band_height
    if plan.bands > 1:  # in reverse mode the grid of a band is made again, as bands are there to spare memory
        policy = jax.checkpoint_policies.save_only_these_names(KEPT)
        found = lax.map(jax.checkpoint(draw, prevent_cse=False, policy=policy), rows)
    else:
        found = jax.tree.map(lambda leaf: leaf[None], draw(rows[0]))
    word = functools.reduce(lambda a, b: a | b, [found.faults[i] for i in range(plan.bands)])
    return Drawn(found.layers, word, found.filled.sum(), found.pairs.sum())
