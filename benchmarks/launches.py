"""Claim: tuned for accelerators, a frame of a million particles at 1024 x 1024 x 256 samples starts at most 3,000 kernels.

An accelerator takes microseconds to start a kernel, however little it does. Counted is what XLA's CPU backend executes for the
same programs, by its profiler: every kernel, copy and sort, also those of a loop's counter. What holds kernels (loops,
branches) is counted apart. Another backend fuses otherwise, but goes through the same loops.
The same frame with the tuning for CPUs is counted with --both. Writes `results/launches.json`.

    python benchmarks/launches.py [--particles 1000000] [--size 1024] [--samples 256] [--both]
"""

from __future__ import annotations

import argparse
import collections
import dataclasses
import pathlib
import re
import tempfile
import time
from collections.abc import Callable, Hashable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import workloads
from kept import keep

import jaxsph as js
from jaxsph.engine.frame.frame import Frame
from jaxsph.engine.planning.fit import see
from jaxsph.engine.render import draw
from jaxsph.engine.request import Request
from jaxsph.engine.runtime.clock import Clock
from jaxsph.engine.runtime.tuning import ACCELERATOR, CPU, Tuning

MOST = 3_000
MEMORY = 16 << 30  # bytes that a plan may take: in one band
UNWRITTEN = 0.1  # seconds after which the profiler has the last kernels of a program
HOLDS = re.compile(r"(while|cond|conditional|call)\b")
TUNINGS = {"accelerator": ACCELERATOR, "cpu": CPU}
RESULTS = pathlib.Path(__file__).with_name("results") / "launches.json"


class Counted(Clock):
    """Runs stages as they are and counts what each executes, by name."""

    def __init__(self) -> None:
        super().__init__(traced=True)
        self.kernels: dict[str, collections.Counter[str]] = {}

    def one(self, stage: str, function: Any, arguments: tuple[Any, ...], **static: Hashable) -> Any:
        def program(*arguments: Any) -> Any:
            return function.__wrapped__(*arguments, **static)

        compiled = jax.jit(program).lower(*arguments).compile()
        instructions = set(re.findall(r"%([\w.\-]+) = ", compiled.as_text()))
        result, executed = traced(lambda: compiled(*arguments), instructions)
        self.kernels.setdefault(function.__name__, collections.Counter()).update(executed)
        return result

    def each(self, stage: str, function: Any, inputs: Sequence[tuple[Any, ...]], **static: Hashable) -> list[Any]:
        return [self.one(stage, function, arguments, **static) for arguments in inputs]

    def over(self, rows: Sequence[int], draw: Callable[[Any], Any]) -> list[Any]:
        return [draw(jnp.int32(row)) for row in rows]


def traced(run: Callable[[], Any], instructions: set[str]) -> tuple[Any, collections.Counter[str]]:
    """A program's result, and how often it executed each of its instructions, on whatever threads."""
    with tempfile.TemporaryDirectory() as folder:
        with jax.profiler.trace(folder):
            result = jax.block_until_ready(run())
            time.sleep(UNWRITTEN)
        (path,) = pathlib.Path(folder).rglob("*.xplane.pb")
        planes = jax.profiler.ProfileData.from_file(str(path)).planes
        names = [event.name for plane in planes for line in plane.lines for event in line.events]
    return result, collections.Counter(name for name in names if name in instructions)


def frame(scene: js.Scene, camera: js.Camera, samples: int, tuning: Tuning) -> dict[str, Any]:
    """Launches of each stage of a frame at full rate, all bundles in one shard."""
    settings = js.Settings(samples=samples, memory_limit=MEMORY)
    plan, clock, asked = js.plan(scene, camera, settings, tuning=tuning), Counted(), Request.of(scene, camera, settings)
    seen = see(asked.scene, asked.camera, plan, clock)
    draw(Frame.of(asked, plan, seen, clock), clock)
    stages = {stage: counts(executed) for stage, executed in clock.kernels.items()}
    total = {kind: sum(stage[kind] for stage in stages.values()) for kind in ("launches", "containers")}
    return {"tuning": dataclasses.asdict(tuning), "bands": plan.bands, **total, "stages": stages}


def counts(executed: collections.Counter[str]) -> dict[str, Any]:
    """Launches, containers, and how many kernels are launched how often."""
    kernels = {name: number for name, number in executed.items() if not HOLDS.match(name)}
    times = collections.Counter(kernels.values())
    launches = sum(kernels.values())
    return {"launches": launches, "containers": executed.total() - launches, "kernels_by_times": dict(sorted(times.items()))}


def variants() -> list[str]:
    """Names of all that is compared."""
    return list(TUNINGS)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--particles", type=int, default=1_000_000)
    parser.add_argument("--size", type=int, default=1024, help="pixels on a side")
    parser.add_argument("--samples", type=int, default=256)
    parser.add_argument("--both", action="store_true", help="count the same with the tuning for CPUs")
    arguments = parser.parse_args()
    work = workloads.cube(round(arguments.particles ** (1 / 3)), size=arguments.size, samples=arguments.samples)
    scene, camera = work.scene("poly6"), work.camera()
    frames = {}
    for name, tuning in list(TUNINGS.items())[: 2 if arguments.both else 1]:
        frames[name] = frame(scene, camera, arguments.samples, tuning)
        each = "  ".join(f"{stage} {found['launches']}" for stage, found in frames[name]["stages"].items())
        print(f"{name}: {frames[name]['launches']} launches, {frames[name]['containers']} containers; {each}", flush=True)
    size = {"particles": scene.particles.num_particles, "size": arguments.size, "samples": arguments.samples}
    keep(RESULTS, frames, workload=work.name, **size, frames=frames)
    launches = frames["accelerator"]["launches"]
    assert launches <= MOST, f"{launches} launches"


if __name__ == "__main__":
    main()
