"""What a view shows now: a scene with its look, and a pose; inputs change it, a page and the code that makes it again are told.

Flow: inputs -> [state] -> scene and camera -> session; state -> page, code.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np

from jaxsph.model.camera.camera import BoundingBox, Camera
from jaxsph.model.camera.path import CameraPath
from jaxsph.model.camera.snug import with_depths
from jaxsph.model.clips.clips import Clip, both
from jaxsph.model.scene import Scene
from jaxsph.model.settings import Settings
from jaxsph.model.transfer.domains import Scale
from jaxsph.model.transfer.function import TransferFunction
from jaxsph.numerics.checks import product
from jaxsph.viewer.code import Source, python_of
from jaxsph.viewer.control_points import ControlPoints, Steps, first_look, is_flat, looking
from jaxsph.viewer.cut import Cut, asked, read
from jaxsph.viewer.inputs import KNOWN_EDITS, MOTIONS, InputError, edit
from jaxsph.viewer.pose import Pose

OTHERS = ("fit", "home", "center", "cut", "restore", "key", "unkey")
"""What can be done besides motions and edits of the look."""
QUIET = ("key", "unkey")
"""What changes no picture."""
SECONDS, MOST_KEYS = 2.0, 256
"""Between key frames of a movie, and how many there may be."""
Seen = Callable[[dict[str, Any]], np.ndarray]


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
        self._steps = None if look is None else Steps(ControlPoints.of(look, flat=is_flat(scene)))
        self._base, self._keys = scene, []  # type: Scene, list[tuple[Camera, np.ndarray]]
        self.scene = self._looked()

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
    def scale(self) -> Scale | None:
        """The axis of the look, where there is one."""
        return None if self._steps is None else self._steps.look.scale

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
        return self._steps is not None and self._steps.look.points is not None

    def told(self) -> dict[str, Any]:
        """For a page, as JSON has it."""
        camera = self.camera
        return {
            "pose": self.pose.told(),
            "size": [camera.width, camera.height],
            "height": self.pose.height,
            "axes": self.pose.axes.tolist(),
            "look": None if self._steps is None else self._steps.look.told(),
            "edited": self.edited,
            "moved": self.moved,
            "cut": None if self.cut is None else self.cut.told(),
            "keys": len(self._keys),
        }

    def code(self, source: Source, settings: Settings) -> dict[str, str]:
        """The Python that makes it again, in as many pixels."""
        moved, edited = self.moved or source.whole, self.edited or source.whole
        pose, look = self.pose if moved else None, self.transfer if edited else None
        if self._given is not self._asked and not moved:
            size = f"width={self._given.width}, height={self._given.height}"
            size += f", half_height=camera.half_height * {self._taller!r}" if self._taller > 1 else ""
            source = dataclasses.replace(source, python=f"{source.python}\ncamera = dataclasses.replace(camera, {size})")
        return {"python": python_of(source, self.camera, pose, look, settings, self.scene.within)}

    def do(self, message: dict[str, Any], seen: Seen) -> None:
        """Do what a message asks for, see `inputs`; also `OTHERS`.

        Args:
            message: `{"do": NAME, ...}`.
            seen: the place that is seen where a message says.

        Raises:
            InputError: what cannot be understood or done; nothing has changed.
        """
        name = message["do"]
        if name in MOTIONS:
            self._move(MOTIONS[name](self.pose, message))
        elif name in KNOWN_EDITS:
            if self._steps is None:
                raise InputError("this scene has no transfer function to edit")
            self._edit(self._steps, message)
        elif name == "fit":
            if not self._base.parts:
                raise InputError("this scene does not say how large it is")
            lower, upper = BoundingBox.around(self._base.parts).bounds()
            self._move(self.pose.fitted(lower, upper, self._given.width / self._given.height))
        elif name == "home":
            self._move(self._first)
            self.moved = False
        elif name == "center":
            self._move(self.pose.centred(seen(message)))
        elif name == "cut":
            self._cut(asked(self.cut, message, self.pose))
        elif name == "key":
            self._keep()
        elif name == "unkey":
            self._keys = self._keys[:-1]
        elif name == "restore":
            if not isinstance(message.get("pose"), dict):
                raise InputError("`pose` of 'restore' must be an object")
            pose = self._first.read(message["pose"])
            pose.camera(1, 1)  # before the look changes
            cut = read(message["cut"]) if "cut" in message else self.cut
            if message.get("points") is not None and self._steps is not None:
                self._edit(self._steps, {"do": "points", "points": message["points"]})
            self._move(pose)
            self._cut(None if cut is None else cut.seen_from(pose))
        else:
            known = ", ".join((*MOTIONS, *KNOWN_EDITS, *OTHERS, "pick"))
            raise InputError(f"there is no {name[:40]!r}; there are {known}")

    def frame(self, scene: Scene) -> None:
        """Show another frame of a sequence, with the look, the camera and the cut that there are."""
        self._base = scene
        self.scene = self._looked()

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

    def _move(self, pose: Pose) -> None:
        pose.camera(1, 1)  # refuses what is none
        self.pose, self.moved = pose, True
        if self.cut is not None:
            self._cut(self.cut.seen_from(pose))

    def _keep(self) -> None:
        camera = with_depths(self.camera, self.scene)
        if len(self._keys) >= MOST_KEYS:
            raise InputError(f"a path has {MOST_KEYS} key frames at most; forget some")
        if self._keys and self._keys[0][0].is_perspective != camera.is_perspective:
            raise InputError("key frames of a path are all of perspective or all of parallel rays; forget those that are not")
        self._keys = [*self._keys, (camera, np.asarray(self.pose.target, np.float64))]

    def _cut(self, cut: Cut | None) -> None:
        self.cut = cut
        self.scene = dataclasses.replace(self.scene, within=self._within())

    def _within(self) -> Clip | None:
        return both(self._base.within, None if self.cut is None else self.cut.clip())

    def _edit(self, steps: Steps, message: dict[str, Any]) -> None:
        edit(steps, message)
        self.scene = self._looked()

    def _looked(self) -> Scene:
        look = None if self._steps is None else self._steps.look.transfer()
        return looking(dataclasses.replace(self._base, within=self._within()), look)
