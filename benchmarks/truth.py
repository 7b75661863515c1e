"""Claim: more samples bring an image nearer to the light integral along each pixel's ray, and this is how near.

Built-in scenes and particle files at 512 x 512, as points and segments of several numbers of samples render them, and segments
refined for tolerances, against `jaxsph.reference.integral` at random pixels among those that any particle touches. A pixel's
error is its largest difference over red, green, blue and alpha; `silent` are pixels over thrice the tolerance whose estimate is
under a third of their error. Images are timed in turns, compiled programs only; what compiling takes is told apart,
as the time of the first image. The pilot is a contender, whose tolerance is kept against its 1,024 samples and not the integral.
For each image but points' `points_time` is the time that uniform points take for the same 99.9 % error, by a power law between
the two numbers of samples beside it. Integrals are kept in `--cache`. Writes `results/truth.json`; ends in an assert on mean
errors.

    python benchmarks/truth.py [SCENE or FILE ...] [--samples 64 128 256 512] [--tolerances 0.03 0.01 0.004] [--cache FOLDER]
"""

from __future__ import annotations

import argparse
import itertools
import pathlib
import statistics
import sys
import time
import warnings
from typing import Any

import numpy as np

sys.path.insert(0, str(pathlib.Path(__file__).parent))
from kept import keep
from workloads import view

import jaxsph as js
from jaxsph.reference.where import chords_of, rays_of, shadows_of, to_view
from jaxsph.trade.sweep import of_frame

SCENES = "mixer", "checker_board", "radial", "dam_break", "flubber", "letters"
RESULTS = pathlib.Path(__file__).with_name("results") / "truth.json"
ROUNDING = 1e-6
PILOTED = 1024  # samples of the pilot
HEADER = f"{'scene':24s} {'integrator':12s} samples     mean   99.9 %      max  evaluations a pixel  seconds"
Record = dict[str, Any]


def touched(scene: js.Scene, camera: js.Camera, most: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns of at most so many random pixels whose ray any support meets."""
    particles, there = scene.particles, np.asarray(scene.particles.valid)
    center = to_view(particles.exact_position()[there], camera)
    support = np.asarray(particles.support, np.float64)[there]
    spheres = center, support, shadows_of(center, support, camera.is_perspective)
    pixels = np.random.default_rng(seed).permutation(camera.width * camera.height)
    found: list[np.ndarray] = []
    for some in np.array_split(pixels, max(len(pixels) // 2048, 1)):
        rows, columns = np.unravel_index(some, (camera.height, camera.width))
        met = np.unique(chords_of(*spheres, rays_of(camera, rows, columns)).ray)
        found.append(some[met])
        if sum(map(len, found)) >= most:
            break
    rows, columns = np.unravel_index(np.concatenate(found)[:most], (camera.height, camera.width))
    return rows, columns


def integral(name: str, scene: js.Scene, camera: js.Camera, options: argparse.Namespace) -> dict[str, np.ndarray]:
    """Pixels, and colour and alpha of each; from the cache, if the same was asked for before."""
    print_of = of_frame(scene, camera, js.Settings(), 0)["fingerprint"]
    file = options.cache and options.cache / f"{print_of}_{options.pixels}_{options.tolerance:g}.npz"
    if file and file.exists():
        with np.load(file) as kept:
            return dict(kept)
    pixels = touched(scene, camera, options.pixels)

    def told(done: int, total: int) -> None:
        print(f"\r{name}: {done} of {total} rays", end="", file=sys.stderr, flush=True)

    image = js.reference.integral(scene, camera, pixels=pixels, tolerance=options.tolerance, progress=told)
    print(file=sys.stderr)
    numbers = {"error": image.error_bound.max(initial=0), "seconds": image.stats["seconds"]["cast"]}
    numbers |= {"evaluations": image.stats["evaluations"], "portions": image.stats["portions"]}
    light = np.concatenate([image.color, image.alpha[:, None]], 1)
    kept = {"rows": pixels[0], "columns": pixels[1], "light": light} | {k: np.asarray(v) for k, v in numbers.items()}
    if file:
        file.parent.mkdir(parents=True, exist_ok=True)
        np.savez(file, **kept)
    return kept


def light_of(image: js.Image) -> np.ndarray:
    """Red, green, blue and alpha."""
    return np.concatenate([np.asarray(image.color), np.asarray(image.alpha)[..., None]], 2)


def timed(scene: js.Scene, camera: js.Camera, settings: js.Settings) -> tuple[js.Image, float]:
    """An image, and the seconds that it took."""
    begun = time.perf_counter()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # a tolerance that is missed is in the table
        image = js.render(scene, camera, settings)
    light_of(image)
    return image, time.perf_counter() - begun


def compared(image: js.Image, settings: js.Settings, truth: dict[str, np.ndarray]) -> Record:
    """Errors of an image at the pixels, and how they are told."""
    place = truth["rows"], truth["columns"]
    error = np.abs(light_of(image)[place] - truth["light"]).max(1)
    errors = {"mean": error.mean(), "p999": np.quantile(error, 0.999), "max": error.max()}
    method = "pilot" if settings.integrator_used == "samples" and settings.tolerance else settings.integrator_used
    asked = {"integrator": method, "samples": settings.samples, "tolerance": settings.tolerance}
    number = image.stats["evaluations"] / image.transmittance.size
    found = asked | {key: float(value) for key, value in errors.items()} | {"evaluations": number}
    if settings.tolerance is None:
        return found
    told, wrong = np.asarray(image.error_bound)[place], error > ROUNDING
    ratio = np.quantile(told[wrong] / error[wrong], [0.01, 0.5, 0.99]).tolist() if wrong.any() else None
    over = {f"over_{times}": float((error > times * settings.tolerance).mean()) for times in (1, 3)}
    over["silent"] = float(((error > 3 * settings.tolerance) & (told < error / 3)).mean())
    missed = float((told > settings.tolerance).mean())
    return found | over | {"estimate_over_error": ratio, "told_over": missed, "faults": int(image.faults)}


def same_error(row: Record, points: list[Record]) -> float | None:
    """Seconds that points take for the same 99.9 % error, by a power law; None where no two of them enclose it."""
    ordered = sorted(points, key=lambda point: point["p999"])
    for better, worse in itertools.pairwise(ordered):
        if better["p999"] <= row["p999"] <= worse["p999"] and better["p999"] < worse["p999"]:
            share = np.log(row["p999"] / better["p999"]) / np.log(worse["p999"] / better["p999"])
            return float(better["seconds"] ** (1 - share) * worse["seconds"] ** share)
    return None


def measure(name: str, options: argparse.Namespace) -> Record:
    """All renderings of a scene against its integral."""
    scene, camera = view(name, options.size)
    truth = integral(pathlib.Path(name).name, scene, camera, options)
    chosen = [js.Settings(samples=n) for n in options.points]
    chosen += [js.Settings(samples=n, integrator="segments") for n in options.samples]
    chosen += [js.Settings(integrator="segments", tolerance=tolerance) for tolerance in options.tolerances]
    chosen += [js.Settings(samples=PILOTED, estimator="pilot", tolerance=tolerance) for tolerance in options.tolerances]
    firsts = [timed(scene, camera, settings) for settings in chosen]
    turns = [[timed(scene, camera, settings)[1] for settings in chosen] for _ in range(options.repeats)]
    rows = [compared(image, settings, truth) | {"first": first} for (image, first), settings in zip(firsts, chosen, strict=True)]
    for row, seconds in zip(rows, zip(*turns, strict=True), strict=True):
        row["seconds"] = statistics.median(seconds)
    points = [row for row in rows if row["integrator"] == "samples"]
    for row in rows:
        if row["integrator"] != "samples":
            row["points_time"] = same_error(row, points)
        print(line(pathlib.Path(name).name, row), flush=True)
    own = {key: float(truth[key]) for key in ("error", "seconds", "evaluations", "portions")}
    pixels = {"pixels": len(truth["rows"]), "particles": scene.particles.num_particles}
    return {"scene": pathlib.Path(name).name, **pixels, "integral": own, "rows": rows}


def line(name: str, row: Record) -> str:
    """A row as text."""
    asked = f"{row['samples']:d}" if row["tolerance"] is None else f"t {row['tolerance']:g}"
    errors = f"{row['mean']:8.1e} {row['p999']:8.1e} {row['max']:8.1e}"
    saved = "" if not row.get("points_time") else f"  points for as much {row['points_time'] / row['seconds']:.2f}"
    told = (
        ""
        if row["tolerance"] is None
        else f"  over {row['over_1']:.4f} {row['over_3']:.4f} silent {row['silent']:.5f} told/true {row['estimate_over_error']}"
    )
    return (
        f"{name:24s} {row['integrator']:12s} {asked:>7s} {errors} {row['evaluations']:20.0f} {row['seconds']:8.3f}{saved}{told}"
    )


def check(records: list[Record]) -> list[str]:
    """Where more samples are no nearer on average."""
    wrong = []
    for record in records:
        uniform = sorted((row for row in record["rows"] if row["tolerance"] is None), key=lambda row: row["samples"])
        for integrator in {row["integrator"] for row in uniform}:
            means = [row["mean"] for row in uniform if row["integrator"] == integrator]
            if any(after >= before for before, after in itertools.pairwise(means)):
                wrong.append(f"{record['scene']}: {integrator} does not come nearer: {means}")
    return wrong


def saved(records: list[Record]) -> list[str]:
    """Geometric means over scenes of the time of points with the same 99.9 % error over that of a tolerance."""
    factors: dict[tuple[str, float], list[float]] = {}
    for row in (row for record in records for row in record["rows"] if row["tolerance"] and row["points_time"]):
        factors.setdefault((row["integrator"], row["tolerance"]), []).append(row["points_time"] / row["seconds"])
    return [
        f"{integrator} at {tolerance:g}: {statistics.geometric_mean(some):.2f}, least {min(some):.2f}, of {len(some)} scenes"
        for (integrator, tolerance), some in factors.items()
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="*", default=SCENES, help="built-in scenes (mixer:2 is a frame) or particle files")
    parser.add_argument("--points", nargs="+", type=int, default=[64, 128, 256, 512, 1024, 2048], help="samples of points")
    parser.add_argument("--samples", nargs="+", type=int, default=[64, 128, 256, 512], help="samples of segments")
    parser.add_argument("--tolerances", nargs="*", type=float, default=[0.03, 0.01, 0.004], help="of segments")
    parser.add_argument("--repeats", type=int, default=3, help="turns that medians are taken of")
    parser.add_argument("--size", type=int, default=512, help="pixels on a side")
    parser.add_argument("--pixels", type=int, default=4000, help="how many are compared")
    parser.add_argument("--tolerance", type=float, default=1e-7, help="of the integral")
    parser.add_argument("--cache", type=pathlib.Path, help="folder where integrals are kept, or were")
    parser.add_argument("-o", "--output", type=pathlib.Path, default=RESULTS)
    options = parser.parse_args()
    print(HEADER)
    records = [measure(name, options) for name in options.scenes]
    print(*saved(records), sep="\n")
    asked = {"size": options.size, "tolerance": options.tolerance}
    keep(options.output, ("samples", "segments", "pilot"), **asked, scenes=records)
    wrong = check(records)
    assert not wrong, "\n".join(wrong)


if __name__ == "__main__":
    main()
