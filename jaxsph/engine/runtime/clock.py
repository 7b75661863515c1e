"""The clock of a frame: it calls the stages that the frame is made of, and tells the seconds of each.

A frame is written once, as calls `clock.one(part, function, arguments, **static)` of jitted functions. Of arrays each is a
compiled program of its own; under a trace it is a part of the program that is traced.

Where a program is missing it is not compiled alone: the whole frame is traced ahead, by shapes, so that all its programs are
compiled side by side, as XLA takes one core for each.
"""

from __future__ import annotations

import functools
import operator
import time
from collections.abc import Callable, Hashable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.sharding import Mesh, NamedSharding
from jax.sharding import PartitionSpec as Spec
from jaxtyping import Array, Int

from jaxsph.engine.runtime.devices import over_mesh
from jaxsph.engine.runtime.programs import PROGRAMS, Programs, barriers_of, place_of, shapes_of, stage
from jaxsph.numerics.checks import Progress, array_of

KEPT = "light"  # name of what is not to be made again where a band is, see `jax.checkpoint`
Made = TypeVar("Made")


class Clock:
    """Calls stages, and books the seconds of each, compile time apart.

    Attributes:
        seconds: of each part of a frame so far.
        mesh: of the devices that share the frame; None where arrays are on one.
        traced: whether stages are parts of a larger program, whose arrays are not known yet.
    """

    def __init__(
        self,
        mesh: Mesh | None = None,
        *,
        traced: bool = False,
        progress: Progress | None = None,
        programs: Programs = PROGRAMS,
    ) -> None:
        self.seconds = {"plan": 0.0, "compile": 0.0, "grid": 0.0, "adapt": 0.0, "cast": 0.0, "image": 0.0}
        self.mesh, self.traced = mesh, traced
        self._progress, self._programs = progress, programs
        self._stops = False  # whether it is to stop where a program is missing
        self._ahead = False  # whether a frame is traced by shapes, ahead of being drawn
        self._place: jax.sharding.Sharding | None = None  # where its arrays are, if that was chosen
        self._last = time.perf_counter()

    def run(self, draw: Callable[..., Made], *arguments: Any, ahead: Callable[..., Any] | None = None) -> Made:
        """What `draw(*arguments)` makes; if any of its programs is missing, all that it runs, or `ahead`, are compiled first."""
        if self.traced:
            return draw(*arguments)
        self._stops = True
        try:
            return draw(*arguments)
        except _MissingProgram:
            self._stops = False
        finally:
            self._stops = False
        self._ahead = True
        try:
            jax.eval_shape(functools.partial(ahead or draw, *arguments))
        finally:
            self._ahead = False
        self.mark("compile")
        return draw(*arguments)

    def mark(self, part: str) -> None:
        """Book the time since the last mark."""
        now = time.perf_counter()
        self.seconds[part] += now - self._last
        self._last = now

    def report(self, done: int, total: int) -> None:
        """Tell how many bands are done."""
        if self._progress is not None and not self._ahead:
            self._progress(done, total)

    def one(self, part: str, function: Any, arguments: tuple[Any, ...], **static: Hashable) -> Any:
        """`function(*arguments, **static)`, for a part of the frame."""
        return self.each(part, function, [arguments], **static)[0]

    def each(self, part: str, function: Any, inputs: Sequence[tuple[Any, ...]], **static: Hashable) -> list[Any]:
        """The same for several arguments of the same shapes, each on a thread of its own."""
        if self.traced:  # not as jitted functions: JAX would keep what it traced of them, for every shape
            with barriers_of(static):
                return [function.__wrapped__(*arguments, **static) for arguments in inputs]
        program = self._programs.get(function, self._shapes_of(function, inputs[0], static), static)
        if self._ahead:
            return [_tracers_of(program.result) for _ in inputs]
        compiled = program.compiled.result()
        self.mark("compile")
        if len(inputs) == 1:
            results = [jax.block_until_ready(compiled(*inputs[0]))]
        else:
            with ThreadPoolExecutor(len(inputs)) as threads:
                results = list(threads.map(lambda arguments: jax.block_until_ready(compiled(*arguments)), inputs))
        self.mark(part)
        return results

    def program(self, part: str, function: Any, arguments: tuple[Any, ...], **static: Hashable) -> Callable[..., Any]:
        """The program of a function, for a part that is under way; to wait for it is booked apart."""
        program = self._programs.get(function, self._shapes_of(function, arguments, static), static)
        if not self._ahead:
            self.mark(part)
            program.compiled.result()
            self.mark("compile")
        return program

    def on_host(self, part: str, work: Callable[[], Any], shapes: Any) -> Any:
        """What the host makes, for a part that is under way; `shapes` are those of it."""
        if self._ahead:
            return _tracers_of(shapes)
        result = jax.block_until_ready(work())
        self.mark(part)
        return result

    def over(self, rows: Sequence[int], draw: Callable[[Int[Array, ""]], Made]) -> list[Made]:
        """All bands one after the other, each by the row of pixels that it begins at.

        Under a trace, in reverse mode, what led to a band is made again, as bands are there to spare memory.
        """
        if self.traced and len(rows) > 1:
            policy = jax.checkpoint_policies.save_only_these_names(KEPT)
            drawn = lax.map(jax.checkpoint(draw, prevent_cse=False, policy=policy), jnp.asarray(rows, jnp.int32))
            return _apart(drawn, len(rows))
        bands = []
        for number, row in enumerate(rows, 1):
            bands.append(draw(array_of(row, jnp.int32)))
            self.report(number, len(rows))
        return bands

    def replicated(self, tree: Any) -> Any:
        """Arrays as all devices of a mesh hold them; without one where they are."""
        if self.mesh is None or self.traced:
            return tree
        return jax.device_put(tree, NamedSharding(self.mesh, Spec()))

    def shared(self, draw: Callable[..., Made], *arguments: Any) -> Made:
        """`draw(*arguments, clock)`; over a mesh that is one program, which all of its devices run, each for its shard."""
        if self.mesh is None or self.traced:
            return draw(*arguments, self)
        drawn = self.one("cast", on_mesh, self.replicated(arguments), mesh=self.mesh, draw=draw)
        return jax.device_put(drawn, self.mesh.devices.flat[0])  # type: ignore[no-any-return]

    def num_shards(self, side_by_side: int) -> int:
        """Of a band: one for each device of a mesh, else as many as run side by side; under a trace one."""
        if self.mesh is not None:
            return self.mesh.size
        return 1 if self.traced else side_by_side

    def shards(self, number: int) -> list[Any]:
        """Numbers of the shards of a band that are run here: over a mesh, of that which this device has."""
        if self.mesh is not None:
            return [lax.axis_index(self.mesh.axis_names).astype(jnp.int32)]
        return [np.int32(nth) for nth in range(number)]

    def pooled(self, of_shards: list[Made]) -> list[Made]:
        """What was found of all shards, of what was found here."""
        if (mesh := self.mesh) is None:
            return of_shards
        return _apart(jax.tree.map(lambda leaf: lax.all_gather(leaf, mesh.axis_names), of_shards[0]), mesh.size)

    def turns(self, number: Int[Array, ""], together: int, most: int) -> tuple[int, int]:
        """In how many turns `number` things are done, and how many in each; where it is not known, with room for the `most`."""
        if self._ahead:
            return 1, together
        if self.traced:
            return 1, most
        return -(-int(number) // together), together

    def _shapes_of(self, function: Any, arguments: tuple[Any, ...], static: dict[str, Hashable]) -> tuple[Any, ...]:
        """Of the arguments of a program, which is at hand unless it is to be compiled now."""
        self._place = place_of(arguments) or (self._place if self._ahead else None)
        shapes = shapes_of(arguments, self._place)
        if self._stops and not self._programs.has(function, shapes, static):
            raise _MissingProgram
        return shapes  # type: ignore[no-any-return]


class _MissingProgram(Exception):
    """Nothing is run until what a frame needs is being compiled."""


@stage("mesh", "draw")
def on_mesh(*arguments: Any, mesh: Mesh, draw: Callable[..., Any]) -> Any:
    """See `Clock.shared`."""
    return over_mesh(mesh, lambda held: draw(*held, Clock(mesh, traced=True)), arguments)


def _tracers_of(shapes: Any) -> Any:
    """Arrays of those shapes, within the trace that is under way."""
    return jax.tree.map(lambda one: jnp.zeros(one.shape, one.dtype), shapes)


def _apart(tree: Any, number: int) -> list[Any]:
    """The first so many along the first axis, one by one."""
    return [jax.tree.map(operator.itemgetter(nth), tree) for nth in range(number)]
