"""The clock of a frame runs its stages, and books the seconds that each part of the frame takes.

A frame is written once, as calls `clock.one(part, function, arguments, **static)` of stages. A clock runs these in three ways:

    with arrays     each stage is a compiled program (`programs`), whose seconds are booked under the part
    ahead           by shapes alone: stages are traced and compiled, and return zeros of their result's shapes
    under a trace   `traced`: the body of each stage becomes a part of what is traced; nothing is booked

`run` tries the first. Where a program is missing it stops, goes through the whole frame ahead, so that all of its programs are
compiled side by side (XLA takes one core for each), and then runs it.

Over a mesh, `on_all_devices` makes one program of several stages, within which a second clock traces: see `on_mesh`.
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
from jax.sharding import Mesh, NamedSharding, PartitionSpec as Spec
from jaxtyping import Array, Int

from jaxsph.engine.runtime.devices import over_mesh
from jaxsph.engine.runtime.programs import PROGRAMS, Programs, barriers_of, place_of, shapes_of, stage
from jaxsph.numerics.checks import Progress, array_of

CHECKPOINT_NAME = "light"  # name of what reverse mode keeps of a band that it computes again, see `jax.checkpoint`
Result = TypeVar("Result")


class Clock:
    """Runs stages, and books the seconds of each; time to compile is booked apart.

    Attributes:
        seconds: of each part of a frame so far; the parts are the keys.
        mesh: the devices that share the frame; None where its arrays are on one.
        traced: whether a trace is under way that the stages are parts of, so that no values are known.
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
        self._stops = False  # whether a stage whose program is missing raises `_MissingProgram`
        self._ahead = False  # whether the frame is traced by shapes, to compile its programs
        self._place: jax.sharding.Sharding | None = None  # where arrays are, if that was chosen for any
        self._last = time.perf_counter()

    def run(self, draw: Callable[..., Result], *arguments: Any, ahead: Callable[..., Any] | None = None) -> Result:
        """Run `draw(*arguments)`; if a program is missing, first have all programs compiled that `ahead` runs, or else `draw`."""
        if self.traced:
            return draw(*arguments)
        self._stops = True
        try:
            return draw(*arguments)
        except _MissingProgram:
            pass
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
        """Book the time since the last mark under a part."""
        now = time.perf_counter()
        self.seconds[part] += now - self._last
        self._last = now

    def report(self, done: int, total: int) -> None:
        """Call the user's `progress` with the number of bands that are done."""
        if self._progress is not None and not self._ahead:
            self._progress(done, total)

    def one(self, part: str, function: Any, arguments: tuple[Any, ...], **static: Hashable) -> Any:
        """Run one stage, `function(*arguments, **static)`, and book its time under `part`."""
        return self.each(part, function, [arguments], **static)[0]

    def each(self, part: str, function: Any, inputs: Sequence[tuple[Any, ...]], **static: Hashable) -> list[Any]:
        """Run one stage for several inputs of the same shapes, each on a thread of its own, as the shards of a band."""
        if self.traced:  # `__wrapped__` is not jitted: JAX would cache a trace of it for every shape
            with barriers_of(static):
                return [function.__wrapped__(*arguments, **static) for arguments in inputs]
        program = self._programs.get(function, self._shapes_of(function, inputs[0], static), static)
        if self._ahead:
            return [_zeros_of(program.result) for _ in inputs]
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
        """The program of a stage that the host calls within `on_host`; the time to wait for it is booked as compiling."""
        program = self._programs.get(function, self._shapes_of(function, arguments, static), static)
        if not self._ahead:
            self.mark(part)
            program.compiled.result()
            self.mark("compile")
        return program

    def on_host(self, part: str, work: Callable[[], Any], shapes: Any) -> Any:
        """Run `work` on the host, such as sorting, and book its time under `part`; `shapes` are those of its result."""
        if self._ahead:
            return _zeros_of(shapes)
        result = jax.block_until_ready(work())
        self.mark(part)
        return result

    def over(self, rows: Sequence[int], draw: Callable[[Int[Array, ""]], Result]) -> list[Result]:
        """Run `draw(row)` for the first row of pixels of each band, one band after the other.

        Under a trace this is a loop whose bands are checkpointed: reverse mode computes a band again, to save memory.
        """
        if self.traced and len(rows) > 1:
            policy = jax.checkpoint_policies.save_only_these_names(CHECKPOINT_NAME)
            stacked = lax.map(jax.checkpoint(draw, prevent_cse=False, policy=policy), jnp.asarray(rows, jnp.int32))
            return _unstack(stacked, len(rows))
        bands = []
        for number, row in enumerate(rows, 1):
            bands.append(draw(array_of(row, jnp.int32)))
            self.report(number, len(rows))
        return bands

    def replicate(self, tree: Any) -> Any:
        """Put arrays on all devices of the mesh; without a mesh, or under a trace, leave them where they are."""
        if self.mesh is None or self.traced:
            return tree
        return jax.device_put(tree, NamedSharding(self.mesh, Spec()))

    def on_all_devices(self, draw: Callable[..., Result], *arguments: Any) -> Result:
        """Run `draw(*arguments, clock)`; with a mesh as one program, which every device runs for its own shard of a band."""
        if self.mesh is None or self.traced:
            return draw(*arguments, self)
        result = self.one("cast", on_mesh, self.replicate(arguments), mesh=self.mesh, draw=draw)
        return jax.device_put(result, self.mesh.devices.flat[0])  # type: ignore[no-any-return]

    def num_shards(self, side_by_side: int) -> int:
        """How many shards a band has: one for each device of a mesh; else `side_by_side` as threads, or one under a trace."""
        if self.mesh is not None:
            return self.mesh.size
        return 1 if self.traced else side_by_side

    def shards(self, number: int) -> list[Any]:
        """Numbers of the shards that are run here: all `number` of a band, or over a mesh the one of this device."""
        if self.mesh is not None:
            return [lax.axis_index(self.mesh.axis_names).astype(jnp.int32)]
        return [np.int32(nth) for nth in range(number)]

    def all_shards(self, of_shards: list[Result]) -> list[Result]:
        """Results of all shards of a band, given those of the shards that were run here; over a mesh devices exchange them."""
        if (mesh := self.mesh) is None:
            return of_shards
        return _unstack(jax.tree.map(lambda leaf: lax.all_gather(leaf, mesh.axis_names), of_shards[0]), mesh.size)

    def turns(self, number: Int[Array, ""], together: int, most: int) -> tuple[int, int]:
        """Divide `number` items into turns of `together`: how many turns there are, and how many items each of them has.

        Under a trace the number is not known, so there is one turn with room for the `most` that there can be.
        """
        if self._ahead:
            return 1, together
        if self.traced:
            return 1, most
        return -(-int(number) // together), together

    def _shapes_of(self, function: Any, arguments: tuple[Any, ...], static: dict[str, Hashable]) -> tuple[Any, ...]:
        """Shapes of the arguments of a stage; raises `_MissingProgram` if its program is missing and the clock stops for that."""
        self._place = place_of(arguments) or (self._place if self._ahead else None)
        shapes = shapes_of(arguments, self._place)
        if self._stops and not self._programs.has(function, shapes, static):
            raise _MissingProgram
        return shapes  # type: ignore[no-any-return]


class _MissingProgram(Exception):
    """Raised by the first stage whose program is missing, so that `Clock.run` compiles all programs before it runs any."""


@stage("mesh", "draw")
def on_mesh(*arguments: Any, mesh: Mesh, draw: Callable[..., Any]) -> Any:
    """The one stage of `Clock.on_all_devices`: `draw(*arguments, clock)` on every device, with a clock that traces."""
    return over_mesh(mesh, lambda inputs: draw(*inputs, Clock(mesh, traced=True)), arguments)


def _zeros_of(shapes: Any) -> Any:
    """Zeros of those shapes, which are tracers, as `Clock.run` has a trace under way."""
    return jax.tree.map(lambda one: jnp.zeros(one.shape, one.dtype), shapes)


def _unstack(tree: Any, number: int) -> list[Any]:
    """The first `number` entries along the first axis of all leaves, each as a tree of its own."""
    return [jax.tree.map(operator.itemgetter(nth), tree) for nth in range(number)]
