r"""Segments between samples: the transfer function integrated over how the quantity changes from one to the next.

Flow: media -> [segments] -> composite.

Samples lie on the borders of segments, and media tell the means of their emission and extinction over each: of particles and
volumes those of the transfer function over a range of the quantity, which is linear in between (Engel, Kraus & Ertl 2001), of
points the integrals along their chords. Within a segment both are taken to be mixed evenly, so that a segment of the optical
thickness $\tau$ shows its mean colour, by extinction, times $1 - e^{-\tau}$: their simplification. What it leaves out is of the
order of $\tau$ times how much colours differ in a segment.

Where the field is smooth the error falls with the square of the segments' length; point samples lose as much at each border of
supports as a sample is long, which segments locate.

**Step doubling** (Kratz et al. 2011, section 6). The same samples without every other one give segments of twice the length, and
how far both differ estimates the error; what a medium gathers is gathered once. An error that falls with the square of the length
can be taken out, too: where thickness or emission of two segments differ little from those of the long one in place of them, they
are carried a third of the difference further (Richardson 1911).
"""

from __future__ import annotations

import functools
from typing import Any

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxsph.engine.cast.integrator import Integrator, Optics, Segment
from jaxsph.engine.cast.refine import CAUTION
from jaxsph.engine.cast.samples import emitted, transmitted
from jaxsph.engine.field.sums import apart_of, together_of
from jaxsph.engine.field.tasks import SlabTask
from jaxsph.model.medium import Medium
from jaxsph.numerics.extremes import clamped, ratio
from jaxsph.numerics.fusion import barriers_kept, fusion_barrier

EXTINCTION = slice(3, 4)
PAIRS = slice(0, 2), slice(2, 4)  # of channels, found together
SMOOTH = 0.25  # of a sum over two segments, that the long one may differ by where the error is taken to be quadratic


class Segments(Integrator):
    """Segments from sample to sample."""

    halo = 1
    between = True
    estimates = True

    def segment(self, optics: Optics, path: Float[Array, "tasks intervals rays"]) -> tuple[Optics, Array]:
        """See `Integrator`; of means of emission and extinction."""
        *emission, extinction = optics
        thickness = extinction * path
        return emitted(colors_of(emission, extinction), transmitted(thickness))[:3], thickness

    def __call__(self, medium: Medium, gathered: Any, task: SlabTask) -> Segment:
        """See `Integrator`."""
        if not barriers_kept():
            color, thickness = self.segment(medium.met(gathered, task), task.path())
            return Segment(tuple(color), jnp.exp(-thickness.sum(1)), thickness)  # type: ignore[arg-type]
        always, intervals = task.slab[0] >= 0, medium.intervals(gathered, task)
        extinction = fusion_barrier(always, _extinction, medium, intervals, task)
        thickness = extinction * task.path()
        left = fusion_barrier(always, transmitted, thickness)
        red, green, blue = (
            fusion_barrier(always, functools.partial(_color, channel=channel), medium, intervals, task, extinction)
            for channel in range(3)
        )
        red_green = fusion_barrier(always, _emitted, red, green, left)
        return Segment((red_green.real, red_green.imag, emitted([blue], left)[0]), left[:, -1], thickness)

    def compared(self, medium: Medium, gathered: Any, task: SlabTask) -> Segment:
        """With quadratic errors taken out, and with an estimate of the error: by how far segments of twice the length differ."""
        always, every_other = task.slab[0] >= 0, task.every_other()
        short = medium.intervals(gathered, task), task
        long = medium.intervals(medium.every_other(gathered), every_other), every_other
        *own, extinction = _amounts_of(always, medium, *short)
        *double, extinction_of_long = _amounts_of(always, medium, *long)
        thickness = fusion_barrier(always, carried, extinction, extinction_of_long)
        left, left_by_long = (fusion_barrier(always, transmitted, one) for one in (thickness, extinction_of_long))
        given = thickness, extinction_of_long, left, left_by_long
        channels = [apart_of(fusion_barrier(always, _colors_compared, *both, *given)) for both in zip(own, double, strict=True)]
        through = left[:, -1] - left_by_long[:, -1]
        error = jnp.abs(through)
        for color, by_long in channels:
            more = color - by_long
            error = jnp.maximum(error, jnp.maximum(jnp.abs(more), jnp.abs(more + through)))
        error = error + (1 - jnp.exp(-medium.missed(gathered, task))) / CAUTION
        red, green, blue = (color for color, _ in channels)
        return Segment((red, green, blue), left[:, -1], thickness, error)


def _amounts_of(always: Array, medium: Medium, intervals: Any, task: SlabTask) -> list[Array]:
    """Emission of red, green and blue, and extinction, of segments in all."""
    pairs = [fusion_barrier(always, functools.partial(_amounts, channels=two), medium, intervals, task) for two in PAIRS]
    return [one for pair in pairs for one in apart_of(pair)]


def _amounts(medium: Medium, intervals: Any, task: SlabTask, channels: slice) -> Any:
    """Two of them."""
    first, second = medium.means(intervals, task, channels)
    return together_of(first * task.path(), second * task.path())


def carried(short: Array, long: Array) -> Array:
    """What segments have in all, with quadratic errors taken out."""
    return short * extrapolated(short, long)


def _colors_compared(short: Array, long: Array, thickness: Array, of_long: Array, left: Array, left_by_long: Array) -> Any:
    """One colour of slabs, and the same by segments of twice the length."""
    (color,), (color_of_long,) = colors_of([carried(short, long)], thickness), colors_of([long], of_long)
    return together_of(emitted([color], left)[0], emitted([color_of_long], left_by_long)[0])


def extrapolated(
    short: Float[Array, "tasks intervals rays"], long: Float[Array, "tasks half_intervals rays"]
) -> Float[Array, "tasks intervals rays"]:
    """What thickness or emission of segments are to be multiplied by, given those of segments of twice the length."""
    both = short[:, ::2] + short[:, 1::2]
    filled = both > 0
    ratio = jnp.where(filled, long / jnp.where(filled, both, 1), 1)
    factor = jnp.where(jnp.abs(ratio - 1) <= SMOOTH, (4 - ratio) / 3, 1)
    return jnp.repeat(factor, 2, axis=1)


def colors_of(emission: Optics, extinction: Float[Array, "tasks intervals rays"]) -> Optics:
    """Mean colours, by extinction; none where there is nothing."""
    return [clamped(ratio(value, extinction), 0, 1) for value in emission]


def _extinction(medium: Medium, intervals: Any, task: SlabTask) -> Array:
    """Mean extinction of segments."""
    (extinction,) = medium.means(intervals, task, EXTINCTION)
    return extinction


def _color(medium: Medium, intervals: Any, task: SlabTask, extinction: Array, *, channel: int) -> Array:
    """Mean colour of segments, at hand before it is composited: a loop over segments would find it anew for each."""
    return colors_of(medium.means(intervals, task, slice(channel, channel + 1)), extinction)[0]


def _emitted(red: Array, green: Array, left: Array) -> Array:
    """Two colours of slabs, as real and imaginary part."""
    return lax.complex(*emitted([red, green], left)[:2])
