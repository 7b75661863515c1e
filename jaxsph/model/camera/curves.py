r"""Smooth curves through values at given times: of places, of rotations, and of the near and far depth (host side, float64).

Flow: key frames -> [curves] -> camera path -> Camera.

All are piecewise cubic with continuous first derivatives. Slopes at inner keys are those of a parabola through three keys, no
larger than three times the smaller of the mean slopes beside them: so what stands still between two keys stands still, and what
moves evenly moves evenly.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.interpolate import CubicHermiteSpline, PchipInterpolator
from scipy.spatial.transform import Rotation

MAX_SLOPE = 3.0
"""Times the smaller of two mean slopes: a cubic whose ends are no steeper is monotone (Fritsch & Carlson 1980)."""


def slopes(times: Float[np.ndarray, " keys"], mean: Float[np.ndarray, "intervals values"]) -> Float[np.ndarray, "keys values"]:
    """Slopes at keys, of the mean slopes in the intervals between them."""
    step = np.diff(times)[:, None]
    before, after = mean[:-1], mean[1:]
    parabola = (step[1:] * before + step[:-1] * after) / (step[1:] + step[:-1])
    size, one, other = (np.linalg.norm(value, axis=1, keepdims=True) for value in (parabola, before, after))
    inner = parabola * np.minimum(1, MAX_SLOPE * np.minimum(one, other) / np.where(size > 0, size, 1))
    return np.concatenate([mean[:1], inner, mean[-1:]])


def through(times: Float[np.ndarray, " keys"], values: Float[np.ndarray, "keys values"]) -> CubicHermiteSpline:
    """A curve through values at two keys or more."""
    mean = np.diff(values, axis=0) / np.diff(times)[:, None]
    return CubicHermiteSpline(times, values, slopes(times, mean))


def monotone(times: Float[np.ndarray, " keys"], values: Float[np.ndarray, " keys"]) -> Any:
    """A curve that stays between the values at the keys beside it (Fritsch & Butland 1984)."""
    return PchipInterpolator(times, values)


def ordered(
    times: Float[np.ndarray, " keys"], lower: Float[np.ndarray, " keys"], upper: Float[np.ndarray, " keys"]
) -> tuple[CubicHermiteSpline, CubicHermiteSpline]:
    r"""Two monotone curves of which the one stays below the other.

    On an interval of length $h$ a cubic has the Bernstein coefficients $f_0$, $f_0 + h m_0 / 3$, $f_1 - h m_1 / 3$ and $f_1$, so
    the lower curve is below where its four are. The outer ones are; slopes of both at a key are made smaller by one factor
    until the inner ones are. That leaves monotone curves monotone, as their slopes get smaller.
    """
    below, above = (PchipInterpolator(times, values).derivative()(times) for values in (lower, upper))
    gap, step = upper - lower, np.diff(times)
    closing = np.maximum(np.append(step, 0) * (below - above), np.append(0, step) * (above - below)) / 3
    share = 0.5 * gap / np.maximum(closing, 0.5 * gap)
    return CubicHermiteSpline(times, lower, share * below), CubicHermiteSpline(times, upper, share * above)


@dataclasses.dataclass(frozen=True)
class Turning:
    r"""Rotations on the shortest way from key to key, with a continuous angular velocity.

    From $R_0$ to $R_1$, $R(s) = R_0 \exp(\omega_1 B_1(s)) \exp(\omega_2 B_2(s)) \exp(\omega_3 B_3(s))$ with the cumulative
    Bernstein polynomials $B_1 = 1 - (1 - s)^3$, $B_2 = 3 s^2 - 2 s^3$, $B_3 = s^3$. $\omega_1$ and $\omega_3$ are a third of the
    angles that the angular velocities at the two keys give, and $\omega_2$ is what is left to $R_1$. Turning evenly about one
    axis is spherical linear interpolation.

    Attributes:
        times: of the keys, ascending.
        keys: one rotation a key.
        velocity: angular velocities at the keys, (keys, 3), radians a unit of time.

    References:
        Kim, Kim & Shin 1995, A general construction scheme for unit quaternion curves.
    """

    times: np.ndarray
    keys: Rotation
    velocity: np.ndarray

    @classmethod
    def through(cls, times: Float[np.ndarray, " keys"], keys: Rotation) -> Turning:
        """Through rotations at two keys or more; of two ways that are equally long, half a turn apart, it takes one."""
        turned = (keys[:-1].inv() * keys[1:]).as_rotvec()
        return cls(times, keys, slopes(times, turned / np.diff(times)[:, None]))

    def __call__(self, time: float) -> Rotation:
        """The rotation at a time between the first and the last key."""
        first = int(np.clip(np.searchsorted(self.times, time, side="right") - 1, 0, len(self.times) - 2))
        step = self.times[first + 1] - self.times[first]
        share = (time - self.times[first]) / step
        begin, end = (Rotation.from_rotvec(step / 3 * self.velocity[key]) for key in (first, first + 1))
        middle = begin.inv() * self.keys[first].inv() * self.keys[first + 1] * end.inv()
        parts = (1 - (1 - share) ** 3, begin), (share**2 * (3 - 2 * share), middle), (share**3, end)
        found = self.keys[first]
        for weight, rotation in parts:
            found = found * Rotation.from_rotvec(weight * rotation.as_rotvec())
        return found
