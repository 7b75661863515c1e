"""Claim: the pilot estimator saves several times the evaluations, and its estimate holds.

In every frame at most one pixel in 100,000 is over the tolerance, and none over twice. Full rate and the pilot
estimator render the same scene in one process, in turns; compile time is apart. `estimate to error` is the estimated over the
true error of pixels that differ from full rate. `oracle` is what `oracle.py` saves where it was run at the same size and
tolerance. Writes `results/pilot.json` and `results/pilot.png`; ends in asserts on errors, as times and savings are for reading.

    python benchmarks/pilot.py [--repeats 5] [--sizes 256 512 1024] [--scenes mixer radial:2 FILE]
"""

from __future__ import annotations

import argparse
import json
import pathlib
import sys

import jax

sys.path.insert(0, str(pathlib.Path(__file__).parent))
import oracle
import peers
import tolerance
import workloads
from kept import keep

import jaxsph as js

SCENES = ("mixer", "radial", "checker_board", "dam_break", "cube")
SEQUENCES = tuple(f"{name}:{frame}" for name in ("mixer", "dam_break") for frame in range(3))  # at the smallest size
SHOWN_AT = 0.004  # in the figure
MOST_OVER = 1e-5  # share of pixels
PILOT = "pilot"
RESULTS = peers.RESULTS.with_name("pilot.json")
HEADER = "scene                 size tolerance  saved oracle full/frame max error     over estimate to error (1, 50, 99 %)"


def contenders() -> dict[tuple[str, float | None], js.Settings]:
    """Settings by variant and tolerance, full rate first."""
    pilots = {(PILOT, limit): js.Settings(tolerance=limit, estimator="pilot") for limit in tolerance.TOLERANCES}
    return {(tolerance.FULL_RATE, None): js.Settings()} | pilots


def oracles() -> dict[tuple[str, int, float], float]:
    """The most that can be saved, by scene, size and tolerance, as far as it was measured."""
    if not oracle.RESULTS.exists():
        return {}
    found = json.loads(oracle.RESULTS.read_text())
    saved: dict[tuple[str, int, float], float] = {}
    for record in found["records"]:
        key = record["scene"], found["size"], record["tolerance"]
        saved[key] = max(saved.get(key, 1), record["saved"])
    return saved


def row(record: dict) -> str:
    """Of the printed table, under HEADER."""
    ratios = " ".join(f"{ratio:.3g}" for ratio in record["estimate_to_error"] or [])
    best = "-" if record["oracle"] is None else f"{record['oracle']:.2f}"
    return (
        f"{record['scene'][-20:]:20s} {record['size']:5d} {record['tolerance']:9g} {record['evaluations_saved']:6.2f} {best:>6s} "
        f"{1 / record['total_to_full']:10.2f} {record['max_error']:9.6f} {record['pixels_over_tolerance']:8.1e} {ratios}"
    )


def keeps_its_word(record: dict) -> bool:
    return record["pixels_over_tolerance"] <= MOST_OVER and record["max_error"] <= 2 * record["tolerance"]


def draw(records: list[dict], path: pathlib.Path) -> None:
    """What is saved at `SHOWN_AT`, in evaluations and in time, and how the estimate compares with the error."""
    import matplotlib.pyplot as plt

    shown = [record for record in records if record["tolerance"] == SHOWN_AT and record["scene"] in SCENES]
    names, sizes = (list(dict.fromkeys(record[key] for record in shown)) for key in ("scene", "size"))
    figure, axes = plt.subplots(1, 3, figsize=(13, 4), layout="constrained")
    titles = "evaluations saved (x oracle)", "time of full rate over the frame's", "estimate over error (1, 50, 99 %)"
    for axis, title in zip(axes, titles, strict=True):
        axis.set(title=title, xticks=range(len(names)), xticklabels=names)
        axis.axhline(1, color="0.7", linewidth=1)
        axis.tick_params("x", rotation=20)
    for k, size in enumerate(sizes):
        here = [record for record in shown if record["size"] == size]
        place = [names.index(record["scene"]) + 0.18 * (k - (len(sizes) - 1) / 2) for record in here]
        label = f"{size} x {size}"
        axes[0].plot(place, [record["evaluations_saved"] for record in here], "o", label=label)
        axes[1].plot(place, [1 / record["total_to_full"] for record in here], "o", label=label)
        some = [(at, record["estimate_to_error"]) for at, record in zip(place, here, strict=True) if record["estimate_to_error"]]
        low, middle, high = ([ratios[i] for _, ratios in some] for i in range(3))
        lines = axes[2].plot([at for at, _ in some], middle, "o", label=label)
        axes[2].vlines([at for at, _ in some], low, high, color=lines[0].get_color())
        best = [(at, record["oracle"]) for at, record in zip(place, here, strict=True) if record["oracle"]]
        axes[0].plot([at for at, _ in best], [saved for _, saved in best], "kx")
    for axis in (axes[0], axes[2]):
        axis.set_yscale("log")
    axes[1].set_ylim(0, None)
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside right upper")
    figure.suptitle(f"Pilot estimator at a tolerance of {SHOWN_AT:g}")
    figure.savefig(path, dpi=130)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--sizes", type=int, nargs="+", default=[256, 512, 1024], help="pixels on a side")
    parser.add_argument("--scenes", nargs="+", default=SCENES, help="names, with a frame after a colon, or particle files")
    parser.add_argument("--sequences", nargs="*", default=SEQUENCES, help="the same, at the smallest size only")
    parser.add_argument("-o", "--output", type=pathlib.Path, default=RESULTS, help="JSON; the figure is beside it")
    arguments = parser.parse_args()
    records, known = [], oracles()
    print(HEADER)
    for size in arguments.sizes:
        for name in [*arguments.scenes, *arguments.sequences * (size == min(arguments.sizes))]:
            scene, camera = workloads.view(name, size)
            label = pathlib.Path(name).name
            found = tolerance.measure(label, scene, camera, arguments.repeats, contenders())
            found = [record | {"size": size} for record in found if record["tolerance"] is not None]
            found = [record | {"oracle": known.get((label, size, record["tolerance"]))} for record in found]
            print("\n".join(row(record) for record in found), flush=True)
            records += found
            jax.clear_caches()  # compiled programs hold memory maps, of which a process may have only so many
    keep(arguments.output, [PILOT], repeats=arguments.repeats, records=records)
    draw(records, arguments.output.with_suffix(".png"))
    broken = [row(record) for record in records if not keeps_its_word(record)]
    assert not broken, "\n".join(["over the tolerance:", HEADER, *broken])


if __name__ == "__main__":
    main()
