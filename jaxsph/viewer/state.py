"""What a view shows now: a scene with its look, a cut and a pose; inputs change it, a page and the code that makes it are told.

Flow: inputs -> [state: one table of what they do] -> scene and camera -> session; state -> page, code.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np

from jaxsph.model.camera.camera import BoundingBox, Camera
from jaxsph.model.camera.framing import with_depths
from jaxsph.model.camera.path import CameraPath
from jaxsph.model.clips import both
from jaxsph.model.scene import Scene
from jaxsph.model.settings import Settings
from jaxsph.model.transfer.function import TransferFunction
from jaxsph.model.transfer.maps import Scale
from jaxsph.numerics.checks import product
from jaxsph.viewer.control_points import ControlPoints, first_look, is_flat, looking
from jaxsph.viewer.cut import Cut, asked, python_of, read
from jaxsph.viewer.inputs import InputError, map_of, number, points_of, shares_of, word
from jaxsph.viewer.pose import Pose, listed

QUIET = ("key", "unkey")
"""What changes no picture."""
AXES, RAYS = ("x", "-x", "y", "-y", "z", "-z", "iso"), ("perspective", "parallel")
MAX_FACTOR, MAX_DEGREES, MAX_STOPS = 100.0, 3600.0, 10.0
SECONDS, MOST_KEYS = 2.0, 256
"""Between key frames of a movie, and how many there may be."""
MAX_STEPS = 200
"""Looks that one can go back to."""


@dataclasses.dataclass(frozen=True)
class Source:
    """Where a scene comes from.

    Attributes:
        python: lines that make `scene`; where they are not known, a line that says so.
        whole: whether look and camera are to be said, too, as those lines do not make them.
    """

    python: str = "# scene: as it was given to js.view"
    whole: bool = False


class State:
    """A scene as it is looked at; for one thread at a time.

    Attributes:
        scene: with the look that is shown, and cut.
        cut: what of it is shown; None is all.
        pose: of the camera; `moved` since the view began, whose camera is that which was given.
    """

    def __init__(self, scene: Scene, camera: Camera) -> None:
        """As `jaxsph.render` takes them.

        Raises:
            ValueError: a camera that is none.
        """
        look, camera = first_look(scene), camera.for_picture()
        self._asked, self._given, self._first, self._taller = camera, camera, Pose.of(camera, scene), 1.0
        self.pose, self.moved, self.cut = self._first, False, None  # type: Pose, bool, Cut | None
        self._look = None if look is None else ControlPoints.of(look, flat=is_flat(scene))
        self._looks, self._step = [] if self._look is None else [self._look], 0
        self._keys: list[tuple[Camera, np.ndarray]] = []
        self.frame(scene)

    @property
    def camera(self) -> Camera:
        """That which was given, until something moves."""
        if not self.moved:
            return self._given
        camera = self.pose.camera(self._given.width, self._given.height)
        if self._base.media:  # which do not say how large they are
            camera = dataclasses.replace(camera, near=self._given.near, far=self._given.far)
        return camera

    @property
    def transfer(self) -> TransferFunction | None:
        """The look that is shown, where there is one."""
        return first_look(self.scene)

    @property
    def look(self) -> ControlPoints:
        """What edits change; `InputError` where there is nothing to edit."""
        if self._look is None:
            raise InputError("this scene has no transfer function to edit")
        return self._look

    @property
    def scale(self) -> Scale | None:
        """The axis of the look, where there is one."""
        return None if self._look is None else self._look.scale

    @property
    def path(self) -> CameraPath | None:
        """Through all key frames, `SECONDS` apart, around the point that all of them turn about, if they do; None of one."""
        if len(self._keys) < 2:
            return None
        middles = np.stack([middle for _, middle in self._keys])
        around = middles[0] if (middles == middles[0]).all() else None
        return CameraPath.from_keys([(SECONDS * k, camera) for k, (camera, _) in enumerate(self._keys)], around=around)

    @property
    def edited(self) -> bool:
        """Whether the look is another than that which was given."""
        return self._look is not None and self._look.points is not None

    def told(self) -> dict[str, Any]:
        """For a page, as JSON has it."""
        camera = self.camera
        return {
            "pose": self.pose.told(),
            "size": [camera.width, camera.height],
            "height": self.pose.height,
            "axes": self.pose.axes.tolist(),
            "look": None if self._look is None else self._look.told(),
            "edited": self.edited,
            "moved": self.moved,
            "cut": None if self.cut is None else self.cut.told(),
            "keys": len(self._keys),
        }

    def code(self, source: Source, settings: Settings) -> str:
        """The Python that makes its picture again."""
        lines = ["import dataclasses", "import jaxsph as js", "", source.python]
        if self.moved or source.whole:
            lines.append(self.pose.python(self.camera))
        elif self._given is not self._asked:
            size = f"width={self._given.width}, height={self._given.height}"
            size += f", half_height=camera.half_height * {self._taller!r}" if self._taller > 1 else ""
            lines.append(f"camera = dataclasses.replace(camera, {size})")
        if self.scene.within is not None:
            lines.append(f"scene = dataclasses.replace(scene, within={python_of(self.scene.within)})")
        if self.transfer is not None and (self.edited or source.whole):
            given = {name: getattr(self.transfer, name) for name in ("values", "colors", "extinction", "extinction_values")}
            named = [f"    {name}={listed(value)}," for name, value in given.items() if value is not None]
            lines += ["transfer = js.TransferFunction.from_points(", *named, ")"]
            lines.append("scene = dataclasses.replace(scene, transfer=transfer)")
        return "\n".join([*lines, f"image = js.render(scene, camera, js.{settings!r})", 'image.save("view.png")'])

    def do(self, message: dict[str, Any]) -> None:
        """Do what a message `{"do": NAME, ...}` asks for, one of `INPUTS`.

        Raises:
            InputError: what cannot be understood or done; nothing has changed.
        """
        name = message["do"]
        if name not in INPUTS:
            raise InputError(f"there is no {name[:40]!r}; there are {', '.join(INPUTS)}, center, pick")
        INPUTS[name](self, message)

    def frame(self, scene: Scene) -> None:
        """Show another frame of a sequence, with the look, the camera and the cut that there are."""
        self._base = self.scene = scene
        if self._look is not None:
            self._show(self._look)
        self.show_cut(self.cut)

    def resize(self, width: int, height: int) -> bool:
        """Have so many pixels, of key frames, too, all of one size; whether that is new.

        What the camera framed stays in the picture: there is more at its sides, or above and below.
        """
        if (self._given.width, self._given.height) == (width, height):
            return False
        taller = max(1.0, self._asked.width / self._asked.height * height / width)
        more, self._taller = taller / self._taller, taller

        def sized(camera: Camera, factor: float) -> Camera:
            return dataclasses.replace(camera, width=width, height=height, half_height=product(camera.half_height, factor))

        self._given, self._keys = sized(self._asked, taller), [(sized(camera, more), middle) for camera, middle in self._keys]
        self._first, self.pose = (dataclasses.replace(pose, tangent=more * pose.tangent) for pose in (self._first, self.pose))
        return True

    def move(self, pose: Pose) -> None:
        """Be seen from elsewhere; `ValueError` of what makes no camera."""
        pose.camera(1, 1)
        self.pose, self.moved = pose, True
        self.show_cut(self.cut)

    def edit(self, look: ControlPoints, *, done: bool = True) -> None:
        """Show another look; `done`: a step that one can go back from, which every move of a drag is not."""
        self._show(look)
        if done:
            self._looks = [*self._looks[: self._step + 1], look][-MAX_STEPS:]
            self._step = len(self._looks) - 1

    def go(self, steps: int) -> None:
        """Show a look that was shown before, or again."""
        looks = self._looks or [self.look]
        self._step = min(max(self._step + steps, 0), len(looks) - 1)
        self._show(looks[self._step])

    def home(self) -> None:
        """Be the first view again."""
        self.move(self._first)
        self.moved = False

    def fit(self) -> None:
        """Show all that there is."""
        if not self._base.parts:
            raise InputError("this scene does not say how large it is")
        lower, upper = BoundingBox.around(self._base.parts).bounds()
        self.move(self.pose.fitted(lower, upper, self._given.width / self._given.height))

    def keep(self) -> None:
        """Have the view for a key frame."""
        camera = with_depths(self.camera, self.scene)
        if len(self._keys) >= MOST_KEYS:
            raise InputError(f"a path has {MOST_KEYS} key frames at most; forget some")
        if self._keys and self._keys[0][0].is_perspective != camera.is_perspective:
            raise InputError("key frames of a path are all of perspective or all of parallel rays; forget those that are not")
        self._keys.append((camera, np.asarray(self.pose.target, np.float64)))

    def forget(self) -> None:
        """Have the last key frame no more."""
        self._keys = self._keys[:-1]

    def show_cut(self, cut: Cut | None) -> None:
        """Show a part of space alone."""
        self.cut = None if cut is None else cut.seen_from(self.pose)
        within = both(self._base.within, None if self.cut is None else self.cut.clip())
        self.scene = dataclasses.replace(self.scene, within=within)

    def restore(self, message: dict[str, Any]) -> None:
        """Show what `told` told: a pose; a cut and control points, where there are any."""
        if not isinstance(message.get("pose"), dict):
            raise InputError("`pose` of 'restore' must be an object")
        pose = self._first.read(message["pose"])
        pose.camera(1, 1)  # before the look changes
        cut = read(message["cut"]) if "cut" in message else self.cut
        if message.get("points") is not None and self._look is not None:
            self.edit(self.look.edited(points_of(message)))
        self.move(pose)
        self.show_cut(cut)

    def _show(self, look: ControlPoints) -> None:
        self._look, self.scene = look, looking(self._base, look.transfer())
        self.show_cut(self.cut)


Input = Callable[[State, dict[str, Any]], None]


def _moves(pose_of: Callable[[Pose, dict[str, Any]], Pose]) -> Input:
    return lambda state, said: state.move(pose_of(state.pose, said))


def _edits(look_of: Callable[[ControlPoints, dict[str, Any]], ControlPoints]) -> Input:
    return lambda state, said: state.edit(look_of(state.look, said), done=said.get("done", True) is not False)


INPUTS: dict[str, Input] = {
    "orbit": _moves(lambda pose, said: pose.orbited(*shares_of(said))),
    "pan": _moves(lambda pose, said: pose.panned(*shares_of(said))),
    "zoom": _moves(lambda pose, said: pose.zoomed(number(said, "factor", 1 / MAX_FACTOR, MAX_FACTOR), *shares_of(said, 0))),
    "roll": _moves(lambda pose, said: pose.rolled(number(said, "degrees", -MAX_DEGREES, MAX_DEGREES))),
    "axis": _moves(lambda pose, said: pose.along(word(said, "name", AXES))),
    "projection": _moves(lambda pose, said: pose.projected(word(said, "name", RAYS) == "perspective")),
    "fit": lambda state, _: state.fit(),
    "home": lambda state, _: state.home(),
    "points": _edits(lambda look, said: look.edited(points_of(said))),
    "colormap": _edits(lambda look, said: look.recoloured(map_of(said))),
    "exposure": _edits(lambda look, said: look.exposed(number(said, "stops", -MAX_STOPS, MAX_STOPS))),
    "reset_look": _edits(lambda look, _: dataclasses.replace(look, points=None)),
    "undo": lambda state, _: state.go(-1),
    "redo": lambda state, _: state.go(1),
    "cut": lambda state, said: state.show_cut(asked(state.cut, said, state.pose)),
    "restore": State.restore,
    "key": lambda state, _: state.keep(),
    "unkey": lambda state, _: state.forget(),
}
"""What inputs do, by name."""
