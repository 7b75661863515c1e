"""Claim: to cast points instead of drawing splats costs less of a frame than it did Kaehler, Abel & Hege 2007, section 4.

Their two data sets in kind (`cosmos`): 150,000 galaxies in gas of 256^3 and 120,000 stars in gas of 256^3, at 830 x
520 pixels. Points as splats (sprites), beyond half the depth as splats (hybrid), all at their feet on the rays (full, as theirs),
all along their chords, and none at all; every contender has its turn in every round. And the trade of their figure 7: error over
time, for regions of any depth. Writes `results/points_and_grids.json` and `.png`; ends in an assert on ratios of medians, under
`--check`.

    python benchmarks/points_and_grids.py [--rounds 7] [--check]
"""

from __future__ import annotations

import argparse
import dataclasses
import pathlib
import statistics
import time

import cosmos
import numpy as np
from kept import keep

import jaxsph as js

THEIRS = {"reionization": (6.3, 3.3, 2.1), "galaxy": (6.6, 3.4, 2.3)}  # frames a second of sprites, hybrid and full
REGIONS = 0.0, 0.25, 0.5, 0.75, 1.0  # of the depth, in which points are cast
RESULTS = pathlib.Path(__file__).with_name("results") / "points_and_grids.json"


def contenders(scene: js.Scene, camera: js.Camera) -> dict[str, js.Scene]:
    """The same scene without points, and with regions of interest from none to all of the depth."""
    near, far = float(camera.near), float(camera.far)
    made = {"gas": js.Scene(volume=scene.volume, volume_transfer=scene.volume_transfer)}
    for region in REGIONS:
        points = scene.points
        if region == 0:
            points = dataclasses.replace(points, spread="centres")
        elif region < 1:
            points = dataclasses.replace(points, splats_beyond=np.float32(near + region * (far - near)))
        made[f"region {region:g}"] = dataclasses.replace(scene, points=points)
    return made | {"feet": dataclasses.replace(scene, points=dataclasses.replace(scene.points, spread="feet"))}


def differs(image: js.Image, truth: js.Image) -> dict[str, float]:
    """From what is cast in full, in colour and alpha."""
    layers = [np.concatenate([np.asarray(one.color), np.asarray(one.alpha)[..., None]], -1) for one in (image, truth)]
    off = np.abs(layers[0] - layers[1]).max(-1)
    return {"max": float(off.max()), "p999": float(np.quantile(off, 0.999)), "rms": float(np.sqrt((off**2).mean()))}


def measured(name: str, rounds: int) -> dict:
    """Seconds of each contender by stage, and how wrong it is."""
    scene, camera = getattr(cosmos, name)()
    shown = contenders(scene, camera)
    first, images = {}, {}
    for which, one in shown.items():
        started = time.perf_counter()
        images[which] = js.render(one, camera)
        first[which] = time.perf_counter() - started
    seconds: dict[str, list[float]] = {which: [] for which in shown}
    stages: dict[str, list[dict[str, float]]] = {which: [] for which in shown}
    for turn in range(rounds):
        print(f"{name}: round {turn + 1} of {rounds}", flush=True)
        for which, one in shown.items():
            started = time.perf_counter()
            found = js.render(one, camera)
            seconds[which].append(time.perf_counter() - started)
            stages[which].append(found.stats["seconds"])
    truth, rows = images["region 1"], []
    for which, times in seconds.items():
        by_stage = {stage: statistics.median(one[stage] for one in stages[which]) for stage in stages[which][0]}
        error = {} if which == "gas" else differs(images[which], truth)
        row = {"what": which, "seconds": statistics.median(times), "first": first[which]}
        rows.append({**row, "stages": by_stage, "error": error})
    return {"scene": name, "points": scene.points.num_points, "grid": scene.volume.shape, "rows": rows, "theirs": THEIRS[name]}


def ratios(found: dict) -> tuple[float, ...]:
    """Seconds of hybrid, of full by feet and of full by chords over those of sprites."""
    seconds = {row["what"]: row["seconds"] for row in found["rows"]}
    return tuple(seconds[what] / seconds["region 0"] for what in ("region 0.5", "feet", "region 1"))


def figure(results: list[dict], path: pathlib.Path) -> None:
    """Error over time, a line for each scene; both axes relative to the full cast."""
    from matplotlib.figure import Figure

    drawn = Figure(figsize=(6, 4), layout="constrained")
    axes = drawn.subplots()
    for found in results:
        rows = {row["what"]: row for row in found["rows"]}
        full = rows["region 1"]["seconds"]
        some = [rows[f"region {region:g}"] for region in REGIONS[:-1]]
        axes.plot([row["seconds"] / full for row in some], [row["error"]["p999"] for row in some], "o-", label=found["scene"])
        for region, row in zip(REGIONS, some, strict=False):
            axes.annotate(f"{region:g}", (row["seconds"] / full, row["error"]["p999"]), textcoords="offset points", xytext=(5, 5))
    axes.set_xlabel("time, over that of casting all points")
    axes.set_ylabel("error that 0.1 % of pixels exceed")
    axes.set_title("Regions of interest: share of the depth in which points are cast")
    axes.legend()
    drawn.savefig(path, dpi=120)


def variants() -> list[str]:
    """Names of all that is compared."""
    return ["gas", *(f"region {region:g}" for region in REGIONS), "feet"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--check", action="store_true", help="assert that ours loses less than theirs")
    options = parser.parse_args()
    results = [measured(name, options.rounds) for name in THEIRS]
    keep(RESULTS, [row["what"] for found in results for row in found["rows"]], scenes=results)
    figure(results, RESULTS.with_suffix(".png"))
    for found in results:
        for row in found["rows"]:
            stages = ", ".join(f"{name} {seconds:.3f}" for name, seconds in row["stages"].items())
            print(f"{found['scene']:13} {row['what']:12} {row['seconds']:.3f} s ({stages})  {row['error']}")
        hybrid, feet, full = ratios(found)
        sprites, half, all_cast = found["theirs"]
        ours = f"hybrid {hybrid:.2f} (theirs {sprites / half:.2f}), feet {feet:.2f} (theirs {sprites / all_cast:.2f})"
        print(f"{'':13} over sprites: {ours}, chords {full:.2f}")
        if options.check:
            assert hybrid < sprites / half and max(feet, full) < sprites / all_cast, "ours loses no less than theirs"


if __name__ == "__main__":
    main()
