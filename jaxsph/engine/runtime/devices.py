"""Devices that share a frame: the user's `devices=` as a mesh, and `over_mesh`, which runs a function on all of them.

Flow: `devices=` -> [devices: chosen_devices, mesh_of] -> Clock; function, inputs -> [over_mesh] -> result, replicated.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec as Spec
from jaxtyping import Array

AXIS = "devices"
"""Name of the one axis of a mesh that is made here."""
Devices = tuple[jax.Device, ...]


def chosen_devices(devices: Any) -> Devices:
    """Check an eager `devices=`, and return the devices of this process that it names.

    Args:
        devices: `"all"`, a number of them, a sequence of `jax.Device`, or a mesh.

    Raises:
        ValueError: more devices than there are, none, the same one twice, one of another process, or anything else.
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
    """The mesh that the user gave; else a mesh with one axis of the devices that were named."""
    if isinstance(devices, Mesh):
        return devices
    return Mesh(np.array(chosen_devices(devices)), (AXIS,), axis_types=(AxisType.Auto,))


def _number(wanted: int, there: int) -> int:
    """`wanted`, if it lies between 1 and the number of devices that are `there`."""
    if not 1 <= wanted <= there:
        some = "device" if there == 1 else "devices"
        kind = jax.default_backend()
        raise ValueError(
            f"`devices` must be from 1 to {there}, as there {'is' if there == 1 else 'are'} {there} {some} ({kind}), got {wanted}"
        )
    return wanted


def over_mesh(mesh: Mesh, function: Callable[[Any], Any], inputs: Any) -> Any:
    """Run `function(inputs)` on every device of a mesh by `jax.shard_map`; all devices then hold the result.

    `function` looks up which device it is on (`Clock.shards`) and draws that device's shard of each band. Each device holds all
    particles and makes the lists of whole bands; bundles are assigned to devices as they are to the shards of one device. Devices
    exchange only what rays met and, with error control, what decisions for a whole band need (`Clock.all_shards`). In reverse
    mode the devices' cotangents of `inputs` are added up.

    Args:
        inputs: a pytree that every device holds. Leaves that are no arrays are no arguments of the `shard_map`, so that numbers
            that are known while tracing stay known.
    """
    leaves, structure = jax.tree.flatten(inputs)
    of_arrays = [nth for nth, leaf in enumerate(leaves) if isinstance(leaf, jax.Array)]

    def on_device(arrays: list[Array]) -> Any:
        all_leaves = [arrays[of_arrays.index(nth)] if nth in of_arrays else leaf for nth, leaf in enumerate(leaves)]
        return jax.tree.map(lambda leaf: leaf[None], function(jax.tree.unflatten(structure, all_leaves)))

    mapped = jax.shard_map(on_device, mesh=mesh, in_specs=Spec(), out_specs=Spec(mesh.axis_names), check_vma=False)
    # copied, as their tangents may be NumPy's, which `shard_map` takes for constants
    result, place = mapped([jnp.copy(leaves[nth]) for nth in of_arrays]), NamedSharding(mesh, Spec())
    if all(kind is AxisType.Explicit for kind in mesh.axis_types):
        result = jax.reshard(result, place)
    else:
        result = jax.tree.map(lambda leaf: lax.with_sharding_constraint(leaf, place), result)
    return jax.tree.map(operator.itemgetter(0), result)
