"""Devices that share a frame: which ones, as a mesh, and functions that all of them run, each for its own shard.

Flow: `devices=` of a user -> [devices: mesh_of] -> clock; a frame or a band -> [over_mesh] -> the same, held by all devices.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.sharding import AxisType, Mesh, NamedSharding
from jax.sharding import PartitionSpec as Spec
from jaxtyping import Array

AXIS = "devices"
"""Name of the one axis of a mesh that is made here."""
Devices = tuple[jax.Device, ...]


def chosen_devices(devices: Any) -> Devices:
    """Devices of this process.

    Args:
        devices: `"all"`, a number of them, a sequence of `jax.Device`, or a mesh.

    Raises:
        ValueError: more than there are, none, one twice, or something else.
    """
    here = tuple(jax.local_devices())
    if isinstance(devices, str) and devices == "all":
        return here
    if isinstance(devices, int | np.integer) and not isinstance(devices, bool):
        return here[: _number(int(devices), len(here))]
    given = tuple(devices.devices.flat) if isinstance(devices, Mesh) else devices
    if isinstance(given, str | bytes) or not isinstance(given, Sequence) or not all(isinstance(d, jax.Device) for d in given):
        raise ValueError(f'`devices` must be "all", a number, a sequence of `jax.Device` or a mesh, got {devices!r}')
    _number(len(given), len(jax.devices()) if isinstance(devices, Mesh) else len(here))
    if any(device.process_index != jax.process_index() for device in given):
        raise ValueError(
            "`devices` of several processes work on one frame under `jax.jit` alone; jit the call, and give a `plan`"
        )
    if len(set(given)) < len(given):
        raise ValueError(f"`devices` must be different ones, got {devices!r}")
    return tuple(given)


def mesh_of(devices: Any) -> Mesh:
    """A mesh as it is, or one of devices in a row."""
    if isinstance(devices, Mesh):
        return devices
    return Mesh(np.array(chosen_devices(devices)), (AXIS,), axis_types=(AxisType.Auto,))


def _number(wanted: int, there: int) -> int:
    if not 1 <= wanted <= there:
        some = "device" if there == 1 else "devices"
        kind = jax.default_backend()
        raise ValueError(
            f"`devices` must be from 1 to {there}, as there {'is' if there == 1 else 'are'} {there} {some} ({kind}), got {wanted}"
        )
    return wanted


def over_mesh(mesh: Mesh, function: Callable[[Any], Any], shared: Any) -> Any:
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
