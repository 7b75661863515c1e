"""The surface of a scene's particles as a closed mesh of triangles, on the host.

Flow: scene -> field at points of a box around all of it -> marching cubes -> [mesh: moved to the surface] -> files.

Past all supports there is nothing, so the surface ends within the box, and the mesh is closed. One step of Newton's along the
gradient takes vertices from the straight lines between points to the surface.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from jaxsph.io.damage import require
from jaxsph.io.replace import known_suffix, written_whole
from jaxsph.model.particles.field import EvenSamples, ParticleField
from jaxsph.model.scene import Scene, widened
from jaxsph.numerics.checks import require_positive
from jaxsph.numerics.trees import fitting, line_of, on_host

FINE = 0.25  # of a typical support, of the surface's field: cells on which little of it is lost
MOST_POINTS = 1 << 28  # 2 GiB
LOOKED_AT = 1 << 13  # vertices and middles of triangles each, whose distance to the surface is told
FARTHEST, FARTHEST_TOLD = 0.5, 2.25  # cells that a vertex is moved, and may be off: the cell that it is of holds some surface
SUFFIXES = ".obj", ".ply"


@dataclasses.dataclass(frozen=True, eq=False)
class Mesh:
    """A closed mesh of triangles, whose normals point out of the fluid; what `jaxsph.mesh` makes.

    Attributes:
        vertices: length units of the particles.
        faces: the three vertices of each triangle, counter-clockwise as seen from outside.
        normals: at vertices, of unit length.
        quantity: of the particles, at vertices (of two quantities that of colours).
        deviation: how far up to 8,192 vertices and as many middles of triangles, evenly out of all, are from the surface, in the
            median and at most: an estimate, by the field and its slope there, length units.
    """

    vertices: Float[np.ndarray, "vertices 3"]
    faces: Int[np.ndarray, "faces 3"]
    normals: Float[np.ndarray, "vertices 3"]
    quantity: Float[np.ndarray, " vertices"]
    deviation: tuple[float, float]

    def __repr__(self) -> str:
        return line_of("Mesh", *self.told)

    @property
    def told(self) -> tuple[str, ...]:
        """How large it is, and how good."""
        off = "{:.2g} off the surface in the median, {:.2g} at most".format(*self.deviation)
        return f"{len(self.vertices):,} vertices", f"{len(self.faces):,} triangles", off

    def save(self, path: str | Path) -> None:
        """Write `.obj` (text: vertices, normals, triangles) or `.ply` (binary, with the quantity), whole or not at all.

        Raises:
            ValueError: another suffix; a folder that is not there or cannot be written to.
        """
        suffix = known_suffix(path, SUFFIXES, "a mesh is written as")
        with written_whole(path) as temporary, open(temporary, "wb") as file:
            (self._write_obj if suffix == ".obj" else self._write_ply)(file)

    def _write_obj(self, file: Any) -> None:
        np.savetxt(file, self.vertices, "v %.9g %.9g %.9g")
        np.savetxt(file, self.normals, "vn %.6f %.6f %.6f")
        np.savetxt(file, np.repeat(self.faces + 1, 2, 1), "f %d//%d %d//%d %d//%d")

    def _write_ply(self, file: Any) -> None:
        names = "x", "y", "z", "nx", "ny", "nz", "quantity"
        kinds = [f"property float {name}" for name in names]
        ends = [f"element face {len(self.faces)}", "property list uchar int vertex_indices", "end_header"]
        header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(self.vertices)}", *kinds, *ends]
        file.write("".join(f"{line}\n" for line in header).encode("ascii"))
        file.write(np.column_stack([self.vertices, self.normals, self.quantity]).astype("<f4").tobytes())
        rows = np.zeros(len(self.faces), [("count", "u1"), ("vertex", "<i4", 3)])
        rows["count"], rows["vertex"] = 3, self.faces
        file.write(rows.tobytes())


@on_host
def mesh(scene: Scene, *, cell: float | None = None) -> Mesh:
    """The surface of a scene, `Scene(surface=...)`, as a closed mesh; all of it, whatever clips leave (host side).

    Marching cubes (Lewiner et al. 2003, of scikit-image) over a field in float64. What is thinner than a cell may be missed. A
    periodic set is taken as it lies, without its copies.

    Args:
        scene: with particles and their surface.
        cell: length between points where the field is known; by default a quarter of the median support that smoothing gives.

    Raises:
        ValueError: a scene without a surface, a cell that is not > 0, or so small that there are more points than 2 GiB hold.
        ImportError: scikit-image is not installed.
    """
    skimage = require("skimage.measure", "meshes", "mesh")
    scene = fitting("scene", scene, Scene)
    scene.check()
    if scene.surface is None:
        raise ValueError("a mesh is of a scene's surface, got None; give `jaxsph.Scene(surface=jaxsph.Surface())`")
    field, level = ParticleField(widened(scene).particle_set, copied=False), float(np.asarray(scene.surface.level))
    cell = (FINE * float(np.median(field.support)) if len(field.support) else 1.0) if cell is None else cell
    require_positive("cell", np.asarray(cell, np.float64), "it is a length, of the particles' unit")
    low, corners, faces = np.zeros(3), np.zeros((0, 3)), np.zeros((0, 3), int)
    if len(field.support):
        low, high = ((field.position + side * (field.support[:, None] + cell)) for side in (-1, 1))
        low, counts = low.min(0), np.ceil((high.max(0) - low.min(0)) / cell) + 1
        if (points := float(counts.prod())) > MOST_POINTS:
            enough = f"{cell * (points / MOST_POINTS) ** (1 / 3):.2g}"
            raise ValueError(f"`cell` = {cell:.4g} makes {points:.3g} points, more than {MOST_POINTS:,}: give {enough} or more")
        x, y, z = (start + cell * np.arange(int(count)) for start, count in zip(low, counts, strict=True))
        samples = EvenSamples(x, y, z[0], cell, len(z), np.zeros((len(y), len(x))), False)
        amounts = field.kernel.norm * field.volume / field.support**3
        values = samples.sums(field.position, field.support, amounts[None], field.kernel)[0].swapaxes(0, 1)
        if values.max() > level:
            corners, faces, *_ = skimage.marching_cubes(values, level, gradient_direction="ascent", allow_degenerate=False)
    return _moved(field, low + cell * corners.astype(np.float64), faces, level, cell)


def _moved(field: ParticleField, vertices: np.ndarray, faces: np.ndarray, level: float, cell: float) -> Mesh:
    """With vertices on the surface, and how far they and the middles of triangles are from it."""

    def off(places: np.ndarray) -> tuple[np.ndarray, Any]:
        """How far along the normal the surface is behind places."""
        there = field.at(places)
        slope = np.linalg.norm(there.gradient, axis=1)
        return np.divide(there.coverage - level, slope, out=np.zeros(len(slope)), where=slope > 0), there

    behind, there = off(vertices)
    vertices = vertices + np.clip(behind, -FARTHEST * cell, FARTHEST * cell)[:, None] * there.normal
    some = [places[:: len(places) // LOOKED_AT + 1] for places in (vertices, vertices[faces].mean(1))]
    away = np.minimum(np.abs(off(np.concatenate(some))[0]), FARTHEST_TOLD * cell)
    deviation = (float(np.median(away)), float(away.max())) if len(away) else (0.0, 0.0)
    return Mesh(vertices, faces, there.normal, np.nan_to_num(there.quantity), deviation)
