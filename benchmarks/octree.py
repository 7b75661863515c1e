"""Claim: where points overlap nowhere, less than a twentieth of the evaluations of a flat march are left along rays in an octree.

A uniform fluid (the filled cube, 1,000,000 particles), a clustered halo of as many (an NFW profile, supports by local density),
the same with points of a hundredth of a support, and maybe particles of a file. Counted along every n-th ray of 512 x 512, with
256 samples: how many samples ask the tree, and how many pairs of a point and a sample are evaluated,

    flat       every sample of every ray that crosses the box asks, and evaluates all entries of its leaf;
    skipping   leaves without entries are skipped;
    segments   and a point is evaluated in a leaf only if it meets the ray's segment in there, which takes a test for each entry
               (Kaehler, Abel & Hege 2007, section 3.2); a segment without any is skipped;
    needed     pairs of a sample and a point whose sphere it is in.

Building, with a kept plan, is timed in turns with a frame of `jaxsph.render`. The rule by which nodes are split is measured by
its `ratio`, if asked for, on a tenth of the particles. Writes `results/octree.json`; ends in an assert.

And which access wins: whole frames of the same scenes, 256 x 256 pixels and 128 point samples, by the perspective grid and by
octrees (`jaxsph.in_octree`, made once), in turns. `--only-frames` measures this alone, and leaves all else in the file as it is.

    python benchmarks/octree.py [--repeats 3] [--particles 1000000] [--every 16] [--ratios] [--data FILE] [--check]
                                [--only-frames]
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import pathlib
import statistics
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import workloads
from leaves_along import LeavesAlong, leaves_along

import jaxsph as js
from jaxsph.engine.access.octree import Octree
from jaxsph.engine.access.octree_build import OctreePlan, build_octree, plan_octree
from jaxsph.trade.measurement import of_this_run

SAMPLES, SIZE, LEAVES = 256, 512, 512
RATIOS = 1.0, 2.0, 4.0
SMALL = 0.01  # of a support: radius of points that overlap nowhere
AT_ONCE = 1 << 22  # (segment, entry) pairs that are tested together
MAX_SHARE = 0.05  # evaluations of small points with all skipping, of those without
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


def contenders(count: int, data: str | None) -> dict[str, tuple[js.Particles, float]]:
    """Particles, and what share of their supports is the radius of a point."""
    fluid = workloads.cube(round(count ** (1 / 3)))
    position, support = halo(count)
    clustered = js.Particles.from_arrays(position, support, np.log(np.linalg.norm(position, axis=1)).astype(np.float32))
    found = {
        "uniform fluid": (js.Particles.from_arrays(fluid.position, fluid.support, fluid.quantity), 1.0),
        "clustered halo": (clustered, 1.0),
        "clustered points": (clustered, SMALL),
    }
    if data is not None:
        found |= {"of a file": (js.io.read_particles(data), 1.0), "points of a file": (js.io.read_particles(data), SMALL)}
    return {name: (js.prepare(particles), share) for name, (particles, share) in found.items()}


def seconds_of(call: Any) -> float:
    started = time.perf_counter()
    jax.block_until_ready(call())
    return time.perf_counter() - started


def spheres(particles: js.Particles, share: float) -> tuple[Any, Any, Any]:
    return particles.position, share * particles.support, particles.valid


def rays(camera: js.Camera, every: int) -> tuple[np.ndarray, np.ndarray]:
    """Origin (3,) and directions (3, rays) in world space, such that the parameter is the depth."""
    pixels = np.arange(every // 2, SIZE, every) + 0.5
    u, v = (np.asarray(side(pixels)) for side in (camera.column, camera.row))
    across, down = np.meshgrid(u, v)
    view = np.stack([across.ravel(), down.ravel(), np.ones(across.size)])
    return np.asarray(camera.eye), (np.asarray(camera.axes).T @ view).astype(np.float32)


def counted(tree: Octree, ball: tuple[Any, Any, Any], camera: js.Camera, every: int) -> dict[str, float]:
    """Samples that ask, and pairs that are evaluated, along some rays."""
    eye, way = rays(camera, every)
    origin, number = [jnp.full(way.shape[1], part) for part in eye], way.shape[1]
    ends = jnp.full(number, camera.near), jnp.full(number, camera.far)

    @jax.jit
    def walk(first: Any) -> LeavesAlong:
        return leaves_along(tree, origin, list(jnp.asarray(way)), first, ends[1], LEAVES, with_empty=True)

    depths = np.asarray(camera.depth(jnp.arange(SAMPLES) + 0.5, SAMPLES))
    found, first = dict.fromkeys(("rays", "leaves", "asks flat", "asks skipping", "asks segments", "flat"), 0.0), ends[0]
    found |= dict.fromkeys(("tests", "segments", "needed", "projected"), 0.0)
    while True:
        along = walk(first)
        entry, exit, begin, length = (np.asarray(value) for value in (along.entry, along.exit, along.begin, along.length))
        samples = np.searchsorted(depths, exit) - np.searchsorted(depths, entry)
        samples[exit <= entry] = 0
        found["leaves"] += int(((exit > entry) & (length > 0)).sum())
        found["asks flat"] += int(samples.sum())
        found["asks skipping"] += int(samples[length > 0].sum())
        found["flat"] += float((samples * length.astype(float)).sum())
        for name, value in met(tree, ball, eye, way, depths, (entry, exit, begin, length, samples)).items():
            found[name] += value
        if np.asarray(along.ended).all():
            break
        first = along.reached
    return found | {"rays": number}


def met(tree: Octree, ball: Any, eye: np.ndarray, way: np.ndarray, depths: np.ndarray, of_leaves: Any) -> dict[str, float]:
    """What segments meet: entries that are tested, pairs that are left, and pairs of a sample inside a sphere."""
    entry, exit, begin, length, samples = of_leaves
    leaf, ray = np.nonzero((samples > 0) & (length > 0))
    of = tuple(value[leaf, ray] for value in (entry, exit, begin, length, samples))
    centre, radius, listed = np.asarray(ball[0]), np.asarray(ball[1]), np.asarray(tree.entry)
    found = dict.fromkeys(("tests", "segments", "asks segments", "needed", "projected"), 0.0)
    up_to = np.cumsum(of[3], dtype=np.int64)
    borders = np.searchsorted(up_to, np.arange(0, up_to[-1] if len(up_to) else 0, AT_ONCE), "right")
    for low, high in zip(borders, [*borders[1:], len(leaf)], strict=True):
        begins, counts, taken = of[2][low:high], of[3][low:high], of[4][low:high]
        segment = np.repeat(np.arange(high - low), counts)
        nth = np.arange(len(segment)) - np.repeat(np.cumsum(counts) - counts, counts)
        sphere = listed[begins[segment] + nth]
        direction = way.T[ray[low:high]][segment]
        off, square = eye - centre[sphere], (direction**2).sum(1)
        nearest = -(off * direction).sum(1) / square
        half = np.sqrt(np.maximum(radius[sphere] ** 2 - ((off + nearest[:, None] * direction) ** 2).sum(1), 0) / square)
        front, back = np.maximum(nearest - half, of[0][low:high][segment]), np.minimum(nearest + half, of[1][low:high][segment])
        meets = (half > 0) & (front < back)
        found["tests"] += len(segment)
        found["segments"] += float((meets * taken[segment]).sum())
        in_front, behind = of[0][low:high][segment], of[1][low:high][segment]
        found["projected"] += float((meets & (nearest >= in_front) & (nearest < behind)).sum())
        found["asks segments"] += float(taken[np.bincount(segment[meets], minlength=high - low) > 0].sum())
        within = np.searchsorted(depths, back[meets]) - np.searchsorted(depths, front[meets])
        found["needed"] += float(within.sum())
    return found


def sizes(tree: Octree, plan: OctreePlan, count: int) -> dict[str, Any]:
    arrays = {name: int(np.asarray(value).nbytes) for name, value in (("node", tree.node), ("entry", tree.entry))}
    occupancy = int(np.asarray(tree.occupancy.before).nbytes)
    facts = {name: int(getattr(tree, name)) for name in ("num_leaves", "num_entries", "deepest", "crowded", "top")}
    per = {"entries a point": facts["num_entries"] / count, "lowered": plan.lowered}
    return facts | per | {"bytes": arrays | {"occupancy": occupancy}}


def by_ratio(particles: js.Particles, share: float, camera: js.Camera, every: int) -> dict[str, Any]:
    """The rule, by how small spheres must be for a node to be split: memory against evaluations."""
    rows = {}
    tenth = dataclasses.replace(particles, valid=particles.valid & (jnp.arange(particles.capacity) % 10 == 0))
    ball = spheres(dataclasses.replace(tenth, support=tenth.support * 10 ** (1 / 3)), share)
    for ratio in RATIOS:
        plan = plan_octree(*ball, ratio=ratio)
        tree = build_octree(*ball, plan=plan)
        found = counted(tree, ball, camera, 4 * every)
        count = int(np.asarray(tenth.valid).sum())
        rows[ratio] = {"entries a point": int(tree.num_entries) / count} | {
            name: found[name] / max(found["asks skipping"], 1) for name in ("flat", "needed")
        }
    return rows


def measured(particles: js.Particles, share: float, repeats: int, every: int, ratios: bool) -> dict[str, Any]:
    """One contender; a frame is only timed of whole supports."""
    ball, scene = spheres(particles, share), scene_of(particles)
    camera, settings = js.Camera.framing(particles, width=SIZE, height=SIZE), js.Settings(samples=SAMPLES)
    plan = plan_octree(*ball)
    planning = seconds_of(lambda: plan_octree(*ball) and 0)
    tree = jax.block_until_ready(build_octree(*ball, plan=plan))
    frames, builds = [], []
    for _ in range(repeats + 1):  # the first compiles
        frames.append(seconds_of(lambda: js.render(scene, camera, settings).color) if share == 1 else 0.0)
        builds.append(seconds_of(lambda: build_octree(*ball, plan=plan).node))
    count = particles.num_particles
    times = {"build": statistics.median(builds[1:]), "frame": statistics.median(frames[1:]), "plan": planning}
    rows: dict[str, Any] = {"counts": counted(tree, ball, camera, every)}
    if ratios and share == 1:
        rows["by ratio"] = by_ratio(particles, share, camera, every)
    return {"particles": count, "seconds": times, "sizes": sizes(tree, plan, count)} | rows


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
    shown = {"grid": scene, "octree": jax.block_until_ready(js.in_octree(scene))}
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
    kept = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
    rows = {}
    for name, (scene, camera) in frame_scenes(FRAME_PARTICLES).items():
        rows[name] = by_access(scene, camera, repeats)
        print(name, json.dumps(rows[name]), flush=True)
    shape = {"size": FRAME, "samples": FRAME_SAMPLES, "particles": FRAME_PARTICLES, "repeats": repeats}
    kept["frames"] = {"run": of_this_run(), **shape, "found": rows}
    RESULTS.write_text(json.dumps(kept, indent=1) + "\n")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--particles", type=int, default=1_000_000)
    parser.add_argument("--every", type=int, default=16, help="rays are counted along every so many rows and columns")
    parser.add_argument("--ratios", action="store_true", help="measure the rule by which nodes are split as well")
    parser.add_argument("--data", help="a file of particles")
    parser.add_argument("--check", action="store_true", help="fail where small points take too many evaluations")
    parser.add_argument("--only-frames", action="store_true", help="measure frames by both kinds of access, and nothing else")
    arguments = parser.parse_args()
    if not arguments.only_frames:
        measure_trees(arguments)
    measure_frames(arguments.repeats)


def measure_trees(arguments: argparse.Namespace) -> None:
    """Evaluations along rays, and sizes of trees."""
    found: dict[str, Any] = {}
    kept = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
    for name, (particles, share) in contenders(arguments.particles, arguments.data).items():
        found[name] = measured(particles, share, arguments.repeats, arguments.every, arguments.ratios)
        print(name, json.dumps(found[name]), flush=True)
        RESULTS.parent.mkdir(exist_ok=True)
        RESULTS.write_text(json.dumps(kept | {"run": of_this_run(), "every": arguments.every, "found": found}, indent=1) + "\n")
    if arguments.check:
        shares = {name: row["counts"]["segments"] / row["counts"]["flat"] for name, row in found.items() if "points" in name}
        assert max(shares.values()) <= MAX_SHARE, shares


if __name__ == "__main__":
    main()
