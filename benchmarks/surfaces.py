"""Claim: where a mesh tool finds the surface of a liquid, so do we without one, off by a tenth of a support in the median.

Three files of liquids, once by `jaxsph.render` of a `jaxsph.Surface`, once by `pysplashsurf` (marching cubes) and a ray cast of
its mesh by Embree, through the middles of the same pixels. Both have the same field and level: cubic splines of
support H = 4 radii, volumes 1 / sum of kernels, a half. Of both CPU time in one process, all threads together, in turns, without
what is compiled; ours with volumes, theirs with neighbours and densities. Depths are compared in supports, where both find a
surface; where one alone does are outlines, and what is thin. Writes `results/surfaces.json` and a picture beside it; ends in an
assert on the medians.

    pip install "jaxsph[peers]"
    python benchmarks/surfaces.py FILE FILE FILE [--size 512] [--repeats 5]
"""

from __future__ import annotations

import argparse
import dataclasses
import pathlib
import statistics
import sys
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import pysplashsurf
import trimesh

sys.path.insert(0, str(pathlib.Path(__file__).parent))
from kept import keep
from PIL import Image as Pillow

import jaxsph as js
from jaxsph.io.settle.supports import even_spacing
from jaxsph.io.table import table_from_columns
from jaxsph.model.camera.framing import with_depths
from jaxsph.model.scene import AMBIENT, COLOR
from jaxsph.reference.where import rays_of, to_world

LEVEL, KERNEL, RADII = 0.5, "cubic_spline", 4  # of a support
CUBES = (1.0, 0.5, 0.25)  # radii: what the tool's pages name as coarse, as usual, and finer
SHOWN = 0.5  # in the picture
CLOSE = 0.1  # supports
DARKEST, BRIGHTEST = -5, 0  # decades of a support, of the picture of differences
CELL, COLORS = 384, 128  # pixels and colours of the picture that is kept
RESULTS = pathlib.Path(__file__).parent / "results" / "surfaces.json"


class Seen(NamedTuple):
    """Depth (inf for none) and picture."""

    depth: np.ndarray
    color: np.ndarray


@dataclasses.dataclass(frozen=True, eq=False)
class Liquid:
    """Positions of a file, and the support of all."""

    name: str
    position: np.ndarray
    support: float

    @classmethod
    def of(cls, path: pathlib.Path) -> Liquid:
        """With the support that the file has, else two spacings."""
        table = js.io.read_table(path)
        position = np.ascontiguousarray(table.position, np.float32)
        spacing = even_spacing(position.astype(np.float64))
        assert spacing is not None, f"{path}: particles do not lie evenly"
        return cls(path.name, position, 2 * spacing if table.support is None else float(np.max(table.support)))

    def particles(self) -> js.Particles:
        """With volumes by kernel sums."""
        table = table_from_columns(self.position, {}, source="positions")
        return js.io.particles_from_table(table, "x", self.support, KERNEL)[0]

    def mesh(self, cube: float) -> trimesh.Trimesh:
        """Of cubes of so many radii; its kernel ends at two smoothing lengths, which are counted in radii, too."""
        made = pysplashsurf.reconstruct_surface(
            self.position,
            particle_radius=self.support / RADII,
            smoothing_length=RADII / 2,
            cube_size=cube,
            iso_surface_threshold=LEVEL,
        ).mesh
        return trimesh.Trimesh(np.asarray(made.vertices, np.float64), np.asarray(made.triangles), process=False)


def cast(mesh: trimesh.Trimesh, camera: js.Camera) -> tuple[np.ndarray, np.ndarray, Any]:
    """View depths of the first triangles that the rays of all pixels meet, which those are (-1 for none), and the rays."""
    rows, columns = (axis.ravel() for axis in np.indices((camera.height, camera.width)))
    rays = rays_of(camera, rows, columns)
    start, way = to_world(rays.start, camera), rays.direction @ np.asarray(camera.axes, np.float64)
    which = mesh.ray.intersects_first(start, way)
    met = which >= 0
    corner, normal = mesh.triangles[which[met], 0], mesh.face_normals[which[met]]
    depth = np.full(len(rows), np.inf)
    depth[met] = ((corner - start[met]) * normal).sum(1) / (way[met] * normal).sum(1)
    return depth, which, (start, way)


def shaded(mesh: trimesh.Trimesh, camera: js.Camera, depth: np.ndarray, which: np.ndarray, rays: Any) -> Seen:
    """Lit as `jaxsph.Surface` is, by normals between those of vertices."""
    start, way = rays
    met, shape = which >= 0, (camera.height, camera.width)
    place = start[met] + depth[met, None] * way[met]
    weights = trimesh.triangles.points_to_barycentric(mesh.triangles[which[met]], place)
    normal = (weights[..., None] * mesh.vertex_normals[mesh.faces[which[met]]]).sum(1)
    facing = np.abs((normal * way[met]).sum(1)) / np.linalg.norm(normal, axis=1) / np.linalg.norm(way[met], axis=1)
    color = np.zeros((len(which), 3))
    color[met] = np.array(COLOR) * (AMBIENT + (1 - AMBIENT) * facing)[:, None]
    return Seen(depth.reshape(shape), color.reshape(*shape, 3))


def timed(does: Callable[[], Any]) -> tuple[float, Any]:
    """CPU seconds of all threads, and what came of it."""
    started = time.process_time()
    made = does()
    return time.process_time() - started, made


def ours(liquid: Liquid, camera: js.Camera) -> tuple[dict[str, float], Seen]:
    """CPU seconds of each stage, and what is seen."""
    before, particles = timed(liquid.particles)
    scene = js.Scene(particles=particles, surface=js.Surface(LEVEL))
    after, image = timed(lambda: js.render(scene, camera))
    return {"volumes": before, "render": after}, Seen(np.asarray(image.depth, np.float64), np.asarray(image.color))


def theirs(liquid: Liquid, camera: js.Camera, cube: float) -> tuple[dict[str, float], Seen, int]:
    """Likewise, and how many triangles."""
    before, mesh = timed(lambda: liquid.mesh(cube))
    after, (depth, which, rays) = timed(lambda: cast(mesh, camera))
    return {"mesh": before, "cast": after}, shaded(mesh, camera, depth, which, rays), len(mesh.faces)


def apart(one: Seen, other: Seen, support: float) -> dict[str, Any]:
    """How far depths are from each other, in supports, and how many pixels one alone finds."""
    here, there = np.isfinite(one.depth), np.isfinite(other.depth)
    off = np.abs(one.depth[here & there] - other.depth[here & there]) / support
    alone = {"ours_alone": int((here & ~there).sum()), "theirs_alone": int((there & ~here).sum()), "both": int(off.size)}
    return {"median": float(np.median(off)), "percent_90": float(np.percentile(off, 90)), **alone}


def measure(liquid: Liquid, size: int, repeats: int) -> tuple[list[dict[str, Any]], list[np.ndarray]]:
    """Records of one file, and its row of the picture."""
    scene = js.Scene(particles=liquid.particles(), surface=js.Surface(LEVEL))
    camera = with_depths(js.Camera.fitted(scene, width=size, height=size), scene)
    ours(liquid, camera)  # compiles
    turns: dict[Any, list[dict[str, float]]] = {cube: [] for cube in (None, *CUBES)}
    for _ in range(repeats):
        seconds, own = ours(liquid, camera)
        turns[None].append(seconds)
        others = {cube: theirs(liquid, camera, cube) for cube in CUBES}
        for cube, (seconds, *_) in others.items():
            turns[cube].append(seconds)
    shared = {"file": liquid.name, "particles": len(liquid.position), "size": size}
    records = []
    for cube, rounds in turns.items():
        stages = {stage: statistics.median(one[stage] for one in rounds) for stage in rounds[0]}
        record = shared | {"contender": "jaxsph" if cube is None else f"pysplashsurf {cube:g}", "cpu_seconds": stages}
        if cube is not None:
            _, seen, triangles = others[cube]
            record |= {"cube": cube, "triangles": triangles, **apart(own, seen, liquid.support)}
        records.append(record)
    seen = others[SHOWN][1]
    return records, [own.color, seen.color, difference(own, seen, liquid.support)]


def difference(one: Seen, other: Seen, support: float) -> np.ndarray:
    """Decades of the difference in supports, dark to bright; red where we alone find one, blue where the mesh alone does."""
    here, there = np.isfinite(one.depth), np.isfinite(other.depth)
    off = np.abs(np.where(here & there, one.depth, 0) - np.where(here & there, other.depth, 0)) / support
    gray = np.clip((np.log10(np.maximum(off, 10.0**DARKEST)) - DARKEST) / (BRIGHTEST - DARKEST), 0, 1)
    color = np.where((here & there)[..., None], gray[..., None] * np.ones(3), 0.0)
    color[here & ~there], color[there & ~here] = (1, 0.2, 0.1), (0.2, 0.4, 1)
    return color


def row(record: dict[str, Any]) -> str:
    """A line of what was measured."""
    seconds = ", ".join(f"{stage} {value:.2f}" for stage, value in record["cpu_seconds"].items())
    told = f"{record['file']:34s} {record['contender']:18s} {seconds}"
    if "median" not in record:
        return told
    alone = f"alone {record['ours_alone']} and {record['theirs_alone']} of {record['both']}"
    return f"{told}; {record['triangles']:,} triangles, apart {record['median']:.1e}, 90 % {record['percent_90']:.1e}; {alone}"


def variants() -> list[str]:
    """Names of all that is compared."""
    return ["jaxsph", *(f"pysplashsurf {cube:g}" for cube in CUBES)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", type=pathlib.Path, nargs="+", help="of liquids")
    parser.add_argument("--size", type=int, default=512, help="pixels on a side")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("-o", "--output", type=pathlib.Path, default=RESULTS, help="JSON; the picture is beside it")
    arguments = parser.parse_args()
    records, rows = [], []
    for file in arguments.files:
        found, pictures = measure(Liquid.of(file), arguments.size, arguments.repeats)
        print("\n".join(map(row, found)), flush=True)
        records += found
        rows.append(np.concatenate(pictures, 1))
    names, theirs = [record["contender"] for record in records], ("pysplashsurf", "trimesh", "embreex")
    keep(arguments.output, names, packages=theirs, repeats=arguments.repeats, records=records)
    picture = Pillow.fromarray(np.rint(255 * np.clip(np.concatenate(rows), 0, 1)).astype(np.uint8))
    small = picture.resize((CELL * len(pictures), CELL * len(rows)), Pillow.Resampling.BOX)
    small.quantize(COLORS).save(arguments.output.with_suffix(".png"), optimize=True)
    far = [row(record) for record in records if record.get("median", 0) > CLOSE]
    assert not far, "\n".join(["medians over a tenth of a support:", *far])


if __name__ == "__main__":
    main()
