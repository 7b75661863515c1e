"""The command `view`: an interactive view in the browser, served on this machine alone.

Flow: options -> Scene, Camera, Settings -> [view] -> Session -> server, browser; the address on stdout.
"""

from __future__ import annotations

import dataclasses
import functools
import warnings
import webbrowser
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from jaxsph.cli import scene as cli_scene
from jaxsph.cli import voice
from jaxsph.cli.console import UsageError, camera_line
from jaxsph.cli.options import groups, values
from jaxsph.cli.options.groups import CAMERA, OWN, QUALITY, flag, option
from jaxsph.cli.options.settings import SCENE, as_medium, settings_of
from jaxsph.cli.sequence import snapshots_of
from jaxsph.cli.voice import say
from jaxsph.io.libraries import require
from jaxsph.model import Scene, Settings
from jaxsph.sequence.snapshots import Snapshots
from jaxsph.viewer.code import Source
from jaxsph.viewer.server import Server, run
from jaxsph.viewer.session import Session
from jaxsph.viewer.stages import DEFAULT
from jaxsph.viewer.timeline import Timeline, timeline_of

MAX_PORT = 65535
SECONDS = 1.0
"""How long the end waits for a picture that is being made."""


@Parameter(name="*")
@dataclasses.dataclass(frozen=True, kw_only=True)
class View(groups.Options, groups.Control, groups.SurfaceLook, groups.View, groups.Mixed, groups.Source):
    """Options of the command."""

    size: Annotated[tuple[int, int], option("--size", "WxH", values.size, CAMERA, "pixels (default 960x720)")] = (960, 720)
    tolerance: Annotated[
        float | None,
        option("--tolerance", "T", values.number, QUALITY, f"error of a pixel that stands still (default {DEFAULT.tolerance:g})"),
    ] = None
    port: Annotated[int, option("--port", "N", values.whole, OWN, "of 127.0.0.1 (default 0: any that is free)")] = 0
    no_browser: Annotated[bool, flag("--no-browser", OWN, "print the address alone")] = False


VIEW = View()


def view(
    *files: Annotated[
        str, Parameter(help="a file of particles or of a volume, a sequence of snapshots, or scene:NAME[:particles=N,frame=K]")
    ],
    asked: View = VIEW,
) -> bool:
    """Look around in the browser; whether threads are left that nothing can end, as a compiler's."""
    if not files:
        raise UsageError("a file, a sequence of files or scene:NAME is needed as FILE")
    options = dataclasses.replace(asked, source=files[0] if len(files) == 1 else list(files))
    if not 0 <= options.port <= MAX_PORT:
        raise UsageError(f"--port must lie from 0 to {MAX_PORT}, got {options.port}; 0 takes any that is free")
    if options.json:
        raise UsageError("--json is for commands that end by themselves; the one line of stdout is the address")
    require("websockets", "an interactive view", "view")
    options = as_medium(options, settings_of(options))
    timeline: Timeline | None = None
    if len(files) == 1:
        scene, camera, _ = cli_scene.scene_of(options)
    else:
        snapshots, camera, _ = snapshots_of(options, gaps=True, strict=False)
        scene, timeline = timeline_of(snapshots, functools.partial(_source_of_frame, options, snapshots))
    settings = _settings(options, scene)
    say("camera", camera_line(camera, options))
    warnings.filterwarnings("ignore", "[0-9]+ of [0-9]+ pixels", UserWarning)  # told in words, of each picture
    session = Session(scene, camera, settings, _source(options) if timeline is None else None, timeline)
    server, opens = Server(session, options.port), not options.no_browser

    def ready() -> None:
        voice.release()
        print(server.url, flush=True)
        session.start()
        if opens:
            webbrowser.open(server.url)

    try:
        run(server, ready)
    finally:
        ended = session.close(SECONDS)
    return not ended


def _settings(options: Any, scene: Scene) -> Settings:
    """Those that are asked for; where nothing says how well, those of a view."""
    made = settings_of(options)
    how = "integrator", "estimator", "relax", "screen"
    if scene.surface is not None or any(getattr(options, name) is not None for name in how):
        return made
    tolerance = DEFAULT.tolerance if made.tolerance is None else made.tolerance
    return dataclasses.replace(made, integrator=DEFAULT.integrator, tolerance=tolerance)


def _source(options: Any) -> Source:
    """How the scene is opened in Python, and by the command."""
    width, height = options.size
    if options.source.startswith(SCENE):
        name, behind = values.file_and_options(options.source)
        more = "".join(f"{key}={value}, " for key, value in behind.items())
        more += f"width={width}, height={height}"
        python = f"scene, camera = js.scenes.load({name.removeprefix(SCENE)!r}, {more})"
        if options.surface not in (None, False):
            python += f"\nscene = dataclasses.replace(scene, surface=js.Surface({options.surface!r}))"
    else:
        names = (
            "color_by",
            "opacity_by",
            "center",
            "width",
            "view",
            "where",
            "colormap",
            "norm",
            "range",
            "preset",
            "surface",
            "surface_of",
            "eye",
            "target",
        )
        given = {name: getattr(options, name) for name in names}
        said = "".join(f", {name}={value!r}" for name, value in given.items() if value is not None)
        python = f"scene, camera = js.io.read_scene({options.source!r}{said}, size=({width}, {height}))"
    return Source(python, options.source, tuple(word for word in options.words if word != options.source))


def _source_of_frame(options: Any, snapshots: Snapshots, path: Path, time: float) -> Source:
    """How a frame of a sequence is made in Python, and by the command where its box is not moved."""
    survey = snapshots.survey
    chosen = {"color_by": survey.quantity, "opacity_by": survey.report.opacity_by}
    names = (*chosen, "support", "kernel", "part_type", "where", "share", "center")
    given = {name: chosen.get(name) or getattr(options, name) for name in names}
    said = "".join(f", {name}={value!r}" for name, value in given.items() if value is not None)
    if snapshots.surface is not None:
        said += f", surface=js.Surface({float(snapshots.surface.level)!r}, {snapshots.surface.of!r})"
    files = [str(file.path) for file in survey.files]
    python = f"snapshots = js.sequence.Snapshots.from_files({files}{said}, gaps=True)\nscene = snapshots.at({time!r})"
    words = [word for word in options.words if word not in options.source]
    told = {word.partition("=")[0] for word in words}
    for name, value in chosen.items():
        option = f"--{name.replace('_', '-')}"
        told_otherwise = option in told or (name == "opacity_by" and options.surface_of is not None)
        words += [f"{option}={value}"] * (value is not None and not told_otherwise)
    return Source(python, "" if snapshots.center is not None else str(path), tuple(words), whole=True)
