"""Claim: levels save evaluations where a ray runs through one phase of a fluid for many samples, and nothing in finer mixtures.

Levels are for bounds of samples: without super-pixels (Hochstetter et al. 2016, section 5.2), or relaxed (5.1). Of each frame the
shares of filled slabs that were given each level, or one colour, at tolerances from 0.001 to 0.03 and 128 to 1,024 samples a ray;
of one of them with every kernel. Writes `results/levels.json`; ends in asserts that what is certified keeps its bound.

    python benchmarks/levels.py [--size 256] [--scenes flubber letters]
"""

from __future__ import annotations

import argparse
import dataclasses
import pathlib
import sys

import numpy as np

sys.path.insert(0, str(pathlib.Path(__file__).parent))
import peers
from kept import keep
from tolerance import layers

import jaxsph as js

SCENES = ("flubber", "letters", "checker_board", "mixer", "radial")
PARTICLES = 100_000
TOLERANCES = (0.001, 0.004, 0.01, 0.03)
SAMPLES = (128, 256, 1024)
KERNELS = ("cubic_spline", "poly6", "wendland_c2")
OF_KERNELS = 256, 0.01  # samples and tolerance at which kernels are compared
VARIANTS = {
    "slabs": {},
    "along the ray": {"super_pixels": False},
    "paper relaxed": {"allocation": "greedy", "relax": 1.0},
}
KINDS = ("0", "1", "2", "3", "4", "super-pixel")
WHERE = f"{'scene':14s} {'variant':14s} {'kernel':13s} {'N':>5s} {'tolerance':>9s}"
HEADER = f"{WHERE} {'saved':>6s}  shares of slabs at levels 0 to 4, and painted"
RESULTS = peers.RESULTS.with_name("levels.json")


def measure(name: str, size: int) -> list[dict]:
    """One record for each variant, number of samples, tolerance and kernel."""
    scene, camera = js.scenes.load(name, PARTICLES, width=size, height=size)
    records = []
    for samples in SAMPLES:
        records += of_frame(name, scene, camera, samples, TOLERANCES)
    for kernel in KERNELS:
        if kernel != scene.particles.kernel:
            other = dataclasses.replace(scene, particles=dataclasses.replace(scene.particles, kernel=kernel))
            records += of_frame(name, other, camera, OF_KERNELS[0], OF_KERNELS[1:])
    return records


def of_frame(name: str, scene: js.Scene, camera: js.Camera, samples: int, tolerances: tuple[float, ...]) -> list[dict]:
    """One record for each variant and tolerance."""
    full = js.render(scene, camera, js.Settings(samples=samples, integrator="samples"))
    records = []
    for variant, chosen in VARIANTS.items():
        plan = None
        for tolerance in tolerances:
            settings = js.Settings(samples=samples, tolerance=tolerance, estimator="interval", **chosen)
            plan = plan or js.plan(scene, camera, settings)
            image = js.render(scene, camera, settings, plan=plan)
            error = np.abs(layers(image) - layers(full)).max()
            levels = np.asarray(image.levels)
            filled = max(int((levels >= 0).sum()), 1)
            records.append({
                "scene": name, "variant": variant, "kernel": scene.particles.kernel, "samples": samples, "tolerance": tolerance,
                "saved": full.stats["evaluations"] / max(image.stats["evaluations"], 1),
                "shares": {kind: float((levels == nth).sum() / filled) for nth, kind in enumerate(KINDS)},
                "certified": bool(image.certified), "max_error": float(error), "max_bound": float(image.error_bound.max()),
            })  # fmt: skip
            print(row(records[-1]), flush=True)
    return records


def row(record: dict) -> str:
    """Of the printed table, under HEADER."""
    where = (
        f"{record['scene']:14s} {record['variant']:14s} {record['kernel']:13s} {record['samples']:5d} {record['tolerance']:9g}"
    )
    return f"{where} {record['saved']:6.2f}  " + " ".join(f"{share:.4f}" for share in record["shares"].values())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=int, default=256, help="pixels on a side")
    parser.add_argument("--scenes", nargs="+", choices=SCENES, default=SCENES)
    arguments = parser.parse_args()
    print(HEADER)
    records = [record for name in arguments.scenes for record in measure(name, arguments.size)]
    keep(RESULTS, VARIANTS, size=arguments.size, particles=PARTICLES, records=records)
    broken = [row(r) for r in records if r["certified"] and not r["max_error"] <= r["max_bound"] <= r["tolerance"]]
    assert not broken, "\n".join(["no certificate:", HEADER, *broken])


if __name__ == "__main__":
    main()
