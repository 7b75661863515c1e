"""Claim: on two cores the first frame of a process takes 4.5 s at full rate, 6 s with the pilot and 8 s of a surface of the dam
break, where another process compiled it 2.5 s.

512 x 512, 256 samples, of the mixer but for the surface. Every frame is the first of a process of its own; a frame is
`jaxsph.render`, the process adds what importing and making the scene take. `--against` takes a checkout of another commit, whose
frames are made in turns with these. Writes `results/first_frames.json`; ends in asserts on the medians.

    python benchmarks/first_frames.py [--repeats 5] [--against FOLDER] [--check]
"""

from __future__ import annotations

import argparse
import json
import os
import pathlib
import statistics
import subprocess
import sys
import tempfile
import time

from kept import keep

SETTINGS = {
    "full rate": {},
    "interval": {"tolerance": 0.004, "estimator": "interval"},
    "pilot": {"tolerance": 0.004, "estimator": "pilot"},
    "surface": {},
}
LIMITS = {"full rate": 4.5, "interval": 8.0, "pilot": 6.0, "surface": 8.0}
LIMIT_WHERE_COMPILED = 2.5
RESULTS = pathlib.Path(__file__).parent / "results" / "first_frames.json"
FRAME = """
import json, sys, time
started = time.perf_counter()
import jaxsph as js
surface = sys.argv[2] == "surface"
scene, camera = js.scenes.load("dam_break" if surface else "mixer")
scene = js.Scene(particles=scene.particles, surface=js.Surface()) if surface else scene
settings = js.Settings(**json.loads(sys.argv[1]))
ready = time.perf_counter()
image = js.render(scene, camera, settings)
done = time.perf_counter()
image = js.render(scene, camera, settings)
print(json.dumps({"before": ready - started, "frame": done - ready, "next": time.perf_counter() - done}))
"""


def first_frame(name: str, folder: str | None, checkout: str | None = None) -> dict[str, float]:
    """Seconds before, of and after the first frame of a process, and of the process as a whole."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith("JAX_")}
    if folder is None:
        environment["JAX_ENABLE_COMPILATION_CACHE"] = "0"
    else:
        environment["XDG_CACHE_HOME"] = folder
    if checkout is not None:
        environment["PYTHONPATH"] = checkout
    started = time.perf_counter()
    command = [sys.executable, "-c", FRAME, json.dumps(SETTINGS[name]), name]
    done = subprocess.run(command, capture_output=True, text=True, check=True, env=environment, cwd=checkout)
    return {**json.loads(done.stdout), "process": time.perf_counter() - started}


def variants() -> list[str]:
    """Names of all that is compared."""
    return [name + how for name in SETTINGS for how in ("", ", other commit", ", compiled before")]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--against", metavar="FOLDER", help="a checkout of another commit")
    parser.add_argument("--check", action="store_true", help="fail where a median is over its limit")
    arguments = parser.parse_args()
    found: dict[str, list[dict[str, float]]] = {}
    with tempfile.TemporaryDirectory() as folder:
        for name in SETTINGS:
            first_frame(name, folder)
        for _ in range(arguments.repeats):
            for name in SETTINGS:
                found.setdefault(name, []).append(first_frame(name, None))
                if arguments.against:
                    found.setdefault(f"{name}, other commit", []).append(first_frame(name, None, arguments.against))
                found.setdefault(f"{name}, compiled before", []).append(first_frame(name, folder))
    medians = {name: {key: statistics.median(run[key] for run in runs) for key in runs[0]} for name, runs in found.items()}
    for name, row in medians.items():
        print(f"{name:28s} " + "  ".join(f"{key} {seconds:5.2f} s" for key, seconds in row.items()))
    keep(RESULTS, medians, medians=medians, repeats=arguments.repeats)
    if arguments.check:
        for name, limit in LIMITS.items():
            assert medians[name]["frame"] <= limit, (name, medians[name])
            assert medians[f"{name}, compiled before"]["frame"] <= LIMIT_WHERE_COMPILED, (name, medians)


if __name__ == "__main__":
    main()
