"""Of a picture in a figure: its pixels, the coordinates of its edges, how long a length in it is.

Flow: Image, Camera -> [places] -> pixels, lengths -> figure.
"""

from __future__ import annotations

import json
import re
from typing import Any

import numpy as np

from jaxsph.io.images.image_files import pixels_of
from jaxsph.io.images.planes import ALIGNED
from jaxsph.io.units import Labels
from jaxsph.model.camera.camera import Camera
from jaxsph.model.image import Image
from jaxsph.model.scene import Scene
from jaxsph.plot.bars import raised

FAR_OFF = 50.0  # widths of a picture: coordinates farther from zero are told from its middle
LIGHT, DARK = "#ffffff", "#000000"
BRIGHT = 0.5  # mean of the edge of a picture, from which letters on it are dark


def described(line: str) -> Camera | None:
    """The camera that `Camera.describe` told of, in float64; `None` of another line."""
    told = re.fullmatch(r"(\w+) (\d+)x(\d+) eye=(\[.*\]) axes=(\[.*\]) .*=(\S+) near=(\S+) far=(\S+)", line)
    if told is None:
        return None
    kind, width, height, *numbers = told.groups()
    made = [np.asarray(json.loads(one.replace("nan", "NaN").replace("inf", "Infinity"))) for one in numbers]
    given: Any = *made, int(width), int(height), kind
    return Camera(*given)


def frame_of(camera: Camera | None, labels: Labels, width: int, height: int) -> tuple[tuple[float, ...], tuple[str, str]]:
    """Coordinates of the left, right, lower and upper edge of a picture, and what they are called: lengths, or pixels."""
    if camera is None or camera.is_perspective:
        return (0, width, 0, height), ("", "")
    tall = 2 * float(camera.half_height)
    wide = tall * width / height
    factor, unit = labels.length_as(max(tall, wide) / 2)
    ends, names = [], []
    for side, axis, plain in zip((wide, tall), camera.exact_axes(), "xy", strict=False):
        which = int(np.argmax(np.abs(axis)))
        sign, middle, name = float(np.sign(axis[which])), float(camera.exact_eye()[which]), f"${'xyz'[which]}$"
        if abs(axis[which]) < 1 - ALIGNED:
            sign, middle, name = 1.0, 0.0, f"${plain}'$"
        elif abs(middle) > FAR_OFF * side:
            middle, name = 0.0, rf"$\Delta {'xyz'[which]}$"
        ends += [factor * (middle - sign * side / 2), factor * (middle + sign * side / 2)]
        names.append(f"{name} ({raised(unit)})")
    return (ends[0], ends[1], ends[2], ends[3]), (names[0], names[1])


def anchor(camera: Camera, scene: Scene | None, target: Any) -> float:
    """Depth at which the scale bar holds."""
    bounds = None if scene is None or not scene.parts else scene.bounds()
    if not camera.is_perspective:
        return 1.0
    if target is None and bounds is None:
        return sum(camera.near_and_far()) / 2
    place = np.mean(bounds, 0) if target is None and bounds is not None else np.asarray(target, np.float64)
    if place.shape != (3,):
        raise ValueError(f"`target` must have shape (3,), got {place.shape}; give x, y and z")
    depth = float((place - camera.exact_eye()) @ camera.exact_axes()[2])
    if depth <= 0:
        if target is not None:
            raise ValueError(f"`target` = {place.tolist()} is not ahead of the eye; give a place that the camera looks at")
        return sum(camera.near_and_far()) / 2
    return depth


def picture_of(image: Image, background: Any) -> tuple[np.ndarray, str]:
    """Pixels, (H, W, 3 or 4) uint8, and the colour of letters that stand out from the edge of the picture."""
    picture = pixels_of(image, background)
    return picture, ink_of(pixels_of(image, "white") if background == "transparent" else picture)


def ink_of(picture: np.ndarray) -> str:
    """The colour of letters that stand out from the edge of a picture, of uint8."""
    edge = np.concatenate([picture[0], picture[-1], picture[:, 0], picture[:, -1]])[..., :3]
    return DARK if edge.mean() > 255 * BRIGHT else LIGHT


def bordered(ink: str, width: float) -> dict[str, Any]:
    """What is drawn in an ink, with a border of so many points that sets it off from anything."""
    from matplotlib import patheffects

    border = patheffects.withStroke(linewidth=width, foreground=DARK if ink == LIGHT else LIGHT)
    return {"color": ink, "path_effects": [border]}


def pixels_per_length(camera: Camera, depth: float) -> float:
    """Pixels that a length unit across the line of sight takes at a depth; in the middle of the image, and anywhere else."""
    spread = depth if camera.is_perspective else 1.0
    return camera.height / (2 * float(camera.half_height) * spread)


def round_length(most: float) -> float:
    """The largest of 1, 2 and 5 times a power of ten that is at most `most`, > 0."""
    power = 10.0 ** np.floor(np.log10(most))
    return float(max((step * power for step in (1, 2, 5) if step * power <= most), default=power))
