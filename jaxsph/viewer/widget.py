"""A view in a notebook: the page's own modules in a widget, with the kernel in the place of the server.

Flow: Session -> pictures -> [widget, through the kernel] <-> Jupyter, VS Code, marimo.
"""

from __future__ import annotations

import functools
import importlib.resources
import re
import threading
from typing import Any

from jaxsph.io.damage import require
from jaxsph.model.camera.camera import Camera
from jaxsph.model.scene import Scene
from jaxsph.model.settings import Settings
from jaxsph.numerics.trees import on_host
from jaxsph.sequence.snapshots import Snapshots
from jaxsph.viewer.session import Session
from jaxsph.viewer.stages import Picture
from jaxsph.viewer.state import frames_of

MODULES = ("made", "moves", "editor", "cut", "time", "view", "notebook")
"""Of the page, each after those that it imports."""
IMPORT = re.compile(r'^import \{([^}]*)\} from "\./(\w+)\.js";\n', re.MULTILINE)
EXPORT = re.compile(r"^export (?=(?:async )?(?:function|const) (\w+))", re.MULTILINE)
MAX_UNSEEN = 2
"""Frames that are on their way to a notebook: more would pile up where it is slow."""


@on_host
def view(scene: Scene | Snapshots, camera: Camera, settings: Settings | None = None) -> Any:
    """Look around in a notebook: a widget with the picture, its camera, and an editor of its transfer function.

    `jaxsph view FILE` shows the same in a browser. A draft comes while something moves; then every pixel gets its ray; then the
    tolerance is kept. The widget always says which of these is seen, and how far it may be off.

    Args:
        scene, camera: as for `jaxsph.render`; or a sequence (`jaxsph.sequence.Snapshots`), whose frames are chosen by a slider.
        settings: of the picture once nothing moves; by default segments with a tolerance of 0.01, of a surface all samples.

    Returns:
        A widget (`anywidget.AnyWidget`) that the notebook shows. Its `session` (`jaxsph.viewer.session.Session`) has the scene
        and the camera that are seen as `session.snapshot()`; `close()` ends it.

    Raises:
        ImportError: the extra `view` is not installed.
        ValueError: a scene with nothing in it, or a camera that is none.
    """
    require("anywidget", "an interactive view in a notebook", "view")
    shown, frames = frames_of(scene) if isinstance(scene, Snapshots) else (scene, [])
    return _widget_class()(Session(shown, camera, settings, frames=frames).start())


@functools.cache
def bundle() -> str:
    """The modules of the page as one, which exports `render` for a notebook."""
    folder, parts = importlib.resources.files(__package__) / "page", []
    for name in MODULES:
        text = (folder / f"{name}.js").read_text(encoding="utf-8")
        exported = EXPORT.findall(text)
        body = EXPORT.sub("", IMPORT.sub(r"const {\1} = _\2;\n", text))
        parts.append(f"const _{name} = (() => {{\n{body}\nreturn {{ {', '.join(exported)} }};\n}})();\n")
    return "".join([*parts, "export default _notebook;\n"])


@functools.cache
def _widget_class() -> Any:
    import anywidget

    class View(anywidget.AnyWidget):  # type: ignore[misc]
        """A view; see `view`."""

        _esm = bundle()
        _css = (importlib.resources.files(__package__) / "page" / "view.css").read_text(encoding="utf-8")

        def __init__(self, session: Session) -> None:
            super().__init__()
            self.session, self._sender = session, _Sender(self.send)
            self._undo = session.listen(self._sender.show)
            self.on_msg(lambda _, message, __: self._received(message))

        def close(self) -> None:
            """End the view."""
            self._undo()
            self.session.close(0)
            super().close()

        def _received(self, message: Any) -> None:
            """Do what a notebook asks for, and answer."""
            name = message.get("do") if isinstance(message, dict) else None
            if name == "seen":
                self._sender.seen()
            elif name == "hello":
                self._sender.seen(anew=True)
                for what in self.session.shown():
                    self._sender.show(what)
            elif (answer := self.session.answer(message)) is not None:
                self._sender.show(answer)

    return View


class _Sender:
    """Sends what is newest, and no more pictures than are seen."""

    def __init__(self, send: Any) -> None:
        self._send, self._unseen = send, 0
        self._newest: Picture | None = None
        self._lock = threading.RLock()

    def show(self, what: Any) -> None:
        """A picture, or something else."""
        if not isinstance(what, Picture):
            self._send(what)
            return
        with self._lock:
            self._newest = what
            self._more()

    def seen(self, *, anew: bool = False) -> None:
        """A picture has arrived; `anew`: there is somebody new, for whom none is on its way."""
        with self._lock:
            self._unseen = 0 if anew else max(self._unseen - 1, 0)
            self._more()

    def _more(self) -> None:
        if self._newest is not None and self._unseen < MAX_UNSEEN:
            picture, self._newest = self._newest, None
            self._unseen += 1
            self._send(picture.header(), [picture.encoded])
