"""Claim: a hundred snapshots whose number of particles drifts by a fifth compile three times at most, and capacities cost little.

Particles of the mixer, as many as each snapshot has, from one camera. A frame that takes a kept plan, its particles padded to a
class, is measured in turns with one that is planned for it to the particle. Writes `results/snapshots.json`.

    python benchmarks/snapshots.py [--repeats 7] [--check]
"""

from __future__ import annotations

import argparse
import pathlib
import statistics
import time

import numpy as np
from kept import keep

import jaxsph as js
from jaxsph.engine.runtime.programs import PROGRAMS

SNAPSHOTS, FIRST, DRIFT = 100, 20_000, 0.2
SETTINGS = {"full rate": {}, "pilot": {"tolerance": 0.004, "estimator": "pilot"}}
MAX_COMPILED, MAX_RATIO = 3, 1.15
COMPARED = 5  # snapshots, spread over the sequence, that are also rendered with a plan of their own: each compiles
RESULTS = pathlib.Path(__file__).parent / "results" / "snapshots.json"


def snapshot(nth: int, capacity: bool = True) -> tuple[js.Scene, js.Camera]:
    """The `nth` of the sequence, in arrays of a class or of just its size."""
    count = int(FIRST * (1 + DRIFT * nth / (SNAPSHOTS - 1)))
    scene, camera = js.scenes.load("mixer", particles=count)
    if capacity:
        return scene, camera
    exact = js.Particles.from_arrays(**scene.particles.to_numpy(), kernel=scene.particles.kernel, capacity=count)
    return js.Scene(particles=exact, transfer=scene.transfer), camera


def sequence(settings: js.Settings, camera: js.Camera) -> list[bool]:
    """Of each snapshot, whether anything was compiled for it."""
    begun: list[int] = []
    compiled = []
    PROGRAMS.on_compile = lambda: begun.append(1)
    for nth in range(SNAPSHOTS):
        before = len(begun)
        js.render(snapshot(nth)[0], camera, settings)
        compiled.append(len(begun) > before)
    PROGRAMS.on_compile = None
    return compiled


def against_exact(settings: js.Settings, camera: js.Camera, repeats: int) -> list[float]:
    """Seconds with a kept plan over seconds with an exact one, of some snapshots: medians of turns."""
    ratios = []
    for nth in np.linspace(0, SNAPSHOTS - 1, COMPARED).astype(int):
        kept, exact = snapshot(nth)[0], snapshot(nth, capacity=False)[0]
        plan = js.plan(exact, camera, settings)
        times: dict[str, list[float]] = {"kept": [], "exact": []}
        for turn in range(repeats + 1):
            for name, scene, given in (("kept", kept, None), ("exact", exact, plan)):
                started = time.perf_counter()
                js.render(scene, camera, settings, plan=given)
                if turn:
                    times[name].append(time.perf_counter() - started)
        ratios.append(statistics.median(times["kept"]) / statistics.median(times["exact"]))
    return ratios


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--check", action="store_true", help="fail where a figure is over its limit")
    arguments = parser.parse_args()
    camera, found = snapshot(0)[1], {}
    for name, given in SETTINGS.items():
        settings = js.Settings(**given)
        compiled, ratios = sequence(settings, camera), against_exact(settings, camera, arguments.repeats)
        found[name] = {"compiled": sum(compiled), "ratios": ratios}
        said = " ".join(f"{ratio:.3f}" for ratio in ratios)
        print(f"{name:10s} {sum(compiled)} of {SNAPSHOTS} snapshots compiled; kept over exact plan {said}", flush=True)
    keep(RESULTS, SETTINGS, settings=found)
    if arguments.check:
        assert all(row["compiled"] <= MAX_COMPILED and max(row["ratios"]) <= MAX_RATIO for row in found.values()), found


if __name__ == "__main__":
    main()
