"""Where a view is seen from, and how it moves: around what it looks at, across it, nearer to it.

Flow: Camera, motions of a pointer -> [pose] -> Camera of each picture.

Everything is float64 on the host. Near and far are left to the scene as soon as a camera has moved.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from jaxsph.model.camera.camera import BoundingBox, Camera, axes_along
from jaxsph.model.camera.directions import sight
from jaxsph.model.camera.path import middle
from jaxsph.model.scene import Scene
from jaxsph.viewer.inputs import InputError, number, vector

HALF_TURN = 180.0
"""Degrees that a pointer's way over the height of the picture turns the view by."""
MIN_ZOOM, MAX_ZOOM = 1e-3, 1e3
"""Of the distance that a view begins at, how far it may come near or go away."""
NARROWEST, WIDEST = 1.0, 150.0  # degrees of perspective that a parallel view is given back as


@dataclasses.dataclass(frozen=True, eq=False)
class Pose:
    """A camera that knows what it looks at.

    Attributes:
        target: (3,) what it turns around, length units.
        axes: (3, 3) rows right, up and forward, orthonormal.
        distance: from the eye to the target, length units.
        tangent: of half the vertical field of view, of parallel views the one that they would be given.
        perspective: whether rays spread from the eye; else half the visible height is `distance * tangent`.
        pole: (3,) axis that a sideways motion turns about.
        start: distance of the first view, by which zooming is bounded.
        up: (3,) which way is up: the axis of the world that was most so in the first view.
    """

    target: np.ndarray
    axes: np.ndarray
    distance: float
    tangent: float
    perspective: bool
    pole: np.ndarray
    start: float
    up: np.ndarray

    @classmethod
    def of(cls, camera: Camera, scene: Scene) -> Pose:
        """The pose of a camera: it looks at the middle of the scene as far as that is straight ahead, else of its depths."""
        axes, eye = camera.exact_axes(), camera.exact_eye()
        lower, upper = BoundingBox.around(scene.parts).bounds() if scene.parts else (eye, eye)
        ahead = float(axes[2] @ ((lower + upper) / 2 - eye))
        if camera.near is not None and camera.far is not None:  # what is seen is between them
            ahead = float(axes[2] @ (np.array(middle(camera)) - eye))
        reach = float(np.linalg.norm(upper - lower)) or 1.0
        distance = ahead if ahead > 0 else reach
        half = float(camera.half_height)
        tangent = half if camera.is_perspective else half / distance
        most = np.abs(axes[1]).argmax()
        up = np.eye(3)[most] * np.sign(axes[1, most])
        return cls(eye + distance * axes[2], axes, distance, tangent, camera.is_perspective, axes[1].copy(), distance, up)

    @property
    def eye(self) -> np.ndarray:
        """(3,) where from, length units."""
        return self.target - self.distance * self.axes[2]

    @property
    def height(self) -> float:
        """Visible height at the depth of the target, length units."""
        return 2 * self.distance * self.tangent

    def camera(self, width: int, height: int) -> Camera:
        """The camera of so many pixels, with near and far of whatever scene it is shown."""
        eye, target, up = self.eye, self.target, self.axes[1]
        if self.perspective:
            return Camera.look_at(eye, target, up, 2 * math.degrees(math.atan(self.tangent)), width, height)
        return Camera.orthographic(eye, target, up, self.height, width, height)

    def around(self, width: int, height: int) -> list[Camera]:
        """Cameras around this one, for whose views there is to be room."""
        turned = [self.orbited(*turn) for turn in ((1 / 3, 0), (2 / 3, 0), (1, 0), (0, 0.4), (0, -0.4))]
        return [pose.camera(width, height) for pose in (*turned, *(self.zoomed(factor) for factor in (0.7, 1.5, 2.5)))]

    def orbited(self, right: float, down: float) -> Pose:
        """Turned as if the target was dragged: by shares of the picture's height."""
        around = self.pole if self.pole @ self.axes[1] >= 0 else -self.pole
        turn = Rotation.from_rotvec(-math.radians(HALF_TURN * right) * around)
        tilt = Rotation.from_rotvec(-math.radians(HALF_TURN * down) * self.axes[0])
        return dataclasses.replace(self, axes=_orthonormal((turn * tilt).apply(self.axes)))

    def panned(self, right: float, down: float) -> Pose:
        """Moved across, as if the target was dragged by shares of the picture's height."""
        step = -right * self.axes[0] + down * self.axes[1]
        return dataclasses.replace(self, target=self.target + step * self.height)

    def zoomed(self, factor: float, right: float = 0.0, down: float = 0.0) -> Pose:
        """Nearer by a factor > 1; what is at a place, in shares of the height from the middle, stays there."""
        distance = self._within_reach(self.distance / factor)
        share = 1 - distance / self.distance
        step = share * self.height * (right * self.axes[0] - down * self.axes[1])
        return dataclasses.replace(self, distance=distance, target=self.target + step)

    def rolled(self, degrees: float) -> Pose:
        """Turned about the line of sight, the picture counterclockwise."""
        axes = _orthonormal(Rotation.from_rotvec(math.radians(degrees) * self.axes[2]).apply(self.axes))
        return dataclasses.replace(self, axes=axes, pole=axes[1].copy())

    def along(self, name: str) -> Pose:
        """Seen along an axis, `"x"`, `"y"` or `"z"`, from the other side with a minus before it; or `"iso"`."""
        forward, up = sight(name.lstrip("-"), self.up)
        ahead = forward * (-1 if name.startswith("-") else 1)
        axes = axes_along(ahead / np.linalg.norm(ahead), up)
        return dataclasses.replace(self, axes=axes, pole=axes[1].copy())

    def fitted(self, lower: np.ndarray, upper: np.ndarray, aspect: float) -> Pose:
        """Such that a box fills the picture, of which the width is `aspect` times the height, from the same side."""
        radius = float(np.linalg.norm(upper - lower)) / 2 or 0.5
        narrow = self.tangent * min(aspect, 1.0)
        sine = narrow / math.hypot(1, narrow) if self.perspective else narrow
        return dataclasses.replace(self, target=(lower + upper) / 2, distance=radius / sine)

    def centred(self, place: np.ndarray) -> Pose:
        """Such that a place is the target, seen from the same side and no nearer or farther than it was."""
        depth = float(self.axes[2] @ (place - self.eye))
        if not self.perspective or not depth > 0:
            return dataclasses.replace(self, target=place)
        return dataclasses.replace(self, target=place, distance=self._within_reach(depth))

    def _within_reach(self, distance: float) -> float:
        return min(max(distance, MIN_ZOOM * self.start), MAX_ZOOM * self.start)

    def places(self, right: np.ndarray, down: np.ndarray, depth: np.ndarray) -> np.ndarray:
        """(N, 3) places at view depths, on the rays of places of the picture in shares of the height from its middle."""
        scale = 2 * self.tangent * (depth if self.perspective else self.distance)
        return self.eye + np.stack([scale * right, -scale * down, depth], -1) @ self.axes

    def python(self, camera: Camera) -> str:
        """The line of Python that makes a camera of this pose."""
        eye, target, up = (listed(vector) for vector in (self.eye, self.target, self.axes[1]))
        size = f"width={camera.width}, height={camera.height}"
        if camera.near is not None and camera.far is not None:
            size += f", near={float(camera.near)!r}, far={float(camera.far)!r}"
        if self.perspective:
            fov = 2 * np.degrees(np.arctan(self.tangent)).item()
            return f"camera = js.Camera.look_at({eye}, {target}, {up}, fov_degrees={fov!r}, {size})"
        return f"camera = js.Camera.orthographic({eye}, {target}, {up}, view_height={self.height!r}, {size})"

    def told(self) -> dict[str, Any]:
        """As numbers for JSON, from which `read` makes it again."""
        vectors = {"target": self.target, "pole": self.pole, "forward": self.axes[2], "up": self.axes[1]}
        numbers = {name: getattr(self, name) for name in ("distance", "tangent", "perspective")}
        return {**{name: vector.tolist() for name, vector in vectors.items()}, **numbers}

    def read(self, told: dict[str, Any]) -> Pose:
        """What `told` said, of a view that began as this did; `InputError` of what makes no pose."""
        said = {"do": "restore", **told}
        target, pole, forward, up = (vector(said, name) for name in ("target", "pole", "forward", "up"))
        distance = number(said, "distance", MIN_ZOOM * self.start, MAX_ZOOM * self.start)
        tangent = number(said, "tangent", *(math.tan(math.radians(fov) / 2) for fov in (NARROWEST / 10, WIDEST)))
        if min(np.linalg.norm(np.cross(forward, up)), np.linalg.norm(pole), np.linalg.norm(forward)) < 1e-9:
            raise InputError("a pose needs directions that span a view")
        axes, pole = axes_along(forward / np.linalg.norm(forward), up), pole / np.linalg.norm(pole)
        changed = dataclasses.replace(self, target=target, axes=axes, pole=pole, distance=distance, tangent=tangent)
        return dataclasses.replace(changed, perspective=said.get("perspective") is True)


def listed(values: Any) -> str:
    """Numbers as Python has them."""
    return str(np.asarray(values, np.float64).tolist())


def _orthonormal(axes: np.ndarray) -> np.ndarray:
    """The same without what rounding has added over many motions."""
    return axes_along(axes[2] / np.linalg.norm(axes[2]), axes[1])
