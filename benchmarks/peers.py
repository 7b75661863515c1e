"""Claim: at full rate a frame costs about what a hand-vectorised Numba packet marcher takes, and less where space is empty.

Both render the same particles in one process, in turns; compile time is apart. `jaxsph` is grid + cast; the marcher is its grid
build + march. Its samples are uniform in depth and ours geometric, so images differ by the discretisation and are compared
loosely. Beside them stands a frame of the pilot estimator, whose analysis counts as cast. Writes `results/peers.json`; ends in
asserts on the ratios of medians.

    python benchmarks/peers.py [--repeats 5] [--check]
"""

from __future__ import annotations

import argparse
import pathlib
import resource
import statistics
import sys
import time
from typing import Any

import numpy as np

sys.path.insert(0, str(pathlib.Path(__file__).parent))
import numba_marcher
import workloads
from kept import keep

import jaxsph as js

LIMITS = {"cube 97336": 1.5, "cube 1000000": 1.5, "dam break": 0.8}
TOLERANCE = 0.004
KERNELS, STEPS = ("poly6", "cubic_spline"), (4, 2)  # of supports, and of packets of rays
PILOT = f"pilot {TOLERANCE} poly6"
PAUSE = 0.5  # seconds between turns: OpenMP threads spin for some 0.2 s after a march, on the next contender's cores
RESULTS = pathlib.Path(__file__).parent / "results" / "peers.json"


def peer(load: workloads.Workload, kernel: str, steps: int):
    """The marcher as a function of no arguments: grid build and march, (seconds of both, image)."""
    render = numba_marcher.marcher(kernel, steps)
    position = np.ascontiguousarray(load.position)
    origin = position.min(0) - np.float32(1e-4 * load.support)
    cells = tuple(int(n) for n in np.floor((position.max(0) - origin) / load.support).astype(int) + 3)
    support, eye = np.float32(load.support), np.array(load.eye, np.float32)
    view = (load.half, load.near, load.far)

    def frame(size: int = load.size, samples: int = load.samples):
        started = time.perf_counter()
        start, columns = numba_marcher.build(position, support, load.quantity, origin, cells)
        built = time.perf_counter()
        image = render(start, columns, support, origin, cells, load.table, eye, *view, size, samples)
        return built - started, time.perf_counter() - built, image

    started = time.perf_counter()
    frame(64, 16)
    return frame, time.perf_counter() - started


def ours(load: workloads.Workload, kernel: str, **control: Any):
    scene, camera, settings = load.scene(kernel), load.camera(), js.Settings(samples=load.samples, **control)
    started = time.perf_counter()
    plan = js.plan(scene, camera, settings)
    image = js.render(scene, camera, settings, plan=plan)
    first = time.perf_counter() - started

    def frame():
        image = js.render(scene, camera, settings, plan=plan)
        seconds = image.stats["seconds"]
        return seconds["grid"], seconds["adapt"] + seconds["cast"], image

    return frame, {"first_frame": first, "compile": image.stats["seconds"]["compile"], "plan": plan}


def measure(load: workloads.Workload, kernels: list[str], repeats: int) -> list[dict]:
    contenders, compile_seconds, notes = {}, {}, {}
    for kernel in kernels:
        name = f"jaxsph {kernel}"
        contenders[name], notes[name] = ours(load, kernel)
        compile_seconds[name] = notes[name]["compile"]
        for steps in STEPS:
            name = f"numba 8x{steps} {kernel}"
            contenders[name], compile_seconds[name] = peer(load, kernel, steps)
    contenders[PILOT], notes[PILOT] = ours(load, "poly6", tolerance=TOLERANCE, estimator="pilot")
    compile_seconds[PILOT] = notes[PILOT]["compile"]
    times: dict[str, list[tuple[float, float]]] = {name: [] for name in contenders}
    images = {}
    for _ in range(repeats):
        for name, frame in contenders.items():
            time.sleep(PAUSE)
            grid, cast, images[name] = frame()
            times[name].append((grid, cast))
    records = []
    for name, pairs in times.items():
        grid, cast = (statistics.median(column) for column in zip(*pairs, strict=True))
        total = statistics.median(sum(pair) for pair in pairs)
        record = {"workload": load.name, "contender": name, "grid": grid, "cast": cast, "total": total}
        record |= {"compile": compile_seconds[name], "peak_resident_gb": peak_memory()}
        if name in notes:
            image = images[name]
            record |= {"first_frame": notes[name]["first_frame"], "evaluations": image.stats["evaluations"]}
            record |= {"planned_gb": notes[name]["plan"].bytes / 2**30, "grid_share": grid / total}
            record |= {"g_evaluations_per_second": image.stats["evaluations"] / cast / 1e9}
        records.append(record)
    agree(images, kernels)
    return records


def agree(images: dict, kernels: list[str]) -> None:
    """The contenders see the same scene: mean colour to 1 %."""
    for kernel in kernels:
        ours, theirs = np.asarray(images[f"jaxsph {kernel}"].color), images[f"numba 8x4 {kernel}"][..., :3]
        assert np.abs(ours.mean((0, 1)) - theirs.mean((0, 1))).max() < 0.01, (ours.mean((0, 1)), theirs.mean((0, 1)))
        assert np.abs(ours - theirs).mean() < 0.02, np.abs(ours - theirs).mean()


def peak_memory() -> float:
    """Of the whole process so far, GiB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20


def ratios(records: list[dict]) -> dict[str, dict[str, float]]:
    """Our median over the best peer's: with the kernel each is given by default, and kernel for kernel."""
    table: dict[str, dict[str, float]] = {}
    for load in dict.fromkeys(record["workload"] for record in records):
        total = {record["contender"]: record["total"] for record in records if record["workload"] == load}
        best = {
            k: min(t for name, t in total.items() if name.startswith("numba") and name.endswith(k))
            for k in ("cubic_spline", "poly6")
        }
        table[load] = {
            "poly6 / peer with cubic spline": total["jaxsph poly6"] / best["cubic_spline"],
            "poly6 / peer with poly6": total["jaxsph poly6"] / best["poly6"],
            f"{PILOT} / peer with cubic spline": total[PILOT] / best["cubic_spline"],
            "cubic spline / peer with cubic spline": total["jaxsph cubic_spline"] / best["cubic_spline"],
        }
    return table


def variants() -> list[str]:
    """Names of all that is compared."""
    return [f"{who} {kernel}" for kernel in KERNELS for who in ("jaxsph", *(f"numba 8x{steps}" for steps in STEPS))] + [PILOT]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--check", action="store_true", help="fail where a ratio is over its limit")
    arguments = parser.parse_args()
    records = []
    for load in (workloads.cube(workloads.CUBE), workloads.cube(100), workloads.dam_break()):
        found = measure(load, list(KERNELS), arguments.repeats)
        records += found
        for record in found:
            rate = f"{record['g_evaluations_per_second']:5.1f} G/s" if "evaluations" in record else ""
            print(
                f"{record['workload']:13s} {record['contender']:24s} grid {record['grid']:.3f}  cast {record['cast']:.3f}"
                f"  total {record['total']:.3f} s  compile {record['compile']:.1f} s  {rate}",
                flush=True,
            )
    table = ratios(records)
    for load, row in table.items():
        print(f"{load:13s} " + "   ".join(f"{name}: {value:.2f}" for name, value in row.items()))
    keep(RESULTS, [record["contender"] for record in records], packages=["numba"], ratios=table, records=records)
    over = {load: row for load, row in table.items() if row["poly6 / peer with cubic spline"] > LIMITS[load]}
    if arguments.check:
        assert not over, over
        assert all(record["compile"] < 10 for record in records if record["contender"].startswith("jaxsph"))


if __name__ == "__main__":
    main()
