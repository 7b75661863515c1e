"""Claim: more samples bring an image nearer to the light integral along each pixel's ray, and this is how near.

Built-in scenes and particle files at 512 x 512, as integrators and numbers of samples render them, against
`jaxsph.reference.integral` at random pixels among those that any particle touches. A pixel's error is its largest difference over
red, green, blue and alpha. Integrals are kept in `--cache`, so that another integrator is judged by the same. Writes
`results/truth.json`; ends in an assert on mean errors.

    python benchmarks/truth.py [SCENE or FILE ...] [--integrators samples ...] [--samples 64 256 1024] [--cache FOLDER]
"""

from __future__ import annotations

import argparse
import itertools
import json
import pathlib
import sys
import time
from typing import Any

import numpy as np

sys.path.insert(0, str(pathlib.Path(__file__).parent))
from workloads import view

import jaxsph as js
from jaxsph.io.replace import written_whole
from jaxsph.provenance import of_frame, of_this_run
from jaxsph.reference_chords import Spheres, rays_of
from jaxsph.reference_media import to_view

SCENES = "mixer", "checker_board", "radial", "dam_break", "flubber", "letters"
RESULTS = pathlib.Path(__file__).with_name("results") / "truth.json"
HEADER = f"{'scene':24s} {'integrator':12s} samples     mean   99.9 %      max  evaluations a pixel  seconds"
Record = dict[str, Any]


def touched(scene: js.Scene, camera: js.Camera, most: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns of at most so many random pixels whose ray any support meets."""
    particles, there = scene.particles, np.asarray(scene.particles.valid)
    center = to_view(particles.exact_position()[there], camera)
    spheres = Spheres(center, np.asarray(particles.support, np.float64)[there], camera.is_perspective)
    pixels = np.random.default_rng(seed).permutation(camera.width * camera.height)
    found: list[np.ndarray] = []
    for some in np.array_split(pixels, max(len(pixels) // 2048, 1)):
        rows, columns = np.unravel_index(some, (camera.height, camera.width))
        met = np.unique(spheres.chords(rays_of(camera, rows, columns)).ray)
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


def rendered(scene: js.Scene, camera: js.Camera, settings: js.Settings, truth: dict[str, np.ndarray]) -> Record:
    """Errors of a rendering at the pixels; the second of two is timed, as the first may compile."""
    for _ in range(2):
        begun = time.perf_counter()
        image = js.render(scene, camera, settings)
        light = np.concatenate([np.asarray(image.color), np.asarray(image.alpha)[..., None]], 2)
        seconds = time.perf_counter() - begun
    error = np.abs(light[truth["rows"], truth["columns"]] - truth["light"]).max(1)
    errors = {"mean": error.mean(), "p999": np.quantile(error, 0.999), "max": error.max()}
    asked = {"integrator": settings.integrator, "samples": settings.samples}
    number = image.stats["evaluations"] / (camera.width * camera.height)
    return asked | {key: float(value) for key, value in errors.items()} | {"evaluations": number, "seconds": seconds}


def measure(name: str, options: argparse.Namespace) -> Record:
    """All renderings of a scene against its integral."""
    scene, camera = view(name, options.size)
    truth = integral(pathlib.Path(name).name, scene, camera, options)
    rows = []
    for integrator in options.integrators:
        for samples in options.samples:
            row = rendered(scene, camera, js.Settings(samples=samples, integrator=integrator), truth)
            errors = f"{row['mean']:8.1e} {row['p999']:8.1e} {row['max']:8.1e}"
            work = f"{row['evaluations']:20.0f} {row['seconds']:8.3f}"
            print(f"{pathlib.Path(name).name:24s} {integrator:12s} {samples:7d} {errors} {work}", flush=True)
            rows.append(row)
    own = {key: float(truth[key]) for key in ("error", "seconds", "evaluations", "portions")}
    pixels = {"pixels": len(truth["rows"]), "particles": scene.particles.num_particles}
    return {"scene": pathlib.Path(name).name, **pixels, "integral": own, "rows": rows}


def check(records: list[Record]) -> list[str]:
    """Where more samples are no nearer on average."""
    wrong = []
    for record in records:
        for integrator in {row["integrator"] for row in record["rows"]}:
            means = [
                row["mean"] for row in sorted(record["rows"], key=lambda row: row["samples"]) if row["integrator"] == integrator
            ]
            if any(after >= before for before, after in itertools.pairwise(means)):
                wrong.append(f"{record['scene']}: {integrator} does not come nearer: {means}")
    return wrong


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="*", default=SCENES, help="built-in scenes (mixer:2 is a frame) or particle files")
    parser.add_argument("--integrators", nargs="+", default=["samples"], help="values of `Settings(integrator=...)`")
    parser.add_argument("--samples", nargs="+", type=int, default=[64, 256, 1024])
    parser.add_argument("--size", type=int, default=512, help="pixels on a side")
    parser.add_argument("--pixels", type=int, default=4000, help="how many are compared")
    parser.add_argument("--tolerance", type=float, default=1e-7, help="of the integral")
    parser.add_argument("--cache", type=pathlib.Path, help="folder where integrals are kept, or were")
    parser.add_argument("-o", "--output", type=pathlib.Path, default=RESULTS)
    options = parser.parse_args()
    print(HEADER)
    records = [measure(name, options) for name in options.scenes]
    asked = {"size": options.size, "tolerance": options.tolerance}
    options.output.parent.mkdir(parents=True, exist_ok=True)
    with written_whole(options.output) as temporary:
        temporary.write_text(json.dumps({"run": of_this_run(), **asked, "scenes": records}, indent=1) + "\n")
    wrong = check(records)
    assert not wrong, "\n".join(wrong)


if __name__ == "__main__":
    main()
