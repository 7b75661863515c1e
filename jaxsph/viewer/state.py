"""What a view shows now: a scene with its look, a cut and a pose; inputs make another of it, a page and its code are told.

Flow: inputs -> [state: one table of what they do] -> scene and camera -> session; state -> page, code.

A cut is measured from a middle, in shares of a reach: what the view turned about, and half of its visible height, when it was
chosen. To move it moves arrays of a clip, and compiles nothing; its kind is static.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from jaxsph.model.camera.camera import BoundingBox, Camera
from jaxsph.model.camera.framing import with_depths
from jaxsph.model.camera.path import CameraPath
from jaxsph.model.clips import Both, Box, Clip, Outside, Plane, Sphere, both
from jaxsph.model.scene import Scene, Surface
from jaxsph.model.settings import Settings
from jaxsph.model.transfer.function import TransferFunction
from jaxsph.numerics.checks import product
from jaxsph.sequence.snapshots import Moment, Snapshots
from jaxsph.viewer.control_points import ControlPoints, first_look, is_flat, looking
from jaxsph.viewer.inputs import FARTHEST, InputError, number, points_of, shares_of, vector, word
from jaxsph.viewer.pose import Pose, listed

AXES, RAYS = ("x", "-x", "y", "-y", "z", "-z", "iso"), ("perspective", "parallel")
MAX_FACTOR, MAX_DEGREES, MAX_STOPS, MAX_NAME = 100.0, 3600.0, 10.0, 100
SECONDS, MOST_KEYS = 2.0, 256
"""Between key frames of a movie, and how many there may be."""
MAX_STEPS = 200
"""Looks that one can go back to."""
OFF = "off"
SHARES = {"plane": (-2.0, 2.0, 0.0), "box": (0.01, 2.0, 0.5), "sphere": (0.01, 2.0, 0.5)}
"""Of each kind: the least and the largest share of the reach, and the first."""
OF_SURFACE = {"level": (1 / FARTHEST, FARTHEST), "smoothing": (0.1, 10.0)}  # numbers of a surface, and their ends


@dataclasses.dataclass(frozen=True)
class Source:
    """Where a scene comes from.

    Attributes:
        python: lines that make `scene`; where they are not known, a line that says so.
        whole: whether look and camera are to be said, too, as those lines do not make them.
    """

    python: str = "# scene: as it was given to js.view"
    whole: bool = False


class Frame(NamedTuple):
    """One frame of a sequence: its name and time for people, what reads its scene, and where that comes from."""

    name: str
    time: float | None
    scene: Callable[[], Scene]
    source: Source


def frames_of(snapshots: Snapshots, source: Callable[[float], Source] = lambda _: Source()) -> tuple[Scene, list[Frame]]:
    """The first frame of a sequence that can be read, and all, those that cannot be without a time; `source` of a time."""
    files = iter(snapshots.survey.files)
    frames = [
        Frame(next(files).path.name, one.time, one, source(one.time))
        if isinstance(one, Moment)
        else Frame(one.path.name, None, one, Source())
        for one in snapshots.each()
    ]
    return next(frame.scene() for frame in frames if frame.time is not None), frames


@dataclasses.dataclass(frozen=True)
class Cut:
    """A part of space that alone is shown.

    Attributes:
        kind: one of `SHARES`.
        middle: (3,) length units.
        reach: length units.
        share: of the reach: how far behind the middle a plane is, half a side of a box, the radius of a sphere.
        axis: (3,) of length 1, across which a plane is; what is before it is cut away.
        follows: whether that is the direction of view, whichever it is.
        outside: whether the other side is shown instead.
    """

    kind: str
    middle: tuple[float, ...]
    reach: float
    share: float
    axis: tuple[float, ...]
    follows: bool = True
    outside: bool = False

    def seen_from(self, pose: Pose) -> Cut:
        """The same once the view has moved."""
        return dataclasses.replace(self, axis=tuple(pose.axes[2].tolist())) if self.follows else self

    def clip(self) -> Clip:
        """What is shown."""
        middle, size = np.array(self.middle), self.reach * self.share
        made: Clip
        if self.kind == "plane":
            made = Plane((middle + size * np.array(self.axis)).tolist(), list(self.axis))
        elif self.kind == "box":
            made = Box((middle - size).tolist(), (middle + size).tolist())
        else:
            made = Sphere(list(self.middle), size)
        return ~made if self.outside else made

    def told(self) -> dict[str, Any]:
        """For a page, as JSON has it; `least` and `most` are ends of the share."""
        least, most, _ = SHARES[self.kind]
        return {**dataclasses.asdict(self), "least": least, "most": most}


def asked(cut: Cut | None, said: dict[str, Any], pose: Pose) -> Cut | None:
    """The cut that a message asks for: another `kind`, `"off"`, another `share`, `follows` or `outside`; or measured from `here`.

    An address says `middle`, `reach` and `axis`, too, as `told` told them.

    Raises:
        InputError: there is none to change, or no such kind or number.
    """
    kind = cut.kind if cut is not None and "kind" not in said else word(said, "kind", (*SHARES, OFF))
    if kind == OFF:
        return None
    least, most, first = SHARES[kind]
    changes: dict[str, Any] = {name: said[name] is True for name in ("follows", "outside") if name in said}
    changes |= {name: tuple(vector(said, name).tolist()) for name in ("middle", "axis") if name in said}
    if not any(changes.get("axis", (1,))):
        raise InputError("`axis` of a cut must have a direction")
    if cut is None or said.get("here") is True:
        middle, reach, axis = pose.target.tolist(), pose.height / 2, tuple(pose.axes[2].tolist())
        old: dict[str, Any] = {} if cut is None else {"follows": cut.follows, "outside": cut.outside}
        cut = Cut(kind, tuple(middle), reach, first, axis, **old)
    elif kind != cut.kind:
        cut = dataclasses.replace(cut, kind=kind, share=first)
    if "reach" in said:
        changes["reach"] = number(said, "reach", 1 / FARTHEST, FARTHEST)
    return dataclasses.replace(cut, share=number(said, "share", least, most, cut.share), **changes).seen_from(pose)


def python_of(clip: Clip) -> str:
    """Python that makes a clip."""
    if isinstance(clip, Both):
        return f"({python_of(clip.first)} & {python_of(clip.second)})"
    if isinstance(clip, Outside):
        return f"~{python_of(clip.clip)}"
    if isinstance(clip, Box):
        given = clip.corners()
    else:
        assert isinstance(clip, Plane | Sphere)
        place, other = (clip.point, clip.normal) if isinstance(clip, Plane) else (clip.center, clip.radius)
        given = np.asarray(place, np.float64) + np.asarray(clip.rest, np.float64), np.asarray(other, np.float64)
    return f"js.{type(clip).__name__}({', '.join(str(one.tolist()) for one in given)})"


@dataclasses.dataclass(frozen=True, eq=False)
class State:
    """A scene as it is looked at; make the first with `of`.

    Attributes:
        base: the scene as it was given, or its frame.
        asked, given: the camera that the view began with, and that with the pixels of the page.
        first, pose: of the camera, at first and now; `moved` since the view began, whose camera is that which was given.
        cut: what of the scene is shown; None is all.
        look: what edits change, where there is any; it is shown.
        surface: by which particles are shown, of all frames; None shows a medium.
        looks, step: those that one can go back to, and which of them was the last.
        keys: cameras of key frames, and what they turn about.
        taller: pictures of the page over those that were asked for, where they show more above and below.
        version: states whose pictures differ are counted.
    """

    base: Scene
    asked: Camera
    given: Camera
    first: Pose
    pose: Pose
    look: ControlPoints | None
    looks: tuple[ControlPoints, ...]
    surface: Surface | None = None
    moved: bool = False
    cut: Cut | None = None
    step: int = 0
    keys: tuple[tuple[Camera, np.ndarray], ...] = ()
    taller: float = 1.0
    version: int = 1

    @classmethod
    def of(cls, scene: Scene, camera: Camera) -> State:
        """The first, of what `jaxsph.render` takes; `ValueError` of a camera that is none."""
        look, camera = first_look(scene), camera.for_picture()
        shown = None if look is None else ControlPoints.of(look, flat=is_flat(scene))
        pose = Pose.of(camera, scene)
        return cls(scene, camera, camera, pose, pose, shown, () if shown is None else (shown,), scene.surface)

    @functools.cached_property
    def camera(self) -> Camera:
        """That which was given, until something moves."""
        if not self.moved:
            return self.given
        camera = self.pose.camera(self.given.width, self.given.height)
        if self.base.media:  # which do not say how large they are
            camera = dataclasses.replace(camera, near=self.given.near, far=self.given.far)
        return camera

    @functools.cached_property
    def scene(self) -> Scene:
        """With the look that is shown, and cut."""
        scene = self.base if self.look is None else looking(self.base, self.look.transfer)
        within = both(self.base.within, None if self.cut is None else self.cut.clip())
        return dataclasses.replace(scene, within=within, surface=self.surface)

    @property
    def transfer(self) -> TransferFunction | None:
        """The look that is shown, where there is one."""
        return first_look(self.scene)

    @property
    def path(self) -> CameraPath | None:
        """Through all key frames, `SECONDS` apart, around the point that all of them turn about, if they do; None of one."""
        if len(self.keys) < 2:
            return None
        middles = np.stack([middle for _, middle in self.keys])
        around = middles[0] if (middles == middles[0]).all() else None
        return CameraPath.from_keys([(SECONDS * k, camera) for k, (camera, _) in enumerate(self.keys)], around=around)

    @property
    def edited(self) -> bool:
        """Whether the look is another than that which was given."""
        return self.look is not None and self.look.points is not None

    def told(self) -> dict[str, Any]:
        """For a page, as JSON has it; numbers of a surface as they were given, and now."""
        surfaces = self.base.surface, self.surface
        return {
            "version": self.version,
            "pose": self.pose.told(),
            "size": [self.camera.width, self.camera.height],
            "height": self.pose.height,
            "axes": self.pose.axes.tolist(),
            "look": None if self.look is None else self.look.told(),
            "edited": self.edited,
            "moved": self.moved,
            "cut": None if self.cut is None else self.cut.told(),
            "surface": self.surface and {name: [float(getattr(one, name)) for one in surfaces] for name in OF_SURFACE},
            "keys": len(self.keys),
        }

    def code(self, source: Source, settings: Settings) -> str:
        """The Python that makes its picture again."""
        lines = ["import dataclasses", "import jaxsph as js", "", source.python]
        if self.moved or source.whole:
            lines.append(self.pose.python(self.camera))
        elif self.given is not self.asked:
            size = f"width={self.given.width}, height={self.given.height}"
            size += f", half_height=camera.half_height * {self.taller!r}" if self.taller > 1 else ""
            lines.append(f"camera = dataclasses.replace(camera, {size})")
        if self.scene.within is not None:
            lines.append(f"scene = dataclasses.replace(scene, within={python_of(self.scene.within)})")
        if self.surface is not self.base.surface:
            numbers = ", ".join(f"{name}={float(getattr(self.surface, name))!r}" for name in OF_SURFACE)
            lines.append(f"scene = dataclasses.replace(scene, surface=dataclasses.replace(scene.surface, {numbers}))")
        if self.transfer is not None and (self.edited or source.whole):
            given = {name: getattr(self.transfer, name) for name in ("values", "colors", "extinction", "extinction_values")}
            named = [f"    {name}={listed(value)}," for name, value in given.items() if value is not None]
            lines += ["transfer = js.TransferFunction.from_points(", *named, ")"]
            lines.append("scene = dataclasses.replace(scene, transfer=transfer)")
        return "\n".join([*lines, f"image = js.render(scene, camera, js.{settings!r})", 'image.save("view.png")'])

    def done(self, message: dict[str, Any]) -> State:
        """What a message `{"do": NAME, ...}` makes of it, one of `INPUTS`.

        Raises:
            ValueError: what cannot be understood or done.
        """
        name = message["do"]
        if name not in INPUTS:
            raise InputError(f"there is no {name[:40]!r}; there are {', '.join(INPUTS)}, center, pick")
        return INPUTS[name](self, message)

    def to(self, **changes: Any) -> State:
        """With other parts, as another state of which there is to be a picture."""
        return dataclasses.replace(self, version=self.version + 1, **changes)

    def resized(self, width: int, height: int) -> State:
        """With so many pixels, of key frames, too, all of one size; itself where that is nothing new.

        What the camera framed stays in the picture: there is more at its sides, or above and below.
        """
        if (self.given.width, self.given.height) == (width, height):
            return self
        taller = max(1.0, self.asked.width / self.asked.height * height / width)
        more = taller / self.taller

        def sized(camera: Camera, factor: float) -> Camera:
            return dataclasses.replace(camera, width=width, height=height, half_height=product(camera.half_height, factor))

        first, pose = (dataclasses.replace(pose, tangent=more * pose.tangent) for pose in (self.first, self.pose))
        keys = tuple((sized(camera, more), middle) for camera, middle in self.keys)
        return self.to(given=sized(self.asked, taller), keys=keys, first=first, pose=pose, taller=taller)

    def seen_from(self, pose: Pose) -> State:
        """Seen from elsewhere."""
        return self.to(pose=pose, moved=True, cut=None if self.cut is None else self.cut.seen_from(pose))

    def with_look(self, edit: Callable[[ControlPoints], ControlPoints], *, done: bool = True) -> State:
        """With another look; `done`: a step that one can go back from, which every move of a drag is not."""
        look = edit(self._look)
        if not done:
            return self.to(look=look)
        looks = (*self.looks[: self.step + 1], look)[-MAX_STEPS:]
        return self.to(look=look, looks=looks, step=len(looks) - 1)

    @property
    def _look(self) -> ControlPoints:
        if self.look is None:
            raise InputError("this scene has no transfer function to edit")
        return self.look

    def _gone(self, steps: int) -> State:
        """With a look that was shown before, or again."""
        looks = self.looks or (self._look,)
        step = min(max(self.step + steps, 0), len(looks) - 1)
        return self.to(look=looks[step], step=step)

    def _fitted(self) -> State:
        if not self.base.parts:
            raise InputError("this scene does not say how large it is")
        lower, upper = BoundingBox.around(self.base.parts).bounds()
        return self.seen_from(self.pose.fitted(lower, upper, self.given.width / self.given.height))

    def shaped(self, said: dict[str, Any]) -> State:
        """With another level or smoothing of its surface."""
        if self.surface is None:
            raise InputError("this scene has no surface of particles")
        given: Any = {name: number(said, name, *ends) for name, ends in OF_SURFACE.items() if name in said}
        return self.to(surface=dataclasses.replace(self.surface, **given))

    def _kept(self) -> State:
        """With the view for a key frame, of which there is no other picture."""
        camera = with_depths(self.camera, self.scene)
        if len(self.keys) >= MOST_KEYS:
            raise InputError(f"a path has {MOST_KEYS} key frames at most; forget some")
        if self.keys and self.keys[0][0].is_perspective != camera.is_perspective:
            raise InputError("key frames of a path are all of perspective or all of parallel rays; forget those that are not")
        return dataclasses.replace(self, keys=(*self.keys, (camera, np.asarray(self.pose.target, np.float64))))

    def _restored(self, said: dict[str, Any]) -> State:
        """With what `told` told: a pose; a cut and control points, where there are any."""
        cut = said.get("cut")
        if not isinstance(said.get("pose"), dict) or not isinstance(cut, dict | None):
            raise InputError("`pose` of 'restore' must be an object, and `cut` one or null")
        state = self.seen_from(self.first.read(said["pose"]))
        if cut is not None:
            cut = {"do": "restore", "follows": False, **cut}
            word(cut, "kind", tuple(SHARES))
            if missing := [name for name in ("middle", "axis", "reach", "share") if name not in cut]:
                raise InputError(f"`cut` of 'restore' must have a `{missing[0]}`")
        if "cut" in said:
            state = state.to(cut=None if cut is None else asked(None, cut, state.pose))
        if said.get("points") is None or self.look is None:
            return state
        return state.with_look(lambda look: look.edited(points_of(said)))


Input = Callable[[State, dict[str, Any]], State]


def _moves(pose_of: Callable[[Pose, dict[str, Any]], Pose]) -> Input:
    return lambda state, said: state.seen_from(pose_of(state.pose, said))


def _edits(look_of: Callable[[ControlPoints, dict[str, Any]], ControlPoints]) -> Input:
    return lambda state, said: state.with_look(lambda look: look_of(look, said), done=said.get("done", True) is not False)


INPUTS: dict[str, Input] = {
    "orbit": _moves(lambda pose, said: pose.orbited(*shares_of(said))),
    "pan": _moves(lambda pose, said: pose.panned(*shares_of(said))),
    "zoom": _moves(lambda pose, said: pose.zoomed(number(said, "factor", 1 / MAX_FACTOR, MAX_FACTOR), *shares_of(said, 0))),
    "roll": _moves(lambda pose, said: pose.rolled(number(said, "degrees", -MAX_DEGREES, MAX_DEGREES))),
    "axis": _moves(lambda pose, said: pose.along(word(said, "name", AXES))),
    "projection": _moves(lambda pose, said: dataclasses.replace(pose, perspective=word(said, "name", RAYS) == RAYS[0])),
    "fit": lambda state, _: state._fitted(),
    "home": lambda state, _: dataclasses.replace(state.seen_from(state.first), moved=False),
    "points": _edits(lambda look, said: look.edited(points_of(said))),
    "colormap": _edits(lambda look, said: look.recoloured(str(said.get("name"))[:MAX_NAME])),
    "exposure": _edits(lambda look, said: look.exposed(number(said, "stops", -MAX_STOPS, MAX_STOPS))),
    "reset_look": _edits(lambda look, _: dataclasses.replace(look, points=None)),
    "undo": lambda state, _: state._gone(-1),
    "redo": lambda state, _: state._gone(1),
    "cut": lambda state, said: state.to(cut=asked(state.cut, said, state.pose)),
    "restore": State._restored,
    "surface": State.shaped,
    "key": lambda state, _: state._kept(),
    "unkey": lambda state, _: dataclasses.replace(state, keys=state.keys[:-1]),
}
"""What inputs do, by name."""
