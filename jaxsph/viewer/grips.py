"""The outline of a cut as it lies in the picture, and the grips that it is moved by.

Flow: Cut, Pose -> [grips] -> lines and grips for the page; a message of a grip -> Cut.

Places are shares of the height of the picture from its middle, right and down. A grip that is pulled goes, on the line that it
moves on, to what is nearest to the ray of the place that it is pulled to. That moves arrays of a clip, and compiles nothing.
"""

from __future__ import annotations

import dataclasses
import itertools
from typing import Any, NamedTuple

import numpy as np

from jaxsph.viewer.cut import SHARES, Cut
from jaxsph.viewer.inputs import MAX_SHARE, InputError, number, word
from jaxsph.viewer.pose import Pose

SIDE, TIP = 0.6, 0.5  # of the reach: half a side of the square that stands for a plane, and how long its normal is
ROUND = 48  # straight parts of a circle
NEAREST = 1e-2  # of the distance to what the view turns about, before which lines are left out
ALONG = 1e-3  # sine of the angle to a ray, below which what moves along a line is not seen to move
BEHIND = 2.0  # reaches that a plane moves away by then, for a pull over the height of the picture


class Ray(NamedTuple):
    """A ray of the picture, by any of its points and its direction of length 1."""

    origin: np.ndarray
    direction: np.ndarray

    @classmethod
    def at(cls, pose: Pose, right: float, down: float) -> Ray:
        """That of a place of the picture."""
        origin = pose.place_at(right, down, 0.0)
        ahead = pose.place_at(right, down, 1.0) - origin
        return cls(origin, ahead / np.linalg.norm(ahead))

    def nearest(self, place: np.ndarray) -> np.ndarray:
        """The point of the ray that is nearest to a place."""
        return self.origin + self.direction * (self.direction @ (place - self.origin))


def told(cut: Cut, pose: Pose) -> dict[str, Any]:
    """For a page, as JSON has it: `lines` are rows of two ends, grips those that can be seen."""
    grips = [(name, pose.seen_at(place)) for name, place in _grips(cut, pose).items()]
    seen = [{"name": name, "at": at[:2].tolist()} for name, at in grips if at[2] > NEAREST * pose.distance]
    return {"lines": _seen(pose, _outline(cut, pose)).tolist(), "grips": seen}


def pulled(cut: Cut | None, said: dict[str, Any], pose: Pose) -> Cut:
    """The cut once the grip `name` has been pulled `right` and `down`.

    Raises:
        InputError: there is none, or no such grip of it.
    """
    if cut is None:
        raise InputError("nothing is cut, so there is no grip; choose a plane, a box or a sphere")
    grips = _grips(cut, pose)
    name = word(said, "name", tuple(grips))
    right, down = (number(said, way, -MAX_SHARE, MAX_SHARE) for way in ("right", "down"))
    place = grips[name]
    at = pose.seen_at(place)
    ray = Ray.at(pose, at[0] + right, at[1] + down)
    if name == "middle":
        return dataclasses.replace(cut, middle=tuple(pose.place_at(at[0] + right, at[1] + down, at[2]).tolist()))
    if name == "tip":
        return _turned(cut, place, ray)
    least, most, _ = SHARES[cut.kind]
    share = _share(cut, place, ray) if cut.kind != "plane" or _moves(cut, ray) else cut.share + BEHIND * down
    return dataclasses.replace(cut, share=min(max(share, least), most))


def _grips(cut: Cut, pose: Pose) -> dict[str, np.ndarray]:
    """Where they are, (3,) each: what sizes or moves the cut, its middle, the tip of its normal."""
    middle, size = np.array(cut.middle), cut.reach * cut.share
    if cut.kind == "plane":
        placed, axis = middle + size * np.array(cut.axis), np.array(cut.axis)
        grips = {"share": placed + SIDE * cut.reach * _across(cut, pose)[1]}
        return grips if cut.follows else {**grips, "tip": placed + TIP * cut.reach * axis}
    if cut.kind == "sphere":
        return {"share": _circle(cut, pose)[0], "middle": middle}
    corners = middle + size * np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
    off = np.linalg.norm((pose.seen_at(corners) - pose.seen_at(middle))[:, :2], axis=1)
    return {"share": corners[np.argmax(off)], "middle": middle}


def _moves(cut: Cut, ray: Ray) -> bool:
    """Whether a plane that moves along its normal is seen to move."""
    return float(np.linalg.norm(np.cross(cut.axis, ray.direction))) > ALONG


def _share(cut: Cut, place: np.ndarray, ray: Ray) -> float:
    """The share with which the grip at a place comes nearest to a ray."""
    middle, size = np.array(cut.middle), cut.reach * cut.share
    if cut.kind == "sphere":
        return float(np.linalg.norm(ray.nearest(middle) - middle)) / cut.reach
    step = cut.reach * np.array(cut.axis) if cut.kind == "plane" else (place - middle) / cut.share
    start = place - step * size / cut.reach
    across, off = (one - ray.direction * (ray.direction @ one) for one in (step, ray.origin - start))
    return float(across @ off / (across @ across))


def _turned(cut: Cut, tip: np.ndarray, ray: Ray) -> Cut:
    """With the tip of the normal on a ray, on the side of the plane's middle that it has been on; what it turns about stays."""
    length, axis = TIP * cut.reach, np.array(cut.axis)
    pivot = tip - length * axis
    near = ray.nearest(pivot)
    half = np.sqrt(max(length**2 - float((near - pivot) @ (near - pivot)), 0.0))
    turned = near + (half if ray.direction @ axis >= 0 else -half) * ray.direction - pivot
    turned /= np.linalg.norm(turned)
    middle = pivot - cut.reach * cut.share * turned
    return dataclasses.replace(cut, axis=tuple(turned.tolist()), middle=tuple(middle.tolist()))


def _across(cut: Cut, pose: Pose) -> tuple[np.ndarray, np.ndarray]:
    """Two directions in a plane: sideways, and upwards as far as there is such."""
    axis = np.array(cut.axis)
    upwards = max(pose.axes[1:], key=lambda one: float(np.linalg.norm(np.cross(axis, one))))
    side = np.cross(axis, upwards)
    side /= np.linalg.norm(side)
    return side, np.cross(side, axis)


def _circle(cut: Cut, pose: Pose) -> np.ndarray:
    """(points, 3) where rays touch a sphere, its rightmost first; of one around the eye, its section across the view."""
    middle, radius, ahead = np.array(cut.middle), cut.reach * cut.share, pose.axes[2]
    if pose.perspective and (distance := float(np.linalg.norm(middle - pose.eye))) > radius:
        ahead = (middle - pose.eye) / distance
        middle, radius = middle - radius**2 / distance * ahead, radius * np.sqrt(1 - (radius / distance) ** 2)
    up = np.cross(pose.axes[0], ahead)
    up /= np.linalg.norm(up)
    angle = np.linspace(0, 2 * np.pi, ROUND + 1)[:, None]
    return np.asarray(middle + radius * (np.cos(angle) * np.cross(ahead, up) + np.sin(angle) * up))


def _outline(cut: Cut, pose: Pose) -> np.ndarray:
    """(lines, 2, 3) their ends."""
    if cut.kind == "sphere":
        points = _circle(cut, pose)
        return np.stack([points[:-1], points[1:]], 1)
    middle, size = np.array(cut.middle), cut.reach * cut.share
    if cut.kind == "box":
        corners = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
        pairs = itertools.combinations(range(8), 2)
        edges = [pair for pair in pairs if (corners[pair[0]] != corners[pair[1]]).sum() == 1]
        return np.asarray(middle + size * corners[np.array(edges)])
    placed, axis = middle + size * np.array(cut.axis), np.array(cut.axis)
    side, up = (SIDE * cut.reach * one for one in _across(cut, pose))
    square = placed + np.array([side + up, side - up, -side - up, up - side])
    lines = np.stack([square, np.roll(square, -1, 0)], 1)
    return lines if cut.follows else np.concatenate([lines, [[placed, placed + TIP * cut.reach * axis]]])


def _seen(pose: Pose, lines: np.ndarray) -> np.ndarray:
    """(lines, 4) ends in the picture, of what lies before the eye."""
    depth, least = pose.seen_at(lines)[..., 2], NEAREST * pose.distance
    lines, depth = lines[(depth > least).any(1)], depth[(depth > least).any(1)]
    part = np.clip((least - depth) / np.where(depth == depth[:, ::-1], 1, depth[:, ::-1] - depth), 0, 1)
    ends = lines + np.where(depth < least, part, 0)[..., None] * (lines[:, ::-1] - lines)
    return np.asarray(pose.seen_at(ends)[..., :2].reshape(-1, 4))
