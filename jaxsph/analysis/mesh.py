"""The surface of a scene's particles as a closed mesh of triangles, on the host.

Flow: scene -> field at points of a box around all of it -> marching cubes -> [mesh: moved to the surface] -> files.

Past all supports there is nothing, so the surface ends within the box, and the mesh is closed. One step of Newton's along the
gradient takes vertices from the straight lines between points to the surface.
"""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import scipy
from jaxtyping import Float, Int

from jaxsph.io.damage import require
from jaxsph.io.replace import known_suffix, written_whole
from jaxsph.model.particles.field import EvenSamples, ParticleField
from jaxsph.model.scene import Scene, widened
from jaxsph.numerics.checks import require_finite, require_positive
from jaxsph.numerics.trees import line_of, on_host

FINE = 0.25  # of a typical support, of the surface's field: cells on which little of it is lost
MOST_POINTS = 1 << 28  # 2 GiB
LOOKED_AT = 1 << 13  # vertices and middles of triangles each, whose distance to the surface is told
FARTHEST, FARTHEST_TOLD = 0.5, 2.25  # cells that a vertex is moved, and may be off: the cell that it is of holds some surface
BESIDE = 1.8  # sides of a cube, between cubes that touch in a corner, but none that are farther
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

        Vertices and quantities have all digits of float64, however far from the origin they lie.

        Raises:
            ValueError: another suffix; a folder that is not there or cannot be written to.
        """
        suffix = known_suffix(path, SUFFIXES, "a mesh is written as")
        with written_whole(path) as temporary, open(temporary, "wb") as file:
            (self._write_obj if suffix == ".obj" else self._write_ply)(file)

    def _write_obj(self, file: Any) -> None:
        np.savetxt(file, self.vertices, "v %.17g %.17g %.17g")
        np.savetxt(file, self.normals, "vn %.6f %.6f %.6f")
        np.savetxt(file, np.repeat(self.faces + 1, 2, 1), "f %d//%d %d//%d %d//%d")

    def _write_ply(self, file: Any) -> None:
        names = "x", "y", "z", "nx", "ny", "nz", "quantity"
        row = np.dtype([(name, "<f4" if name.startswith("n") else "<f8") for name in names])
        kinds = [f"property {'float' if row[name].itemsize == 4 else 'double'} {name}" for name in names]
        ends = [f"element face {len(self.faces)}", "property list uchar int vertex_indices", "end_header"]
        header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(self.vertices)}", *kinds, *ends]
        file.write("".join(f"{line}\n" for line in header).encode("ascii"))
        vertices = np.zeros(len(self.vertices), row)
        for name, column in zip(names, (*self.vertices.T, *self.normals.T, self.quantity), strict=True):
            vertices[name] = column
        file.write(vertices.tobytes())
        rows = np.zeros(len(self.faces), [("count", "u1"), ("vertex", "<i4", 3)])
        rows["count"], rows["vertex"] = 3, self.faces
        file.write(rows.tobytes())


@on_host
def mesh(scene: Scene, *, cell: float | None = None, smallest_piece: float = 0.0) -> Mesh:
    """The surface of a scene, `Scene(surface=...)`, as a closed mesh; all of it, whatever clips leave (host side).

    Marching cubes (Lewiner et al. 2003, of scikit-image) over a field in float64. What is thinner than a cell may be missed. A
    periodic set is taken as it lies, without its copies. A surface that is nowhere is an empty mesh, with a warning.

    Args:
        scene: with particles and their surface.
        cell: length between points where the field is known; by default a quarter of the median support that smoothing gives.
            One that is wider than supports are is warned of.
        smallest_piece: share of the volume of the largest piece, from which on pieces are in the mesh, and bubbles in them.

    Raises:
        ValueError: a scene without a surface, a cell that is not > 0, or so small that there are more points than 2 GiB hold.
        ImportError: scikit-image is not installed.
    """
    skimage = require("skimage.measure", "meshes", "mesh")
    scene.check()
    if scene.surface is None:
        raise ValueError("a mesh is of a scene's surface, got None; give `jaxsph.Scene(surface=jaxsph.Surface())`")
    if not 0 <= smallest_piece <= 1:
        raise ValueError(f"`smallest_piece` must lie in [0, 1], got {smallest_piece}: it is a share of the volume of the largest")
    field, level = ParticleField(widened(scene).particle_set, copied=False), float(np.asarray(scene.surface.level))
    typical = float(np.median(field.support)) if len(field.support) else 1.0
    cell = FINE * typical if cell is None else cell
    require_positive("cell", cell, "it is a length, of the particles' unit")
    require_finite("cell", cell, "it is a length, of the particles' unit")
    corners, faces, most = [np.zeros((0, 3))], [np.zeros((0, 3), int)], 0.0
    amounts = field.kernel.norm * field.volume / field.support**3
    for rows, (x, y, z) in _lattices(field, cell):
        samples = EvenSamples(x, y, z[0], cell, len(z), np.zeros((len(y), len(x))), False)
        values = samples.sums(field.position[rows], field.support[rows], amounts[None, rows], field.kernel)[0].swapaxes(0, 1)
        most = max(most, float(values.max()))
        if values.max() > level:
            some, joined, *_ = skimage.marching_cubes(values, level, gradient_direction="ascent", allow_degenerate=False)
            faces.append(joined + sum(map(len, corners)))
            corners.append(np.array([x[0], y[0], z[0]]) + cell * some.astype(np.float64))
    if cell > typical:
        wider = f"cells of {cell:.4g} are wider than supports, {typical:.4g} in the median"
        warnings.warn(f"{wider}, so what is thinner than a cell is lost; `cell={FINE * typical:.2g}` has it", stacklevel=3)
    if most <= level:
        remedy = "give a lower level" if cell <= typical else "give a lower level or a smaller `cell`"
        warnings.warn(
            f"the mesh is empty: the surface is at {level:.4g}, and the field reaches {most:.4g}; {remedy}", stacklevel=3
        )
    return _moved(field, *_pieces(np.concatenate(corners), np.concatenate(faces), smallest_piece), level, cell)


def _lattices(field: ParticleField, cell: float) -> Iterator[tuple[np.ndarray, list[np.ndarray]]]:
    """Points around all particles, or, where these are too many, around each of the sets that do not reach each other."""
    if not len(field.support):
        return
    low, high = (field.position + side * (field.support[:, None] + cell) for side in (-1, 1))
    lower = low.min(0)
    sets = np.zeros(len(low), int)
    if np.ceil((high.max(0) - lower) / cell + 1).prod() > MOST_POINTS:
        bins = np.floor((field.position - lower) / (high - low).max())
        bins, which = np.unique(bins, axis=0, return_inverse=True)
        near = scipy.spatial.cKDTree(bins).query_pairs(BESIDE, output_type="ndarray")
        sets = connected(near, len(bins))[which.ravel()]
    order = np.argsort(sets, kind="stable")
    boxes = []
    for rows in np.split(order, np.flatnonzero(np.diff(sets[order])) + 1):
        first = np.floor((low[rows].min(0) - lower) / cell)
        counts = np.ceil((high[rows].max(0) - lower) / cell) - first + 1
        boxes.append((rows, first, counts))
    points = max(float(counts.prod()) for *_, counts in boxes)
    if points > MOST_POINTS:
        enough = f"{cell * (points / MOST_POINTS) ** (1 / 3):.2g}"
        raise ValueError(f"`cell` = {cell:.4g} makes {points:.3g} points, more than {MOST_POINTS:,}: give {enough} or more")
    for rows, first, counts in boxes:
        yield rows, [lower[axis] + cell * (first[axis] + np.arange(int(counts[axis]))) for axis in range(3)]


def connected(pairs: np.ndarray, number: int) -> Int[np.ndarray, " number"]:
    """Which set each of so many belongs to, of those that pairs connect."""
    links = scipy.sparse.coo_matrix((np.ones(len(pairs), bool), tuple(pairs.T)), (number, number))
    return np.asarray(scipy.sparse.csgraph.connected_components(links, directed=False)[1])


def _pieces(vertices: np.ndarray, faces: np.ndarray, smallest: float) -> tuple[np.ndarray, np.ndarray]:
    """Drop closed pieces whose volume is less than a share of that of the largest one."""
    if not smallest or not len(faces):
        return vertices, faces
    piece = connected(np.concatenate([faces[:, :2], faces[:, 1:]]), len(vertices))
    middle = np.stack([np.bincount(piece, along) for along in vertices.T], 1) / np.bincount(piece)[:, None]
    a, b, c = (vertices[faces] - middle[piece[faces]]).swapaxes(0, 1)
    volume = np.abs(np.bincount(piece[faces[:, 0]], (a * np.cross(b, c)).sum(1), len(middle)))
    large = (volume >= smallest * volume.max())[piece]
    return vertices[large], (np.cumsum(large) - 1)[faces[large[faces[:, 0]]]]


def _moved(field: ParticleField, vertices: np.ndarray, faces: np.ndarray, level: float, cell: float) -> Mesh:
    """Move vertices to the surface, and estimate how far they and the middles of triangles are from it then."""

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
