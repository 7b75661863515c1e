"""Claims: to find which particles touch which rays takes less than a fifth of a frame at full rate; and no frame is faster where
rays find particles or points in object space, by an octree, than by view-aligned lists.

A filled cube of 97,336 and of 1,000,000 particles in random order, 512 x 512 pixels, 256 samples; particles as they are, and
prepared (`jaxsph.prepare`); with the host sorting and picking, and with all of it left to XLA. Every contender has its turn in
every round; stages are timed one by one, and beside them whole frames. Seconds of the processor tell more than those of the
clock where other processes are at work.

Object space: whole frames at full rate of the same scene by lists and by `object_space` (Kaehler, Abel & Hege 2007, section 3.1),
whose trees are made once, in turns: the same rays, the same samples, the same picture to rounding. Particles and points,
everywhere alike and clustered; and points in clumps in large empty space, with radii of 1 : 1000, where trees should win if
anywhere. Writes `results/access.json`; ends in asserts on medians.

    python benchmarks/access.py [--repeats 7] [--only stages|objects] [--check]
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import pathlib
import statistics
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import workloads
from kept import keep, of_run
from object_space import in_object_space

import jaxsph as js
from jaxsph.engine.frame.stages import grid_of, ordered_of
from jaxsph.engine.planning.fit import demanded, see, shape_of
from jaxsph.engine.request import Request
from jaxsph.engine.runtime.clock import Clock

SIDES = workloads.CUBE, 100
ACCESS = "view", "measure and sort", "order", "lists"
MOST = 0.2  # of a frame at full rate
PIXELS, SAMPLES, COUNT = 256, 128, 100_000  # of frames by lists and in object space
POINT, OPACITY = 0.3, 0.2  # of a support: radius of points, of which about one is in the reach of each; and what each hides
CLUMPS, CLUMP = 30, 0.02  # in a box of side 2: how many, and how wide each is
LEAST, LARGEST, FALLOFF = 2e-4, 0.2, 1.5  # radii of points in clumps, of which r^-FALLOFF are larger than r
SAME = 1e-5  # largest difference of colours that the order of sums may make
NOISE = 0.1  # that medians of a few turns are off by
PARTS = "stages", "object space"
FRAMES = (
    "particles, uniform",
    "particles, clustered",
    "points, uniform",
    "points, clustered",
    "points, clumps",
    "points, clumps, feet",
)
RESULTS = pathlib.Path(__file__).with_name("results") / "access.json"


class Stages:
    """Access of one contender, stage by stage."""

    def __init__(self, scene: js.Scene, camera: js.Camera, settings: js.Settings, on_host: bool) -> None:
        self.scene, self.camera, self.settings = scene, camera, settings
        plan = js.plan(scene, camera, settings)
        tuning = dataclasses.replace(plan.cast.tuning, sorts_on_host=on_host)
        self.plan = plan if on_host else js.plan(scene, camera, settings, tuning=tuning)
        self.tuning, self.seconds, self.cpu = tuning, {}, {}

    def turn(self) -> None:
        """Time all stages once."""
        plan, camera, clock = self.plan, self.camera, Clock()
        asked = Request.of(self.scene, camera, self.settings)
        shape = dataclasses.replace(shape_of(asked), tuning=self.tuning)
        seen = self._timed("view", lambda: see(asked.scene, asked.camera, plan, clock))
        seen, _ = self._timed("measure and sort", lambda: demanded(seen, asked, shape))
        cells = {"samples": plan.samples, "slab_samples": plan.cast.slab_samples, "between_samples": False}
        ordered = self._timed("order", lambda: ordered_of(clock, seen.viewed, camera, self.tuning, seen.order, **cells))
        given = clock, ordered, camera, jnp.int32(0), plan.lists, self.tuning
        self._timed("lists", lambda: grid_of(*given, samples=plan.samples, beside=False))
        image = self._timed("frame", lambda: js.render(self.scene, camera, self.settings, plan=plan))
        self.seconds.setdefault("cast", []).append(image.stats["seconds"]["cast"])

    def medians(self) -> dict[str, float]:
        """Of seconds by the clock and, as `cpu`, by the processor."""
        found = {name: statistics.median(times[1:]) for name, times in self.seconds.items()}
        found["access"] = sum(found[name] for name in ("view", "measure and sort", "order", "lists"))
        found["cpu access"] = sum(
            statistics.median(self.cpu[name][1:]) for name in ("view", "measure and sort", "order", "lists")
        )
        return found

    def _timed(self, name: str, stage: Callable[[], Any]) -> Any:
        started, used = time.perf_counter(), time.process_time()
        result = stage()
        self.seconds.setdefault(name, []).append(time.perf_counter() - started)
        self.cpu.setdefault(name, []).append(time.process_time() - used)
        return result


def halo(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Positions and supports of a spherical NFW profile of ten scale radii, each support with 33 particles in it."""
    rng, grid = np.random.default_rng(7), np.geomspace(1e-4, 10, 4096)
    mass = np.log1p(grid) - grid / (1 + grid)
    radius = np.interp(rng.uniform(mass[0], mass[-1], count), mass, grid)
    way = rng.normal(size=(count, 3))
    position = way / np.linalg.norm(way, axis=1)[:, None] * radius[:, None]
    number = count / (4 * np.pi * mass[-1]) / (radius * (1 + radius) ** 2)
    return position.astype(np.float32), np.cbrt(33 / (4 / 3 * np.pi * number)).astype(np.float32)


def clumps(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Positions and radii of points in a few clumps of a large box, most of which is empty."""
    rng = np.random.default_rng(9)
    position = rng.uniform(-1, 1, (CLUMPS, 3))[rng.integers(CLUMPS, size=count)] + rng.normal(0, CLUMP, (count, 3))
    radius = np.minimum(LEAST * rng.uniform(size=count) ** (-1 / FALLOFF), LARGEST)
    return position.astype(np.float32), radius.astype(np.float32)


def frames() -> dict[str, tuple[js.Scene, js.Camera]]:
    """What is seen by lists and in object space."""
    cube, (position, support) = workloads.cube(round(COUNT ** (1 / 3))), halo(COUNT)
    quantity = np.log(np.linalg.norm(position, axis=1)).astype(np.float32)
    sets = {"uniform": (cube.position, cube.support, cube.quantity), "clustered": (position, support, quantity)}
    made = {}
    for name, columns in sets.items():
        particles = js.prepare(js.Particles.from_arrays(*columns))
        camera = js.Camera.framing(particles, width=PIXELS, height=PIXELS)
        transfer = js.scenes.default_transfer(particles)
        made[f"particles, {name}"] = js.Scene(particles=particles, transfer=transfer), camera
    anywhere = np.random.default_rng(8).uniform(0, 1, (COUNT, 3)).astype(np.float32)  # a lattice would have points in rows
    points = {"uniform": (anywhere, POINT * cube.support), "clustered": (position, POINT * support), "clumps": clumps(COUNT)}
    for name, columns in points.items():
        for spread in ("chords", "feet") if name == "clumps" else ("chords",):
            some = js.Points.from_arrays(*columns, (1.0, 0.8, 0.5), opacity=OPACITY, spread=spread)
            camera = js.Camera.framing(some.spheres(), width=PIXELS, height=PIXELS)
            made[f"points, {name}" + (", feet" if spread == "feet" else "")] = js.Scene(points=some), camera
    return {name: made[name] for name in FRAMES}


def by_access(name: str, scene: js.Scene, camera: js.Camera, repeats: int) -> dict[str, Any]:
    """Seconds of a frame by lists and by an octree, in turns; what the tree is like, and how far pictures are apart."""
    settings, started = js.Settings(samples=SAMPLES, integrator="samples"), time.perf_counter()
    shown = {"lists": scene, "octree": jax.block_until_ready(in_object_space(scene))}
    made, tree = time.perf_counter() - started, shown["octree"].media[0].octree
    first = {which: np.asarray(js.render(one, camera, settings).color) for which, one in shown.items()}  # compiles
    seconds: dict[str, list[float]] = {which: [] for which in shown}
    for turn in range(repeats):
        print(f"{name}: turn {turn + 1} of {repeats}", flush=True)
        for which, one in shown.items():
            started = time.perf_counter()
            jax.block_until_ready(js.render(one, camera, settings).color)
            seconds[which].append(time.perf_counter() - started)
    medians = {which: statistics.median(times) for which, times in seconds.items()}
    apart = float(np.abs(first["lists"] - first["octree"]).max())
    assert apart <= SAME < first["lists"].max(), f"{name}: pictures are {apart} apart"
    lengths = np.asarray(tree.node)[:, 1]
    built = {
        "seconds": made,
        "levels": tree.levels,
        "entries a sphere": len(tree.entry) / COUNT,
        "fullest leaf": int(lengths.max()),
    }
    return {"seconds": medians, "ratio": medians["octree"] / medians["lists"], "apart": apart, "octree": built}


def object_space(repeats: int) -> dict[str, Any]:
    """Rows of all frames, with what they were measured by."""
    rows = {}
    for name, (scene, camera) in frames().items():
        rows[name] = by_access(name, scene, camera, repeats)
        print(f"{name:26s} octree over lists {rows[name]['ratio']:.2f}  {json.dumps(rows[name])}", flush=True)
    sizes = {"pixels": PIXELS, "samples": SAMPLES, "count": COUNT, "repeats": repeats}
    return {"run": of_run(), **sizes, "rows": rows}


def stages(repeats: int) -> dict[str, dict[str, dict[str, float]]]:
    """Medians of the stages of access, of all contenders."""
    found: dict[str, dict[str, dict[str, float]]] = {}
    for side in SIDES:
        work = workloads.cube(side)
        scene, camera, settings = work.scene("poly6"), work.camera(), js.Settings(samples=work.samples)
        prepared = dataclasses.replace(scene, particles=js.prepare(scene.particles))
        contenders = {
            "as given": Stages(scene, camera, settings, on_host=True),
            "prepared": Stages(prepared, camera, settings, on_host=True),
            "by XLA alone": Stages(scene, camera, settings, on_host=False),
        }
        for turn in range(1 + repeats):  # the first compiles
            print(f"{work.name}: turn {turn} of {repeats}", flush=True)
            for contender in contenders.values():
                contender.turn()
        found[work.name] = {name: contender.medians() for name, contender in contenders.items()}
        for name, row in found[work.name].items():
            figures = "  ".join(f"{stage} {1e3 * t:.1f}" for stage, t in row.items())
            print(f"{work.name:13s} {name:13s} {figures} ms", flush=True)
    return found


def write(more: dict[str, Any]) -> dict[str, Any]:
    """Add to the results."""
    known = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
    parts = {name: known[name] for name in PARTS if name in known} | more
    keep(RESULTS, [f"{name}: {row}" for name, part in parts.items() for row in part["rows"]], **parts)
    return parts


def variants() -> list[str]:
    """Names of all that is compared."""
    return [*(f"{PARTS[0]}: cube {side**3}" for side in SIDES), *(f"{PARTS[1]}: {name}" for name in FRAMES)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--only", choices=("stages", "objects"), help="measure one of both, and leave the other as it is")
    parser.add_argument("--check", action="store_true", help="fail where access takes too large a share of a frame")
    arguments = parser.parse_args()
    if arguments.only != "stages":
        found = write({"object space": object_space(arguments.repeats)})
        if arguments.check:
            ratios = {name: row["ratio"] for name, row in found["object space"]["rows"].items()}
            assert min(ratios.values()) >= 1 - NOISE, ratios
    if arguments.only != "objects":
        medians = stages(arguments.repeats)
        write({"stages": {"run": of_run(), "repeats": arguments.repeats, "rows": medians}})
        if arguments.check:
            shares = {name: rows["as given"]["access"] / rows["as given"]["frame"] for name, rows in medians.items()}
            assert max(shares.values()) <= MOST, shares


if __name__ == "__main__":
    main()
