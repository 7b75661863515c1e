"""Claim: a projection keeps all mass, has the column density of a uniform box to 1e-4, and agrees with other codes to 1e-3.

Of each particle file along z at 512 x 512, and beside a peer at 256 x 256; in periodic boxes between their faces:

    mass       in the image, over that of the particles (`--pixel mean`), to 1e-3;
    uniform    the middle of a lattice of equal particles, cubic spline and Wendland C2, whole and cut by depths, to 1e-4;
    sarracen   column density by the cubic spline over 2 h, where that is the support: its exact means over pixels against
               `pixel="mean"`, its rays through their middles against `pixel="ray"`. Relative differences in pixels that hold at
               least 1e-3 of the most, and their 99.9 %; to 1e-3. A periodic box is given to it as copies beside the box along x
               and y, and rays pass the whole of each copy: of a whole period that is the same. All is moved by 1e-6 of a
               pixel, as its exact means raise an error where a particle lies on the edge of one;
    seconds    of `project`, compiled, and what compiling took; and of the peer, compiled, in its own process before.

Peers are asked in a process of their own, by a Python that has them, and left out where it does not. Writes
`results/projections.json`; ends in asserts.

    python benchmarks/projections.py FILE ... [--peer-python PYTHON] [--sizes 256 512] [--repeats 3] [--check]
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
from typing import Any

import jax
import numpy as np

import jaxsph as js
from jaxsph.analysis.projection.plan import plan_projection
from jaxsph.io.settle.quantities import ROLES, choose_quantity
from jaxsph.trade.measurement import of_this_run

MASS, UNIFORM, PEER, HELD = 1e-3, 1e-4, 1e-3, 1e-3
OFF = 1e-6  # pixels
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
    off = np.abs(values[there] / truth[there] - 1)
    of_most = float(np.abs(values - truth).max() / truth.max())
    return {"pixels": int(there.sum()), "median": float(np.median(off)), "99.9 %": float(np.quantile(off, 0.999))} | {
        "largest": float(off.max()), "largest of the most": of_most
    }  # fmt: skip


def measured(path: str, options: argparse.Namespace) -> dict[str, Any]:
    """One file."""
    table = js.io.read_table(path)
    particles = js.io.particles_from_table(table, "x", kernel="cubic_spline")[0]
    name = table.named(*ROLES["mass"])
    mass = np.ones(len(table)) if name is None else choose_quantity(table, name)[0]
    found: dict[str, Any] = {"particles": len(table), "periodic": particles.box is not None, "format": table.source, "sizes": {}}
    for size in sorted(options.sizes):
        camera = js.Camera.along_axis(particles, "z", size, size)
        peer = None
        if options.peer_python and size == min(options.sizes):  # the peer takes minutes
            peer = asked(options.peer_python, particles, mass / mass.mean(), camera)
        rows = {rule: row_of(particles, mass / mass.mean(), camera, rule, peer, options.repeats) for rule in ("mean", "ray")}
        pixel = 2 * float(camera.half_height) / size
        rows["smallest support in pixels"] = float(particles.to_numpy()["support"].min() / pixel)
        found["sizes"][size] = rows
        print(f"{pathlib.Path(path).name} {size} {json.dumps(rows)}", flush=True)
    return found


def row_of(particles: js.Particles, mass: np.ndarray, camera: js.Camera, rule: str, peer: Any, repeats: int) -> dict[str, Any]:
    """One image, its time, and how far it is from the peer's."""
    plan, seconds = plan_projection(particles, camera, pixel=rule), []
    for _ in range(repeats + 1):
        started = time.perf_counter()
        image = js.project(particles, camera, mass, pixel=rule, plan=plan)
        jax.block_until_ready(image.values)
        seconds.append(time.perf_counter() - started)
    values, area = np.asarray(image.values, np.float64), float(image.pixel_area)
    row: dict[str, Any] = {"seconds": statistics.median(seconds[1:]), "first_seconds": seconds[0]}
    row["mass"] = float(values.sum() * area / mass.sum() - 1)
    if peer is not None:
        row["sarracen"] = differences(values, peer[rule]) | {"seconds": peer[f"{rule}_seconds"], "version": peer["version"]}
        row["sarracen"]["mass"] = float(peer[rule].sum() * area / mass.sum() - 1)
    return row


def check(result: dict[str, Any]) -> None:
    """The claim."""
    assert all(off <= UNIFORM for off in result["uniform"].values()), result["uniform"]
    for name, found in result["files"].items():
        for size, rows in found["sizes"].items():
            assert abs(rows["mean"]["mass"]) <= MASS, (name, size)
            for rule in ("mean", "ray"):
                if "sarracen" in rows[rule]:
                    assert rows[rule]["sarracen"]["99.9 %"] <= PEER, (name, size, rule)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("files", nargs="*", metavar="FILE")
    parser.add_argument("--peer-python")
    parser.add_argument("--sizes", type=int, nargs="+", default=[256, 512], help="the smallest is that of the peer, too")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--check", action="store_true", help="do not write results")
    options = parser.parse_args()
    result = {**of_this_run(), "uniform": {kernel: uniform(kernel) for kernel in LATTICES}}
    print("uniform", result["uniform"])
    result["files"] = {pathlib.Path(path).name: measured(path, options) for path in options.files}
    check(result)
    if not options.check:
        RESULTS.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
