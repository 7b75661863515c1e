"""Executors for several devices: each runs some of the shards of a band.

Flow: frame -> [device_executors] -> programs.

What is not of a shard runs on the first device. Nothing is exchanged but what a frame's stages are given: programs are those of
one device, and so are the bits of an image.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Hashable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

from jaxsph.engine.runtime.executors import Clock, Forecast, Traced, side_by_side
from jaxsph.engine.runtime.programs import PROGRAMS, Programs, shapes_of

Devices = tuple[jax.Device, ...]


def placed(tree: Any, device: jax.Device) -> Any:
    """Shapes of arrays, on a device."""
    place = jax.sharding.SingleDeviceSharding(device)

    def shape(leaf: jax.ShapeDtypeStruct) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=place, weak_type=leaf.weak_type)

    return jax.tree.map(shape, shapes_of(tree))


class OnDevices(Clock):
    """Runs compiled programs, the shards of a band in turn on each of some devices."""

    def __init__(self, devices: Devices, programs: Programs = PROGRAMS) -> None:
        super().__init__(programs)
        self._devices = devices
        self._copies: dict[tuple[int, jax.Device], tuple[Any, Any]] = {}

    @property
    def devices(self) -> Devices:
        """As given."""
        return self._devices

    def _forecast(self) -> Forecast:
        return ForecastOnDevices(self.devices, self._programs)

    def each(self, stage: str, function: Any, inputs: Sequence[tuple[Any, ...]], **static: Hashable) -> list[Any]:
        """Each on its device, side by side."""
        places = [self.devices[nth % len(self.devices)] for nth in range(len(inputs))]
        pairs = list(zip(inputs, places, strict=True))
        begun = [self._programs.get(function, placed(arguments, device), static) for arguments, device in pairs]
        programs = [program.compiled.result() for program in begun]
        self.mark("compile")
        results = side_by_side(programs, self._given(pairs))
        self.mark(stage)
        return results

    def program(self, stage: str, function: Any, arguments: tuple[Any, ...], **static: Hashable) -> Callable[..., Any]:
        """That of the first device."""
        return super().program(stage, function, placed(arguments, self.devices[0]), **static)

    def _given(self, pairs: list[tuple[tuple[Any, ...], jax.Device]]) -> list[tuple[Any, ...]]:
        """Arguments where they are wanted; what several calls in a row are given is copied once."""
        before, self._copies = self._copies, {}

        def put(leaf: Any, device: jax.Device) -> Any:
            key = id(leaf), device
            made = self._copies.get(key) or before.get(key) or (leaf, jax.device_put(leaf, device))
            self._copies[key] = made
            return made[1]

        return [jax.tree.map(functools.partial(put, device=device), some) for some, device in pairs]


class ForecastOnDevices(Forecast):
    """Has the programs of each device compiled that a frame will need."""

    def __init__(self, devices: Devices, programs: Programs = PROGRAMS) -> None:
        super().__init__(programs)
        self.devices = devices

    def one(self, stage: str, function: Any, arguments: tuple[Any, ...], **static: Hashable) -> Any:
        """The shapes that `function` returns on the first device."""
        return super().one(stage, function, placed(arguments, self.devices[0]), **static)

    def each(self, stage: str, function: Any, inputs: Sequence[tuple[Any, ...]], **static: Hashable) -> list[Any]:
        """The same for each device that has any."""
        own = inputs[: len(self.devices)]
        found = [
            Forecast.one(self, stage, function, placed(one, device), **static)
            for one, device in zip(own, self.devices, strict=False)
        ]
        return [found[nth % len(found)] for nth in range(len(inputs))]


class OnMesh(Traced):
    """Calls the functions of one shard, as part of a program that each device of a mesh runs for its own (`jax.shard_map`)."""

    def __init__(self, mesh: jax.sharding.Mesh) -> None:
        self.mesh = mesh

    def own(self, of_shards: Sequence[Any]) -> list[Any]:
        """That of this device."""
        nth = lax.axis_index(self.mesh.axis_names)
        return [jax.tree.map(lambda *values: jnp.stack(values)[nth], *of_shards)]

    def pooled(self, of_shards: Sequence[Any]) -> list[Any]:
        """Those of all devices."""
        (own,) = of_shards
        leaves, structure = jax.tree.flatten(own)
        found = [lax.all_gather(leaf, self.mesh.axis_names) for leaf in leaves]
        return [jax.tree.unflatten(structure, [leaf[nth] for leaf in found]) for nth in range(self.mesh.size)]
