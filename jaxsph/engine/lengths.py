"""Any unit of length: what is far from 1 is rendered in a unit that differs from its own by a power of two.

Flow: scene, camera -> [lengths] -> request; Image -> [lengths] -> Image.

Products of a few lengths must be numbers, and of float32 those of 1e24 (cm across a galaxy) are none. A power of two changes no
digit, so that the picture is the one that exact numbers would have had. Frames in a comfortable unit are left alone.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np

from jaxsph.engine.access.resolution import longest
from jaxsph.model.camera.camera import Camera
from jaxsph.model.clips import Both, Box, Outside, Plane, Sphere
from jaxsph.model.particles.particles import Particles
from jaxsph.model.points import Points
from jaxsph.model.scene import Scene
from jaxsph.model.transfer.function import TransferFunction
from jaxsph.model.volume import Volume
from jaxsph.numerics.checks import product
from jaxsph.numerics.trees import unchecked_of

COMFORTABLE = 0.75
"""Of the binary digits that lengths may have, those that the longest of a camera may, before a frame is scaled."""
PLACED = {"position": 1, "position_rest": 1}
PART = 0
LENGTHS: dict[type, dict[str, int]] = {
    Scene: dict.fromkeys(("particles", "transfer", "media", "volume", "volume_transfer", "points", "within", "surface"), PART),
    Particles: PLACED | {"support": 1, "box": PART},
    Points: PLACED | {"radius": 1, "splats_beyond": 1, "extinction": -1},
    TransferFunction: {"extinction": -1},
    Volume: {"lower": 1, "spacing": 1, "lower_rest": 1},
    Plane: {"point": 1, "rest": 1},
    Box: {"lower": 1, "upper": 1, "rest": 1},
    Sphere: {"center": 1, "radius": 1, "rest": 1},
    Outside: {"clip": PART},
    Both: {"first": PART, "second": PART},
    Camera: {"eye": 1, "eye_rest": 1, "near": 1, "far": 1},
}
"""Powers of length of the fields of all that a frame is made of, or that they are a part that has some in turn.

Volumes of particles count by their ratios alone; a camera of parallel rays has a height that is a length, too.
"""


def digits_to_scale(part: Any, camera: Camera) -> int:
    """Binary digits by which lengths are to be scaled, such that the longest of the camera is about 1; 0 where it is comfortable.

    0, too, for what is made of anything whose lengths are not known, such as a medium of another package.
    """
    ends = [abs(float(camera.near)), abs(float(camera.far))]
    ends += [] if camera.is_perspective else [abs(float(camera.half_height))]
    length = max(ends)
    if not 0 < length < math.inf:
        return 0
    digits = math.frexp(length)[1]
    limit = COMFORTABLE * math.log2(longest(np.result_type(part.dtype, camera.dtype)))
    return -digits if abs(digits) > limit and _is_known(part) else 0


def scaled(part: Any, digits: int) -> Any:
    """A scene, a camera or a part of one, with lengths times `2 ** digits`."""
    if digits == 0 or part is None:
        return part
    if isinstance(part, tuple):
        return tuple(scaled(one, digits) for one in part)
    fields = {field.name: getattr(part, field.name) for field in dataclasses.fields(part)}
    powers = _lengths_of(part) or {}
    if isinstance(part, Camera) and not part.is_perspective:
        powers = powers | {"half_height": 1}
    for name, power in powers.items():
        fields[name] = scaled(fields[name], digits) if power == PART else times(fields[name], digits * power)
    return unchecked_of(type(part), **fields)


def times(value: Any, digits: int) -> Any:
    """A number or numbers times `2 ** digits`, which alone may be beyond what their dtype holds; None stays."""
    half = digits // 2
    return value if value is None or digits == 0 else product(product(value, 2.0**half), 2.0 ** (digits - half))


def _lengths_of(part: Any) -> dict[str, int] | None:
    """Of a medium by itself; None where they are not known."""
    return LENGTHS.get(type(part), getattr(part, "LENGTHS", None))


def _is_known(part: Any) -> bool:
    if part is None:
        return True
    if isinstance(part, tuple):
        return all(map(_is_known, part))
    known = _lengths_of(part)
    return known is not None and all(_is_known(getattr(part, name)) for name, power in known.items() if power == PART)
