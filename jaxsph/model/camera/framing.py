"""Depths of a camera, snug to what there is to see.

Flow: camera, scene -> [framing] -> camera with depths.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from jaxsph.model.camera.camera import BoundingBox, Camera
from jaxsph.model.camera.directions import NEAREST, ROUNDING, corners_of
from jaxsph.numerics.checks import array_of, is_traced

OF_NOTHING = 1.0, 2.0  # depths where nothing is in front of the eye: rays meet nothing between any


def with_depths(camera: Camera, shown: Any) -> Camera:
    """With near and far of what is shown, where they are None (host side): those found for a scene's picture, or all of a part.

    Raises `ValueError`: none under a trace, or with media, which do not say how large they are; one that leaves nothing to be
    shown.
    """
    camera = camera.for_picture() if hasattr(shown, "parts") else dataclasses.replace(camera, snug=None)
    if camera.near is not None and camera.far is not None:
        return camera
    traced = is_traced(camera, shown)  # type: ignore[unreachable]
    if traced or getattr(shown, "media", ()):
        where = f"{'under jit, vmap or grad' if traced else 'with `media`'}, where the size of a scene is not known"
        raise ValueError(f"`near` and `far` must be given {where}; give them to the camera")
    parts = getattr(shown, "parts", (shown,))
    found = snug(dataclasses.replace(camera, near=OF_NOTHING[0], far=OF_NOTHING[1]), *parts, clip=getattr(shown, "within", None))
    ends = (camera.near, found.near), (camera.far, found.far)
    near, far = (array_of(own if given is None else given, camera.dtype) for given, own in ends)
    if not float(near) < float(far):
        given = f"`near` = {float(near):.6g} and `far` = {float(far):.6g}"
        raise ValueError(f"{given} hold nothing of the scene; give both, near < far")
    return dataclasses.replace(camera, near=near, far=far)


def snug(camera: Camera, *parts: Any, clip: Any = None) -> Camera:
    """`camera` with near and far moved to what parts reach, as far as a clip shows it; as it is where none is before the eye."""
    spans = [span for part in parts if (span := _span(camera, part)) is not None]
    if not spans:
        return camera
    ends = min(near for near, _ in spans), max(far for _, far in spans)
    return snug_between(camera, *clipped(ends, camera, clip, *parts))


def clipped(ends: tuple[float, float], camera: Camera, clip: Any, *parts: Any) -> tuple[float, float]:
    """Depths at which a clip shows what lies between two; these where it is None, or shows nothing there."""
    if clip is None:
        return ends
    shown = clip.ends(camera.exact_axes()[2], *BoundingBox.around(parts))
    origin = float(_depth(camera, np.zeros(3)))
    near, far = max(ends[0], shown[0] + origin), min(ends[1], shown[1] + origin)
    return (near, far) if near < far else ends


def _span(camera: Camera, part: Any) -> tuple[float, float] | None:
    """From the least to the greatest depth of a part; None of an empty one."""
    if not hasattr(part, "valid") or getattr(part, "box", None) is not None:
        depth = _depth(camera, corners_of(*part.bounds()))
        return float(depth.min()), float(depth.max())
    if not len(part):
        return None
    depth = _depth(camera, part.places())
    reach = part.unpadded(part.support if hasattr(part, "support") else part.radius)
    return float((depth - reach).min()), float((depth + reach).max())


def _depth(camera: Camera, position: np.ndarray) -> np.ndarray:
    return np.asarray((position - camera.exact_eye()) @ camera.exact_axes()[2])


def snug_between(camera: Camera, near: float, far: float) -> Camera:
    """`camera` with depths about these, none of them behind an eye; as it is where all are (host side)."""
    if camera.is_perspective:
        if far <= 0:
            return camera
        near = max(near, NEAREST * far)
    margin = ROUNDING * max(abs(near), abs(far))
    near = near * (1 - ROUNDING) if camera.is_perspective else near - margin
    return dataclasses.replace(camera, near=array_of(near, camera.dtype), far=array_of(far + margin, camera.dtype))
