"""One picture by several processes: each renders some rows of it, and all of these make the picture.

Flow: scene, camera, settings -> measures of the whole -> rows of each -> [parts: render_tile] -> parts -> [merge_tiles] -> Image.

Rays of one bundle know nothing of those of another, and all that is chosen by how large supports appear is chosen by the whole
picture. So a part is the same bits as these rows of the whole: colours, transmittance, depth, bounds and estimates. The pilot
alone asks a lattice that bundles share, and that ends with a part: what the whole interpolates near a cut, a part marches.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterable, Sequence
from typing import Any

import jax
import numpy as np

from jaxsph.engine.access.lists import TILE
from jaxsph.engine.frame.finish import finish_image
from jaxsph.engine.frame.frame import Frame
from jaxsph.engine.planning.fit import demanded, fit, see, shape_of
from jaxsph.engine.planning.viewing import Measures
from jaxsph.engine.render import draw
from jaxsph.engine.request import Request
from jaxsph.engine.runtime.clock import Clock
from jaxsph.io.images.image_files import FIRST_ROW, ROWS
from jaxsph.io.replace import digest_of, fingerprint
from jaxsph.model.camera.camera import Camera
from jaxsph.model.camera.framing import with_depths
from jaxsph.model.image import Image
from jaxsph.model.scene import Scene
from jaxsph.model.settings import Settings
from jaxsph.numerics import __version__
from jaxsph.numerics.checks import Progress, array_of
from jaxsph.numerics.trees import on_host

PICTURE, PART, PARTS = "jaxsph.picture", "jaxsph.part", "jaxsph.parts"
"""Names of the metadata that say of which picture an image is a part, which (from 0 on), and of how many."""
OF_PARTS = (PICTURE, PART, PARTS, FIRST_ROW, ROWS)
OF_FILES = ("certified", "faults")  # names of the metadata that files add, each of its own part
NO_LEAVES = "`settings.screen` must be 'pixels' for parts of a picture: leaves of a quadtree lie across their edges"
LAYERS = "color", "transmittance", "depth", "error_bound", "evaluations"


@on_host
def render_tile(
    scene: Scene, camera: Camera, settings: Settings | None, index: int, count: int, *, progress: Progress | None = None
) -> Image:
    """Render one of `count` parts of a picture, each some of its rows; `jaxsph.scale.merge_tiles` makes the picture of them.

    Parts are cut between tiles of 16 x 16 pixels so that all have about as many pairs of particles and bundles of rays. A part is
    the same bits as these rows of `jaxsph.render(scene, camera, settings)`, but where machines round differently; with the pilot
    estimator it keeps the same tolerance.

    Args:
        scene, camera, settings: as for `jaxsph.render`: those of the whole picture, the same for all parts.
        index: which part, from 0 (the topmost rows) to `count - 1`.
        count: at least 1, at most the rows of tiles that the picture has.
        progress: as for `jaxsph.render`.

    Returns:
        Image of those rows alone, whose metadata say where they belong and of which picture they are.

    Raises:
        ValueError: an index or a count outside those ranges; a screen that is a quadtree, whose leaves are not cut; traced
            arguments; as `jaxsph.render`.
    """
    settings = settings or Settings()
    _require_parts(scene, camera, settings, index, count)
    camera = with_depths(camera, scene)
    x64, of_any_memory = jax.config.read("jax_enable_x64"), dataclasses.replace(settings, memory_limit=None)
    mark = fingerprint("p", __version__, x64, digest_of((scene, camera)), of_any_memory)  # all that the picture depends on
    clock, asked = Clock(progress=progress), Request.of(scene, camera, settings)
    shape = shape_of(asked)
    in_view, demand = demanded(see(asked.scene, asked.camera, shape, clock), asked, shape)
    rows = cuts(demand.measures, -(-camera.width // TILE), count)[index : index + 2]
    beside = int(asked.scene.formulas.antialias > 1)  # by their neighbours pixels are found that have several rays
    around = max(rows[0] - beside, 0), min(rows[1] + beside, len(demand.measures.tile_pairs))
    first, of_part = rows[0] * TILE, demand.of_rows(*around)
    plan = fit(of_part.shaped(headroom=1.0), roomy=of_part)  # where there is no room for more than this part needs
    clock.mark("plan")
    frame = Frame.of(asked, plan, in_view, clock, around[0] * TILE)
    drawing = clock.run(draw, frame, clock)
    image = asked.in_given_unit(finish_image(drawing, frame, settings, clock))
    if around != tuple(rows):
        own = slice(first - frame.first_row, rows[1] * TILE - frame.first_row)  # on the host: a device would compile for each
        layers: Any = {name: np.array(np.asarray(getattr(image, name))[own]) for name in (*LAYERS, "normal")}
        image = dataclasses.replace(image, **layers)
    place = ((PICTURE, mark), (PART, index), (PARTS, count), (FIRST_ROW, first), (ROWS, camera.height))
    return dataclasses.replace(image, metadata=(*image.metadata, *place))


def cuts(measures: Measures, tile_columns: int, count: int) -> list[int]:
    """The rows of tiles at which parts begin, and the end of the last: as evenly as whole rows allow, at least one each.

    A row weighs as its (particle, bundle) pairs, and one more for each bundle.
    """
    weights = measures.bundle_pairs + 4 * tile_columns
    sums, total = np.cumsum(weights), int(weights.sum())
    ends = [0]
    for part in range(1, count):
        near = int(np.searchsorted(sums, total * part / count))
        before, after = (sums[near - 1] if near else 0), sums[near]
        row = int(near + (after + before < 2 * total * part / count))
        ends.append(min(max(row, ends[-1] + 1), len(weights) - count + part))
    return [*ends, len(weights)]


def _require_parts(scene: Scene, camera: Camera, settings: Settings, index: int, count: int) -> None:
    if settings.screen == "quadtree":
        raise ValueError(f"{NO_LEAVES}; render it as a whole, or without the quadtree")
    most = -(-camera.height // TILE)
    if not 1 <= count <= most:
        wrong = f"`count` must lie in [1, {most}], as {camera.height} rows of pixels are {most} of tiles, got {count};"
        raise ValueError(f"{wrong} take fewer parts")
    if not 0 <= index < count:
        raise ValueError(f"`index` must lie in [0, {count - 1}] for {count} parts, got {index}")


def merge_tiles(parts: Iterable[Image], *, names: Sequence[str] | None = None) -> Image:
    """The picture that parts of `render_tile` make, in whatever order they are given.

    Args:
        parts: all of them, rendered here or read from EXR files.
        names: what to call them in messages, one a part; by default their places.

    Returns:
        Image, the same as `jaxsph.render` gives: layers and metadata, and `stats` summed over the parts where all have them.

    Raises:
        ValueError: none at all; an image that is no part, parts of different pictures, one that is missing or there twice. The
            message names it.
    """
    given = list(parts)
    called = list(names) if names is not None else [f"image {place}" for place in range(len(given))]
    if not given or len(called) != len(given):
        raise ValueError(f"`parts` must be at least one, each with a name, got {len(given)} and {len(called)} names")
    for image, name in zip(given, called, strict=True):
        if not set(OF_PARTS) <= dict(image.metadata).keys():
            made_by = "parts are made by `jaxsph render --tile I/N` or `jaxsph.scale.render_tile`"
            raise ValueError(f"{name} is not a part of a picture; {made_by}")
    told = [(dict(image.metadata), image, name) for image, name in zip(given, called, strict=True)]
    _require_one_picture(told)
    told.sort(key=lambda one: int(one[0][PART]))
    _require_all(told)
    return joined([image for _, image, _ in told])


Part = tuple[dict[str, Any], Image, str]  # what its metadata tell, the image, and what it is called


def _require_one_picture(told: list[Part]) -> None:
    """Compare with what most parts say, so that the one that differs is named."""
    of = [(str(said[PICTURE]), int(said[PARTS])) for said, *_ in told]
    common = max(of, key=of.count)
    other = told[of.index(common)][2]
    for (picture, count), (*_, name) in zip(of, told, strict=True):
        if picture != common[0]:
            why = "scene, camera, settings or version differ; render that part again"
            raise ValueError(f"{name} is part of another picture than {other}: {why}")
        if count != common[1]:
            raise ValueError(f"{name} is one of {count} parts, but {other} is one of {common[1]}; render all with the same count")


def _require_all(told: list[Part]) -> None:
    """Each once, in order, and rows that follow on one another: machines that round differently may cut differently."""
    for (said, _, name), (after, _, other) in itertools.pairwise(told):
        if int(said[PART]) == int(after[PART]):
            raise ValueError(f"{name} and {other} are both part {said[PART]} of the picture; give one of them")
    first, whole, _ = told[0]
    count, there = int(first[PARTS]), {int(said[PART]) for said, *_ in told}
    if missing := [f"{place}/{count}" for place in range(count) if place not in there]:
        raise ValueError(f"{len(missing)} of {count} parts of the picture are missing: --tile {', '.join(missing)}")
    begins = [*(int(said[FIRST_ROW]) for said, *_ in told), int(first[ROWS])]
    for (_, image, name), (begin, end) in zip(told, itertools.pairwise(begins), strict=True):
        if begin + image.shape[0] != end or image.shape[1] != whole.shape[1]:
            raise ValueError(
                f"{name} ends at row {begin + image.shape[0]} and the next part begins at {end}, {image.shape[1]} pixels wide: "
                "these parts were cut differently; render all of them with one version, on machines of one kind"
            )
    if begins[0] != 0:
        raise ValueError(f"{told[0][2]} begins at row {begins[0]}, not 0; render it again")


def joined(parts: list[Image]) -> Image:
    """The image of rows that follow on one another."""
    of_pixels = (*LAYERS, "normal") if all(part.normal is not None for part in parts) else LAYERS
    whole = {name: array_of(np.concatenate([getattr(part, name) for part in parts])) for name in of_pixels}
    of_slabs = [part.levels for part in parts if part.levels is not None]
    levels = array_of(np.concatenate(of_slabs, axis=1)) if len(of_slabs) == len(parts) else None
    return dataclasses.replace(
        parts[0],
        **whole,
        certified=all(bool(part.certified) for part in parts),
        faults=int(np.bitwise_or.reduce([int(part.faults) for part in parts])),
        stats=_summed([part.stats for part in parts]),
        metadata=tuple((name, value) for name, value in parts[0].metadata if name not in OF_PARTS + OF_FILES),
        levels=levels,
    )


def _summed(stats: list[dict[str, Any]]) -> dict[str, Any]:
    """Sums of what all parts counted, stage by stage for seconds."""
    if not all(stats):
        return {}
    summed: dict[str, Any] = {}
    for name, value in stats[0].items():
        values = [each[name] for each in stats]
        summed[name] = _summed(values) if isinstance(value, dict) else sum(values)
    return summed
