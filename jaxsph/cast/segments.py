r"""Segments between samples: the transfer function integrated over how the quantity changes from one to the next.

Flow: media -> [segments] -> composite.

Samples lie on the borders of segments, and media tell the means of their emission and extinction over each: of particles and
volumes those of the transfer function over a range of the quantity, which is linear in between (Engel, Kraus & Ertl 2001), of
points the integrals along their chords. Within a segment both are taken to be mixed evenly, so that a segment of the optical
thickness $\tau$ shows its mean colour, by extinction, times $1 - e^{-\tau}$: their simplification. What it leaves out is of the
order of $\tau$ times how much colours differ in a segment.

Where the field is smooth the error falls with the square of the segments' length; point samples lose as much at each border of
supports as a sample is long, which segments locate.
"""

from __future__ import annotations

import functools
from typing import Any

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxsph.cast.integrator import Integrator, Optics, Segment
from jaxsph.cast.samples import emitted, transmitted
from jaxsph.field.tasks import SlabTask
from jaxsph.model.medium import Medium
from jaxsph.numerics.fusion import barriers_kept, fusion_barrier

EXTINCTION = slice(3, 4)


class Segments(Integrator):
    """Segments from sample to sample."""

    halo = 1
    between = True

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
        red_green, blue = (
            fusion_barrier(always, functools.partial(_emitted, channels=channels), medium, intervals, task, extinction, left)
            for channels in (slice(0, 2), slice(2, 3))
        )
        return Segment((red_green.real, red_green.imag, blue.real), left[:, -1], thickness)


def colors_of(emission: Optics, extinction: Float[Array, "tasks intervals rays"]) -> Optics:
    """Mean colours, by extinction; none where there is nothing."""
    filled = extinction > 0
    divisor = jnp.where(filled, extinction, 1)
    return [jnp.where(filled, jnp.clip(value / divisor, 0, 1), 0) for value in emission]


def _extinction(medium: Medium, intervals: Any, task: SlabTask) -> Array:
    """Mean extinction of segments."""
    (extinction,) = medium.means(intervals, task, EXTINCTION)
    return extinction


def _emitted(medium: Medium, intervals: Any, task: SlabTask, extinction: Array, left: Array, *, channels: slice) -> Array:
    """One or two colours of slabs, as real and imaginary part."""
    first, *second, _ = emitted(colors_of(medium.means(intervals, task, channels), extinction), left)
    return lax.complex(first, second[0] if second else jnp.zeros_like(first))
