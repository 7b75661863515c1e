"""Light along rays in float64 NumPy: where rays are inside of balls, and dense integrals between there."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from formulas import KERNELS

FINE = 12  # points of a Gauss-Legendre rule
ABSCISSAE, WEIGHTS = np.polynomial.legendre.leggauss(FINE)


def up_to_points():
    """Matrix (points, points) of integrals from -1 to each point of the rule, of the polynomial through all."""
    values = np.polynomial.legendre.legvander(ABSCISSAE, FINE)
    beneath = np.concatenate([-np.ones((FINE, 1)), values[:, : FINE - 1]], 1)
    return 0.5 * (values[:, 1:] - beneath) @ (values[:, :FINE] * WEIGHTS[:, None]).T


class Rays(NamedTuple):
    """Places `start + s direction` at the depths s between `near` and `far`; (rays, 3), row by row."""

    start: np.ndarray
    direction: np.ndarray
    near: float
    far: float

    @classmethod
    def of(cls, camera):
        """One for each pixel of a camera."""
        axes, half = np.asarray(camera.axes, np.float64), float(camera.half_height)
        columns = half * (2 * np.arange(camera.width) + 1 - camera.width) / camera.height
        rows = half * (camera.height - 1 - 2 * np.arange(camera.height)) / camera.height
        u, v = np.meshgrid(columns, rows)
        aside, ahead = u.reshape(-1, 1) * axes[0] + v.reshape(-1, 1) * axes[1], np.broadcast_to(axes[2], (u.size, 3))
        start = np.broadcast_to(camera.exact_eye(), aside.shape)
        ends = float(camera.near), float(camera.far)
        return cls(start, ahead + aside, *ends) if camera.is_perspective else cls(start + aside, ahead, *ends)

    @property
    def slant(self):
        """Path length a unit of depth."""
        return np.linalg.norm(self.direction, axis=1)

    def chords(self, center, square):
        """Depths (rays, balls) at which balls of these squared radii begin and end, between near and far; else both the same."""
        offset = np.asarray(center, np.float64)[None] - self.start[:, None]
        length = (self.direction**2).sum(1)[:, None]
        foot = (offset * self.direction[:, None]).sum(-1) / length
        away = ((offset - foot[..., None] * self.direction[:, None]) ** 2).sum(-1)
        half = np.sqrt(np.maximum(np.asarray(square) - away, 0) / length)
        return tuple(np.clip(end, self.near, self.far) for end in (foot - half, foot + half))

    def in_box(self, lower, upper):
        """Path length (rays,) in a box along the axes."""
        faces = (np.stack([lower, upper]).astype(float)[:, None] - self.start) / self.direction
        begin, end = (np.clip(depth, self.near, self.far) for depth in (faces.min(0).max(1), faces.max(0).min(1)))
        return np.maximum(end - begin, 0) * self.slant

    def within(self, center, square):
        """Path length (rays,) in the union of balls."""
        begin, end = self.chords(center, square)
        order = np.argsort(begin, 1)
        begin, end = np.take_along_axis(begin, order, 1), np.take_along_axis(end, order, 1)
        total, reached = np.zeros(begin.shape[0]), np.full(begin.shape[0], self.near)
        for k in range(begin.shape[1]):
            total += np.maximum(end[:, k] - np.maximum(begin[:, k], reached), 0)
            reached = np.maximum(reached, end[:, k])
        return total * self.slant


BEFORE = up_to_points()


def light(rays, particles, transfer, pieces=16):
    """Colour (rays, 3) and transmittance of particles: Gauss rules on `pieces` of what is between the ends of chords."""
    exists = np.asarray(particles.valid)
    center, support, quantity, volume = (
        np.asarray(getattr(particles, name), np.float64)[exists] for name in ("position", "support", "quantity", "volume")
    )
    borders = np.sort(np.concatenate([*rays.chords(center, support**2), np.full((len(rays.start), 1), rays.far)], 1), 1)
    values, colors, extinction = (np.asarray(getattr(transfer, name), np.float64) for name in ("values", "colors", "extinction"))
    color, thickness = np.zeros((len(rays.start), 3)), np.zeros(len(rays.start))
    for first, last in zip(borders.T[:-1], borders.T[1:], strict=True):
        for piece in range(0 if (first == last).all() else pieces):
            length = (last - first) / pieces
            depth = (first + piece * length)[:, None] + length[:, None] * (ABSCISSAE + 1) / 2
            place = rays.start[:, None] + depth[..., None] * rays.direction[:, None]
            away = np.linalg.norm(place[:, :, None] - center, axis=-1) / support
            weight = volume / support**3 * KERNELS[particles.kernel](away)
            total = weight.sum(-1)
            found = (weight * quantity).sum(-1) / np.where(total > 0, total, 1)
            here = np.where(total > 0, np.interp(found, values, extinction), 0) * (rays.slant * length)[:, None] / 2
            weighed = here * WEIGHTS * np.exp(-(thickness[:, None] + here @ BEFORE.T))
            color += np.stack([(weighed * np.interp(found, values, channel)).sum(1) for channel in colors.T], 1)
            thickness += (here * WEIGHTS).sum(1)
    return color, np.exp(-thickness)
