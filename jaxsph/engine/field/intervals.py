r"""The field of particles between samples: linear from one to the next, and from a border to the sample that it is next to.

Flow: sums at samples, cover -> [intervals] -> media.

An interval whose two ends are inside of supports is taken to be so all along. Where one end is inside, it is so as far as the
cover's piece goes that this end is of, and the field is linear between that end and what it is at the border, the quantity of the
particle that makes it. Where neither is, a whole piece may lie between them. What pieces that are not connected leave open counts
as half of an interval: an estimate, as rare as two borders more in a few samples of one ray.

**Two quantities.** With colour $c(A)$ and extinction $s(B)$, both quantities linear from one end to the other, the mean of
extinction is that over B's range, exactly, and the mean of emission $\overline{c s}$ is the mean of $c$ over A's range times that
of $s$, plus $\Delta c \Delta s / 12$ of two functions that run linearly from end to end, by their slopes in the middle. Where no
control point lies within, that is exact. Where one does it is off by $O(\Delta c \Delta s)$, thus by the square of the interval's
length: in the intervals that cross a control point, which are as many however short they are, so that in all of a ray it adds an
error of the third order to one of the second, that of the linear field.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxsph.engine.field.cover import Cover
from jaxsph.engine.field.tasks import Part
from jaxsph.engine.lookups.means import MeanTables, mean_light
from jaxsph.model.transfer.function import slope_in_middle
from jaxsph.numerics.extremes import clamped, greater, lesser, ratio

LIGHT, EXTINCTION = range(4), 3  # channels: red, green, blue, extinction
BESIDE = 1e-3  # of an interval that rounding may move a border out of it


class Intervals(NamedTuple):
    """Of each interval, the field where it begins and ends, and what share of it is inside of supports.

    Where all is, `near` and `far` are those of samples; else those of where the inner part begins and ends.
    """

    near: Float[Array, "tasks intervals rays"]
    far: Float[Array, "tasks intervals rays"]
    share: Float[Array, "tasks intervals rays"]

    def narrowed(self, ahead: Float[Array, "tasks intervals rays"], part: Part | None) -> Intervals:
        """What is in a part of each interval; `ahead` is the share before the inner part, in which the field is linear."""
        if part is None:
            return self
        begin, end = greater(ahead, part.begin), lesser(ahead + self.share, part.end)
        inverse = ratio(1.0, self.share)
        near, far = (self.near + clamped((at - ahead) * inverse, 0, 1) * (self.far - self.near) for at in (begin, end))
        return Intervals(near, far, greater(0, end - begin) * ratio(part.share, part.end - part.begin))


def intervals_of(
    quantity: Float[Array, "tasks samples rays"],
    inside: Bool[Array, "tasks samples rays"],
    cover: Cover,
    depth: Float[Array, "tasks samples"],
    part: Part | None = None,
) -> Intervals:
    """Intervals between samples of slabs.

    Args:
        quantity: at samples, relative to what that of the cover is.
        part: of each interval that counts; None where all does.
    """
    begin, end = depth[:, :-1, None], depth[:, 1:, None]
    length = end - begin
    behind = begin >= cover.pivot[:, None]
    front, back, of_front, of_back = (jnp.where(behind, both[1][:, None], both[0][:, None]) for both in cover[:4])
    first, second = inside[:, :-1], inside[:, 1:]
    slack = BESIDE * length
    begins = (front >= begin - slack) & (front <= end + slack)
    ends = (back >= begin - slack) & (back <= end + slack)
    inverse = ratio(1.0, length)
    ahead = jnp.where(begins, clamped((front - begin) * inverse, 0, 1), jnp.where(first, 0, 0.5))
    past = jnp.where(ends, clamped((end - back) * inverse, 0, 1), jnp.where(second, 0, 0.5))
    ahead, past = jnp.where(first, 0, ahead), jnp.where(second, 0, past)
    hidden = ~first & ~second & ~(begins & ends)
    share = jnp.where(hidden, 0, greater(0, 1 - ahead - past))
    at_front = jnp.where(begins, of_front, jnp.where(second, quantity[:, 1:], 0))
    at_back = jnp.where(ends, of_back, jnp.where(first, quantity[:, :-1], 0))
    found = Intervals(jnp.where(first, quantity[:, :-1], at_front), jnp.where(second, quantity[:, 1:], at_back), share)
    return found.narrowed(ahead, part)


class Paired(NamedTuple):
    """Intervals of two quantities, with what their means are made of.

    Attributes:
        color: of the quantity of colours.
        extinction: its mean over what of each interval is inside of supports.
        rise: how much it rises from the beginning of that to its end.
    """

    color: Intervals
    extinction: Float[Array, "tasks intervals rays"]
    rise: Float[Array, "tasks intervals rays"]


def looked_up(tables: tuple[MeanTables, ...], intervals: list[Intervals]) -> Intervals | Paired:
    """What `means_by` reads: the intervals of one quantity, as they are; of two, with their extinction."""
    return intervals[0] if len(intervals) == 1 else Paired(intervals[0], *extinction_over(tables[-1], intervals[-1]))


def extinction_over(tables: MeanTables, intervals: Intervals) -> tuple[Array, Array]:
    """`Paired.extinction` and `Paired.rise`, by the second quantity."""
    near, far, _ = intervals
    (mean,) = mean_light(tables, near, far, slice(EXTINCTION, EXTINCTION + 1))
    rise = slope_in_middle(tables.segments, near, far, EXTINCTION) * (far - near)
    return mean, clamped(rise, -2 * mean, 2 * mean)


def means_by(
    tables: tuple[MeanTables, ...], looked: Intervals | Paired, channels: slice
) -> list[Float[Array, "tasks intervals rays"]]:
    """Means of emission in red, green and blue and of extinction, by one quantity or two; see the head of this file."""
    if isinstance(looked, Intervals):
        return means_of(tables[0], looked, channels)
    (near, far, share), extinction, rise = looked
    found = []
    for channel in range(*channels.indices(len(LIGHT))):
        mean = extinction
        if channel != EXTINCTION:
            (color,) = mean_light(tables[0], near, far, slice(channel, channel + 1))  # whose extinction is 1
            most = 2 * greater(0, lesser(color, 1 - color))
            change = clamped(slope_in_middle(tables[0].segments, near, far, channel) * (far - near), -most, most)
            mean = color * extinction + change * rise / 12
        found.append(jnp.where(share > 0, share * mean, 0))
    return found


def means_of(tables: MeanTables, intervals: Intervals, channels: slice) -> list[Float[Array, "tasks intervals rays"]]:
    """Means of emission in red, green and blue and of extinction, a unit length, of those that `channels` selects."""
    near, far, share = intervals
    return [jnp.where(share > 0, share * mean, 0) for mean in mean_light(tables, near, far, channels)]
