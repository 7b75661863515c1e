"""Claim: colour by one quantity and opacity by another take at most 1.25 of the time that one quantity takes.

Built-in scenes at 512 x 512 with 256 samples. The second quantity is the first once more, and the transfer function the same, so
that both pictures are of the same light, end the same rays, and differ in cost alone. In turns in one process, compiled
programs only; ratios of medians. Writes `results/two_quantities.json`; ends in an assert.

    python benchmarks/two_quantities.py [SCENE or FILE ...] [--repeats 7] [--size 512]
"""

from __future__ import annotations

import argparse
import dataclasses
import pathlib
import statistics
import time

import numpy as np
from kept import keep
from workloads import view

import jaxsph as js

SCENES = "mixer", "radial", "checker_board", "dam_break"
MOST = 1.25
SETTINGS = {
    "samples": js.Settings(),
    "segments": js.Settings(integrator="segments"),
    "certified 0.004": js.Settings(integrator="samples", tolerance=0.004),
    "pilot 0.004": js.Settings(tolerance=0.004, estimator="pilot"),
}
RESULTS = pathlib.Path(__file__).with_name("results") / "two_quantities.json"


def twice(scene: js.Scene) -> js.Scene:
    """The same scene, its quantity carried twice."""
    particles, transfer = scene.particle_set, scene.transfer
    assert transfer is not None
    pair = dataclasses.replace(particles, extinction_quantity=particles.quantity)
    return js.Scene(particles=pair, transfer=dataclasses.replace(transfer, extinction_values=transfer.values))


def seconds(scene: js.Scene, camera: js.Camera, settings: js.Settings) -> float:
    begun = time.perf_counter()
    np.asarray(js.render(scene, camera, settings).color)
    return time.perf_counter() - begun


def measure(name: str, options: argparse.Namespace) -> list[dict[str, object]]:
    scene, camera = view(name, options.size)
    scenes, rows, called = (scene, twice(scene)), [], pathlib.Path(name).name
    for asked, settings in SETTINGS.items():
        images = [js.render(each, camera, settings) for each in scenes]
        apart = float(np.abs(np.asarray(images[0].color) - np.asarray(images[1].color)).max())
        turns = [[seconds(each, camera, settings) for each in scenes] for _ in range(options.repeats)]
        one, two = (statistics.median(times) for times in zip(*turns, strict=True))
        rows.append({"scene": called, "settings": asked, "one": one, "two": two, "ratio": two / one, "apart": apart})
        print(f"{called:20s} {asked:16s} {one:7.3f} s {two:7.3f} s  {two / one:.2f}  apart {apart:.1e}", flush=True)
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="*", default=SCENES)
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--size", type=int, default=512)
    options = parser.parse_args()
    rows = [row for name in options.scenes for row in measure(name, options)]
    keep(RESULTS, SETTINGS, size=options.size, rows=rows)
    slow = [row for row in rows if row["ratio"] > MOST]  # type: ignore[operator]
    assert not slow, f"more than {MOST} of one quantity: {slow}"


if __name__ == "__main__":
    main()
