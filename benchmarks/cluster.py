"""Claim: two workers of a core each render frames at 1.6 times the rate of one, the same bits whatever dies or is damaged.

40 snapshots, one of them cut short, become frames on two workers of this machine, one of which is killed on the way: all other
frames are made, the broken file is named, and the command `movie` ends with code 1. The rate is that of frames after each worker
has compiled its programs; one worker and two take turns, with a core each. It is that of a machine at rest: where others use
both cores, two workers may get no more of them than one. The load and the processor seconds a frame are told beside it.

    python benchmarks/cluster.py [--particles N] [--turns N]
"""

from __future__ import annotations

import argparse
import os
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
from kept import keep

import jaxsph as js
from jaxsph.sequence.cluster import local_client

RESULT = Path(__file__).parent / "results" / "cluster.json"
FRAMES = 40
WORKERS = 1, 2
BROKEN = 17
MIN_SPEEDUP = 1.6
SETTINGS = js.Settings(samples=128)


def write_snapshots(folder: Path, particles: int) -> list[Path]:
    """A cloud that turns and falls apart, one file a frame."""
    rng = np.random.default_rng(5)
    start, drift = rng.normal(size=(particles, 3)) * 0.4, rng.normal(size=(particles, 3)) * 0.004
    support = np.full(particles, 3.0 * particles ** (-1 / 3), np.float32)
    paths = [folder / f"snap_{number:03d}.npz" for number in range(FRAMES)]
    for number, path in enumerate(paths):
        position = (start + number * drift).astype(np.float32)
        np.savez(path, position=position, support=support, temperature=start[:, 0], id=np.arange(particles), time=float(number))
    return paths


class Rate(NamedTuple):
    """Of frames, from when every worker has compiled."""

    frames_a_second: float
    processor_seconds_a_frame: float


def rate(workers: int, snapshots: js.sequence.Snapshots, camera: js.Camera, folder: Path, cores: list[int]) -> Rate:
    """How fast frames are rendered by so many workers."""
    moments = snapshots.moments(snapshots.times)
    with local_client(workers, cores=cores) as client:
        output = folder / f"{workers}_{time.monotonic_ns()}"
        list(js.render_frames([*moments[:2]] * workers, camera, SETTINGS, client, output=output / "warm"))
        used, started = sum(client.run(time.process_time).values()), time.perf_counter()
        list(js.render_frames(moments, camera, SETTINGS, client, output=output / "timed"))
        elapsed = time.perf_counter() - started
        used = sum(client.run(time.process_time).values()) - used
    return Rate(len(moments) / elapsed, used / len(moments))


def same_whatever_dies(paths: list[Path], camera: js.Camera, folder: Path) -> dict[str, object]:
    """Frames of one process, and of two workers one of which is killed; the broken file is one of the frames."""

    def frames(client: object, output: Path, killed: list[int]) -> tuple[list[js.sequence.FrameFile], str]:
        made, said = [], ""
        try:
            for frame in js.render_frames(paths, camera, SETTINGS, client, output=output):
                made.append(frame)
                if len(made) == FRAMES // 4 and killed:
                    os.kill(killed.pop(), signal.SIGKILL)
        except js.sequence.FramesError as error:
            said = str(error)
        return made, said

    alone, said_alone = frames(None, folder / "alone", [])
    with local_client(2) as client:
        victim = next(iter(client.run(os.getpid).values()))
        on, said_on = frames(client, folder / "on", [victim])
        replaced = victim not in client.run(os.getpid).values()
    failed = [frame.number for frame in on if frame.error is not None]
    same = all(
        one.path.read_bytes() == other.path.read_bytes()
        for one, other in zip(alone, on, strict=True)
        if other.error is None and one.error is None
    )
    return {
        "frames": len(on),
        "failed": failed,
        "named": paths[BROKEN].name in said_on and paths[BROKEN].name in said_alone,
        "same_bits": same and failed == [frame.number for frame in alone if frame.error is not None],
        "worker_replaced": replaced,
    }


def command(folder: Path) -> dict[str, object]:
    """`jaxsph movie --workers 2` over the same files."""
    arguments = ["movie", *sorted(str(path) for path in folder.glob("snap_*.npz")), "--frames", str(FRAMES), "--workers", "2"]
    size = ["--size", "64x64", "--samples", "32", "-o", str(folder / "movie.mp4")]
    ended = subprocess.run([sys.executable, "-m", "jaxsph", *arguments, *size], capture_output=True, text=True)
    return {
        "exit_code": ended.returncode,
        "named": f"snap_{BROKEN:03d}.npz" in ended.stderr,
        "lines_of_stderr_on_failure": sum(line.startswith("jaxsph movie:") for line in ended.stderr.splitlines()),
        "frames_in_movie": js.io.movie_info(folder / "movie.mp4").frames,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--particles", type=int, default=100_000)
    parser.add_argument("--turns", type=int, default=2)
    options = parser.parse_args()
    load = os.getloadavg()
    cores = sorted(os.sched_getaffinity(0))
    assert len(cores) > 1, "two workers need two cores"
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        paths = write_snapshots(folder, options.particles)
        snapshots = js.sequence.Snapshots.from_files(paths)
        camera = js.Camera.framing(snapshots, width=256, height=256)
        rates: dict[int, list[Rate]] = {workers: [] for workers in WORKERS}
        for _ in range(options.turns):
            for workers, found in rates.items():
                found.append(rate(workers, snapshots, camera, folder, cores[:workers]))
            print(rates, flush=True)
        paths[BROKEN].write_bytes(paths[BROKEN].read_bytes()[: paths[BROKEN].stat().st_size // 2])
        whatever = same_whatever_dies(paths, camera, folder)
        print(whatever, flush=True)
        told = command(folder)
        print(told, flush=True)
    turns = list(zip(rates[1], rates[2], strict=True))
    speedup = statistics.median(two.frames_a_second / one.frames_a_second for one, two in turns)
    of_processors = statistics.median(2 * one.processor_seconds_a_frame / two.processor_seconds_a_frame for one, two in turns)
    record = {
        "load_of_the_machine": {"before": load, "after": os.getloadavg()},
        "scene": {"particles": options.particles, "size": 256, "samples": SETTINGS.samples, "frames": FRAMES},
        "rates": {f"{workers} workers": [turn._asdict() for turn in values] for workers, values in rates.items()},
        "speedup_of_two_workers": speedup,
        "speedup_by_processor_seconds": of_processors,
        "killed_and_truncated": whatever,
        "command": told,
    }
    keep(RESULT, [f"{workers} workers" for workers in WORKERS], **record)
    assert whatever["frames"] == FRAMES and whatever["failed"] == [BROKEN + 1]
    assert whatever["same_bits"] and whatever["named"] and whatever["worker_replaced"]
    assert told["exit_code"] == 1 and told["named"] and told["frames_in_movie"] == FRAMES - 1
    assert speedup >= MIN_SPEEDUP, f"two workers are {speedup:.2f} times as fast as one, at a load of {load[0]:.1f} before"


if __name__ == "__main__":
    main()
