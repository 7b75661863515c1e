"""Camera paths as JSON files, to be written by hand too.

Flow: CameraPath -> [write_camera_path] -> file -> [read_camera_path] -> CameraPath.

```json
{"keys": [{"time": 0, "eye": [0, 0, 9], "target": [0, 0, 0]},
          {"time": 4, "eye": [9, 0, 0], "target": [0, 0, 0], "fov": 30}],
 "around": [0, 0, 0]}
```
Of a key, `up` is (0, 1, 0) and `fov` 45 degrees unless given; `view_height` in place of `fov` makes it
orthographic. `near` and `far` may be left out where who reads the file knows what there is to see. Of the path, `around` and
`ease` are as in `CameraPath.from_keys`; `width` and `height` are the size of its pictures; `note` may hold any text. Paths of
several legs have `"legs": [{"keys": [...]}, ...]` in place of `keys`.
"""

from __future__ import annotations

import itertools
import json
import math
import os
from collections.abc import Mapping
from typing import Any

import numpy as np

from jaxsph.io.damage import naming, regular_file
from jaxsph.io.saved.json_text import read_json, require_version, write_json
from jaxsph.model.camera.camera import Bounded, Camera
from jaxsph.model.camera.path import CameraPath, Leg

FORMAT, VERSION = "jaxsph camera path", 1
OF_PATH = "format", "version", "note", "width", "height", "legs", "keys", "around", "ease"
OF_LEG = "keys", "around", "ease"
OF_KEY = "time", "eye", "target", "up", "fov", "view_height", "near", "far"
UP, FOV_DEGREES, SIZE = (0.0, 1.0, 0.0), 45.0, 512
NEAREST = 1e-3  # smallest near over far of depths that are found: samples are geometric between them
MARGIN = 1e-4  # widening of depths that are found, far above the rounding of float32


def write_camera_path(path: str | os.PathLike[str], camera_path: CameraPath) -> None:
    """Write a camera path to `path`, a `.json`, whole or not at all.

    Raises `ValueError`: another suffix, or a place that cannot be written to.
    """
    first = camera_path.legs[0].cameras[0]
    head = {"format": FORMAT, "version": VERSION, "width": first.width, "height": first.height}
    legs = [
        {
            "around": None if leg.around is None else list(leg.around),
            "ease": leg.ease,
            "keys": [_written_key(time, camera) for time, camera in zip(leg.times, leg.cameras, strict=True)],
        }
        for leg in camera_path.legs
    ]
    write_json(path, "camera path", json.dumps(head | (legs[0] if len(legs) == 1 else {"legs": legs}), indent=1))


def read_camera_path(
    path: str | os.PathLike[str], *, width: int | None = None, height: int | None = None, shown: Bounded | None = None
) -> CameraPath:
    """Read a camera path that `write_camera_path`, or a person, wrote.

    Args:
        path: the file.
        width, height: size in pixels, in place of the file's; 512 x 512 where neither says.
        shown: what there is to see; near and far of keys that have none are moved to the box around it.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: no regular file; no JSON; a name that is missing or unknown; times that do not ascend; what
            `Camera.look_at` refuses.
    """
    file = regular_file(path)
    found = read_json(file)
    corners = None
    if shown is not None:
        lower, upper = shown.bounds()
        corners = np.array(list(itertools.product((0, 1), repeat=3))) * (upper - lower) + lower
    with naming(file):
        return _path(found, width, height, corners)


def _path(found: Any, width: int | None, height: int | None, corners: np.ndarray | None) -> CameraPath:
    head = _known("a camera path", found, OF_PATH)
    if head.get("format", FORMAT) != FORMAT:
        raise ValueError(f'"format" must be "{FORMAT}", got {head["format"]!r}; `CameraPath.save` writes such files')
    require_version(head, VERSION)
    if ("legs" in head) == ("keys" in head):
        raise ValueError('must have "keys", or "legs" of which each has some')
    for name in ("width", "height"):
        if isinstance(head.get(name), bool) or not isinstance(head.get(name, SIZE), int):
            raise ValueError(f'"{name}" must be a whole number of pixels, got {head[name]!r}')
    size = width or head.get("width", SIZE), height or head.get("height", SIZE)
    legs = head.get("legs", [{name: head[name] for name in OF_LEG if name in head}])
    if not isinstance(legs, list):
        raise ValueError('"legs" must be a list of objects with "keys"')
    return CameraPath(tuple(_leg(_known("a leg", leg, OF_LEG), size, corners) for leg in legs))


def _leg(leg: Mapping[str, Any], size: tuple[int, int], corners: np.ndarray | None) -> Leg:
    keys = leg.get("keys")
    if not isinstance(keys, list) or not keys:
        raise ValueError('"keys" must be a list of at least one key')
    known = [_known(f"key {number}", key, OF_KEY) for number, key in enumerate(keys, 1)]
    times = tuple(_number(f"key {number}", "time", key) for number, key in enumerate(known, 1))
    cameras = tuple(_camera(f"key {number}", key, size, corners) for number, key in enumerate(known, 1))
    around = None if leg.get("around") is None else _vector("a leg", "around", leg)
    if not isinstance(leg.get("ease", False), bool):
        raise ValueError(f'"ease" must be true or false, without quotes, got {leg["ease"]!r}')
    return Leg(times, cameras, around, leg.get("ease", False))


def _camera(what: str, key: Mapping[str, Any], size: tuple[int, int], corners: np.ndarray | None) -> Camera:
    eye, target = _vector(what, "eye", key), _vector(what, "target", key)
    up = _vector(what, "up", key) if "up" in key else UP
    near, far = _depths(what, key, np.asarray(eye), np.asarray(target), corners)
    if "fov" in key and "view_height" in key:
        raise ValueError(f"{what} has both `fov` and `view_height`; the one is of perspective, the other of parallel rays")
    kind, name = (Camera.orthographic, "view_height") if "view_height" in key else (Camera.look_at, "fov")
    opening = _number(what, name, {"fov": FOV_DEGREES, **key})
    with naming(what):
        return kind(eye, target, up, opening, *size, near=near, far=far)


def _depths(
    what: str, key: Mapping[str, Any], eye: np.ndarray, target: np.ndarray, corners: np.ndarray | None
) -> tuple[float, float]:
    """Near and far: as given, or of the box that there is to see."""
    given = [name for name in ("near", "far") if name in key]
    if len(given) == 2:
        return _number(what, "near", key), _number(what, "far", key)
    if given or corners is None:
        missing = "far" if given == ["near"] else "near"
        raise ValueError(f"{what} lacks `{missing}`; give `near` and `far`, the depths between which there is something to see")
    forward = (target - eye) / max(float(np.linalg.norm(target - eye)), np.finfo(float).tiny)
    depth = (corners - eye) @ forward
    margin = MARGIN * float(np.abs(depth).max())
    near, far = float(depth.min()) - margin, float(depth.max()) + margin
    if "view_height" in key:
        return near, far
    if not far > 0:
        raise ValueError(f"{what} looks away from all there is to see; turn it around, or give `near` and `far`")
    return max(near, NEAREST * far), far


def _known(what: str, found: Any, names: tuple[str, ...]) -> Mapping[str, Any]:
    """The entry, if it has no names but these."""
    if not isinstance(found, dict):
        raise ValueError(f"{what} must be an object {{...}}, got {type(found).__name__}")
    unknown = sorted(set(found) - set(names))
    if unknown:
        raise ValueError(f"{what} has {', '.join(map(repr, unknown))}, which is not known; it may have {', '.join(names)}")
    return found


def _number(what: str, name: str, key: Mapping[str, Any]) -> float:
    value = key.get(name)
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        lacks = f"{what} lacks `{name}`" if name not in key else f"`{name}` of {what} must be a finite number, got {value!r}"
        raise ValueError(lacks)
    return float(value)


def _vector(what: str, name: str, key: Mapping[str, Any]) -> tuple[float, float, float]:
    value = key.get(name)
    if name not in key:
        raise ValueError(f"{what} lacks `{name}`, three numbers [x, y, z]")
    numbers = value if isinstance(value, list) else []
    if len(numbers) != 3 or any(isinstance(x, bool) or not isinstance(x, int | float) or not math.isfinite(x) for x in numbers):
        raise ValueError(f"`{name}` of {what} must be three finite numbers [x, y, z], got {value!r}")
    return float(numbers[0]), float(numbers[1]), float(numbers[2])


def _written_key(time: float, camera: Camera) -> dict[str, Any]:
    axes, eye = np.asarray(camera.axes, np.float64), camera.exact_eye()
    (near, far), half = camera.near_and_far(), float(camera.half_height)
    target = eye + axes[2] * max(abs(near), abs(far))
    opening = {"fov": 2 * math.degrees(math.atan(half))} if camera.is_perspective else {"view_height": 2 * half}
    place = {"time": time, "eye": eye.tolist(), "target": target.tolist(), "up": axes[1].tolist()}
    return place | opening | {"near": near, "far": far}
