"""Claim: the pilot estimator saves several times the evaluations, and its estimate holds.

At most one pixel in 100,000 is over the tolerance, and none over twice. Full rate and the pilot estimator render the same scene
in one process, in turns; compile time is apart. `estimate to error` is the estimated over the true error of pixels that differ
from full rate. Writes `results/pilot.json`; ends in asserts on errors, as times and savings are for reading.

    python benchmarks/pilot.py [--repeats 5] [--sizes 256 512 1024] [--scenes mixer radial]
"""

from __future__ import annotations

import argparse
import json
import pathlib
import sys

sys.path.insert(0, str(pathlib.Path(__file__).parent))
import peers
import tolerance
import workloads

import jaxsph as js

CUBE = 46  # particles along an edge of the peers' filled cube
SCENES = ("mixer", "radial", "checker_board", "dam_break", "cube")
MOST_OVER = 1e-5  # share of pixels
RESULTS = peers.RESULTS.with_name("pilot.json")
HEADER = "scene           size tolerance  saved full/frame max error     over estimate to error (1, 50, 99 %)"


def contenders() -> dict[tuple[str, float | None], js.Settings]:
    """Settings by variant and tolerance, full rate first."""
    pilots = {("pilot", limit): js.Settings(tolerance=limit, estimator="pilot") for limit in tolerance.TOLERANCES}
    return {(tolerance.FULL_RATE, None): js.Settings()} | pilots


def load(name: str, size: int) -> tuple[js.Scene, js.Camera]:
    if name == "cube":
        work = workloads.cube(CUBE, size=size)
        return work.scene("poly6"), work.camera()
    return js.scenes.load(name, width=size, height=size)


def row(record: dict) -> str:
    """Of the printed table, under HEADER."""
    ratios = " ".join(f"{ratio:.3g}" for ratio in record["estimate_to_error"] or [])
    return (
        f"{record['scene']:14s} {record['size']:5d} {record['tolerance']:9g} {record['evaluations_saved']:6.2f} "
        f"{1 / record['total_to_full']:10.2f} {record['max_error']:9.6f} {record['pixels_over_tolerance']:8.1e} {ratios}"
    )


def keeps_its_word(record: dict) -> bool:
    return record["pixels_over_tolerance"] <= MOST_OVER and record["max_error"] <= 2 * record["tolerance"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--sizes", type=int, nargs="+", default=[256, 512, 1024], help="pixels on a side")
    parser.add_argument("--scenes", nargs="+", choices=SCENES, default=SCENES)
    arguments = parser.parse_args()
    records = []
    print(HEADER)
    for size in arguments.sizes:
        for name in arguments.scenes:
            scene, camera = load(name, size)
            found = tolerance.measure(name, scene, camera, arguments.repeats, contenders())
            found = [record | {"size": size} for record in found if record["tolerance"] is not None]
            print("\n".join(row(record) for record in found), flush=True)
            records += found
    RESULTS.parent.mkdir(exist_ok=True)
    RESULTS.write_text(
        json.dumps({"machine": peers.machine(), "repeats": arguments.repeats, "records": records}, indent=1) + "\n"
    )
    broken = [row(record) for record in records if not keeps_its_word(record)]
    assert not broken, "\n".join(["over the tolerance:", HEADER, *broken])


if __name__ == "__main__":
    main()
