"""The command `view`: an interactive view in the browser, served on this machine alone.

Flow: options -> Scene, Camera, Settings -> [view] -> Session -> server, browser; the address on stdout.
"""

from __future__ import annotations

import dataclasses
import functools
import shlex
import tempfile
import warnings
import webbrowser
from pathlib import Path
from typing import Annotated, Any

from jaxsph.cli import groups, scene as cli_scene, voice
from jaxsph.cli.console import SCENE, UsageError, camera_line
from jaxsph.cli.groups import OWN, QUALITY, as_medium, offered, settings_of
from jaxsph.cli.voice import say
from jaxsph.io.damage import require
from jaxsph.io.opening import values
from jaxsph.io.opening.looks import shown_surface
from jaxsph.io.opening.opened import GROUPS
from jaxsph.io.opening.options import CAMERA, OF_SURFACE, Look, Source as OfSource, View, flag, option
from jaxsph.model.scene import Scene
from jaxsph.model.settings import Settings
from jaxsph.sequence.snapshots import Snapshots
from jaxsph.viewer.server import Server, run
from jaxsph.viewer.session import Session
from jaxsph.viewer.stages import DEFAULT
from jaxsph.viewer.state import Frame, Source, frames_of, python_of

MAX_PORT = 65535
SIZE = 960, 720  # until the window says how large it is
SECONDS = 1.0  # how long the end waits for a picture that is being made


@offered(without="draft")
class Asked(groups.Options, groups.Quality, Look, View, groups.Beside, OfSource):
    """Options of the command."""

    size: Any = option(None, "WxH", values.size, CAMERA, "pixels (default: as the window has room for)")
    tolerance: float | None = option(None, "T", values.number, QUALITY, f"of a pixel at rest (default {DEFAULT.tolerance:g})")
    port: int = option(0, "N", values.whole, OWN, "of 127.0.0.1 (default 0: any that is free)")
    no_browser: bool = flag(OWN, "print the address alone")


def view(*files: Annotated[str, groups.FRAMES], asked: Asked = Asked()) -> bool:
    """Look around in the browser; whether threads are left that nothing can end, as a compiler's."""
    if not files:
        raise UsageError("a file, a sequence of files or scene:NAME is needed as FILE")
    options = dataclasses.replace(asked, source=files[0] if len(files) == 1 else list(files), size=asked.size or SIZE)
    if not 0 <= options.port <= MAX_PORT:
        raise UsageError(f"--port must lie from 0 to {MAX_PORT}, got {options.port}; 0 takes any that is free")
    if options.json:
        raise UsageError("--json is for commands that end by themselves; the one line of stdout is the address")
    require("websockets", "an interactive view", "view")
    options = as_medium(options, settings_of(options))
    frames: list[Frame] = []
    if len(files) == 1:
        opened = cli_scene.opened_of(options)
        scene, camera = opened.scene, opened.camera
    else:
        snapshots, seen, _ = cli_scene.snapshots_of(options, gaps=True, strict=False)
        camera = seen.camera
        scene, frames = frames_of(snapshots, functools.partial(_source_of_frame, options, snapshots))
    settings = _settings(options, scene)
    say("camera", camera_line(camera, options))
    warnings.filterwarnings("ignore", "[0-9]+ of [0-9]+ pixels", UserWarning)  # told in words, of each picture
    source = None if frames else _source(options)
    session = Session(scene, camera, settings, source, frames, fits=asked.size is None)
    server, opens = Server(session, options.port), not options.no_browser

    with tempfile.TemporaryDirectory(prefix="jaxsph-") as folder:  # this user's alone, unlike what browsers are started with

        def ready() -> None:
            voice.release()
            print(server.url, flush=True)
            session.start()
            if opens:
                page = Path(folder) / "view.html"
                page.write_text(f'<meta http-equiv="refresh" content="0; url={server.url}">\n', encoding="ascii")
                webbrowser.open(page.as_uri())

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
    return dataclasses.replace(made, tolerance=DEFAULT.tolerance) if made.tolerance is None else made


def _source(options: Any) -> Source:
    """How the scene is opened in Python."""
    width, height = options.size
    if any(getattr(options, name) not in (None, ()) for name in ("points", "volume", "iso", "mix")):
        return Source(f"# scene: as it was opened by {shlex.join(['jaxsph', 'view', *options.words])}", whole=True)
    fields = [field for group in GROUPS for field in dataclasses.fields(group) if field.name != "size"]
    given = {field.name: getattr(options, field.name) for field in fields if getattr(options, field.name) != field.default}
    if options.source.startswith(SCENE):
        name, behind = values.file_and_options(options.source)
        more = "".join(f"{key}={value}, " for key, value in behind.items())
        python = f"scene, camera = js.scenes.load({name.removeprefix(SCENE)!r}, {more}width={width}, height={height})"
        if options.surface not in (None, False):
            python += f"\nscene = dataclasses.replace(scene, surface=js.{shown_surface(options)!r})"
        return Source(python, whole=bool(given.keys() - {"surface", *OF_SURFACE}))
    said = {name: repr(str(value) if isinstance(value, Path) else value) for name, value in given.items()}
    if options.clips:
        said["clips"] = f"[{', '.join(map(python_of, options.clips))}]"
    more = "".join(f", {name}={value}" for name, value in said.items())
    return Source(f"scene, camera = js.io.read_scene({options.source!r}{more}, size=({width}, {height}))")


def _source_of_frame(options: Any, snapshots: Snapshots, time: float) -> Source:
    """How a frame of a sequence is made in Python."""
    survey = snapshots.survey
    chosen = {"color_by": survey.quantity, "opacity_by": survey.report.opacity_by, "center": options.center or snapshots.center}
    names = (*chosen, "support", "kernel", "part_type", "where", "share", "frame")
    given = {name: chosen.get(name) or getattr(options, name) for name in names}
    said = "".join(f", {name}={value!r}" for name, value in given.items() if value is not None)
    if snapshots.surface is not None:
        said += f", surface=js.{snapshots.surface!r}"
    files = [str(file.path) for file in survey.files]
    python = f"snapshots = js.sequence.Snapshots.from_files({files}{said}, gaps=True)\nscene = snapshots.at({time!r})"
    return Source(python, whole=True)
