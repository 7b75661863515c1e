"""Ways to run the stages of a frame: for real and timed, as a forecast of what will be compiled, or as part of a trace.

A frame is written once, as calls `run.one(stage, function, arguments, **static)` of jitted functions. Of several devices each
runs some of the shards of a band, and the first what is not of a shard. Nothing is exchanged but what stages are given: programs
are those of one device, and so are the bits of an image.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Hashable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Int

from jaxsph.engine.runtime.programs import PROGRAMS, Programs, shapes_of
from jaxsph.engine.runtime.tuning import Tuning

Devices = tuple[jax.Device, ...]


def placed(tree: Any, device: jax.Device) -> Any:
    """Shapes of arrays, on a device."""
    place = jax.sharding.SingleDeviceSharding(device)

    def shape(leaf: jax.ShapeDtypeStruct) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=place, weak_type=leaf.weak_type)

    return jax.tree.map(shape, shapes_of(tree))


class HostStage(NamedTuple):
    """A stage that the host does part of, where a frame is run stage by stage and its tuning says so.

    Attributes:
        function: the stage as one jitted function.
        on_host: the same, given a `Clock` or a `Forecast` to run programs by, and the host.
    """

    function: Any
    on_host: Callable[..., Any]


class AllShards:
    """Of executors that run every shard of a band."""

    def own(self, of_shards: list[Any]) -> list[Any]:
        """All."""
        return of_shards

    pooled = own

    def with_host(
        self: Any, stage: str, made: HostStage, arguments: tuple[Any, ...], *, tuning: Tuning, **static: Hashable
    ) -> Any:
        """Done in part by the host where that pays."""
        if not tuning.sorts_on_host:
            return self.one(stage, made.function, arguments, tuning=tuning, **static)
        return made.on_host(self, stage, *arguments, tuning=tuning, **static)


class Clock(AllShards):
    """Runs compiled programs, wherever arrays are or on some devices; and tells the seconds of each stage, compile time apart."""

    devices: Devices = ()

    def __init__(self, programs: Programs = PROGRAMS) -> None:
        self.seconds = {"plan": 0.0, "compile": 0.0, "grid": 0.0, "adapt": 0.0, "cast": 0.0, "image": 0.0}
        self._programs = programs
        self._last = time.perf_counter()

    def foresee(self, draw: Callable[[Forecast], Any]) -> None:
        """Have all that `draw` runs compiled side by side."""
        draw(Forecast(self._programs, self.devices))
        self.mark("compile")

    def mark(self, stage: str) -> None:
        """Book the time since the last mark."""
        now = time.perf_counter()
        self.seconds[stage] += now - self._last
        self._last = now

    def absorb(self, others: Sequence[Clock]) -> None:
        """Book the seconds of executors that ran side by side meanwhile: of each stage those of the slowest."""
        for stage in self.seconds:
            self.seconds[stage] += max(other.seconds[stage] for other in others)
        self._last = time.perf_counter()

    def one(self, stage: str, function: Any, arguments: tuple[Any, ...], **static: Hashable) -> Any:
        """Compile `function` for `arguments` if need be, run it, and book both."""
        return self.each(stage, function, [arguments], **static)[0]

    def each(self, stage: str, function: Any, inputs: Sequence[tuple[Any, ...]], **static: Hashable) -> list[Any]:
        """The same for several arguments of the same shapes, each on a thread of its own."""
        program = self._programs.get(function, inputs[0], static).compiled.result()
        self.mark("compile")
        results = side_by_side([program] * len(inputs), inputs)
        self.mark(stage)
        return results

    def by_host(self, stage: str, work: Callable[[], Any], shapes: Any) -> Any:
        """What the host makes, for a stage that is under way."""
        result = jax.block_until_ready(work())
        self.mark(stage)
        return result

    def program(self, stage: str, function: Any, arguments: tuple[Any, ...], **static: Hashable) -> Callable[..., Any]:
        """The program of a function, for a stage that is under way; to wait for it is booked apart."""
        self.mark(stage)
        program = self._programs.get(function, arguments, static).compiled.result()
        self.mark("compile")
        return program

    def turns(self, number: Int[Array, ""], together: int, most: int) -> tuple[int, int]:
        """As many as there are things for."""
        return -(-int(number) // together), together


def side_by_side(programs: Sequence[Callable[..., Any]], inputs: Sequence[tuple[Any, ...]]) -> list[Any]:
    """What programs return when they are done, several each on a thread of its own."""

    def done(program: Callable[..., Any], arguments: tuple[Any, ...]) -> Any:
        return jax.block_until_ready(program(*arguments))

    if len(inputs) == 1:
        return [done(programs[0], inputs[0])]
    with ThreadPoolExecutor(len(inputs)) as threads:
        return list(threads.map(done, programs, inputs))


class Forecast(AllShards):
    """Has programs compiled side by side that a frame will need, on all its devices, without running any: results are shapes."""

    def __init__(self, programs: Programs = PROGRAMS, devices: Devices = ()) -> None:
        self._programs, self._devices = programs, devices

    def one(self, stage: str, function: Any, arguments: tuple[Any, ...], **static: Hashable) -> Any:
        """The shapes that `function` returns; its compilation has begun."""
        return self.each(stage, function, [arguments], **static)[0]

    def each(self, stage: str, function: Any, inputs: Sequence[tuple[Any, ...]], **static: Hashable) -> list[Any]:
        """The same for several arguments of the same shapes, once for each device that has any."""
        own = [placed(given, device) for given, device in zip(inputs, self._devices, strict=False)] or inputs[:1]
        found = [self._programs.get(function, given, static).result for given in own]
        return [found[nth % len(found)] for nth in range(len(inputs))]

    def by_host(self, stage: str, work: Callable[[], Any], shapes: Any) -> Any:
        """The shapes of what the host will make."""
        return shapes

    def program(self, stage: str, function: Any, arguments: tuple[Any, ...], **static: Hashable) -> Any:
        """As `one`."""
        return self.one(stage, function, arguments, **static)

    def turns(self, number: Int[Array, ""], together: int, most: int) -> tuple[int, int]:
        """One, as all are runs of the same program."""
        return 1, together


class Traced(AllShards):
    """Calls the functions that are jitted, as part of a larger program.

    Not as jitted functions: JAX would keep what it traced of them for as long as they live, for every shape.
    """

    def one(self, stage: str, function: Any, arguments: tuple[Any, ...], **static: Hashable) -> Any:
        """`function(*arguments, **static)`."""
        return function.__wrapped__(*arguments, **static)

    def each(self, stage: str, function: Any, inputs: Sequence[tuple[Any, ...]], **static: Hashable) -> list[Any]:
        """One after the other."""
        return [function.__wrapped__(*arguments, **static) for arguments in inputs]

    def with_host(self, stage: str, made: HostStage, arguments: tuple[Any, ...], **static: Hashable) -> Any:
        """All of it by XLA, as a trace holds no values for the host."""
        return self.one(stage, made.function, arguments, **static)

    def turns(self, number: Int[Array, ""], together: int, most: int) -> tuple[int, int]:
        """One, with room for all."""
        return 1, most


class OnDevices(Clock):
    """Runs compiled programs, the shards of a band in turn on each of some devices."""

    def __init__(self, devices: Devices, programs: Programs = PROGRAMS) -> None:
        super().__init__(programs)
        self.devices = devices
        self._copies: dict[tuple[int, jax.Device], tuple[Any, Any]] = {}

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


class OnMesh(Traced):
    """Calls the functions of one shard, as part of a program that each device of a mesh runs for its own (`jax.shard_map`)."""

    def __init__(self, mesh: jax.sharding.Mesh) -> None:
        self.mesh = mesh

    def own(self, of_shards: list[Any]) -> list[Any]:
        """That of this device."""
        nth = lax.axis_index(self.mesh.axis_names)
        return [jax.tree.map(lambda *values: jnp.stack(values)[nth], *of_shards)]

    def pooled(self, of_shards: list[Any]) -> list[Any]:
        """Those of all devices."""
        (own,) = of_shards
        leaves, structure = jax.tree.flatten(own)
        found = [lax.all_gather(leaf, self.mesh.axis_names) for leaf in leaves]
        return [jax.tree.unflatten(structure, [leaf[nth] for leaf in found]) for nth in range(self.mesh.size)]


Executor = Clock | Forecast | Traced
"""What a frame needs to be run."""
