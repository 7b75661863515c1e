"""The command `info`: what a file holds, and what of it would be shown.

Flow: file or scene, options -> table, `jaxsph.io.opening` -> [info] -> lines on stdout.
"""

from __future__ import annotations

import dataclasses
from typing import Annotated, Any

from jaxsph import io
from jaxsph.cli import look as cli_look
from jaxsph.cli import parts as cli_parts
from jaxsph.cli import scene as cli_scene
from jaxsph.cli.console import attributes, camera_line, refuse, say_notes, say_report, span, wrong_usage
from jaxsph.cli.options import groups
from jaxsph.cli.options.settings import SCENE
from jaxsph.cli.voice import report, result, say
from jaxsph.io.opening.opened import Loaded, load, staged
from jaxsph.io.opening.options import Look, View
from jaxsph.model import Camera
from jaxsph.model.camera.camera import Bounded, BoundingBox


@dataclasses.dataclass(frozen=True, kw_only=True)
class Info(groups.Options, groups.Beside, groups.Source):
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
    parts += [(one.file, cli_parts.described_volume(one.file, one.options.get("quantity"))) for one in options.volume]
    parts += cli_parts.points_of(options, described=True)
    if camera is None or len(parts) > 1:
        camera = Camera.framing(BoundingBox.around(part for _, part in parts))
    say("camera", camera_line(camera))
    report(camera=camera_line(camera), source=options.source)
    cli_parts.warn_apart(parts, options.command)


def _described(options: Any) -> tuple[Bounded, Camera | None]:
    """Say what the source holds; what there is to frame, and its camera."""
    if options.source.startswith(SCENE):
        name, scene, camera = cli_scene.named_scene(options)
        columns = scene.particle_set.to_numpy()
        count = scene.particle_set.num_particles
        say("scene", f"{name}, {count:,} particles, support {span(columns['support'])}")
        say("quantity", f"concentration, {span(columns['quantity'])}")
        report(particles=count, quantity="concentration")
        return scene.particle_set, camera
    if io.is_volume(options.source):
        refuse(options, options.of_particles, "is for particles, and this is a volume")
        volume = cli_parts.described_volume(options.source, options.color_by)
        return volume, _camera(Loaded(options.source, volume, "values"))
    table = io.read_table(options.source, part_type=options.part_type)
    result(f"{options.source}: {table.source}, {len(table):,} particles")
    attributes(table)
    cli_look.say_units(table)
    result("\n`jaxsph render` would show")
    with wrong_usage(of=io.ConditionError):
        loaded = load(options.source, options, Look())
    taken = loaded.report
    assert taken is not None
    columns = loaded.shown.to_numpy()  # type: ignore[union-attr]
    say("quantity", f"{loaded.quantity}, {span(columns['quantity'])}")
    if loaded.opacity_by is not None:
        say("opacity", f"by {loaded.opacity_by}, {span(columns.get('extinction_quantity', columns['quantity']))}")
    say_report(taken, columns["support"])
    say_notes(note for note in taken.notes if note not in table.conventions)
    report(quantity=loaded.quantity, opacity_by=loaded.opacity_by, support=taken.support, kernel=taken.kernel)
    return loaded.shown, _camera(loaded)


def _camera(loaded: Loaded) -> Camera:
    """The camera that `render` would choose, and what of it is said."""
    opened = staged(loaded, Look(), View())
    for what, text in opened.said:
        if what in ("surface", "box", "up"):
            say(what, text)
    return opened.camera
