"""Transfer functions and camera paths as JSON files, to be written by hand too.

Flow: TransferFunction, CameraPath -> [write_...] -> file -> [read_transfer, read_camera_path] -> the same.

```json
{"format": "jaxsph transfer function", "version": 1, "dtype": "float32",
 "values": [0, 1], "colors": [[0, 0, 0], [1, 1, 1]], "extinction": [0, 2]}
```
Numbers are written with as many digits as their dtype needs, so that a file gives the same function again, and can be edited by
hand. `note` may hold any text. What else a version of the class has stands under the name of its field.

```json
{"keys": [{"time": 0, "eye": [0, 0, 9], "target": [0, 0, 0]},
          {"time": 4, "eye": [9, 0, 0], "target": [0, 0, 0], "fov": 30}],
 "around": [0, 0, 0]}
```
Of a key, `up` is (0, 1, 0) and `fov` 45 degrees unless given; `view_height` in place of `fov` makes it
orthographic. `near` and `far` may be left out where who reads the file knows what there is to see. Of the path, `around` and
`ease` are as in `CameraPath.from_keys`; `width` and `height` are the size of its pictures; `note` may hold any text. Paths of
several legs have `"legs": [{"keys": [...]}, ...]` in place of `keys`.

What is no JSON, or says a thing twice, is refused with the file's name.
"""

from __future__ import annotations

import dataclasses
import json
import math
import os
from collections.abc import Mapping
from typing import Any

import numpy as np

from jaxsph.io.damage import DataError, naming, short_text
from jaxsph.io.replace import known_suffix, written_whole
from jaxsph.model.camera.camera import Bounded, BoundingBox, Camera
from jaxsph.model.camera.framing import OF_NOTHING, snug
from jaxsph.model.camera.path import CameraPath, Leg
from jaxsph.model.transfer.function import TransferFunction

VERSION = 1
OF_TRANSFER, REQUIRED = "jaxsph transfer function", ("values", "colors", "extinction")
KNOWN = "format", "version", "dtype", "note"
FORMAT = "jaxsph camera path"
OF_PATH = "format", "version", "note", "width", "height", "legs", "keys", "around", "ease"
OF_LEG = "keys", "around", "ease"
OF_KEY = "time", "eye", "target", "up", "fov", "view_height", "near", "far"
UP, FOV_DEGREES, SIZE = [0.0, 1.0, 0.0], 45.0, 512
SUFFIX = ".json"
MAX_DIGITS = 300  # of a whole number: what float64 holds


def write_transfer(path: str | os.PathLike[str], transfer: TransferFunction) -> None:
    """Write `transfer` to `path`, a `.json`, whole or not at all.

    Raises `ValueError`: another suffix, or a place that cannot be written to.
    """
    head = {"format": OF_TRANSFER, "version": VERSION, "dtype": str(transfer.values.dtype)}
    fields = {field.name: getattr(transfer, field.name) for field in dataclasses.fields(transfer)}
    rows = [f'  "{name}": {_text(value)}' for name, value in fields.items() if value is not None]
    start = [f"  {json.dumps(name)}: {json.dumps(value)}" for name, value in head.items()]
    _write_json(path, "transfer function", "{\n" + ",\n".join(start + rows) + "\n}")


def read_transfer(path: str | os.PathLike[str]) -> TransferFunction:
    """Read a transfer function that `write_transfer`, or a person, wrote.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: no regular file, no JSON, of another format or version, a field that is missing or unknown, or what
            `TransferFunction.from_points` refuses.
    """
    content = read_json(path)
    with naming(path):
        return TransferFunction.from_points(**_fields(content))


def _fields(content: Any) -> dict[str, Any]:
    if not isinstance(content, dict) or content.get("format") != OF_TRANSFER:
        must = f'"format" must be "{OF_TRANSFER}"; `TransferFunction.save` writes such files'
        raise ValueError(f"is JSON, but no transfer function: {must}")
    _require_version({"version": None} | content)
    names = [field.name for field in dataclasses.fields(TransferFunction)]
    _known("a transfer function", content, (*KNOWN, *names))
    missing = [name for name in REQUIRED if name not in content]
    if missing:
        raise ValueError(f"lacks {', '.join(missing)}; it must hold {', '.join(REQUIRED)}")
    dtype = content.get("dtype", "float32")
    if dtype not in ("float32", "float64"):
        raise ValueError(f'"dtype" must be float32 or float64, got {dtype!r}')
    return {name: _rows(name, content[name], dtype) for name in names if content.get(name) is not None}


def _rows(name: str, given: Any, dtype: str) -> np.ndarray:
    numbers_only(name, given)
    try:
        with np.errstate(over="ignore"):  # what float32 cannot hold is refused as not finite
            return np.asarray(given, np.float64).astype(dtype)
    except (TypeError, ValueError) as error:
        raise ValueError(f'"{name}" must hold numbers in rows of one length: {error}') from error


def _text(value: Any) -> str:
    """JSON of an array, in lines of a row each where it has rows."""
    rows = np.asarray(value)
    if rows.ndim > 1:
        return "[" + ",\n    ".join(_text(row) for row in rows) + "]"
    return "[" + ", ".join(str(number) for number in rows) + "]"


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
    _write_json(path, "camera path", json.dumps(head | (legs[0] if len(legs) == 1 else {"legs": legs}), indent=1))


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
    content = read_json(path)
    with naming(path):
        return _path(content, width, height, None if shown is None else BoundingBox(*shown.bounds()))


WRITERS = {TransferFunction: write_transfer, CameraPath: write_camera_path}
READERS = {TransferFunction: read_transfer, CameraPath: read_camera_path}


def _path(content: Any, width: int | None, height: int | None, shown: BoundingBox | None) -> CameraPath:
    head = _known("a camera path", content, OF_PATH)
    if head.get("format", FORMAT) != FORMAT:
        raise ValueError(f'"format" must be "{FORMAT}", got {head["format"]!r}; `CameraPath.save` writes such files')
    _require_version(head)
    if ("legs" in head) == ("keys" in head):
        raise ValueError('must have "keys", or "legs" of which each has some')
    for name in ("width", "height"):
        if isinstance(head.get(name), bool) or not isinstance(head.get(name, SIZE), int):
            raise ValueError(f'"{name}" must be a whole number of pixels, got {head[name]!r}')
    asked = {"width": width, "height": height}.items()
    size: Any = tuple(head.get(name, SIZE) if given is None else given for name, given in asked)
    legs = head.get("legs", [{name: head[name] for name in OF_LEG if name in head}])
    if not isinstance(legs, list):
        raise ValueError('"legs" must be a list of objects with "keys"')
    return CameraPath(tuple(_leg(_known("a leg", leg, OF_LEG), size, shown) for leg in legs))


def _leg(leg: Mapping[str, Any], size: tuple[int, int], shown: BoundingBox | None) -> Leg:
    keys = leg.get("keys")
    if not isinstance(keys, list) or not keys:
        raise ValueError('"keys" must be a list of at least one key')
    known = [_known(f"key {number}", key, OF_KEY) for number, key in enumerate(keys, 1)]
    times = tuple(_numbers(f"key {number}", "time", key, 1)[0] for number, key in enumerate(known, 1))
    cameras = tuple(_camera(f"key {number}", key, size, shown) for number, key in enumerate(known, 1))
    around = None if leg.get("around") is None else _numbers("a leg", "around", leg, 3)
    if not isinstance(leg.get("ease", False), bool):
        raise ValueError(f'"ease" must be true or false, without quotes, got {leg["ease"]!r}')
    return Leg(times, cameras, around, leg.get("ease", False))


def _camera(what: str, key: Mapping[str, Any], size: tuple[int, int], shown: BoundingBox | None) -> Camera:
    """With depths as given, or of the box that there is to see."""
    eye, target, up = (_numbers(what, name, {"up": UP, **key}, 3) for name in ("eye", "target", "up"))
    given = [_numbers(what, name, key, 1)[0] for name in ("near", "far") if name in key]
    if len(given) == 1 or (not given and shown is None):
        missing = "far" if "near" in key else "near"
        raise ValueError(f"{what} lacks `{missing}`; give `near` and `far`, the depths between which there is something to see")
    if "fov" in key and "view_height" in key:
        raise ValueError(f"{what} has both `fov` and `view_height`; the one is of perspective, the other of parallel rays")
    kind, name = (Camera.orthographic, "view_height") if "view_height" in key else (Camera.look_at, "fov")
    (opening,) = _numbers(what, name, {"fov": FOV_DEGREES, **key}, 1)
    near, far = given or OF_NOTHING
    with naming(what):
        made = kind(eye, target, up, opening, *size, near=near, far=far)
    found = made if given else snug(made, shown)
    if found is made and not given:
        raise ValueError(f"{what} looks away from all there is to see; turn it around, or give `near` and `far`")
    return found


def _known(what: str, content: Any, names: tuple[str, ...]) -> Mapping[str, Any]:
    """The entry, if it has no names but these."""
    if not isinstance(content, dict):
        raise ValueError(f"{what} must be an object {{...}}, got {type(content).__name__}")
    unknown = sorted(set(content) - set(names))
    if unknown:
        raise ValueError(f"{what} has {', '.join(map(repr, unknown))}, which is not known; it may have {', '.join(names)}")
    return content


def _numbers(what: str, name: str, key: Mapping[str, Any], count: int) -> Any:
    """A finite number, or three of them in a list."""
    value, told = key.get(name), "three finite numbers [x, y, z]" if count == 3 else "a finite number"
    if name not in key:
        raise ValueError(f"{what} lacks `{name}`, {told}")
    given = value if isinstance(value, list) and count == 3 else [value]
    if len(given) != count or any(isinstance(x, bool) or not isinstance(x, int | float) or not math.isfinite(x) for x in given):
        raise ValueError(f"`{name}` of {what} must be {told}, got {value!r}")
    return tuple(map(float, given))


def _written_key(time: float, camera: Camera) -> dict[str, Any]:
    axes, eye = camera.exact_axes(), camera.exact_eye()
    (near, far), half = camera.near_and_far(), float(camera.half_height)
    target = eye + axes[2] * max(abs(near), abs(far))
    opening = {"fov": 2 * math.degrees(math.atan(half))} if camera.is_perspective else {"view_height": 2 * half}
    place = {"time": time, "eye": eye.tolist(), "target": target.tolist(), "up": axes[1].tolist()}
    return place | opening | {"near": near, "far": far}


def _write_json(path: str | os.PathLike[str], what: str, text: str) -> None:
    """Write the text of `what` to a `.json`, whole or not at all; `ValueError` for another suffix, or where that cannot be."""
    known_suffix(path, [SUFFIX], f"a {what} is written as")
    with written_whole(path) as temporary:
        temporary.write_text(text + "\n", encoding="utf-8")


def _require_version(content: Any) -> None:
    """Raise where an object is of another version than this."""
    stated = content.get("version", VERSION)
    if isinstance(stated, bool) or stated != VERSION:
        remedy = "update jaxsph" if isinstance(stated, int) and stated > VERSION else "save it again"
        raise ValueError(f'"version" is {stated!r}, and this version of jaxsph reads {VERSION}; {remedy}')


def read_json(file: str | os.PathLike[str]) -> Any:
    """What a file says; `ValueError`: no JSON, nested too deeply, a whole number of more than 300 digits, a name twice."""
    try:
        return json.loads(short_text(file), object_pairs_hook=_object, parse_int=_whole)
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{file}: is no JSON: {error}; repair it there, or save it again") from error
    except RecursionError as error:
        raise ValueError(f"{file}: brackets are nested too deeply for a file of this kind; save it again") from error
    except DataError:
        raise
    except ValueError as error:
        raise ValueError(f"{file}: {error}") from error


def numbers_only(name: str, given: Any) -> None:
    """Raise where rows of numbers hold text, true, false or null, which arrays would take for numbers."""
    if isinstance(given, list):
        for one in given:
            numbers_only(name, one)
    elif isinstance(given, bool) or not isinstance(given, int | float):
        raise ValueError(f'"{name}" must hold numbers, got {json.dumps(given)[:40]}; write numbers without quotes')


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """An object, in which the last of two would win unsaid."""
    made = dict(pairs)
    if len(made) < len(pairs):
        names = [name for name, _ in pairs]
        twice = next(name for name in names if names.count(name) > 1)
        raise ValueError(f'"{twice[:40]}" stands twice in one object; leave one of them out')
    return made


def _whole(digits: str) -> int:
    if len(digits) > MAX_DIGITS:
        raise ValueError(f"the number {digits[:12]}... has {len(digits)} digits, at most {MAX_DIGITS} are read; correct it")
    return int(digits)
