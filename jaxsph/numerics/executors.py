"""Ways to run the stages of a frame: for real and timed, as a forecast of what will be compiled, or as part of a trace.

A frame is written once, as calls `run.one(stage, function, arguments, **static)` of jitted functions. What is decided on the
host between them asks `run.may_hold`.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Hashable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Protocol

import jax
from jaxtyping import Array, Bool, Int

from jaxsph.numerics.programs import PROGRAMS, Programs


class Executor(Protocol):
    """What a frame needs to be run."""

    def one(self, stage: str, function: Any, arguments: tuple[Any, ...], **static: Hashable) -> Any:
        """`function(*arguments, **static)`, booked under a stage."""
        ...

    def each(self, stage: str, function: Any, inputs: Sequence[tuple[Any, ...]], **static: Hashable) -> list[Any]:
        """The same for several arguments of the same shapes, side by side where that pays."""
        ...

    def may_hold(self, flag: Bool[Array, ""]) -> bool:
        """Whether what depends on a flag is to be run."""
        ...

    def turns(self, number: Int[Array, ""], together: int, most: int) -> tuple[int, int]:
        """In how many turns `number` of at most `most` things are done, if so many are done together; and how many then are."""
        ...


class Clock:
    """Runs compiled programs and tells the seconds of each stage, compile time apart."""

    def __init__(self, programs: Programs = PROGRAMS) -> None:
        self.seconds = {"plan": 0.0, "compile": 0.0, "grid": 0.0, "adapt": 0.0, "cast": 0.0, "image": 0.0}
        self._programs = programs
        self._last = time.perf_counter()
        self._known: list[bool] = []
        self._foresee: Callable[[list[bool]], Any] | None = None

    def foresee(self, draw: Callable[[list[bool]], Any]) -> None:
        """Have all that is to follow compiled side by side, by `draw`, given the flags that are known; anew with each flag."""
        self._foresee = draw
        with contextlib.suppress(Unforeseen):
            draw(list(self._known))
        self.mark("compile")

    def mark(self, stage: str) -> None:
        """Book the time since the last mark."""
        now = time.perf_counter()
        self.seconds[stage] += now - self._last
        self._last = now

    def one(self, stage: str, function: Any, arguments: tuple[Any, ...], **static: Hashable) -> Any:
        """Compile `function` for `arguments` if need be, run it, and book both."""
        return self.each(stage, function, [arguments], **static)[0]

    def each(self, stage: str, function: Any, inputs: Sequence[tuple[Any, ...]], **static: Hashable) -> list[Any]:
        """The same for several arguments of the same shapes, each on a thread of its own."""
        program = self._programs.get(function, inputs[0], static).compiled.result()
        self.mark("compile")
        if len(inputs) == 1:
            results = [jax.block_until_ready(program(*inputs[0]))]
        else:
            with ThreadPoolExecutor(len(inputs)) as threads:
                results = list(threads.map(lambda arguments: jax.block_until_ready(program(*arguments)), inputs))
        self.mark(stage)
        return results

    def may_hold(self, flag: Bool[Array, ""]) -> bool:
        """The flag's value."""
        self._known.append(bool(flag))
        if self._foresee is not None:
            self.foresee(self._foresee)
        return self._known[-1]


    def turns(self, number: Int[Array, ""], together: int, most: int) -> tuple[int, int]:
        """As many as there are things for."""
        return -(-int(number) // together), together


class Unforeseen(Exception):
    """What follows depends on a flag that is not known yet."""


class Forecast:
    """Has programs compiled side by side that a frame will need, without running any: results are shapes.

    Args:
        known: flags in the order in which they will be asked for, as far as they are known.
    """

    def __init__(self, known: Sequence[bool] = (), programs: Programs = PROGRAMS) -> None:
        self._known = iter(known)
        self._programs = programs

    def one(self, stage: str, function: Any, arguments: tuple[Any, ...], **static: Hashable) -> Any:
        """The shapes that `function` returns; its compilation has begun."""
        return self._programs.get(function, arguments, static).result

    def each(self, stage: str, function: Any, inputs: Sequence[tuple[Any, ...]], **static: Hashable) -> list[Any]:
        """The same for several arguments of the same shapes."""
        return [self.one(stage, function, inputs[0], **static)] * len(inputs)

    def may_hold(self, flag: Bool[Array, ""]) -> bool:
        """The flag's value where it is known; else what follows cannot be foreseen."""
        for value in self._known:
            return value
        raise Unforeseen

    def turns(self, number: Int[Array, ""], together: int, most: int) -> tuple[int, int]:
        """One, as all are runs of the same program."""
        return 1, together


class Traced:
    """Calls the functions that are jitted, as part of a larger program.

    Not as jitted functions: JAX would keep what it traced of them for as long as they live, for every shape.
    """

    def one(self, stage: str, function: Any, arguments: tuple[Any, ...], **static: Hashable) -> Any:
        """`function(*arguments, **static)`."""
        return function.__wrapped__(*arguments, **static)

    def each(self, stage: str, function: Any, inputs: Sequence[tuple[Any, ...]], **static: Hashable) -> list[Any]:
        """One after the other."""
        return [function.__wrapped__(*arguments, **static) for arguments in inputs]

    def may_hold(self, flag: Bool[Array, ""]) -> bool:
        """A trace knows no values, and has to be ready for either."""
        return True

    def turns(self, number: Int[Array, ""], together: int, most: int) -> tuple[int, int]:
        """One, with room for all."""
        return 1, most
