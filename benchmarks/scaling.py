"""Claim: cost grows no faster than linearly with particles and with pixels.

One scene, first with more and more particles at a fixed image, then with more and more pixels at a fixed number of particles;
at full rate and at a tolerance. The exponent is the slope of log time over log number, by least squares; compile time and plans
are apart. Writes `results/scaling.json`; ends in asserts on the exponents.

    python benchmarks/scaling.py [--repeats 3] [--scene checker_board]
"""

from __future__ import annotations

import argparse
import pathlib
import statistics
import sys

import numpy as np

sys.path.insert(0, str(pathlib.Path(__file__).parent))
import peers
import tolerance
from kept import keep

import jaxsph as js

PARTICLES = (30_000, 100_000, 300_000, 1_000_000, 3_000_000)
PIXELS = (128, 256, 512, 1024, 2048)  # on a side
PARTICLES_SHOWN, PIXELS_SHOWN = 100_000, 256  # while the other one grows
SETTINGS = {
    "full rate": js.Settings(),
    "interval 0.004": js.Settings(integrator="samples", tolerance=0.004),
    "pilot 0.004": js.Settings(tolerance=0.004, estimator="pilot"),
}
MOST = 1.0  # exponent
RESULTS = peers.RESULTS.with_name("scaling.json")


def measure(scene: js.Scene, camera: js.Camera, repeats: int) -> dict[str, dict[str, float]]:
    """Median seconds of every stage and in all, by setting; they take turns."""
    plans = {name: js.plan(scene, camera, settings) for name, settings in SETTINGS.items()}
    for name, settings in SETTINGS.items():
        js.render(scene, camera, settings, plan=plans[name])
    turns: dict[str, list[dict[str, float]]] = {name: [] for name in SETTINGS}
    for _ in range(repeats):
        for name, settings in SETTINGS.items():
            seconds = js.render(scene, camera, settings, plan=plans[name]).stats["seconds"]
            turns[name].append({stage: seconds[stage] for stage in tolerance.STAGES})
    found = {}
    for name, all_turns in turns.items():
        stages = {stage: statistics.median(turn[stage] for turn in all_turns) for stage in tolerance.STAGES}
        found[name] = stages | {"total": statistics.median(sum(turn.values()) for turn in all_turns)}
    return found


def exponent(records: list[dict], number: str, name: str) -> float:
    """Slope of log time over log number."""
    counts, seconds = zip(*((record[number], record["seconds"][name]["total"]) for record in records), strict=True)
    return float(np.polyfit(np.log(counts), np.log(seconds), 1)[0])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--scene", default="checker_board", choices=js.scenes.names())
    parser.add_argument("--particles", type=int, nargs="+", default=PARTICLES)
    parser.add_argument("--sizes", type=int, nargs="+", default=PIXELS)
    arguments = parser.parse_args()
    views = {"particles": [(n, PIXELS_SHOWN) for n in arguments.particles]}
    views["pixels"] = [(PARTICLES_SHOWN, size) for size in arguments.sizes]
    tables, exponents = {}, {}
    for number, frames in views.items():
        print(f"{number:>10s} " + " ".join(f"{name:>15s}" for name in SETTINGS))
        tables[number] = []
        for count, size in frames:
            scene, camera = js.scenes.load(arguments.scene, count, width=size, height=size)
            seconds = measure(scene, camera, arguments.repeats)
            tables[number].append({"particles": scene.particles.num_particles, "pixels": size**2, "seconds": seconds})
            totals = " ".join(f"{seconds[name]['total']:15.3f}" for name in SETTINGS)
            print(f"{tables[number][-1][number]:10d} {totals}", flush=True)
        exponents[number] = {name: exponent(tables[number], number, name) for name in SETTINGS}
        print(f"{'exponent':>10s} " + " ".join(f"{exponents[number][name]:15.2f}" for name in SETTINGS), flush=True)
    asked = {"scene": arguments.scene, "repeats": arguments.repeats}
    keep(RESULTS, SETTINGS, **asked, exponents=exponents, tables=tables)
    steep = [(number, name) for number, found in exponents.items() for name, slope in found.items() if slope > MOST]
    assert not steep, f"grows faster than linearly: {steep}"


if __name__ == "__main__":
    main()
