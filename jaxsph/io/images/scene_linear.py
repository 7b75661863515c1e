"""Colours of OpenEXR files: the linear light that a display shows for `image.color`.

Flow: image.color -> [scene_linear] -> `R` `G` `B` of a file -> [scene_linear] -> image.color.

Colour maps are made by eye on a display, and so `image.color` is display-referred: sRGB, premultiplied, over black. Tools take
the numbers of an EXR file for linear light, and encode them themselves to show them. So a file holds the sRGB decoding
(IEC 61966-2-1) of `image.color`, and what such a tool shows over black is what a PNG file shows. Its header says so.

| `jaxsph.color` in the header | colours of the file |
|---|---|
| `linear Rec.709` | linear light |
| `sRGB, display-referred` | `image.color` itself: a part of a picture, which is to keep its bits |
| none, of a file of jaxsph | `image.color` itself: written before colours were linear |
| none, of a foreign file | linear light, as OpenEXR defines it; other primaries than those of Rec. 709 are not converted |
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxsph.io.damage import DataError

COLOR_KEY = "jaxsph.color"
LIGHT, DISPLAYED = "linear Rec.709", "sRGB, display-referred"
CHROMATICITIES = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)
"""Of Rec. 709, which are those of sRGB: red, green, blue and white, x and y each."""
SLOPE, POWER, OFFSET = 12.92, 2.4, 0.055
DARKEST_OF_POWER = 0.04045  # a displayed number up to which the curve is a straight line
BLOCK = 1 << 20  # numbers that are converted at a time, as float64 takes room


def light_of(color: Any) -> Float[np.ndarray, "..."]:
    """Linear light of displayed colours, by float64 in float32; beyond [0, 1] the curve goes on, and is odd."""
    return _by_blocks(color, _decoded)


def color_of(light: Any) -> Float[np.ndarray, "..."]:
    """Displayed colours of linear light: of `light_of(color)` to 2 eps of `color`, relative; NaN and inf stay what they are."""
    return _by_blocks(light, _encoded)


def header_of(*, displayed: bool) -> dict[str, Any]:
    """What a header says of colours that are displayed numbers, or linear light."""
    return {COLOR_KEY: DISPLAYED} if displayed else {COLOR_KEY: LIGHT, "chromaticities": CHROMATICITIES}


def is_light(header: Mapping[str, Any]) -> bool:
    """Whether colours of a file are linear light. Raises `DataError`: the header says something else than files of jaxsph do."""
    told = header.get(COLOR_KEY)
    if told is None:
        return not any(name.startswith("jaxsph.") for name in header)
    if told not in (LIGHT, DISPLAYED):
        raise DataError(f"has {COLOR_KEY} = {told!r}, which is neither {LIGHT!r} nor {DISPLAYED!r}; save it as one")
    return bool(told == LIGHT)


def _by_blocks(values: Any, convert: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    given = np.asarray(values)
    flat, made = given.reshape(-1), np.empty(given.size, np.float32)
    with np.errstate(over="ignore", under="ignore"):  # what float32 cannot hold is inf or 0 in it
        for first in range(0, given.size, BLOCK):
            part = flat[first : first + BLOCK].astype(np.float64)
            made[first : first + BLOCK] = np.copysign(convert(np.abs(part)), part)
    return made.reshape(given.shape)


def _decoded(color: np.ndarray) -> np.ndarray:
    return np.where(color <= DARKEST_OF_POWER, color / SLOPE, ((color + OFFSET) / (1 + OFFSET)) ** POWER)


def _encoded(light: np.ndarray) -> np.ndarray:
    """The inverse: its border is where that of `_decoded` goes, not 0.0031308, which the standard rounds to."""
    straight = light <= np.float32(DARKEST_OF_POWER / SLOPE)
    return np.where(straight, light * SLOPE, (1 + OFFSET) * light ** (1 / POWER) - OFFSET)
