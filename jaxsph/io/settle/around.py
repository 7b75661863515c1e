"""What lies about a place: the centre of mass, the way from a centre to particles, and components of vectors along it.

Flow: ParticleTable, center -> [around] -> quantities, views, velocities of a frame.
"""

from __future__ import annotations

import re

import numpy as np
from jaxtyping import Float

from jaxsph.io.table import ParticleTable

RADIUS, COMPONENTS = "radius", ("radial", "phi", "theta")


def names_center(text: str) -> bool:
    """Whether a text names a radius, or a component about a centre such as `velocity.radial`."""
    return re.search(rf"\b(?:{RADIUS}|vr|\w+\.(?:{'|'.join(COMPONENTS)}))\b", text, re.IGNORECASE) is not None


def centre_of_mass(table: ParticleTable) -> Float[np.ndarray, "3"]:
    """The middle of masses, of equal ones where there are none; in a periodic box that on circles (Bai & Breen 2008)."""
    position, mass = table.position.astype(np.float64), table.masses()
    if not len(position):
        return np.zeros(3)
    if mass is not None and mass.sum() == 0:  # as of tracers
        mass = None
    if table.box_size is None:
        return np.average(position, axis=0, weights=mass)
    turn = np.exp(2j * np.pi * position / table.box_size)
    angle = np.angle(np.average(turn, axis=0, weights=mass)) % (2 * np.pi)
    return angle / (2 * np.pi) * np.asarray(table.box_size)


def center_of(table: ParticleTable) -> tuple[Float[np.ndarray, "3"], str]:
    """The place that radii are from, and what it is called."""
    if table.center is not None and not callable(table.center):
        return np.asarray(table.center, np.float64), "the center that is asked for"
    return table.center() if table.center is not None else centre_of_mass(table), "the centre of mass of all"


def away_from(table: ParticleTable, center: np.ndarray) -> Float[np.ndarray, "particles 3"]:
    """Positions from a place, float64; in a periodic box on the shortest way."""
    return shortest(table.position.astype(np.float64) - center, table.box_size)


def shortest(way: np.ndarray, sides: tuple[float, ...] | None) -> Float[np.ndarray, "particles 3"]:
    """Ways between particles in a periodic box of these sides, if there is one, to the nearest copies."""
    return way if sides is None else way - np.multiply(sides, np.round(way / sides))


def component_about(vector: np.ndarray, away: np.ndarray, component: str) -> Float[np.ndarray, " particles"]:
    """A vector's component at places (N, 3) from a middle: `"radial"`, `"phi"` about the z axis, or `"theta"`, down from it."""
    radius, across = np.linalg.norm(away, axis=1), np.hypot(away[:, 0], away[:, 1])
    if component == "radial":
        return (vector * away).sum(1) / np.where(radius > 0, radius, 1)
    x, y, z = away.T
    over = np.where(across > 0, across, 1)
    if component == "phi":
        return (x * vector[:, 1] - y * vector[:, 0]) / over
    outward = (x * vector[:, 0] + y * vector[:, 1]) / over
    return (z * outward - across * vector[:, 2]) / np.where(radius > 0, radius, 1)
