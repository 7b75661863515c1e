"""Claim: to find which particles touch which rays takes less than a fifth of a frame at full rate.

A filled cube of 97,336 and of 1,000,000 particles in random order, 512 x 512 pixels, 256 samples; particles as they are, and
prepared (`jaxsph.prepare`); with the host sorting and picking, and with all of it left to XLA. Every contender has its turn in
every round; stages are timed one by one, and beside them whole frames. Seconds of the processor tell more than those of the
clock where other processes are at work. Writes `results/access.json`; ends in an assert on medians.

    python benchmarks/access.py [--repeats 7] [--check]
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import pathlib
import statistics
import time
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import workloads

import jaxsph as js
from jaxsph.engine.frame.stages import grid_of, ordered_of
from jaxsph.engine.planning.fit import demanded, see, shape_of
from jaxsph.engine.request import Request
from jaxsph.engine.runtime.executors import Eager
from jaxsph.trade.sweep import of_this_run

SIDES = workloads.CUBE, 100
ACCESS = "view", "measure and sort", "order", "lists"
MOST = 0.2  # of a frame at full rate
RESULTS = pathlib.Path(__file__).with_name("results") / "access.json"


class Stages:
    """Access of one contender, stage by stage."""

    def __init__(self, scene: js.Scene, camera: js.Camera, settings: js.Settings, on_host: bool) -> None:
        self.scene, self.camera, self.settings = scene, camera, settings
        plan = js.plan(scene, camera, settings)
        tuning = dataclasses.replace(plan.cast.tuning, sorts_on_host=on_host)
        self.plan = plan if on_host else js.plan(scene, camera, settings, tuning=tuning)
        self.tuning, self.seconds, self.cpu = tuning, {}, {}

    def turn(self) -> None:
        """Time all stages once."""
        plan, camera, run = self.plan, self.camera, Eager()
        asked = Request.of(self.scene, camera, self.settings)
        shape = dataclasses.replace(shape_of(asked), tuning=self.tuning)
        seen = self._timed("view", lambda: see(asked.scene, asked.camera, plan, run))
        seen, _ = self._timed("measure and sort", lambda: demanded(seen, asked, shape))
        cells = {"samples": plan.samples, "slab_samples": plan.cast.slab_samples, "between_samples": False}
        ordered = self._timed("order", lambda: ordered_of(run, seen.viewed, camera, self.tuning, seen.order, **cells))
        given = run, ordered, camera, jnp.int32(0), plan.lists, self.tuning
        self._timed("lists", lambda: grid_of(*given, samples=plan.samples, beside=False))
        image = self._timed("frame", lambda: js.render(self.scene, camera, self.settings, plan=plan))
        self.seconds.setdefault("cast", []).append(image.stats["seconds"]["cast"])

    def medians(self) -> dict[str, float]:
        """Of seconds by the clock and, as `cpu`, by the processor."""
        found = {name: statistics.median(times[1:]) for name, times in self.seconds.items()}
        found["access"] = sum(found[name] for name in ("view", "measure and sort", "order", "lists"))
        found["cpu access"] = sum(
            statistics.median(self.cpu[name][1:]) for name in ("view", "measure and sort", "order", "lists")
        )
        return found

    def _timed(self, name: str, stage: Callable[[], Any]) -> Any:
        started, used = time.perf_counter(), time.process_time()
        result = stage()
        self.seconds.setdefault(name, []).append(time.perf_counter() - started)
        self.cpu.setdefault(name, []).append(time.process_time() - used)
        return result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--check", action="store_true", help="fail where access takes too large a share of a frame")
    arguments = parser.parse_args()
    found: dict[str, dict[str, dict[str, float]]] = {}
    for side in SIDES:
        work = workloads.cube(side)
        scene, camera, settings = work.scene("poly6"), work.camera(), js.Settings(samples=work.samples)
        prepared = dataclasses.replace(scene, particles=js.prepare(scene.particles))
        contenders = {
            "as given": Stages(scene, camera, settings, on_host=True),
            "prepared": Stages(prepared, camera, settings, on_host=True),
            "by XLA alone": Stages(scene, camera, settings, on_host=False),
        }
        for _ in range(1 + arguments.repeats):  # the first compiles
            for contender in contenders.values():
                contender.turn()
        found[work.name] = {name: contender.medians() for name, contender in contenders.items()}
        for name, row in found[work.name].items():
            print(
                f"{work.name:13s} {name:13s} " + "  ".join(f"{stage} {1e3 * t:.1f}" for stage, t in row.items()) + " ms",
                flush=True,
            )
    RESULTS.parent.mkdir(exist_ok=True)
    RESULTS.write_text(json.dumps({"run": of_this_run(), "repeats": arguments.repeats, "medians": found}, indent=1) + "\n")
    if arguments.check:
        shares = {name: rows["as given"]["access"] / rows["as given"]["frame"] for name, rows in found.items()}
        assert max(shares.values()) <= MOST, shares


if __name__ == "__main__":
    main()
