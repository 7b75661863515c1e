"""The commands `render`, a picture of each file, whole or a part of it, in one go or in stages; and `merge`, of its parts.

Flow: options -> Scene, Camera, Settings -> [render] -> EXR or PNG, its path on stdout, prose on stderr.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from cyclopts import Parameter

import jaxsph
from jaxsph import io
from jaxsph.analysis.mesh import SUFFIXES, mesh
from jaxsph.cli import console, figures, groups, scene as cli_scene, voice
from jaxsph.cli.commands.columns import contours_over
from jaxsph.cli.console import UsageError, wrong_usage
from jaxsph.cli.groups import MEANS, OUTPUT, QUALITY, SETTINGS, as_medium, offered, output, settings_of
from jaxsph.cli.table import header
from jaxsph.cli.voice import say
from jaxsph.engine.frame.quadtree import progressive
from jaxsph.engine.runtime.devices import chosen_devices
from jaxsph.io.opening import values
from jaxsph.io.opening.opened import Opened
from jaxsph.io.opening.options import Look, Source, View, flag, option
from jaxsph.model.camera.camera import Camera
from jaxsph.model.image import Image
from jaxsph.model.scene import Scene
from jaxsph.model.settings import Settings
from jaxsph.scale import parts as tiles

NAME = "{}"  # what stands in OUT for the name of a file
WHERE = ".exr, .png, .pdf, .svg, or .obj, .ply for a mesh; of several files a folder, or a name with {} in it (default: FILE.png)"
OF_MESH = {one.name for group in (groups.Options, Source) for one in dataclasses.fields(group)} - {"opacity_by"}
OF_MESH |= {"output", "surface", "surface_of", "smoothing", "cell", "smallest_piece"}
OF_SURFACE = "surfaces of particles are in their place to rounding; what is thinner than a sample may be missed, see --samples"
SEEN = 0.013, 0.065
"""99.9 % errors of 256 point samples against the light integral, over the built-in scenes (`benchmarks/truth.py`)."""


@offered(without="difference")
class Render(groups.Options, groups.Quality, groups.Key, Look, View, groups.Beside, Source):
    """Options of the command."""

    output: Path | None = output(WHERE)
    cell: float | None = option(None, "LENGTH", values.number, OUTPUT, "of a mesh (default: a quarter of a support)", show=False)
    smallest_piece: float | None = option(
        None, "SHARE", values.number, OUTPUT, "of a mesh: of the largest piece's volume, less of which is left out", show=False
    )
    bracket: bool = flag(
        QUALITY, "between what each pixel is proven to lie at full rate, as layers lower.* and upper.* of the EXR", show=False
    )
    progressive: bool = flag(QUALITY, "by a quadtree, in stages: OUT is rewritten at each")
    devices: Any = option(None, "all|N", values.devices, MEANS, "share the picture among devices (default: one)")
    tile: Any = option(None, "I/N", values.tile, MEANS, "part I of N alone, as EXR; `jaxsph merge` puts parts together")


def render(
    *files: Annotated[str, Parameter(help="files of particles or of volumes, or scene:NAME[:particles=N,frame=K]")],
    asked: Render = Render(),
) -> None:
    """Make a picture of each source that is given, or of the parts that stand for it."""
    render_each(dataclasses.replace(asked, source=list(files)), _render)


@offered()
class Merge(groups.Options):
    """Options of the command."""

    output: Path | None = output(".exr or .png")


def merge(
    *files: Annotated[Path, Parameter(help="all parts of one picture, those of `jaxsph render --tile I/N`, in any order")],
    asked: Merge = Merge(),
) -> None:
    """Read the parts, put them together, and write the picture."""
    if asked.output is None or not files:
        raise UsageError("-o OUT is needed: where should the picture go?" if files else "the parts of a picture are needed")
    console.require_writable(asked.output, "an image must be", figures.IMAGES)
    for path in files:
        if path.suffix.lower() != ".exr":
            raise UsageError(f"{path}: parts are .exr")
    image = tiles.merge_tiles([io.read_image(path) for path in files], names=[str(path) for path in files])
    image.save(asked.output)
    height, width = image.shape
    say("image", f"{asked.output}, {width} x {height}, of {len(files)} parts")
    tolerance = dict(image.metadata).get("jaxsph.tolerance")
    if tolerance is not None:
        kind = "certified" if image.certified else "estimated"
        say("error", f"at most {console.largest(image.error_bound):.2g} ({kind}), tolerance {tolerance:g}")
    voice.written(asked.output, size=[width, height], parts=len(files))
    console.tell_if_unseen("merge", asked.output, [image.color])


def render_each(options: Any, render: Callable[[Any], None]) -> None:
    """Render each of `options.source`, or all as panels; one that fails keeps none of the others from being done.

    Raises `UsageError`: OUT is not for several files, or two have the same name; `RuntimeError`: some failed, which and why.
    """
    sources = options.source
    if options.panels and sources:
        return render(options)
    if len(sources) < 2 and not (sources and options.output is not None and NAME in options.output.name):
        render(dataclasses.replace(options, source=sources[0] if sources else None))
        return
    outputs, failed = outputs_of(sources, options.output), []
    voice.release()
    for nth, (source, place) in enumerate(zip(sources, outputs, strict=True), 1):
        say("", f"{nth} of {len(sources)}: {source}")
        place.parent.mkdir(parents=True, exist_ok=True)
        try:
            render(dataclasses.replace(options, source=source, output=place))
        except (ValueError, OSError, RuntimeError) as error:
            failed.append(f"{source}: {error}")
            say("failed", str(error))
    if failed:
        raise RuntimeError(f"{len(failed)} of {len(sources)} failed: {'; '.join(failed)}")


def outputs_of(sources: Sequence[str], output: Path | None) -> list[Path]:
    """Where the picture of each goes: into a folder, or by a name with `{}` in it; here without."""
    names = [console.stem_of(source) for source in sources]
    if len(set(names)) < len(names):  # equal names in two folders
        names = [f"{Path(source).parent.name}_{name}".strip("_") for source, name in zip(sources, names, strict=True)]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise UsageError(f"two pictures would be called {twice}: render these files one by one, with -o")
    if output is None:
        return [Path(f"{name}.png") for name in names]
    if NAME in output.name:
        return [output.with_name(output.name.replace(NAME, name)) for name in names]
    if output.suffix.lower() in (*figures.IMAGES, *figures.VECTORS, *SUFFIXES):
        what = "mesh" if output.suffix.lower() in SUFFIXES else "picture"
        raise UsageError(f"-o {output} is one {what}, but there are {len(sources)}; give a folder, or a name with {{}} in it")
    return [output / f"{name}.png" for name in names]


def _mesh(options: Any, output: Path) -> None:
    """The surface of a source, as a mesh."""
    console.refuse_others(options, OF_MESH, "is of a picture, and a mesh is none: leave it out, or write .png or .exr")
    if options.part_type is not None and (len(options.types) > 1 or options.types[0][1] is not None):
        raise UsageError(f"--part-type must be one type without a look for a mesh, got {options.part_type!r}")
    console.require_writable(output, "a mesh must be", SUFFIXES)
    cli_scene.require_something(options)
    scene = cli_scene.opened_of(options).scene
    if scene.surface is None:
        raise UsageError(f"{output} is a mesh of a surface, and there is none: give --surface")
    with wrong_usage("--cell, --smallest-piece: ") if options.cell or options.smallest_piece else contextlib.nullcontext():
        made = mesh(scene, cell=options.cell, smallest_piece=options.smallest_piece or 0.0)
    made.save(output)
    say("mesh", f"{output}, {', '.join(made.told)}")
    median, most = made.deviation
    voice.written(output, vertices=len(made.vertices), triangles=len(made.faces), deviation={"median": median, "most": most})


def _render(options: Any) -> None:
    """One picture."""
    if options.output is not None and options.output.suffix.lower() in SUFFIXES:
        return _mesh(options, options.output)
    console.refuse(options, ("cell", "smallest_piece"), f"is of a mesh: write {' or '.join(SUFFIXES)}")
    settings = settings_of(options)
    if options.devices is not None:
        with wrong_usage("--devices: "):
            chosen_devices(options.devices)
    cli_scene.require_something(options)
    named = ".png" if options.tile is None else "_{}_of_{}.exr".format(*options.tile)
    output = figures.output_of(options, "an image must be", (*figures.IMAGES, *figures.VECTORS), named)
    if options.tile is not None and output.suffix.lower() != ".exr":
        raise UsageError(f"{output}: a part must be .exr, which says where it belongs; `jaxsph merge` makes a .png of all parts")

    if options.bracket:
        if output.suffix.lower() != ".exr":
            raise UsageError(f"{output}: --bracket writes layers that only .exr holds: give -o {output.with_suffix('.exr')}")
        console.refuse(options, ("tile", "progressive", "background"), "and --bracket exclude each other: leave one out")

    def opening(one: Any, like: Opened | None) -> tuple[Opened, Callable[[], figures.Made]]:
        opened = cli_scene.opened_of(as_medium(one, settings), like)
        return opened, functools.partial(_made, one, settings, output, opened)

    figures.draw(options, output, opening)


def _made(options: Any, settings: Settings, output: Path, opened: Opened) -> figures.Made:
    """A picture, and what is said of it."""
    scene, camera = opened.scene, opened.camera

    def draw() -> Image:
        if options.progressive:
            voice.release()
            return _in_stages(scene, camera, settings, output)
        with console.progress("render") as show:
            if options.tile is None:
                return jaxsph.render(scene, camera, settings, progress=show, devices=options.devices)
            image = tiles.render_tile(scene, camera, settings, *options.tile, progress=show)
        first_row = dict(image.metadata)[tiles.FIRST_ROW]
        say("part", f"{options.tile}, rows {first_row} to {first_row + image.shape[0] - 1} of {camera.height}")
        return image

    contours = None if options.contours is None else contours_over(options, opened)
    image = draw()
    said = {"error": OF_SURFACE if scene.surface is not None else _how_wrong(image, settings)}
    if options.bracket:
        made = jaxsph.bracket(scene, camera, settings)
        image = dataclasses.replace(image, lower=made.lower, upper=made.upper)
        widest = console.largest(made.upper - made.lower)
        said["bracket"] = f"at full rate pixels lie between layers lower.* and upper.*, at most {widest:.2g} apart"
    told = header("render", options.words, part=options.tile is not None)
    image = dataclasses.replace(image, metadata=(*image.metadata, told))
    width, height = options.size
    results = {
        "settings": {name: getattr(settings, name) for name in SETTINGS} | {"integrator": settings.integrator_used},
        "stats": {name: value for name, value in image.stats.items() if name != "seconds"},
        "error": {"bound": console.largest(image.error_bound), "certified": bool(image.certified)},
    }
    about = "image", f"{width} x {height}, {settings.samples} samples a ray"
    seen = [image.color] if options.tile is None and (scene.particles is None or scene.particles.num_particles) else []
    return figures.Made(image, about, said, results, image.stats, look={}, labels=opened.labels, contours=contours, colors=seen)


def _how_wrong(image: Image, settings: Settings) -> str:
    """What is known of the picture's error."""
    if settings.tolerance is not None:
        about = settings.is_refined
        how = "estimated against the light integral" if about else "certified" if image.certified else "estimated"
        bounds = np.asarray(image.error_bound)
        known = bounds[np.isfinite(bounds)]
        bound = f"{'about ' if about else ''}{console.largest(known):.2g}"
        words = f"at most {bound} ({how}), tolerance {settings.tolerance:g}"
        unknown = bounds.size - known.size
        return f"{words}; unknown in {unknown} pixels, at a jump of the transfer function or a clip's face" if unknown else words
    remedy = "--tolerance 0.01 keeps and tells it"
    if settings.integrator_used != "samples" or settings.samples != Settings().samples:
        return f"not estimated; {remedy}"
    low, high = SEEN
    return f"not estimated: of built-in scenes one pixel in a thousand is off by {low:g} to {high:g} with these samples; {remedy}"


def _in_stages(scene: Scene, camera: Camera, settings: Settings, output: Path) -> Image:
    """The last image; `output` is rewritten at each stage, whole or not at all, and keeps the last when interrupted."""
    shown: Image | None = None
    try:
        for image in progressive(scene, camera, settings):
            image.save(output)
            shown, stats = image, image.stats
            errors = f"estimated error {stats['max_error']:.2g} at most, {100 * stats['l2_error']:.2g} % in L2"
            rays = f"{stats['rays']:,} rays cast, {stats['rays_left']:,} left at most"
            say(f"stage {stats['stage']}", f"{errors}; {rays}; {sum(stats['seconds'].values()):.2f} s")
    except KeyboardInterrupt:
        if shown is not None:
            say("stopped", f"{output} holds stage {shown.stats['stage']}")
        raise
    assert shown is not None
    return shown
