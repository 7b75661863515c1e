"""Claim: a snapshot is rendered within a quarter of its size in memory, the same pixels as in memory, in at most twice the time.

A made Gadget-like snapshot in eight files, ordered in cells, of 60 bytes a particle. Each way is a process of its own, of which
the peak of resident memory is taken, less that of the same with a thousandth of the particles: what Python, JAX and compiled
programs take. Times are from opening the files to the image, the second frame in the process (programs compiled, files in the
system's cache); the index is made before, and its time told apart. Writes `results/larger_than_memory.json`; ends in an assert.

With `--shares` it shows instead that any share of the size gives the same picture, or a refusal that names what should do, and
that this works: a table, with another assert.

    python benchmarks/larger_than_memory.py [--particles 20000000] [--size 1024] [--share 0.25] [--folder DIR]
    python benchmarks/larger_than_memory.py --shares 0.25 0.35 0.5 [--particles 8000000] [--frames 1]
"""

from __future__ import annotations

import argparse
import json
import pathlib
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from typing import Any

import h5py
import numpy as np

import jaxsph as js
from jaxsph.io.replace import written_whole
from jaxsph.scale.from_disk import TooLittleMemoryError
from jaxsph.trade.sweep import of_this_run

FILES, NEIGHBOURS = 8, 32
CELLS = 16  # of a file along each edge
SAMPLES = 256
SMALL = 1000  # times fewer particles, by which what programs take is known
MOST_TIME, SAME = 2.0, 1e-6
RESULTS = pathlib.Path(__file__).with_name("results") / "larger_than_memory.json"


def write(folder: pathlib.Path, count: int) -> pathlib.Path:
    """A snapshot of the unit cube, of which each file has a slice, ordered in cells; the first file of it."""
    rng, each = np.random.default_rng(0), count // FILES
    support = 1.2 * np.cbrt(NEIGHBOURS / (4 / 3 * np.pi * count))
    for number in range(FILES):
        octant = np.array([number >> 2 & 1, number >> 1 & 1, number & 1], np.float32)
        position = (octant + rng.random((each, 3), np.float32)) / 2
        cell = np.floor((position - octant / 2) * (2 * CELLS)).clip(0, CELLS - 1).astype(int)
        position = position[np.argsort(cell @ np.array([CELLS**2, CELLS, 1]), kind="stable")]
        x, y, z = position.T
        density = 1 + 0.5 * np.sin(9 * x) * np.sin(7 * y)
        columns = {
            "Coordinates": position,
            "Velocities": rng.random((each, 3), np.float32),
            "ParticleIDs": np.arange(each, dtype=np.int64) + number * each,
            "Masses": (density / count).astype(np.float32),
            "Density": density.astype(np.float32),
            "InternalEnergy": (1.5 + np.sin(12 * x) * np.cos(10 * y) * np.sin(8 * z + 1)).astype(np.float32),
            "SmoothingLength": (support * rng.uniform(0.9, 1.1, each)).astype(np.float32),
            "Potential": rng.random(each, np.float32),
            "Metallicity": rng.random(each, np.float32),
        }
        with h5py.File(folder / f"snap.{number}.hdf5", "w") as file:
            header = file.create_group("Header").attrs
            header["NumFilesPerSnapshot"], header["ThisFile"], header["Time"] = FILES, number, 1.0
            for name, values in columns.items():
                file[f"PartType0/{name}"] = values
    return folder / "snap.0.hdf5"


def one_way(options: argparse.Namespace) -> None:
    """Render one way, twice, and print what it took; in a process of its own."""
    begun = time.perf_counter()
    on_disk = js.scale.OnDisk.open(options.path, "InternalEnergy", kernel="cubic_spline")
    opened = time.perf_counter() - begun
    transfer = js.TransferFunction.from_colormap("viridis", (0.5, 2.5), 3.0)
    camera = js.Camera.framing(on_disk, width=options.size, height=options.size)
    seconds: list[float] = []
    for _ in range(options.frames):
        begun = time.perf_counter()
        if options.way == "disk":
            on_disk = js.scale.OnDisk.open(options.path, "InternalEnergy", kernel="cubic_spline")
            try:
                image = js.scale.render_from_disk(on_disk, transfer, camera, js.Settings(samples=SAMPLES), memory=options.memory)
            except TooLittleMemoryError as error:
                print(json.dumps({"refused": str(error), "least": error.least}))
                return
        else:
            particles = js.io.read_particles(options.path, "InternalEnergy", kernel="cubic_spline", box=None)
            image = js.render(js.Scene(particles=particles, transfer=transfer), camera, js.Settings(samples=SAMPLES))
        color = np.asarray(image.color)
        seconds.append(time.perf_counter() - begun)
    np.save(options.image, color)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    stats = {name: image.stats.get(name) for name in ("panes", "most_particles")}
    print(json.dumps({"opened": opened, "first": seconds[0], "seconds": seconds[-1], "peak": peak, **stats}))


def apart(way: str, path: pathlib.Path, memory: int, size: int, frames: int = 2) -> tuple[dict[str, Any], Any]:
    """What a way takes in a process of its own, and its image."""
    image = path.with_name(f"{way}.npy")
    command = [sys.executable, __file__, "--way", way, "--path", str(path), "--memory", str(memory), "--image", str(image)]
    command += ["--size", str(size), "--frames", str(frames)]
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
    told = json.loads(done.stdout.splitlines()[-1])
    return told, None if "least" in told else np.load(image)


def compared(options: argparse.Namespace, folder: pathlib.Path) -> dict[str, Any]:
    for name in ("whole", "small"):
        (folder / name).mkdir(exist_ok=True)
    path, small = write(folder / "whole", options.particles), write(folder / "small", options.particles // SMALL)
    size = sum(file.stat().st_size for file in path.parent.glob("*.hdf5"))
    memory = int(options.share * size)
    found: dict[str, Any] = {"particles": options.particles, "bytes": size, "limit": memory, "size": options.size}
    images = {}
    for way in ("disk", "memory"):
        base, _ = apart(way, small, memory, options.size)
        told, images[way] = apart(way, path, memory, options.size)
        if way == "disk":  # the first process has made the index
            found["indexed"] = told["opened"]
            told, images[way] = apart(way, path, memory, options.size)
        found[way] = told | {"beyond": told["peak"] - base["peak"]}
        print(way, found[way], flush=True)
    found["apart"] = float(np.abs(images["disk"] - images["memory"]).max())
    return found


def of_shares(options: argparse.Namespace, folder: pathlib.Path) -> None:
    """A table of what each share of the size gives, beside the picture in memory."""
    path = write(folder, options.particles)
    size = sum(file.stat().st_size for file in folder.glob("*.hdf5"))
    whole, image = apart("memory", path, size, options.size, options.frames)
    print(f"{options.particles:,} particles, {size / 1e6:.0f} MB; in memory {whole['seconds']:.1f} s", flush=True)
    for share in options.shares:
        memory = int(share * size)
        told, picture = apart("disk", path, memory, options.size, options.frames)
        if picture is None:
            print(f"{share:g} | {memory / 1e6:.1f} MB | refused: {told['refused']}", flush=True)
            memory = told["least"]
            told, picture = apart("disk", path, memory, options.size, options.frames)
        assert picture is not None, f"{memory} bytes were named as enough: {told['refused']}"
        off = float(np.abs(picture - image).max())
        took = f"{told['seconds']:.1f} s, {told['seconds'] / whole['seconds']:.2f} of the time"
        print(f"{share:g} | {memory / 1e6:.1f} MB | {told['panes']} panes | {took} | apart {off:.1e}", flush=True)
        assert off <= SAME


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--particles", type=int, default=20_000_000)
    parser.add_argument("--size", type=int, default=1024, help="pixels on a side")
    parser.add_argument("--share", type=float, default=0.25, help="of the size of the snapshot, that memory may be")
    parser.add_argument("--shares", type=float, nargs="+", help="several shares: a table of them, and no measurement is kept")
    parser.add_argument("--frames", type=int, default=2, help="in each process, the last of which is timed")
    parser.add_argument("--folder", type=pathlib.Path, help="where to write the snapshot")
    parser.add_argument("--way", choices=("disk", "memory"), help=argparse.SUPPRESS)
    for name, kind in (("path", pathlib.Path), ("memory", int), ("image", pathlib.Path)):
        parser.add_argument(f"--{name}", type=kind, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.way:
        one_way(options)
        return
    folder = pathlib.Path(tempfile.mkdtemp(dir=options.folder))
    try:
        if options.shares:
            of_shares(options, folder)
            return
        found = compared(options, folder)
    finally:
        shutil.rmtree(folder)
    ratio = found["disk"]["seconds"] / found["memory"]["seconds"]
    print(f"{found['disk']['beyond'] / found['bytes']:.2f} of its size, {ratio:.2f} of the time, apart {found['apart']:.1e}")
    with written_whole(RESULTS) as temporary:
        temporary.write_text(json.dumps({"run": of_this_run(), **found}, indent=1) + "\n")
    assert found["apart"] <= SAME and found["disk"]["beyond"] <= options.share * found["bytes"]
    assert ratio <= MOST_TIME


if __name__ == "__main__":
    main()
