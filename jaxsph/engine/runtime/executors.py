"""Ways to run the stages of a frame: program by program, or as part of a trace; on one device, on several, or over a mesh.

A frame is written once, as calls `run.one(stage, function, arguments, **static)` of jitted functions. Of several devices each
runs some of the shards of a band, and the first what is not of a shard. Nothing is exchanged but what stages are given: programs
are those of one device, and so are the bits of an image.
"""

from __future__ import annotations

import functools
import math
import operator
import time
from collections.abc import Callable, Hashable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.sharding import AxisType, Mesh
from jaxtyping import Array, Int

from jaxsph.engine.runtime.programs import PROGRAMS, Programs, barriers_of, shapes_of
from jaxsph.numerics.checks import array_of

AXIS = "devices"
"""Name of the one axis of a mesh that is made here."""
MANY = 4  # bands for each device, of which one more or less does not matter
KEPT = "light"  # name of what is not to be made again where a band is, see `jax.checkpoint`
Devices = tuple[jax.Device, ...]
Made = TypeVar("Made")


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


class Dealing(NamedTuple):
    """Who draws what.

    Attributes:
        groups: devices that draw a band together, all of as many.
        bands: numbers of the bands of each group.
        shards: of every band.
    """

    groups: tuple[Devices, ...]
    bands: tuple[tuple[int, ...], ...]
    shards: int


def dealing(devices: Devices, pairs: Sequence[int], least_shards: int, whole: bool = False) -> Dealing:
    """Deal bands with so many pairs to devices; `whole`: all of them work on every band.

    A band goes to the group that has the fewest pairs so far, the fullest bands first: no group then has more than 4/3 of the
    pairs of the best dealing's fullest group (Graham 1969).
    """
    number = 1 if whole else len(devices) if len(pairs) >= MANY * len(devices) else math.gcd(len(devices), len(pairs))
    size = len(devices) // number
    groups = tuple(devices[first : first + size] for first in range(0, len(devices), size))
    load, bands = [0] * number, [[] for _ in range(number)]  # type: ignore[var-annotated]
    for band in sorted(range(len(pairs)), key=lambda band: -pairs[band]):
        least = min(range(number), key=lambda group: (load[group], len(bands[group])))
        load[least] += pairs[band]
        bands[least].append(band)
    shards = -(-least_shards // size) * size
    return Dealing(groups, tuple(tuple(sorted(one)) for one in bands), shards)


class Run:
    """What a frame needs to be run; where nothing else is said, on the device that arrays are on.

    Attributes:
        foreseeing: whether programs begin to be compiled and none is run: results are shapes.
    """

    foreseeing = False

    def one(self, stage: str, function: Any, arguments: tuple[Any, ...], **static: Hashable) -> Any:
        """`function(*arguments, **static)`, for a stage."""
        return self.each(stage, function, [arguments], **static)[0]

    def each(self, stage: str, function: Any, inputs: Sequence[tuple[Any, ...]], **static: Hashable) -> list[Any]:
        """The same for several arguments of the same shapes."""
        raise NotImplementedError(type(self).__name__)

    def over(self, rows: Sequence[int], draw: Callable[[Int[Array, ""]], Made]) -> list[Made]:
        """All bands, each by the row of pixels that it begins at."""
        raise NotImplementedError(type(self).__name__)

    def dealt(self, pairs: Callable[[], Sequence[int]], least_shards: int, whole: bool) -> Dealing:
        """Who draws what, see `dealing`."""
        return Dealing(((),), (), least_shards)

    def foreseen(self, draw: Callable[[], Made]) -> Made:
        """What `draw` makes."""
        return draw()

    def shards(self, number: int) -> list[Int[Array, ""]]:
        """Numbers of the shards of a band that are run here."""
        return [array_of(nth, jnp.int32) for nth in range(number)]

    def pooled(self, of_shards: list[Made]) -> list[Made]:
        """What was found of all shards, of what was here."""
        return of_shards

    def turns(self, number: Int[Array, ""], together: int, most: int) -> tuple[int, int]:
        """In how many turns `number` things are done, and how many in each: in one, with room for all there can be."""
        return 1, most


class Eager(Run):
    """Runs compiled programs, wherever arrays are or on some devices; and tells the seconds of each stage, compile time apart.

    Attributes:
        seconds: of each stage so far.
        devices: the shards of a band are run in turn on each of these; where arrays are if there are none.
    """

    def __init__(self, devices: Devices = (), programs: Programs = PROGRAMS) -> None:
        self.seconds = {"plan": 0.0, "compile": 0.0, "grid": 0.0, "adapt": 0.0, "cast": 0.0, "image": 0.0}
        self.devices, self.foreseeing = devices, False
        self._programs, self._copies = programs, dict[tuple[int, jax.Device], tuple[Any, Any]]()
        self._last = time.perf_counter()

    def foreseen(self, draw: Callable[[], Made]) -> Made:
        """What `draw` makes, after all programs that it runs have begun to be compiled, side by side."""
        self.foreseeing = True
        try:
            draw()
        finally:
            self.foreseeing = False
        self.mark("compile")
        return draw()

    def mark(self, stage: str) -> None:
        """Book the time since the last mark."""
        now = time.perf_counter()
        self.seconds[stage] += now - self._last
        self._last = now

    def absorb(self, others: Sequence[Eager]) -> None:
        """Book the seconds of others that ran side by side meanwhile: of each stage those of the slowest."""
        for stage in self.seconds:
            self.seconds[stage] += max(other.seconds[stage] for other in others)
        self._last = time.perf_counter()

    def dealt(self, pairs: Callable[[], Sequence[int]], least_shards: int, whole: bool) -> Dealing:
        """See `Run`."""
        return dealing(self.devices, pairs(), least_shards, whole) if self.devices else super().dealt(pairs, least_shards, whole)

    def over(self, rows: Sequence[int], draw: Callable[[Int[Array, ""]], Made]) -> list[Made]:
        """One after the other."""
        return [draw(array_of(row, jnp.int32)) for row in rows]

    def each(self, stage: str, function: Any, inputs: Sequence[tuple[Any, ...]], **static: Hashable) -> list[Any]:
        """Compile if need be, run each on a thread of its own, on its device if there are any, and book both."""
        given = [shapes_of(some, device) for some, device in zip(inputs, self.devices, strict=False)] or inputs[:1]
        begun = [self._programs.get(function, some, static) for some in given]
        if self.foreseeing:
            return [begun[nth % len(begun)].result for nth in range(len(inputs))]
        programs = [program.compiled.result() for program in begun]
        self.mark("compile")

        def run(nth: int, some: tuple[Any, ...]) -> Any:
            return jax.block_until_ready(programs[nth % len(programs)](*some))

        there = self._there(inputs) if self.devices else inputs
        if len(inputs) == 1:
            results = [run(0, there[0])]
        else:
            with ThreadPoolExecutor(len(inputs)) as threads:
                results = list(threads.map(run, range(len(inputs)), there))
        self.mark(stage)
        return results

    def by_host(self, stage: str, work: Callable[[], Any], shapes: Any) -> Any:
        """What the host makes, for a stage that is under way; `shapes` are those of it."""
        if self.foreseeing:
            return shapes
        result = jax.block_until_ready(work())
        self.mark(stage)
        return result

    def program(self, stage: str, function: Any, arguments: tuple[Any, ...], **static: Hashable) -> Callable[..., Any]:
        """The program of a function, for a stage that is under way; to wait for it is booked apart."""
        begun = self._programs.get(function, shapes_of(arguments, self.devices[0]) if self.devices else arguments, static)
        if self.foreseeing:
            return begun
        self.mark(stage)
        program = begun.compiled.result()
        self.mark("compile")
        return program

    def turns(self, number: Int[Array, ""], together: int, most: int) -> tuple[int, int]:
        """As many as there are things for."""
        return 1 if self.foreseeing else -(-int(number) // together), together

    def _there(self, inputs: Sequence[tuple[Any, ...]]) -> list[tuple[Any, ...]]:
        """Arguments where they are wanted; what several calls in a row are given is copied once."""
        before, self._copies = self._copies, {}

        def put(leaf: Any, device: jax.Device) -> Any:
            key = id(leaf), device
            made = self._copies.get(key) or before.get(key) or (leaf, jax.device_put(leaf, device))
            self._copies[key] = made
            return made[1]

        places = [self.devices[nth % len(self.devices)] for nth in range(len(inputs))]
        return [jax.tree.map(functools.partial(put, device=device), some) for some, device in zip(inputs, places, strict=True)]


class Traced(Run):
    """Calls the functions that are jitted, as part of a larger program; of one shard where each device of a mesh runs that.

    Not as jitted functions: JAX would keep what it traced of them for as long as they live, for every shape.
    """

    def __init__(self, mesh: Mesh | None = None) -> None:
        self.mesh = mesh

    def dealt(self, pairs: Callable[[], Sequence[int]], least_shards: int, whole: bool) -> Dealing:
        """A shard for each device of a mesh."""
        return Dealing(((),), (), 1 if self.mesh is None else self.mesh.size)

    def over(self, rows: Sequence[int], draw: Callable[[Int[Array, ""]], Made]) -> list[Made]:
        """All bands one after the other; in reverse mode what led to one is made again, as bands are there to spare memory."""
        if len(rows) == 1:
            return [draw(jnp.int32(rows[0]))]
        policy = jax.checkpoint_policies.save_only_these_names(KEPT)
        found = lax.map(jax.checkpoint(draw, prevent_cse=False, policy=policy), jnp.asarray(rows, jnp.int32))
        return _apart(found, len(rows))

    def shards(self, number: int) -> list[Int[Array, ""]]:
        """Over a mesh, of that which this device has."""
        return super().shards(number) if self.mesh is None else [lax.axis_index(self.mesh.axis_names).astype(jnp.int32)]

    def pooled(self, of_shards: list[Made]) -> list[Made]:
        """Those of all devices."""
        if (mesh := self.mesh) is None:
            return of_shards
        found = jax.tree.map(lambda leaf: lax.all_gather(leaf, mesh.axis_names), of_shards[0])
        return _apart(found, mesh.size)

    def each(self, stage: str, function: Any, inputs: Sequence[tuple[Any, ...]], **static: Hashable) -> list[Any]:
        """One after the other."""
        with barriers_of(static):
            return [function.__wrapped__(*arguments, **static) for arguments in inputs]


def _apart(tree: Any, number: int) -> list[Any]:
    """The first so many along the first axis, one by one."""
    return [jax.tree.map(operator.itemgetter(nth), tree) for nth in range(number)]
