"""Claim: cells that hold particles, and no others, are in the grid; and a tolerance is spent where the picture allows it.

Figures of where the work of a picture goes, as the papers have them:

- `cells_occupied.jpg`: pictures, and the cells of the sparse grid that are occupied (Hochstetter et al. 2016, figures 1 and 10).
- `cells_levels.jpg`: `radial` to a tolerance, and what its slabs were given: over the picture, along a section, and cut open
  (figure 3 there).
- `leaves.jpg`: leaves of the quadtree over the picture at two stages (Kratz et al. 2011, figures 4f and 4g).

Slabs are those of `Image.levels`, and a cell is occupied if any of its slabs is. Leaves are what `Image.error_bound` is 0 at the
corners of. Writes into `docs/gallery`; ends in asserts.

    python benchmarks/cells.py [occupied|levels|leaves ...] [-o FOLDER]
"""

from __future__ import annotations

import argparse
import io
import itertools
import pathlib
import sys
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from PIL import Image as Picture

sys.path.insert(0, str(pathlib.Path(__file__).parent))
import made_fields

import jaxsph as js

GALLERY = pathlib.Path(__file__).parent.resolve().parent / "docs" / "gallery"
BUNDLE, CELL_SAMPLES = 8, 16  # pixels on a side, and samples along depth, of a cell
MOST_BYTES = 150_000
DOTS_AN_INCH, QUALITY = 110, 78
SAMPLES = 512  # a ray, of pictures of occupied cells
AROUND = 0.25  # of the extent of what is drawn, that is left free on each side
SECTION = 0.5  # of the picture's height: the row of bundles through which the section goes
LEAF, STAGES, WORST = 32, (2, 4), 400  # pixels on a side of the first leaves; stages that are drawn; leaves split in one
EMPTY, FULL_RATE, COARSER, SUPER_PIXEL = range(4)
KINDS = {
    "empty": "#ffffff",
    "full rate": "#9a9a9a",
    "fewer samples along the ray": "#2e9e5b",
    "super-pixel: one colour": "#f2c12e",
}
KIND_OF_LEVEL = np.array([FULL_RATE, COARSER, COARSER, COARSER, COARSER, SUPER_PIXEL, EMPTY])  # levels 0 to 5; -1 is the last


class Radial(NamedTuple):
    """How `radial` is drawn: by so many particles, pixels and samples that many slabs lie within one of its bands."""

    particles: int = 4_000_000
    pixels: int = 768
    samples: int = 1024
    tolerance: float = 0.01


RADIAL = Radial()
Pixels = Bool[np.ndarray, "height width"]
Corners = Float[np.ndarray, "deep_and_one rows_and_one columns_and_one 3"]


class Faces(NamedTuple):
    """Faces of cells, or of slabs, that are seen from somewhere, those behind first.

    Attributes:
        corners: on the picture, to the right and upwards, as shares of depth.
        light: by how much each is turned towards the light, 0 to 1.
        cell: which cell, or slab, it is of.
    """

    corners: Float[np.ndarray, "faces 4 2"]
    light: Float[np.ndarray, " faces"]
    cell: Int[np.ndarray, "faces 3"]


def corners_of(camera: js.Camera, shape: tuple[int, ...], samples: int, each: int) -> Corners:
    """Corners of all cells of a grid in the world, of `each` so many samples, or of its slabs.

    The last row and column may reach over the picture's edge.
    """
    deep, rows, columns = shape
    border = np.minimum(np.arange(deep + 1) * each, samples)
    z = np.asarray(camera.depth(border.astype(np.float32), samples), np.float64)[:, None, None]
    u = np.asarray(camera.column(BUNDLE * np.arange(columns + 1.0)), np.float64)
    v = np.asarray(camera.row(BUNDLE * np.arange(rows + 1.0)), np.float64)[:, None]
    wide = z if camera.is_perspective else np.ones_like(z)
    view = np.stack(np.broadcast_arrays(u * wide, v * wide, z), -1)
    return view @ camera.exact_axes() + camera.exact_eye()


def cell_of(camera: js.Camera, position: Float[np.ndarray, "n 3"], samples: int, each: int) -> Int[np.ndarray, "n 3"]:
    """Which cell, of `each` so many samples, or which slab each place of the world lies in: along depth, row, column."""
    x, y, z = np.moveaxis(camera.exact_view(np.asarray(position, np.float64)), -1, 0)
    near, far = camera.near_and_far()
    part = np.log(z / near) / np.log(far / near) if camera.is_perspective else (z - near) / (far - near)
    wide, tall = float(camera.half_height) * camera.width / camera.height, float(camera.half_height)
    over = z if camera.is_perspective else np.ones_like(z)
    column, row = (x / over / wide + 1) / 2 * camera.width, (1 - y / over / tall) / 2 * camera.height
    return np.floor(np.stack([part * samples / each, row / BUNDLE, column / BUNDLE], -1)).astype(int)


def filled_cells(levels: Int[np.ndarray, "slabs rows columns"], slab_samples: int) -> Bool[np.ndarray, "cells rows columns"]:
    """Which cells have any slab that particles can touch."""
    slabs, per_cell = len(levels), CELL_SAMPLES // slab_samples
    past = np.pad(levels, ((0, -slabs % per_cell), (0, 0), (0, 0)), constant_values=-1)
    return (past.reshape(-1, per_cell, *levels.shape[1:]) >= 0).any(1)


def faces_of(occupied: Bool[np.ndarray, "deep rows columns"], corners: Corners, eye: js.Camera) -> Faces:
    """Faces between occupied cells, or slabs, and empty ones, as a camera sees them from outside."""
    found, cells = [], []
    around = np.pad(occupied, 1)
    for axis, side in itertools.product(range(3), (0, 1)):
        beside = np.roll(around, 1 - 2 * side, axis)[1:-1, 1:-1, 1:-1]
        cell = np.argwhere(occupied & ~beside)
        one, other = (np.eye(3, dtype=int)[k] for k in range(3) if k != axis)
        first = cell + side * np.eye(3, dtype=int)[axis]
        found.append(np.stack([corners[tuple((first + step).T)] for step in (0 * one, one, one + other, other)], 1))
        cells.append(cell)
    world, cell = np.concatenate(found), np.concatenate(cells)
    outward = world.mean(1) - np.stack([corners[tuple((cell + step).T)] for step in np.ndindex(2, 2, 2)]).mean(0)
    normal = np.cross(world[:, 2] - world[:, 0], world[:, 3] - world[:, 1])
    normal *= np.sign((normal * outward).sum(1, keepdims=True)) / np.linalg.norm(normal, axis=1, keepdims=True)
    seen = (normal * (world.mean(1) - eye.exact_eye())).sum(1) < 0
    view = eye.exact_view(world[seen])
    order = np.argsort(-np.linalg.norm(view, axis=-1).mean(1))
    light = np.abs(eye.exact_view(normal[seen] + eye.exact_eye()) @ np.array([0.35, 0.8, -0.48]))
    return Faces((view[..., :2] / view[..., 2:])[order], light[order], cell[seen][order])


def on_picture(eye: js.Camera, places: Float[np.ndarray, "... 3"]) -> Float[np.ndarray, "... 2"]:
    """Places of the world as a camera sees them."""
    view = eye.exact_view(np.asarray(places, np.float64))
    return view[..., :2] / view[..., 2:]


def draw_cells(axes: Axes, occupied: np.ndarray, corners: Corners, eye: js.Camera, levels: np.ndarray | None = None) -> None:
    """What is occupied from outside, with the edges of what the camera sees; by levels in the colours of their kinds, or blue."""
    faces = faces_of(occupied, corners, eye)
    colors = np.array([to_rgb(color) for color in KINDS.values()])
    blue = np.broadcast_to([0.62, 0.75, 0.9], (len(faces.cell), 3))
    edge = 0.6 if levels is None else 1.0  # slabs are too thin for dark edges
    base = blue if levels is None else colors[KIND_OF_LEVEL[levels[tuple(faces.cell.T)]]]
    shaded = base * (0.5 + 0.5 * faces.light[:, None])
    axes.add_collection(PolyCollection(faces.corners, facecolors=shaded, edgecolors=edge * shaded, linewidths=0.2, zorder=2))
    ends = corners[np.ix_((0, -1), (0, -1), (0, -1))]
    at = [(ends[0, a, b], ends[1, a, b]) for a, b in itertools.product((0, 1), repeat=2)]
    at += [(ends[k, 0, 0], ends[k, 0, 1]) for k in (0, 1)] + [(ends[k, 1, 0], ends[k, 1, 1]) for k in (0, 1)]
    at += [(ends[k, 0, b], ends[k, 1, b]) for k, b in itertools.product((0, 1), repeat=2)]
    axes.add_collection(LineCollection(on_picture(eye, np.array(at)), colors="0.35", linewidths=0.8, zorder=1))
    for end, name, where in ((ends[0, 1, 0], "near", (-4, -10)), (ends[1, 0, 1], "far", (3, 3))):
        axes.annotate(name, on_picture(eye, end), xytext=where, textcoords="offset points", fontsize=8, color="0.25")
    low, high = faces.corners.min((0, 1)), faces.corners.max((0, 1))
    middle, half = (low + high) / 2, (0.5 + AROUND) * (high - low).max()
    x, y = ((at - half, at + half) for at in middle)
    axes.set(aspect="equal", xlim=x, ylim=y, xticks=[], yticks=[])
    axes.spines[:].set_visible(False)


def leaves_of(known: Pixels, coarsest: int, inside: Pixels) -> list[np.ndarray]:
    """Outlines of the leaves of a quadtree that hold anything: squares whose corners have rays and whose middle has
    none, or single pixels.

    Args:
        known: pixels that have a ray, or need none.
        coarsest: pixels on a side of the leaves that all begin with.
        inside: pixels in which there is anything.
    """
    bottom, right = known.shape[0] - 1, known.shape[1] - 1
    outlines: list[np.ndarray] = []

    def descend(row: int, column: int, side: int) -> None:
        half = side // 2
        if side > 1 and known[min(row + half, bottom), min(column + half, right)]:
            for down, across in itertools.product((0, half), repeat=2):
                descend(row + down, column + across, half)
        elif inside[row : row + side + 1, column : column + side + 1].any():
            outlines.append(np.array([column, row]) + side * np.array([(0, 0), (1, 0), (1, 1), (0, 1), (0, 0)]))

    for row, column in itertools.product(range(0, known.shape[0], coarsest), range(0, known.shape[1], coarsest)):
        descend(row, column, coarsest)
    return outlines


def page(rows: int, columns: int, size: tuple[float, float], **more: Any) -> tuple[Figure, np.ndarray]:
    """A figure as wide as a page of the documentation."""
    figure = Figure(figsize=size, layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False, **more)


def show_picture(axes: Axes, picture: np.ndarray, title: str) -> None:
    """Pixels under a title, without ticks."""
    axes.imshow(picture, interpolation="none" if picture.shape[0] > 300 else "nearest")
    axes.set(xticks=[], yticks=[])
    axes.set_title(title, fontsize=9)


def save(figure: Figure, path: pathlib.Path) -> None:
    """As JPEG, small enough for a page."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=DOTS_AN_INCH)
    path.parent.mkdir(parents=True, exist_ok=True)
    Picture.open(buffer).convert("RGB").save(path, quality=QUALITY, optimize=True)
    print(path, f"{path.stat().st_size / 1000:.0f} kB", flush=True)
    assert path.stat().st_size < MOST_BYTES


def draw_occupied(folder: pathlib.Path) -> None:
    """Cells of the sparse grid that hold particles, of letters that fall into a basin and of two fluids wound into sheets."""
    figure, rows = page(2, 2, (9.0, 7.6), width_ratios=(1, 1.35))
    for (left, right), name in zip(rows, ("letters", "flubber"), strict=True):
        scene, camera = js.scenes.load(name, width=512, height=512)
        settings = js.Settings(samples=SAMPLES, integrator="samples", estimator="interval", tolerance=0.01)
        plan = js.plan(scene, camera, settings)
        image = js.render(scene, camera, settings, plan=plan)
        occupied = filled_cells(np.asarray(image.levels), plan.cast.slab_samples)
        cells = cell_of(camera, np.asarray(scene.particles.position), SAMPLES, CELL_SAMPLES)
        inside = ((cells >= 0) & (cells < occupied.shape)).all(1)
        assert inside.mean() > 0.9 and occupied[tuple(cells[inside].T)].all()
        show_picture(left, image.to_uint8(), f"{name}, {camera.width} x {camera.height} pixels")
        corners = corners_of(camera, occupied.shape, SAMPLES, CELL_SAMPLES)
        draw_cells(right, occupied, corners, beside(scene, camera))
        depth, height, width = occupied.shape
        share = f"{occupied.sum():,} of {occupied.size:,} cells are occupied"
        right.set_title(f"{share} ({width} x {height} bundles, {depth} cells deep)", fontsize=9)
    save(figure, folder / "cells_occupied.jpg")


def draw_levels(folder: pathlib.Path) -> None:
    """`radial` to a tolerance, and what its slabs were given: over the picture, in a section and cut open."""
    scene, camera = js.scenes.load("radial", particles=RADIAL.particles, width=RADIAL.pixels, height=RADIAL.pixels)
    along = {"samples": RADIAL.samples, "integrator": "samples", "estimator": "interval"}
    settings = js.Settings(**along, tolerance=RADIAL.tolerance)
    plan = js.plan(scene, camera, settings)
    image = js.render(scene, camera, settings, plan=plan)
    assert image.certified and float(image.error_bound.max()) <= RADIAL.tolerance
    assert len(image.levels) == -(-RADIAL.samples // plan.cast.slab_samples)
    save(levels_figure(image, scene, camera, plan.cast.slab_samples), folder / "cells_levels.jpg")


def levels_figure(image: js.Image, scene: js.Scene, camera: js.Camera, slab_samples: int) -> Figure:
    """Picture, how much of each of its bundles is spared over it, a section, and slabs cut open."""
    figure, ((first, second), (third, fourth)) = page(2, 2, (9.0, 9.0))
    levels = np.asarray(image.levels)
    corners = corners_of(camera, levels.shape, RADIAL.samples, slab_samples)
    row = int(SECTION * levels.shape[1])
    share = 100 * image.stats["evaluations"] / image.stats["evaluations_full"]
    show_picture(first, image.to_uint8(), f"radial to a tolerance of {RADIAL.tolerance:g}: {share:.0f} % of the evaluations")
    draw_spared(second, levels, camera)
    for axes, color in ((first, "white"), (second, "black")):
        axes.axhline((row + 0.5) * BUNDLE, color=color, linewidth=1.2, linestyle=(0, (6, 4)))
    draw_section(third, levels, corners, camera, row)
    below = (levels >= 0) & (np.arange(levels.shape[1])[:, None] >= row)
    draw_cells(fourth, below, corners, beside(scene, camera, 1.0), levels)
    fourth.set_title("slabs below the dashed line, from above", fontsize=9)
    present = {EMPTY, *KIND_OF_LEVEL[levels].ravel().tolist()}
    patches = [
        Patch(facecolor=color, edgecolor="0.4", label=kind) for k, (kind, color) in enumerate(KINDS.items()) if k in present
    ]
    figure.legend(handles=patches, loc="outside lower center", ncols=4, frameon=False, fontsize=9)
    return figure


def draw_section(axes: Axes, levels: np.ndarray, corners: Corners, camera: js.Camera, row: int) -> None:
    """What the slabs of a row of bundles were given: seen from above, the camera below."""
    slabs, _, columns = levels.shape
    view = camera.exact_view(corners[:, row])
    x, z = view[..., 0], view[..., 2]
    quads = [np.stack([side[k : k + slabs, j : j + columns] for k, j in ((0, 0), (0, 1), (1, 1), (1, 0))], -1) for side in (x, z)]
    colors = np.array(list(KINDS.values()))[KIND_OF_LEVEL[levels[:, row]].ravel()]
    outlines = np.stack(quads, -1).reshape(-1, 4, 2)
    axes.add_collection(PolyCollection(outlines, facecolors=colors, edgecolors="0.55", linewidths=0.05))
    axes.autoscale_view()
    axes.set(aspect="equal", xlabel="across (code units)", ylabel="depth from the camera (code units)")
    axes.set_title("slabs along the dashed line, from above", fontsize=9)


def draw_spared(axes: Axes, levels: np.ndarray, camera: js.Camera) -> None:
    """How many of the occupied slabs of each bundle are not at full rate, in its place in the picture."""
    occupied = (levels >= 0).sum(0)
    share = np.where(occupied > 0, 100 * (levels > 0).sum(0) / np.maximum(occupied, 1), np.nan)
    rows, columns = share.shape
    shown = axes.imshow(share, "cividis", vmin=0, vmax=50, extent=(-0.5, BUNDLE * columns - 0.5, BUNDLE * rows - 0.5, -0.5))
    axes.set(xticks=[], yticks=[], xlim=(-0.5, camera.width - 0.5), ylim=(camera.height - 0.5, -0.5))
    axes.set_title("slabs of each bundle that are not at full rate", fontsize=9)
    axes.figure.colorbar(shown, ax=axes, extend="max", shrink=0.8, label="%", pad=0.02)


def beside(scene: js.Scene, camera: js.Camera, above: float = 0.45) -> js.Camera:
    """A camera that looks at the grid of another from its right and above, by so much."""
    right, up, forward = camera.exact_axes()
    middle = np.mean(scene.bounds(), 0)
    away = 1.6 * np.linalg.norm(middle - camera.exact_eye())
    return js.Camera.look_at(middle + away * (0.75 * right + above * up - 0.5 * forward), middle, up, near=0.1, far=10 * away)


def draw_leaves(folder: pathlib.Path) -> None:
    """Leaves over a picture at two of its stages."""
    figure, axes = page(2, 1, (9.0, 8.2))
    scene, camera = made_fields.mixing_layer(171, width=384, height=160)
    progress = js.progressive(scene, camera, js.Settings(samples=64, leaf_pixels=LEAF), worst=WORST)
    images = list(itertools.islice(progress, STAGES[-1] + 1))
    for here, stage in zip(axes[:, 0], STAGES, strict=True):
        image = images[stage]
        known, inside = np.asarray(image.error_bound) == 0, np.asarray(image.transmittance) < 1
        outlines = leaves_of(known, LEAF // 2, inside)
        single, larger = ([one for one in outlines if (np.ptp(one[:, 0]) == 1) == alone] for alone in (True, False))
        rays, error = image.stats["rays"], image.stats["l2_error"]
        title = f"stage {stage}: {rays:,} rays for {known.size:,} pixels, estimated error {error:.1%}"
        show_picture(here, (0.7 * image.to_uint8()).astype(np.uint8), title)
        here.add_collection(LineCollection(larger, colors="gold", linewidths=0.5))
        here.add_collection(PolyCollection(single, facecolors="gold", alpha=0.35, linewidths=0))
        here.set(xlim=(-0.5, camera.width - 0.5), ylim=(camera.height - 0.5, -0.5))
    patches = [Patch(facecolor="none", edgecolor="goldenrod", label="leaf: rays at its corners")]
    patches += [Patch(facecolor="gold", alpha=0.7, label="every pixel has a ray")]
    figure.legend(handles=patches, loc="outside lower center", ncols=2, frameon=False, fontsize=9)
    save(figure, folder / "leaves.jpg")


FIGURES = {"occupied": draw_occupied, "levels": draw_levels, "leaves": draw_leaves}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("figures", nargs="*", default=[*FIGURES], help=f"of {', '.join(FIGURES)}; all by default")
    parser.add_argument("-o", "--output", type=pathlib.Path, default=GALLERY, help="folder that they are written into")
    asked = parser.parse_args()
    for name in asked.figures:
        FIGURES[name](asked.output)


if __name__ == "__main__":
    main()
