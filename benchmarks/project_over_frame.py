"""Claim: on CPUs a projection of 32 k periodic particles with pixel means takes at most 5 times as long as a full-rate frame.

At 512 x 512 along z, compiled, in turns in one process; of a random uniform set, and of the particle files that are named:

    frame      `render`, 256 samples a ray, nothing adapted;
    mean, ray  `project` with either rule of pixels.

The camera sees the whole period, whose columns need no images along rays. Recorded for the uniform set only.

Writes `results/project_over_frame.json`; ends in an assert.

    python benchmarks/project_over_frame.py [FILE ...] [--size 512] [--repeats 3] [--check]
"""

from __future__ import annotations

import argparse
import json
import pathlib
import statistics
import time
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from kept import keep

import jaxsph as js
from jaxsph.analysis.projection.plan import plan_projection

MOST, COUNT, SUPPORT, SAMPLES = 5.0, 32768, 0.05, 256
RESULTS = pathlib.Path(__file__).with_name("results") / "project_over_frame.json"


def uniform() -> js.Particles:
    """A periodic box of random places."""
    rng = np.random.default_rng(0)
    position, quantity = rng.uniform(0, 1, (COUNT, 3)), rng.uniform(0, 1, COUNT)
    return js.Particles.from_arrays(position, SUPPORT, quantity, 1 / COUNT, "cubic_spline", box=(1, 1, 1))


def contenders(particles: js.Particles, size: int) -> dict[str, Callable[[], Any]]:
    """What is timed, with its plan made."""
    camera = js.Camera.along_axis(particles, "z", size, size)
    low, high = (float(end) for end in np.quantile(particles.to_numpy()["quantity"], [0, 1]))
    depth = float(camera.far - camera.near)
    look = js.TransferFunction.from_points([low, high], [[0.1, 0.2, 0.9], [0.9, 0.3, 0.1]], [1 / depth, 2 / depth])
    scene, settings = js.Scene(particles=particles, transfer=look), js.Settings(samples=SAMPLES)
    found: dict[str, Callable[[], Any]] = {"frame": lambda: js.render(scene, camera, settings).color}
    for rule in ("mean", "ray"):
        plan = plan_projection(particles, camera, pixel=rule)
        found[rule] = lambda rule=rule, plan=plan: js.project(particles, camera, pixel=rule, plan=plan).values  # type: ignore[misc]
    return found


def measured(particles: js.Particles, options: argparse.Namespace) -> dict[str, float]:
    """Median seconds of each, the first turn left out, and means over the frame."""
    runs = contenders(particles, options.size)
    seconds: dict[str, list[float]] = {name: [] for name in runs}
    for _ in range(options.repeats + 1):
        for name, run in runs.items():
            started = time.perf_counter()
            jax.block_until_ready(run())
            seconds[name].append(time.perf_counter() - started)
    found = {name: statistics.median(each[1:]) for name, each in seconds.items()}
    return found | {"mean over frame": found["mean"] / found["frame"], "ray over frame": found["ray"] / found["frame"]}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("files", nargs="*", metavar="FILE")
    parser.add_argument("--size", type=int, default=512)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--check", action="store_true", help="do not write results")
    options = parser.parse_args()
    found: dict[str, Any] = {}
    sets = {"uniform": uniform}
    for path in options.files:
        sets[pathlib.Path(path).name] = lambda path=path: js.io.particles_from_table(js.io.read_table(path), "x")[0]  # type: ignore[misc]
    for name, made in sets.items():
        found[name] = measured(made(), options)
        print(name, json.dumps(found[name]), flush=True)
    if not options.check:
        keep(RESULTS, ("frame", "mean", "ray"), size=options.size, sets=found)
    assert all(each["mean over frame"] <= MOST for each in found.values()), found


if __name__ == "__main__":
    main()
