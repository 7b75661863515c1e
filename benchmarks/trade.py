"""Claim: what is certified is never over its tolerance, and what the pilot estimates hardly ever.

`jaxsph.sweep` measures every estimator at every tolerance, coarser sampling and smaller images for five scenes, those of the
Hochstetter et al. 2016's table 2. A folder of each scene under `results/trade/` holds its figures and the table, which is
measured on where an earlier run was stopped. Writes `results/trade.json`; ends in asserts on errors and bounds, as times are
for reading. Most of the time is compiling: some three minutes a scene on two busy cores.

    python benchmarks/trade.py [--repeats 3] [--size 512] [--scenes mixer radial] [--particles 50000] [--frames 0 2]
"""

from __future__ import annotations

import argparse
import pathlib
import sys

sys.path.insert(0, str(pathlib.Path(__file__).parent))
import peers
from kept import keep

import jaxsph as js
from jaxsph.plot import sweep_figures as figures
from jaxsph.trade.sweep import BASELINES, ESTIMATORS, FULL_RATE, Row

SCENES = ("mixer", "checker_board", "radial", "letters", "flubber")
RESULTS = peers.RESULTS.with_name("trade.json")
MOST_OVER = 1e-5  # share of pixels, and at most twice the tolerance, that the pilot's estimate may be over it
HEADER = f"{'scene':14s} {'method':17s} tolerance max error  mean error      bound  evaluations  seconds  of full rate"


def measure(name: str, arguments: argparse.Namespace) -> list[Row]:
    """Table and figures of a scene, over the frames asked for."""
    size = {"width": arguments.size, "height": arguments.size}
    views = [js.scenes.load(name, arguments.particles, frame, **size) for frame in arguments.frames or [None]]
    scenes, cameras = zip(*views, strict=True)
    place = (scenes, cameras) if arguments.frames else views[0]
    folder = arguments.output / name
    chosen = {"name": name, "frames": arguments.frames, "repeats": arguments.repeats, "folder": folder}
    chosen |= {"baselines": arguments.baselines, "converged": arguments.converged}
    rows = js.sweep(*place, js.Settings(samples=arguments.samples, integrator="samples"), **chosen)
    figures.draw(rows, folder)
    return rows


def line(row: Row) -> str:
    """Of the printed table, under HEADER."""
    tolerance, bound = ("-" if value is None else f"{value:.2g}" for value in (row["tolerance"], row["max_bound"]))
    share, slower = row["evaluations"] / max(row["evaluations_full"], 1), row["total"] / row["full_total"]
    return (
        f"{row['scene']:14s} {row['method']:17s} {tolerance:>9s} {row['max_error']:9.2g} {row['mean_error']:11.2g} {bound:>10s}"
        f" {share:12.2f} {row['total']:8.3f} {slower:13.2f}"
    )


def keeps_its_word(row: Row) -> bool:
    if row["certified"]:
        return row["max_error"] <= row["max_bound"] <= row["tolerance"] and row["over_bound"] == 0
    if row["method"] == "pilot":
        return (
            row["over_tolerance"] <= max(MOST_OVER, 1 / (row["width"] * row["height"]))
            and row["max_error"] <= 2 * row["tolerance"]
        )
    return True  # what is relaxed is an estimate, and a baseline promises nothing


def on_the_front(rows: list[Row]) -> list[str]:
    """Settings that nothing beats in both error against full rate and time, over all frames."""
    points = [point for point in figures.summary(rows) if point["method"] != "full rate"]
    front = figures.pareto_front([point["error"] for point in points], [point["time"] for point in points])
    names = [(points[i]["method"], points[i]["tolerance"]) for i in front]
    return [method if tolerance is None else f"{method} {tolerance:g}" for method, tolerance in names]


def beaten(rows: list[Row]) -> dict[str, str | None]:
    """For every baseline, the setting with error control that takes no more time and errs no more; None where there is none."""
    points = figures.summary(rows)
    ours = [point for point in points if point["tolerance"] is not None]
    found: dict[str, str | None] = {}
    for baseline in (point for point in points if point["tolerance"] is None and point["method"] != "full rate"):
        better = [one for one in ours if one["time"] <= baseline["time"] and one["error"] <= baseline["error"]]
        best = min(better, key=lambda one: one["time"], default=None)
        found[baseline["method"]] = None if best is None else f"{best['method']} {best['tolerance']:g}"
    return found


def variants() -> list[str]:
    """Names of all that is compared."""
    return [FULL_RATE, *BASELINES, *ESTIMATORS]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--size", type=int, default=512, help="pixels on a side")
    parser.add_argument("--samples", type=int, default=256, help="along a ray")
    parser.add_argument("--particles", type=int, help="instead of each scene's own number")
    parser.add_argument("--frames", type=float, nargs="+", help="a sequence, instead of the frame that shows a scene best")
    parser.add_argument("--baselines", nargs="*", default=BASELINES, help="coarser sampling and smaller images; none at all")
    parser.add_argument(
        "--converged", type=int, default=8, help="times the samples, of the image that full rate is compared with"
    )
    parser.add_argument("--scenes", nargs="+", choices=SCENES, default=SCENES)
    parser.add_argument("-o", "--output", type=pathlib.Path, default=RESULTS.with_suffix(""), help="folder of tables and figures")
    arguments = parser.parse_args()
    print(HEADER)
    tables, fronts, dominated = {}, {}, {}
    for name in arguments.scenes:
        tables[name] = measure(name, arguments)
        fronts[name] = on_the_front(tables[name])
        dominated[name] = beaten(tables[name])
        print("\n".join(map(line, tables[name])))
        print(f"{name:14s} front: {', '.join(fronts[name])}")
        winners = [f"{baseline} by {by or 'nothing'}" for baseline, by in dominated[name].items()]
        print(f"{name:14s} beaten: {', '.join(winners)}", flush=True)
    rows = [row for table in tables.values() for row in table]
    shape = {"size": arguments.size, "samples": arguments.samples, "repeats": arguments.repeats}
    target = arguments.output.with_suffix(".json")
    keep(target, [row["method"] for row in rows], **shape, fronts=fronts, beaten=dominated, records=rows)
    broken = [line(row) for row in rows if not keeps_its_word(row)]
    assert not broken, "\n".join(["over the tolerance:", HEADER, *broken])
    certified = [row for row in rows if row["certified"]]
    assert certified and all(row["over_tolerance"] == 0 for row in certified)


if __name__ == "__main__":
    main()
