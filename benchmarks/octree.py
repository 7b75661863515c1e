"""Claim: where samples lie in slabs, no frame is faster by octrees than by the perspective grid.

Whole frames of particles and of points, everywhere alike and clustered, 256 x 256 pixels and 128 point samples, by the grid and
by octrees (`in_octree`, made once), in turns.

And what octrees of 1,000,000 spheres take to build, how large they are, and at how many entries a sample looks: of a uniform
fluid (the filled cube), a clustered halo (an NFW profile, supports by local density), and points of a hundredth of a support in
it. The rule by which nodes are split is measured by its `ratio`, on as many particles as frames have. Building is counted in
seconds of the one core that it takes. Writes `results/octree.json`; ends in an assert.

    python benchmarks/octree.py [--repeats 3] [--particles 1000000] [--only trees|frames]
"""

from __future__ import annotations

import argparse
import json
import pathlib
import statistics
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import workloads

import jaxsph as js
from jaxsph.engine.access.octree import build_octree
from jaxsph.engine.media.octree_medium import in_octree
from jaxsph.trade.sweep import of_this_run

SAMPLES, SIZE, EVERY = 256, 512, 16
RATIOS = 1.0, 2.0, 4.0
SMALL = 0.01  # of a support: radius of points that overlap nowhere
NOISE = 0.1  # that medians of a few turns are off by
FRAME, FRAME_SAMPLES, FRAME_PARTICLES = 256, 128, 100_000
POINT, OPACITY = 0.3, 0.2  # of a support: radius of points, of which about one is in the reach of each; and what each hides
RESULTS = pathlib.Path(__file__).with_name("results") / "octree.json"


def halo(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Positions and supports of a spherical NFW profile of ten scale radii, each support with 33 particles in it."""
    rng = np.random.default_rng(7)
    grid = np.geomspace(1e-4, 10, 4096)
    mass = np.log1p(grid) - grid / (1 + grid)
    radius = np.interp(rng.uniform(mass[0], mass[-1], count), mass, grid)
    way = rng.normal(size=(count, 3))
    position = way / np.linalg.norm(way, axis=1)[:, None] * radius[:, None]
    number = count / (4 * np.pi * mass[-1]) / (radius * (1 + radius) ** 2)
    return position.astype(np.float32), np.cbrt(33 / (4 / 3 * np.pi * number)).astype(np.float32)


def scene_of(particles: js.Particles) -> js.Scene:
    return js.Scene(particles=particles, transfer=js.scenes.default_transfer(particles))


def contenders(count: int) -> dict[str, tuple[js.Particles, float]]:
    """Particles, and what share of their supports is the radius of a point."""
    fluid = workloads.cube(round(count ** (1 / 3)))
    position, support = halo(count)
    clustered = js.Particles.from_arrays(position, support, np.log(np.linalg.norm(position, axis=1)).astype(np.float32))
    found = {
        "uniform fluid": (js.Particles.from_arrays(fluid.position, fluid.support, fluid.quantity), 1.0),
        "clustered halo": (clustered, 1.0),
        "clustered points": (clustered, SMALL),
    }
    return {name: (js.prepare(particles), share) for name, (particles, share) in found.items()}


def seconds_of(call: Any) -> float:
    started = time.perf_counter()
    jax.block_until_ready(call())
    return time.perf_counter() - started


def spheres(particles: js.Particles, share: float) -> tuple[Any, Any, Any]:
    return particles.position, share * particles.support, particles.valid


def measured(ball: tuple[Any, Any, Any], camera: js.Camera, **rule: float) -> dict[str, Any]:
    """One octree: what it takes, and the entries that samples look at along every `EVERY`-th ray of every `EVERY`-th row."""
    started = time.process_time()
    tree = build_octree(*ball, **rule)
    seconds = time.process_time() - started
    pixels = np.arange(EVERY // 2, SIZE, EVERY) + 0.5
    column, row = np.meshgrid(np.asarray(camera.column(pixels)), np.asarray(camera.row(pixels)))
    depth = np.asarray(camera.depth(jnp.arange(SAMPLES) + 0.5, SAMPLES))
    view = np.stack([column.ravel(), row.ravel(), np.ones(column.size)])[..., None] * depth
    place = np.einsum("kx,krs->xrs", camera.axes, view) + np.asarray(camera.eye)[:, None, None]
    leaf = tree.leaf_at([jnp.asarray((at - zero) / tree.side) for at, zero in zip(place, tree.lower, strict=True)])
    looked, length = np.asarray(leaf.length), np.asarray(tree.node)[:, 1]
    return {
        "build seconds": seconds,
        "entries a sphere": int(np.maximum(length, 0).sum()) / int(np.asarray(ball[2]).sum()),
        "entries a sample": float(looked[looked > 0].mean()),
        "top": tree.top,
        "levels": tree.levels,
        "bytes": tree.node.nbytes + tree.entry.nbytes + tree.occupancy.before.nbytes,
    }


def measure_trees(count: int) -> None:
    """Add to the results what octrees are like."""
    found: dict[str, Any] = {}
    for name, (particles, share) in contenders(count).items():
        found[name] = measured(spheres(particles, share), js.Camera.framing(particles, width=SIZE, height=SIZE))
        print(name, json.dumps(found[name]), flush=True)
    for name, (particles, share) in contenders(FRAME_PARTICLES).items():
        camera = js.Camera.framing(particles, width=SIZE, height=SIZE)
        found[name]["by ratio"] = {ratio: measured(spheres(particles, share), camera, ratio=ratio) for ratio in RATIOS}
        print(name, json.dumps(found[name]["by ratio"]), flush=True)
    write({"trees": {"run": of_this_run(), "particles": count, "found": found}})


def write(more: dict[str, Any]) -> None:
    """Add to the results."""
    kept = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
    RESULTS.parent.mkdir(exist_ok=True)
    RESULTS.write_text(json.dumps(kept | more, indent=1) + "\n")


def frame_scenes(count: int) -> dict[str, tuple[js.Scene, js.Camera]]:
    """Particles and points, everywhere alike and clustered."""
    cube, (position, support) = workloads.cube(round(count ** (1 / 3))), halo(count)
    quantity = np.log(np.linalg.norm(position, axis=1)).astype(np.float32)
    sets = {
        "uniform": js.prepare(js.Particles.from_arrays(cube.position, cube.support, cube.quantity)),
        "clustered": js.prepare(js.Particles.from_arrays(position, support, quantity)),
    }
    found = {}
    for name, particles in sets.items():
        camera, valid = js.Camera.framing(particles, width=FRAME, height=FRAME), np.asarray(particles.valid)
        place, radius = (np.asarray(value)[valid] for value in (particles.position, POINT * particles.support))
        if name == "uniform":  # a lattice would have points in rows
            place = np.random.default_rng(8).uniform(place.min(0), place.max(0), place.shape).astype(np.float32)
        points = js.Points.from_arrays(place, radius, (1.0, 0.8, 0.5), opacity=OPACITY)
        found |= {f"{name} particles": (scene_of(particles), camera), f"{name} points": (js.Scene(points=points), camera)}
    return found


def by_access(scene: js.Scene, camera: js.Camera, repeats: int) -> dict[str, Any]:
    """Seconds of a frame by the grid and by octrees, in turns; and how far their images are apart."""
    settings, started = js.Settings(samples=FRAME_SAMPLES), time.perf_counter()
    shown = {"grid": scene, "octree": jax.block_until_ready(in_octree(scene))}
    made = time.perf_counter() - started
    first = {name: np.asarray(js.render(one, camera, settings).color) for name, one in shown.items()}  # compiles
    times: dict[str, list[float]] = {name: [] for name in shown}
    for _ in range(repeats):
        for name, one in shown.items():
            times[name].append(seconds_of(lambda one=one: js.render(one, camera, settings).color))
    seconds = {name: statistics.median(turns) for name, turns in times.items()}
    apart = float(np.abs(first["grid"] - first["octree"]).mean())
    return {"seconds": seconds, "octree over grid": seconds["octree"] / seconds["grid"], "made": made, "mean difference": apart}


def measure_frames(repeats: int) -> None:
    """Add to the results which access wins."""
    rows = {}
    for name, (scene, camera) in frame_scenes(FRAME_PARTICLES).items():
        rows[name] = by_access(scene, camera, repeats)
        print(name, json.dumps(rows[name]), flush=True)
    shape = {"size": FRAME, "samples": FRAME_SAMPLES, "particles": FRAME_PARTICLES, "repeats": repeats}
    write({"frames": {"run": of_this_run(), **shape, "found": rows}})
    assert min(row["octree over grid"] for row in rows.values()) >= 1 - NOISE


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--particles", type=int, default=1_000_000)
    parser.add_argument(
        "--only", choices=("trees", "frames"), help="measure one of both, and leave the other in the file as it is"
    )
    arguments = parser.parse_args()
    if arguments.only != "frames":
        measure_trees(arguments.particles)
    if arguments.only != "trees":
        measure_frames(arguments.repeats)


if __name__ == "__main__":
    main()
