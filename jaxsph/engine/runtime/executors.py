"""Ways to run the stages of a frame: for real and timed, as a forecast of what will be compiled, or as part of a trace.

A frame is written once, as calls `run.one(stage, function, arguments, **static)` of jitted functions.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Hashable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
from jaxtyping import Array, Int

from jaxsph.engine.runtime.programs import PROGRAMS, Programs
from jaxsph.engine.runtime.tuning import Tuning


class HostStage(NamedTuple):
    """A stage that the host does part of, where a frame is run stage by stage and its tuning says so.

    Attributes:
        function: the stage as one jitted function.
        on_host: the same, given a `Clock` to run programs by.
        foreseen: the shapes that it returns, given a `Forecast` to have those programs compiled by.
    """

    function: Any
    on_host: Callable[..., Any]
    foreseen: Callable[..., Any]


class AllShards:
    """Of executors that run every shard of a band."""

    def own(self, of_shards: Sequence[Any]) -> list[Any]:
        """All."""
        return list(of_shards)

    def pooled(self, of_shards: Sequence[Any]) -> list[Any]:
        """What is given."""
        return list(of_shards)


class Clock(AllShards):
    """Runs compiled programs and tells the seconds of each stage, compile time apart."""

    def __init__(self, programs: Programs = PROGRAMS) -> None:
        self.seconds = {"plan": 0.0, "compile": 0.0, "grid": 0.0, "adapt": 0.0, "cast": 0.0, "image": 0.0}
        self._programs = programs
        self._last = time.perf_counter()

    @property
    def devices(self) -> tuple[jax.Device, ...]:
        """That are chosen; none where all is done wherever arrays are."""
        return ()

    def foresee(self, draw: Callable[[Forecast], Any]) -> None:
        """Have all that `draw` runs compiled side by side."""
        draw(self._forecast())
        self.mark("compile")

    def _forecast(self) -> Forecast:
        return Forecast(self._programs)

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

    def with_host(self, stage: str, made: HostStage, arguments: tuple[Any, ...], *, tuning: Tuning, **static: Hashable) -> Any:
        """Done in part by the host where that pays."""
        if not tuning.sorts_on_host:
            return self.one(stage, made.function, arguments, tuning=tuning, **static)
        result = jax.block_until_ready(made.on_host(self, stage, *arguments, tuning=tuning, **static))
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
    """Has programs compiled side by side that a frame will need, without running any: results are shapes."""

    def __init__(self, programs: Programs = PROGRAMS) -> None:
        self._programs = programs

    def one(self, stage: str, function: Any, arguments: tuple[Any, ...], **static: Hashable) -> Any:
        """The shapes that `function` returns; its compilation has begun."""
        return self._programs.get(function, arguments, static).result

    def each(self, stage: str, function: Any, inputs: Sequence[tuple[Any, ...]], **static: Hashable) -> list[Any]:
        """The same for several arguments of the same shapes."""
        return [self.one(stage, function, inputs[0], **static)] * len(inputs)

    def with_host(self, stage: str, made: HostStage, arguments: tuple[Any, ...], *, tuning: Tuning, **static: Hashable) -> Any:
        """The shapes that a stage returns; its programs' compilation has begun."""
        if not tuning.sorts_on_host:
            return self.one(stage, made.function, arguments, tuning=tuning, **static)
        return made.foreseen(self, stage, *arguments, tuning=tuning, **static)

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


Executor = Clock | Forecast | Traced
"""What a frame needs to be run."""
