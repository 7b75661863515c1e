"""What of a world some pixels of an image can see: which spheres and boxes, by planes (host side).

Flow: camera, pixels -> [frusta: Planes] -> which particles of a snapshot a pane of a picture needs.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from jaxsph.model.camera.camera import Camera

SLACK = 256 * float(np.finfo(np.float32).eps)
"""Of coordinates and supports, that a distance may be off by where the camera's numbers are float32."""


class Planes(NamedTuple):
    """A convex region: points x with n . (x - origin) <= d for all planes.

    Attributes:
        origin: of the coordinates, float64.
        normals: n, of any length.
        offsets: d.
    """

    origin: Float[np.ndarray, "3"]
    normals: Float[np.ndarray, "planes 3"]
    offsets: Float[np.ndarray, " planes"]

    def meet(self, position: Float[np.ndarray, "places 3"], reach: Float[np.ndarray, " places"]) -> Bool[np.ndarray, " places"]:
        """Whether spheres can reach into the region: never false where one does, seldom true where none does."""
        offset = position - self.origin
        slack = SLACK * (np.abs(offset).max(initial=0) + np.abs(position).max(initial=0))
        return self._meet(offset, reach * (1 + SLACK) + slack)

    def meet_boxes(
        self, lower: Float[np.ndarray, "boxes 3"], upper: Float[np.ndarray, "boxes 3"], reach: Float[np.ndarray, " boxes"]
    ) -> Bool[np.ndarray, " boxes"]:
        """Whether any sphere whose middle lies in a box can, none of which is larger than its `reach`."""
        half, middle = (upper - lower) / 2, (upper + lower) / 2
        inside = half @ np.abs(self.normals).T
        slack = SLACK * (
            np.abs(middle - self.origin).max(1, initial=0) + half.max(1, initial=0) + np.abs(middle).max(1, initial=0)
        )
        return self._meet(middle - self.origin, reach * (1 + SLACK) + slack, inside)

    def _meet(self, offset: np.ndarray, reach: np.ndarray, inside: np.ndarray | None = None) -> np.ndarray:
        lengths, met = np.linalg.norm(self.normals, axis=1), np.ones(len(offset), bool)
        for number, (normal, most, length) in enumerate(zip(self.normals, self.offsets, lengths, strict=True)):
            beyond = offset @ normal - reach * length
            met &= (beyond if inside is None else beyond - inside[:, number]) <= most
        return met


def seen_by(camera: Camera, top: int, bottom: int, left: int, right: int) -> Planes:
    """What rays of rows `top` to `bottom - 1` and columns `left` to `right - 1` pass through, between near and far.

    And a pixel around that: so whatever a list of particles takes for touching by rounding is met here, too.
    """
    along_row, up, forward = np.asarray(camera.axes, np.float64)
    low, high = sorted(float(camera.row(jnp.asarray(row, camera.dtype))) for row in (top - 1, bottom + 1))
    least, most = sorted(float(camera.column(jnp.asarray(column, camera.dtype))) for column in (left - 1, right + 1))
    near, far = camera.near_and_far()
    depths = [(-forward, -near), (forward, far)]
    if camera.is_perspective:
        sides = [
            (up - high * forward, 0.0),
            (low * forward - up, 0.0),
            (along_row - most * forward, 0.0),
            (least * forward - along_row, 0.0),
        ]
    else:
        sides = [(up, high), (-up, -low), (along_row, most), (-along_row, -least)]
    normals, offsets = zip(*sides, *depths, strict=True)
    return Planes(camera.exact_eye(), np.stack(normals), np.array(offsets))


def between_depths(camera: Camera) -> Planes:
    """What lies between near and far."""
    seen = seen_by(camera, 0, camera.height, 0, camera.width)
    return Planes(seen.origin, seen.normals[-2:], seen.offsets[-2:])
