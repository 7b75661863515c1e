"""Where places are in a picture: pixels of points, edges of a box, and how long a length is.

Flow: camera, scene -> [projected] -> lines and lengths in pixels -> figure of an image.
"""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxsph.model.camera.camera import Bounded, Camera
from jaxsph.model.scene import Scene

PIECES = 128  # of an edge, each of which is hidden or not
AHEAD = 1e-3  # of the far depth, before which nothing is drawn


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
    ahead = depth > AHEAD * abs(float(camera.far)) if camera.is_perspective else np.ones(depth.shape, bool)
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


def bounds_of(scene: Scene) -> tuple[np.ndarray, np.ndarray] | None:
    """Lower and upper corner around particles, volumes and points; `None` where there are none of these."""
    parts: list[Bounded] = [] if scene.particles is None else [scene.particles]
    parts += [*(volume for volume, _ in scene.volumes), *scene.point_sets]
    if not parts:
        return None
    corners = [part.bounds() for part in parts]
    return np.min([lower for lower, _ in corners], 0), np.max([upper for _, upper in corners], 0)
