"""Where places are in a picture, and which coordinates its edges have.

Flow: Camera, positions -> [places] -> pixels, lengths -> figure.
"""

from __future__ import annotations

import itertools
import json
import re
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxsph.io.units import Labels
from jaxsph.model.camera.camera import Camera
from jaxsph.plot.bars import raised

ALIGNED = 1e-6  # of 1: what an axis of the picture may be off that of the world
FAR_OFF = 50.0  # widths of a picture: coordinates farther from zero are told from its middle
PIECES = 128  # of an edge, each of which is hidden or not
AHEAD = 1e-3  # of the far depth, before which nothing is drawn


def described(line: str) -> Camera | None:
    """The camera that `Camera.describe` told of, in float64; `None` of another line."""
    told = re.fullmatch(r"(\w+) (\d+)x(\d+) eye=(\[.*\]) axes=(\[.*\]) .*=(\S+) near=(\S+) far=(\S+)", line)
    if told is None:
        return None
    kind, width, height, *numbers = told.groups()
    made = [np.asarray(json.loads(one.replace("nan", "NaN").replace("inf", "Infinity"))) for one in numbers]
    given: Any = *made, int(width), int(height), kind
    return Camera(*given)


def frame_of(
    camera: Camera | None, labels: Labels, width: int, height: int
) -> tuple[tuple[float, float, float, float], tuple[str, str]]:
    """Coordinates of the left, right, lower and upper edge of a picture, and what they are called: lengths, or pixels."""
    if camera is None or camera.is_perspective:
        return (0, width, 0, height), ("", "")
    tall = 2 * float(camera.half_height)
    wide = tall * width / height
    factor, unit = labels.length_as(max(tall, wide) / 2)
    ends, names = [], []
    for side, axis, plain in zip((wide, tall), np.asarray(camera.axes, np.float64), "xy", strict=False):
        which = int(np.argmax(np.abs(axis)))
        sign, middle, name = float(np.sign(axis[which])), float(camera.exact_eye()[which]), f"${'xyz'[which]}$"
        if abs(axis[which]) < 1 - ALIGNED:
            sign, middle, name = 1.0, 0.0, f"${plain}'$"
        elif abs(middle) > FAR_OFF * side:
            middle, name = 0.0, rf"$\Delta {'xyz'[which]}$"
        ends += [factor * (middle - sign * side / 2), factor * (middle + sign * side / 2)]
        names.append(f"{name} ({raised(unit)})")
    return (ends[0], ends[1], ends[2], ends[3]), (names[0], names[1])


class Lines(NamedTuple):
    """Pieces of lines in pixels, x to the right and y down from the upper left corner of the image.

    Attributes:
        ends: of the pieces.
        depth: of their middles, length units.
    """

    ends: Float[np.ndarray, "pieces 2 2"]
    depth: Float[np.ndarray, " pieces"]

    def hidden(self, depth: Float[np.ndarray, "height width"]) -> Bool[np.ndarray, " pieces"]:
        """Which of them lie behind the depth at which transmittance falls to 1/2."""
        height, width = depth.shape
        column, row = np.floor(self.ends.mean(1)).T
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        at = depth[np.where(inside, row, 0).astype(int), np.where(inside, column, 0).astype(int)]
        return inside & (at < self.depth)


def to_pixels(camera: Camera, position: Float[np.ndarray, "... 3"]) -> tuple[np.ndarray, np.ndarray]:
    """Pixel coordinates (..., 2) of world positions, the middle of the first pixel at 1/2; and their depths.

    What is not ahead of a perspective eye has no place: NaN.
    """
    view = (np.asarray(position, np.float64) - camera.exact_eye()) @ np.asarray(camera.axes, np.float64).T
    depth = view[..., 2]
    ahead = depth > AHEAD * abs(camera.near_and_far()[1]) if camera.is_perspective else np.ones(depth.shape, bool)
    spread = np.where(ahead, depth, 1) if camera.is_perspective else np.ones_like(depth)
    half = float(camera.half_height)
    x = (view[..., 0] / spread / half * camera.height + camera.width) / 2
    y = (1 - view[..., 1] / spread / half) / 2 * camera.height
    return np.where(ahead[..., None], np.stack([x, y], -1), np.nan), depth


def box_lines(camera: Camera, lower: Float[np.ndarray, "3"], upper: Float[np.ndarray, "3"]) -> Lines:
    """The twelve edges of a box, in pieces; those that are not ahead of the eye are left out."""
    corners = np.array(list(itertools.product((0, 1), repeat=3)))
    pairs = [(one, other) for one, other in itertools.combinations(corners, 2) if np.abs(one - other).sum() == 1]
    share = np.linspace(0, 1, PIECES + 1)[:, None]
    places = np.array([lower + (upper - lower) * (one + (other - one) * share) for one, other in pairs])
    pixels, depth = to_pixels(camera, places)
    ends = np.stack([pixels[:, :-1], pixels[:, 1:]], 2).reshape(-1, 2, 2)
    middle = ((depth[:, :-1] + depth[:, 1:]) / 2).ravel()
    drawn = np.isfinite(ends).all((1, 2))
    return Lines(ends[drawn], middle[drawn])


def pixels_per_length(camera: Camera, depth: float) -> float:
    """Pixels that a length unit across the line of sight takes at a depth; in the middle of the image, and anywhere else."""
    spread = depth if camera.is_perspective else 1.0
    return camera.height / (2 * float(camera.half_height) * spread)


def round_length(most: float) -> float:
    """The largest of 1, 2 and 5 times a power of ten that is at most `most`, > 0."""
    power = 10.0 ** np.floor(np.log10(most))
    return float(max((step * power for step in (1, 2, 5) if step * power <= most), default=power))
