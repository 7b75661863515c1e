"""Claim: a projection keeps all mass, has the column density of a uniform box to 1e-4, and agrees with other codes to 1e-3.

    uniform    the middle of a lattice of equal particles, cubic spline and Wendland C2, whole and cut by depths, to 1e-4.

Of random particles of equal supports in a unit box, along z, in turns in one process: rays and means over pixels of `project` by
either kernel, and swiftsimio's backends, which sum a Wendland C2 kernel of two dimensions over the same supports:

    seconds    of an image as a user asks for it, plan included, the first apart; and over those of swiftsimio's `fast`;
    error      against what a pixel of each stands for, by its own kernel and summed in float64, in the middle of the image: rays
               of `project`, to 1e-5, of `fast` and of `nested`; means of `project`, to 1e-4, and of `subsampled`;
    column     of swiftsimio's: against the column of Wendland C2 in three dimensions, of which its kernel is not the integral.

Of each particle file along z at 512 x 512, and beside another peer at 256 x 256; in periodic boxes between their faces:

    seconds    as above; and of the peer, compiled, in its own process before;
    mass       in the image, over that of the particles (`--pixel mean`), to 1e-3;
    sarracen   column density by the cubic spline over 2 h, where that is the support: its exact means over pixels against
               `pixel="mean"`, its rays through their middles against `pixel="ray"`, to 1e-3. A periodic box is given to it as
               copies beside the box along x and y, and rays pass the whole of each copy: of a whole period that is the same.
               All is moved by 1e-6 of a pixel, as its exact means raise an error where a particle lies on the edge of one.

Of clustered particles, whose supports span a factor of 100 and of which 40 % are smaller than three pixels at 512 x 512:

    seconds    of rays, of means, and of a slice through the middle: of sums of masses and of means of a quantity; in turns;
    error      of slices, against float64 sums at 4,096 of its places, over the largest value, to 1e-6.

Differences are relative, in pixels that hold at least 1e-3 of the most. Peers are left out where they are not: swiftsimio is
asked in this process (`pip install "jaxsph[peers]"`), sarracen in one of its own, by a Python that has it. Writes
`results/projections.json`; ends in asserts.

    python benchmarks/projections.py [FILE ...] [--peer-python PYTHON] [--sizes 256 512] [--boxes 200000,512 ...] [--check]
"""

from __future__ import annotations

import argparse
import itertools
import json
import pathlib
import statistics
import subprocess
import tempfile
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from kept import keep

import jaxsph as js
from jaxsph.io.settle.quantities import choose_quantity
from jaxsph.model.particles import kernels
from jaxsph.reference.image import integral_across

try:
    import swiftsimio
    from swiftsimio.visualisation.projection_backends import backends_parallel
    from swiftsimio.visualisation.projection_backends.kernels import kernel_gamma
except ImportError:
    swiftsimio = None

MASS, UNIFORM, PEER, HELD = 1e-3, 1e-4, 1e-3, 1e-3
ERROR = {"ray": 1e-5, "mean": 1e-4}
OFF = 1e-6  # pixels
PAUSE = 0.5  # seconds between turns: threads of OpenMP spin for some 0.2 s after a peer's image, on the next contender's cores
SPACINGS = 2.4  # supports in mean spacings of the particles of a box
WINDOW = 64  # pixels on a side, in the middle of a box, whose truth is known
BACKENDS = {"fast": "ray", "subsampled": "mean", "nested": "ray"}  # of swiftsimio, and what a pixel of each stands for
CLUSTERS = np.array([[0.3, 0.35, 0.5], [0.7, 0.4, 0.45], [0.5, 0.72, 0.55]])
SLICED = 1e-6
LATTICES = {"cubic_spline": 4.2, "wendland_c2": 5.2}  # supports in spacings, for which sums over a lattice are even
RESULTS = pathlib.Path(__file__).with_name("results") / "projections.json"
ASK = """
import sys, time
import numpy as np
import sarracen

given = np.load(sys.argv[1])
h, mass = given["support"] / 2, given["mass"]
columns = {"x": given["x"], "y": given["y"], "z": 0 * h, "h": h, "m": mass, "rho": mass / h**3}
data = sarracen.SarracenDataFrame(columns, params={"hfact": 1.0})
data.kernel = sarracen.kernels.CubicSplineKernel()
size, found = int(given["size"]), {"version": sarracen.__version__}
for name, exact in (("mean", True), ("ray", False)):
    how = {"exact": exact, "normalize": False, "integral_samples": 10000}
    how |= {"xlim": tuple(given["xlim"]), "ylim": tuple(given["ylim"])}
    for side in (8, size):  # the first compiles
        started = time.perf_counter()
        found[name] = sarracen.interpolate.interpolate_3d_proj(data, "rho", x_pixels=side, y_pixels=side, **how)
        found[name + "_seconds"] = time.perf_counter() - started
np.savez(sys.argv[2], **found)
"""


def uniform(kernel: str) -> float:
    """The largest relative error of the column density in the middle of a lattice of 24^3, whole and cut."""
    axis = (np.arange(24) + 0.5) / 12 - 1
    position = np.stack(np.meshgrid(axis, axis, axis), -1).reshape(-1, 3)
    particles = js.Particles.from_arrays(position, LATTICES[kernel] / 12, 0.0, 3.0 / 12**3, kernel)
    camera = js.Camera.orthographic((0, 0, 5), (0, 0, 0), view_height=0.7, width=64, height=64, near=1, far=9)
    off = []
    for ends, depth in ((None, 2.0), ((4.6, 5.3), 0.7)):
        values = np.asarray(js.project(particles, camera, depth_range=ends).values, np.float64)
        off.append(np.abs(values / (3.0 * depth) - 1).max())
    return float(max(off))


def copies(particles: js.Particles, mass: np.ndarray) -> dict[str, np.ndarray]:
    """Places across z, supports and masses in float64; of a periodic box with the copies beside it."""
    columns = particles.to_numpy()
    place, support = particles.exact_position()[: particles.num_particles, :2], columns["support"].astype(np.float64)
    if particles.box is not None:
        lower, upper = (corner[:2] for corner in particles.box.corners())
        place = lower + np.mod(place - lower, upper - lower)
        turns = np.array(list(itertools.product((-1, 0, 1), repeat=2)))
        place = (place + turns[:, None] * (upper - lower)).reshape(-1, 2)
        support, mass = np.tile(support, len(turns)), np.tile(mass, len(turns))
    return {"x": place[:, 0], "y": place[:, 1], "support": support, "mass": mass}


def asked(python: str, particles: js.Particles, mass: np.ndarray, camera: js.Camera) -> Any:
    """Images of the peer, rows from the top; None where it is not there."""
    half = float(camera.half_height)
    middle = camera.exact_eye()[:2] - np.array([OFF, 0.7 * OFF]) * 2 * half / camera.height
    ends = {f"{axis}lim": middle[k] + half * np.array([-1, 1]) for k, axis in enumerate("xy")}
    with tempfile.TemporaryDirectory() as folder:
        given, answer = pathlib.Path(folder) / "given.npz", pathlib.Path(folder) / "answer.npz"
        np.savez(given, **copies(particles, mass), **ends, size=camera.width)
        run = subprocess.run([python, "-c", ASK, str(given), str(answer)], capture_output=True, text=True)
        if run.returncode:
            print(f"no peer: {run.stderr.strip().splitlines()[-1:]}")
            return None
        with np.load(answer) as found:
            return {name: found[name][::-1] if found[name].ndim else found[name].item() for name in found.files}


def differences(values: np.ndarray, truth: np.ndarray) -> dict[str, float]:
    """Relative, in pixels that hold enough."""
    there = truth > HELD * truth.max()
    off, of_most = np.abs(values[there] / truth[there] - 1), np.abs(values - truth).max() / truth.max()
    found = {"median": np.median(off), "99.9 %": np.quantile(off, 0.999), "largest": off.max(), "largest of the most": of_most}
    return {"pixels": int(there.sum())} | {name: float(each) for name, each in found.items()}


def in_turns(runs: dict[Any, Callable[[], Any]], repeats: int) -> dict[Any, tuple[np.ndarray, dict[str, Any]]]:
    """Image and seconds of each, the first apart."""
    seconds: dict[Any, list[float]] = {name: [] for name in runs}
    images = {}
    for _ in range(repeats + 1):
        for name, run in runs.items():
            time.sleep(PAUSE)
            started = time.perf_counter()
            images[name] = np.asarray(run())
            seconds[name].append(time.perf_counter() - started)
    rows = {name: {"seconds": statistics.median(each[1:]), "first_seconds": each[0]} for name, each in seconds.items()}
    return {name: (images[name].astype(np.float64), row) for name, row in rows.items()}


def ours(particles: js.Particles, camera: js.Camera, of: Any = None) -> dict[str, Callable[[], Any]]:
    """Both rules of pixels."""
    return {rule: lambda rule=rule: js.project(particles, camera, of, pixel=rule).values for rule in ("ray", "mean")}


def theirs(place: np.ndarray, support: np.ndarray, mass: np.ndarray, size: int) -> dict[str, Callable[[], Any]]:
    """Backends of swiftsimio, rows from the top; none where it is not there."""
    if swiftsimio is None:
        return {}
    x, y = place[:, :2].T.astype(np.float64)
    given = x, y, mass, (support / kernel_gamma).astype(np.float32), size
    return {name: lambda name=name: backends_parallel[name](*given).T[::-1] for name in BACKENDS}


def profiles(away: np.ndarray) -> dict[str, np.ndarray]:
    """Columns of kernels of support 1 at distances from their middles, and the kernel in two dimensions of swiftsimio."""
    found, end = {"swiftsimio": 7 / np.pi * (1 - away) ** 4 * (1 + 4 * away)}, np.ones_like(away)
    for name in LATTICES:
        kernel = kernels.by_name(name)
        column = integral_across(
            np.array([0.0, *reversed(kernel.ends)]),
            away**2,
            lambda square, t, of=kernel: of.of_square(square + t * t, np),
            -end,
            end,
        )
        found[name] = kernel.norm * column
    return found


def truth(place: np.ndarray, support: float, mass: float, size: int) -> dict[str, dict[str, np.ndarray]]:
    """Rays and means of the window by each profile, in float64."""
    nodes, weights = np.polynomial.legendre.leggauss(3)  # of a pixel on each axis: the one in the middle is its ray
    x = ((size - WINDOW) / 2 + np.arange(WINDOW)[:, None] + (1 + nodes) / 2).ravel() / size
    away = np.linspace(0, 1, 2**16 + 1)  # so fine that a line between two is right to 1e-8
    tables = profiles(away)
    sums = {name: np.zeros((len(x), len(x))) for name in tables}
    near = (np.abs(place[:, :2] - 0.5) < WINDOW / 2 / size + support).all(1)
    for middle in place[near].astype(np.float64):
        distance = np.hypot(x - middle[0], x[::-1, None] - middle[1]) / support
        met = np.nonzero(distance < 1)
        for name, table in tables.items():
            sums[name][met] += np.interp(distance[met], away, table)
    parts = {name: (each * mass / support**2).reshape(WINDOW, 3, WINDOW, 3) for name, each in sums.items()}
    means = {name: np.einsum("isjt,s,t->ij", each, weights / 2, weights / 2) for name, each in parts.items()}
    return {name: {"ray": parts[name][:, 1, :, 1], "mean": means[name]} for name in parts}


def box(count: int, size: int, repeats: int) -> dict[str, Any]:
    """One box: all contenders."""
    place = np.random.default_rng(0).random((count, 3)).astype(np.float32)
    support, mass = np.full(count, SPACINGS * count ** (-1 / 3), np.float32), np.full(count, 1 / count, np.float32)
    camera = js.Camera.orthographic((0.5, 0.5, 3), (0.5, 0.5, 0), view_height=1, width=size, height=size)
    runs = {("swiftsimio", name): run for name, run in theirs(place, support, mass, size).items()}
    for kernel in LATTICES:
        particles = js.Particles.from_arrays(place, support, 0.0, mass, kernel)
        runs |= {(kernel, rule): run for rule, run in ours(particles, camera).items()}
    middle, right = slice((size - WINDOW) // 2, (size + WINDOW) // 2), truth(place, float(support[0]), float(mass[0]), size)
    rows: dict[str, Any] = {}
    for (code, name), (values, row) in in_turns(runs, repeats).items():
        rule, seen = BACKENDS.get(name, name), values[middle, middle]
        rows[f"{code} {name}"] = row
        row["error"] = differences(seen, right[code][rule])
        if "swiftsimio fast" in rows:
            row["over fast"] = row["seconds"] / rows["swiftsimio fast"]["seconds"]
        if code == "swiftsimio":
            row["column"] = differences(seen, right["wendland_c2"][rule])
        print(f"{count} {size} {code} {name} {json.dumps(row)}", flush=True)
    return rows


def crowded(count: int, size: int, repeats: int) -> dict[str, Any]:
    """Three clusters, evenly dense a logarithm of the radius: rays, means over pixels, and slices."""
    rng = np.random.default_rng(7)
    radius, direction = np.exp(rng.uniform(np.log(0.004), np.log(0.4), count)), rng.normal(size=(count, 3))
    place = CLUSTERS[np.arange(count) % 3] + radius[:, None] * direction / np.linalg.norm(direction, axis=1)[:, None]
    spacing = radius * (4 * np.pi * np.log(100) * 3 / count) ** (1 / 3)
    mass, camera = (
        np.full(count, 1 / count, np.float32),
        js.Camera.orthographic((0.5, 0.5, 3), (0.5, 0.5, 0), (0, 1, 0), 1, size, size),
    )
    particles = js.Particles.from_arrays(place, SPACINGS * spacing, radius**-0.5, spacing**3, "cubic_spline")
    plane, seen = (
        js.Plane((0.5, 0.5, 0.5), (0, 0, 1)),
        {"center": (0.5, 0.5, 0.5), "view_height": 1.0, "width": size, "height": size},
    )
    asked = {"slice of sums": {"of": mass, "normalised": False}, "slice of means": {}}
    runs = ours(particles, camera, mass)
    runs |= {name: lambda how=how: js.slice(particles, plane, **seen, **how).values for name, how in asked.items()}
    rows, some = {}, rng.choice(size**2, 4096, replace=False)
    points = js.slice(particles, plane, **seen).positions().reshape(-1, 3)[some]
    for name, (values, row) in in_turns(runs, repeats).items():
        rows[name] = row
        if name in asked:
            truth, found = np.asarray(js.sample(particles, points, **asked[name]), np.float64), values.ravel()[some]
            both = np.isfinite(truth) & np.isfinite(found)  # but for rounding at the edge of supports
            row["error"] = float(np.abs(found - truth)[both].max() / np.abs(truth[both]).max())
            row["one alone"] = int((np.isfinite(truth) != np.isfinite(found)).sum())
        row["over rays"] = row["seconds"] / rows["ray"]["seconds"]
        print(f"{count} {size} clustered {name} {json.dumps(row)}", flush=True)
    return rows


def measured(path: str, options: argparse.Namespace) -> dict[str, Any]:
    """One file."""
    table = js.io.read_table(path)
    particles = js.io.particles_from_table(table, "x", kernel="cubic_spline")[0]
    name = table.of_role("mass")
    mass = np.ones(len(table)) if name is None else choose_quantity(table, name)[0]
    mass = mass / mass.mean()
    found: dict[str, Any] = {"particles": len(table), "periodic": particles.box is not None, "format": table.source, "sizes": {}}
    for size in sorted(options.sizes):
        camera = js.Camera.along_axis(particles, "z", size, size)
        peer = None
        if options.peer_python and size == min(options.sizes):  # the peer takes minutes
            peer = asked(options.peer_python, particles, mass, camera)
        pixel = 2 * float(camera.half_height) / size
        rows: dict[str, Any] = {"smallest support in pixels": float(particles.to_numpy()["support"].min() / pixel)}
        for rule, (values, row) in in_turns(ours(particles, camera, mass), options.repeats).items():
            row["mass"], rows[rule] = float(values.sum() * pixel**2 / mass.sum() - 1), row
            if peer is not None:
                row["sarracen"] = differences(values, peer[rule]) | {
                    "seconds": peer[f"{rule}_seconds"],
                    "version": peer["version"],
                }
                row["sarracen"]["mass"] = float(peer[rule].sum() * pixel**2 / mass.sum() - 1)
        found["sizes"][size] = rows
        print(f"{pathlib.Path(path).name} {size} {json.dumps(rows)}", flush=True)
    return found


def check(result: dict[str, Any]) -> None:
    """The claim."""
    assert all(off <= UNIFORM for off in result["uniform"].values()), result["uniform"]
    for case, rows in result["boxes"].items():
        for name, row in rows.items():
            code, rule = name.split()
            assert code == "swiftsimio" or row["error"]["largest"] <= ERROR[rule], (case, name, row)
    for case, rows in result["clustered"].items():
        for name, row in rows.items():
            assert row.get("error", 0) <= SLICED and row.get("one alone", 0) <= 2, (case, name, row)
    for name, found in result["files"].items():
        for size, rows in found["sizes"].items():
            assert abs(rows["mean"]["mass"]) <= MASS, (name, size)
            for rule in ("mean", "ray"):
                if "sarracen" in rows[rule]:
                    assert rows[rule]["sarracen"]["99.9 %"] <= PEER, (name, size, rule)


def variants() -> list[str]:
    """Names of all that is compared."""
    return [f"swiftsimio {name}" for name in BACKENDS] + [f"{kernel} {rule}" for kernel in LATTICES for rule in ("ray", "mean")]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("files", nargs="*", metavar="FILE")
    parser.add_argument("--peer-python")
    parser.add_argument("--sizes", type=int, nargs="+", default=[256, 512], help="the smallest is that of the peer, too")
    cases = ["32768,512", "200000,512", "1000000,1024"]
    parser.add_argument("--boxes", nargs="*", default=cases, metavar="PARTICLES,SIZE", help="pixels: a multiple of 16")
    clustered = ["200000,512", "200000,1024", "1000000,1024"]
    parser.add_argument("--clustered", nargs="*", default=clustered, metavar="PARTICLES,SIZE")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--check", action="store_true", help="do not write results")
    options = parser.parse_args()
    result: dict[str, Any] = {"swiftsimio": getattr(swiftsimio, "__version__", None)}
    if swiftsimio is None:
        print("no swiftsimio here: boxes are projected without a peer")
    result["uniform"] = {kernel: uniform(kernel) for kernel in LATTICES}
    print("uniform", result["uniform"])
    result["boxes"] = {case: box(*map(int, case.split(",")), options.repeats) for case in options.boxes}
    result["clustered"] = {case: crowded(*map(int, case.split(",")), options.repeats) for case in options.clustered}
    result["files"] = {pathlib.Path(path).name: measured(path, options) for path in options.files}
    if not options.check:
        keep(RESULTS, [name for rows in result["boxes"].values() for name in rows], **result)
    check(result)


if __name__ == "__main__":
    main()
