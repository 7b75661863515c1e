"""The commands `info`, what a file holds, and what of it would be shown; and `transfer`, a transfer function over what rays meet.

Flow: file or scene, options -> table, `jaxsph.io.opening` -> [data] -> lines on stdout; Scene, Camera -> figure, JSON.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from jaxsph import io
from jaxsph.cli import console, figures, groups, scene as cli_scene, voice
from jaxsph.cli.console import SCENE, attributes, camera_line, refuse, require_writable, span, stem_of, units_of, wrong_usage
from jaxsph.cli.groups import OUTPUT, OWN, offered, output
from jaxsph.cli.voice import report, result, say, say_all, tell
from jaxsph.io.opening import values
from jaxsph.io.opening.looks import values_of
from jaxsph.io.opening.opened import Loaded, load, staged
from jaxsph.io.opening.options import OF_SURFACE, Look, Source, View, option
from jaxsph.io.opening.part_types import read_types
from jaxsph.io.replace import write_figure
from jaxsph.io.settle.assemble import GLANCE
from jaxsph.io.settle.derived import FORMULAS
from jaxsph.io.settle.quantities import formulas_said
from jaxsph.io.units import spoken
from jaxsph.model.camera.camera import Bounded, BoundingBox, Camera
from jaxsph.plot.transfer_figure import transfer_figure

OF_FUNCTIONS = {"output", *(one.name for one in dataclasses.fields(groups.Options))}  # what a function alone has


@offered(without="iso mix")
class Info(groups.Options, groups.Beside, Source):
    """Options of the command."""


def info(file: Annotated[str | None, groups.FILE] = None, /, *, asked: Info = Info()) -> None:
    """Say what a file holds, and what `render` would show of it."""
    options = dataclasses.replace(asked, source=file)
    cli_scene.require_something(options)
    parts: list[tuple[str, Bounded]] = []
    camera = None
    if options.source is not None:
        shown, camera = _described(options)
        parts.append((options.source, shown))
    parts += [
        (one.file, cli_scene.volume_of_file(one.file, one.options.get("quantity"), described=True)[0]) for one in options.volume
    ]
    parts += cli_scene.points_of(options, described=True)
    if camera is None or len(parts) > 1:
        camera = Camera.framing(BoundingBox.around(part for _, part in parts))
    say("camera", camera_line(camera))
    report(camera=camera_line(camera), source=options.source)
    for sentence in cli_scene.apart(parts):
        tell(options.command, f"warning: {sentence}")


def _described(options: Any) -> tuple[Bounded, Camera | None]:
    """Say what the source holds; what there is to frame, and its camera."""
    if options.source.startswith(SCENE):
        loaded, scene, camera = cli_scene.named_scene(options)
        say("quantity", f"{loaded.quantity}, {span(values_of(loaded.shown))}")
        report(particles=scene.particle_set.num_particles, quantity=loaded.quantity)
        return scene.particle_set, camera
    if io.is_volume(options.source):
        refuse(options, options.of_particles, "is for particles, and this is a volume")
        volume = cli_scene.volume_of_file(options.source, options.color_by, described=True)[0]
        return volume, _camera(Loaded(options.source, volume, "values"))
    types, _ = read_types(options.source, options.types, options.physical)
    table = types[0].table
    for one in types:
        result(f"{options.source}: {one.table.source}, {len(one.table):,} particles{f' of {one.called}' * (len(types) > 1)}")
        attributes(one.table)
    if len(types) > 1:
        report(types={one.called: {"particles": len(one.table), "attributes": list(one.table.columns)} for one in types})
    stated = ({"positions": table.units.length} if table.units.length is not None else {}) | dict(table.units.columns)
    if stated:
        units = {name: spoken(unit) for name, unit in stated.items()}
        say("units", f"stated for {', '.join(stated)}")
        say("", "; ".join(f"{name} {units_of(unit)}" for name, unit in units.items()))
        report(units=units)
    if moment := io.labels_of(table, "", 1.0).moment:
        say("time", moment)
    for sentence in formulas_said(table, *FORMULAS):
        say("by name", sentence)
    result("\n`jaxsph render` would show")
    with wrong_usage(of=io.ConditionError):
        loaded = load(options.source, options, Look(), effort=GLANCE)
    cli_scene.say_chosen(loaded, table.conventions)
    say_all(loaded.said)
    taken: Any = loaded.report
    report(quantity=loaded.quantity, opacity_by=loaded.opacity_by, support=taken.support, kernel=taken.kernel)
    return loaded.shown, _camera(loaded)


def _camera(loaded: Loaded) -> Camera:
    """The camera that `render` would choose, and what of it is said."""
    opened = staged(loaded, Look(), View())
    say_all((what, text) for what, text in opened.said if what in ("surface", "box", "up"))
    return opened.camera


@offered(
    without=f"surface surface_of {' '.join(OF_SURFACE)} background annotate axes length_unit title dpi font_size panels "
    "difference contours"
)
class Transfer(groups.Options, groups.Key, Look, View, Source):
    """Options of the command."""

    output: Path | None = output(".png, .pdf or .svg: the figure (default: named after FILE, here)")
    save: Path | None = option(None, "FILE.json", Path, OUTPUT, "write the function, for --transfer")
    rays: int = option(2000, "N", values.count(1), OWN, "random pixels for the histogram of what they meet (default 2000)")
    surface: Any = False
    annotate: Any = True


def transfer(
    file: Annotated[str, Parameter(help="a file, scene:NAME, or a saved function (.json)")], /, *, asked: Transfer = Transfer()
) -> None:
    """Draw a transfer function over what rays meet."""
    options = dataclasses.replace(asked, source=file)
    output = options.output or Path(f"{stem_of(file)}_transfer.png")
    figures.require_figure(output)
    if options.save is not None:
        require_writable(options.save, "--save: a transfer function is written as", (".json",))
    if Path(file).suffix.lower() == ".json":
        console.refuse_others(options, OF_FUNCTIONS, "is for FILE or scene:NAME, and this is a saved function")
        look, over = io.read_transfer(file), ""
        say("colours", f"{len(look.values)} control points over {span(look.values)}, extinction {span(look.extinction)}")
        figure = transfer_figure(look, title=Path(file).name)
    else:
        opened = cli_scene.opened_of(options)
        scene, camera = opened.scene, opened.camera
        look, over = scene.looks[0], f", over what {min(options.rays, camera.width * camera.height)} rays meet"
        figure = transfer_figure(look, scene, camera, labels=opened.labels, title=file, rays=options.rays)
    write_figure(figure, output)
    say("figure", f"{output}{over}")
    voice.written(output, values=[float(look.values[0]), float(look.values[-1])])
    if options.save is not None:
        look.save(options.save)
        say("saved", f"{options.save}: render with --transfer {options.save}")
        voice.written(options.save)
