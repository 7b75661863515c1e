"""Claim: mixed by extinction, overlapping media show the same light however few the samples; mixed by opacity, too much of it.

Two uniform volumes in one place, red and blue, each of optical thickness 2, and the galaxy of `cosmos` (30,000
stars, 96^3): Kaehler, Abel & Hege 2007, equation 1, against weights by extinction, from 4 to 256 samples. Writes
`results/mixing.json` and `.png`; ends in an assert under `--check`.

    python benchmarks/mixing.py [--check]
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import pathlib

import cosmos
import numpy as np
from kept import keep
from matplotlib.figure import Figure

import jaxsph as js

SAMPLES = 4, 8, 16, 32, 64, 128, 256
THICKNESS = 2.0
MIXES = "extinction", "opacity"
RESULTS = pathlib.Path(__file__).with_name("results") / "mixing.json"


def uniform() -> tuple[js.Scene, js.Camera]:
    """Two volumes in one place."""
    volume = js.Volume.from_array(np.ones((2, 2, 2), np.float32), (-1.0, -1.0, -1.0), 2.0)
    looks = tuple(
        js.TransferFunction.from_points([0.0, 1.0], [color] * 2, [THICKNESS / 2] * 2) for color in ((1.0, 0, 0), (0, 0, 1.0))
    )
    camera = js.Camera.orthographic((0, 0, -2.0), (0, 0, 0), view_height=1.0, width=16, height=16, near=1.0, far=3.0)
    return js.Scene(volume=(volume, volume), volume_transfer=looks), camera


def light(scene: js.Scene, camera: js.Camera, samples: int, mix: str) -> np.ndarray:
    """All colours."""
    return np.asarray(js.render(dataclasses.replace(scene, mix=mix), camera, js.Settings(samples=samples)).color)


def measured() -> dict[str, dict[str, list[float]]]:
    """What is shown of the uniform volumes over what there is; and how far the galaxy is from that of the most samples."""
    slab, ahead = uniform()
    there = 1 - math.exp(-2 * THICKNESS)
    galaxy, view = cosmos.galaxy(30_000, 96, width=320, height=200)
    truth = light(galaxy, view, 4 * SAMPLES[-1], "extinction")
    found: dict[str, dict[str, list[float]]] = {"shown": {}, "galaxy": {}}
    for mix in MIXES:
        found["shown"][mix] = [float(light(slab, ahead, samples, mix)[8, 8].sum() / there) for samples in SAMPLES]
        off = [np.abs(light(galaxy, view, samples, mix) - truth) for samples in SAMPLES]
        found["galaxy"][mix] = [float(np.sqrt((one**2).mean())) for one in off]
    return found


def figure(found: dict[str, dict[str, list[float]]], path: pathlib.Path) -> None:
    """Both over the number of samples."""
    drawn = Figure(figsize=(9, 3.6), layout="constrained")
    left, right = drawn.subplots(1, 2)
    for mix, marker in (("extinction", "o-"), ("opacity", "s--")):
        left.semilogx(SAMPLES, found["shown"][mix], marker, base=2, label=f'mix="{mix}"')
        right.loglog(SAMPLES, found["galaxy"][mix], marker, base=2, label=f'mix="{mix}"')
    left.set(title="two uniform volumes in one place", xlabel="samples", ylabel="light shown, over what there is")
    right.set(title="galaxy", xlabel="samples", ylabel="RMS difference from 1024 samples")
    for axes in (left, right):
        axes.legend()
    drawn.savefig(path, dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--check", action="store_true", help="assert the claim")
    options = parser.parse_args()
    found = measured()
    keep(RESULTS, MIXES, samples=SAMPLES, **found)
    figure(found, RESULTS.with_suffix(".png"))
    for what, by in found.items():
        for mix, values in by.items():
            print(f"{what:8} {mix:11}", *(f"{value:.4f}" for value in values))
    if options.check:
        assert max(abs(value - 1) for value in found["shown"]["extinction"]) < 1e-5 < 0.2 < found["shown"]["opacity"][0] - 1


if __name__ == "__main__":
    main()
