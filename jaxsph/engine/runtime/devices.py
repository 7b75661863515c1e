"""Which devices are meant: all, so many, a list of them, or those of a mesh.

Flow: user -> [devices] -> executors.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
from jax.sharding import AxisType, Mesh

AXIS = "devices"
"""Name of the one axis of a mesh that is made here."""


def chosen_devices(devices: Any) -> tuple[jax.Device, ...]:
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
