"""Compiled programs: made once, run with the time they take booked by stage, compile time apart."""

from __future__ import annotations

import time
from collections.abc import Hashable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax


class Clock:
    """Seconds by stage, with compile time apart."""

    def __init__(self) -> None:
        self.seconds = {"plan": 0.0, "compile": 0.0, "grid": 0.0, "adapt": 0.0, "cast": 0.0, "image": 0.0}
        self._last = time.perf_counter()

    def mark(self, stage: str) -> None:
        """Book the time since the last mark."""
        now = time.perf_counter()
        self.seconds[stage] += now - self._last
        self._last = now

    def run(self, stage: str, function: Any, arguments: tuple[Any, ...], **static: Hashable) -> Any:
        """Compile `function` for `arguments` if need be, run it, and book both."""
        return self.run_all(stage, function, [arguments], **static)[0]

    def run_all(self, stage: str, function: Any, inputs: list[tuple[Any, ...]], **static: Hashable) -> list[Any]:
        """The same for several arguments of the same shapes, side by side."""
        program = _compiled(function, inputs[0], static)
        self.mark("compile")
        if len(inputs) == 1:
            results = [jax.block_until_ready(program(*inputs[0]))]
        else:
            with ThreadPoolExecutor(len(inputs)) as threads:
                results = list(threads.map(lambda arguments: jax.block_until_ready(program(*arguments)), inputs))
        self.mark(stage)
        return results


_PROGRAMS: dict[Hashable, Any] = {}
MOST_PROGRAMS = 24  # compiled stages that are kept, the oldest goes first: each takes up to 2000 of the 65530 memory maps


def _compiled(function: Any, arguments: tuple[Any, ...], static: dict[str, Hashable]) -> Any:
    leaves, structure = jax.tree_util.tree_flatten(arguments)
    shapes = tuple((leaf.shape, leaf.dtype, leaf.weak_type, leaf.sharding) for leaf in leaves)
    key = (function, tuple(static.items()), structure, shapes, jax.config.read("jax_enable_x64"))
    if key not in _PROGRAMS:
        while len(_PROGRAMS) >= MOST_PROGRAMS:
            del _PROGRAMS[next(iter(_PROGRAMS))]
        _PROGRAMS[key] = function.lower(*arguments, **static).compile()
    return _PROGRAMS[key]
