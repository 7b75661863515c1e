r"""The light integral: samples that count as far as there is anything, and how much they are wrong by.

Flow: media -> [segments] -> composite.

As point samples, each in the middle of what it stands for, but media give means from border to border as good as they know them:
particles count samples as far as supports cover them, volumes integrate the transfer function over the range of the quantity
(Engel, Kraus & Ertl 2001), of points there are integrals along their chords. So the borders of what is there lie where they are,
and where the field is smooth the error falls with the square of the samples' length.

**How wrong.** Of a function f that is smooth over three samples of length h the mean over the middle one is its value there and
$h^2 f'' / 24$ more, a 24th of the second difference: that is taken out. Where f has a kink within a sample it may be wrong by
three times as much, and next to a border nothing but the difference to one neighbour is known of how f changes. As samples are
wrong by either sign here and there, their errors add up as independent ones do, each as it is seen through what lies in front.
"""

from __future__ import annotations

import functools
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsph.engine.cast.integrator import Segment
from jaxsph.engine.cast.samples import PointSamples, emitted, thickness_of, transmitted
from jaxsph.engine.field.sums import apart_of, together_of
from jaxsph.engine.field.tasks import SlabTask
from jaxsph.model.medium import Medium
from jaxsph.numerics.extremes import clamped, greater, ratio
from jaxsph.numerics.fusion import barriers_kept, fusion_barrier

SMOOTH = 0.25  # of a sample, that a second difference may be where the light is taken to be smooth over three
KINK, EDGE = 1 / 8, 1 / 4  # of second differences where it is not, of differences at borders: what a sample may be wrong by


class Segments(PointSamples):
    """Samples with means from border to border."""

    between = True
    estimates = True

    def __call__(self, medium: Medium, gathered: Any, task: SlabTask) -> Segment:
        """See `Integrator`."""
        if not barriers_kept():
            return super().__call__(medium, gathered, task)
        always = task.slab[0] >= 0
        thickness, samples = fusion_barrier(always, thickness_of, medium, gathered, task)
        left = fusion_barrier(always, transmitted, thickness)

        def color(channel: int) -> Array:  # at hand before it is composited: a loop over samples would find it anew for each
            return medium.colors(samples, task, slice(channel, channel + 1))[0]

        red, green, blue = (fusion_barrier(always, functools.partial(color, channel)) for channel in range(3))
        red, green = apart_of(fusion_barrier(always, lambda: together_of(*emitted([red, green], left)[:2])))
        return Segment((red, green, emitted([blue], left)[0]), left[:, -1], thickness)

    def compared(self, medium: Medium, gathered: Any, task: SlabTask) -> Segment:
        """With quadratic errors taken out where the light is smooth, and with an estimate of the error."""
        always = task.slab[0] >= 0
        plain, samples = fusion_barrier(always, thickness_of, medium, gathered, task)
        known = functools.partial(smoothed, thickness=plain, share=medium.covered(gathered, task), exact=medium.exact_means)
        thickness, doubt = apart_of(fusion_barrier(always, known, plain))
        left = fusion_barrier(always, transmitted, thickness)

        def color_of(channel: int) -> Any:
            (color,) = medium.colors(samples, task, slice(channel, channel + 1))
            emission, of_emission = apart_of(known(color * plain))
            front = jnp.concatenate([jnp.ones_like(left[:, :1]), left[:, :-1]], 1)
            error = jnp.sqrt(((front * greater(doubt, of_emission)) ** 2).sum(1))
            return together_of(emitted([clamped(ratio(emission, thickness), 0, 1)], left)[0], error)

        found = [apart_of(fusion_barrier(always, functools.partial(color_of, channel))) for channel in range(3)]
        (red, green, blue), errors = zip(*found, strict=True)
        return Segment((red, green, blue), left[:, -1], thickness, functools.reduce(greater, errors))


def smoothed(amount: Float[Array, "tasks samples rays"], thickness: Array, share: Array | None, exact: bool) -> Any:
    """What samples emit or absorb, with quadratic errors taken out where it is smooth; and how much it may be wrong by.

    Args:
        thickness: what they absorb.
        share: what share of each sample holds any, which is known in the middle of that; None where means are given.
        exact: whether these are exact.
    """
    if exact or amount.shape[1] < 3:
        return together_of(amount, 0.25 * amount * thickness * jnp.exp(-thickness))
    value, covered = (amount, jnp.ones_like(amount, bool)) if share is None else (ratio(amount, share), share > 0)
    rise, both = value[:, 1:] - value[:, :-1], covered[:, 1:] & covered[:, :-1]
    second, inner = rise[:, 1:] - rise[:, :-1], both[:, 1:] & both[:, :-1]
    second, inner = (jnp.concatenate([one[:, :1], one, one[:, -1:]], 1) for one in (second, inner))
    step, nothing = jnp.abs(jnp.where(both, rise, 0)), jnp.zeros_like(rise[:, :1])
    step = greater(jnp.concatenate([nothing, step], 1), jnp.concatenate([step, nothing], 1))
    smooth = inner & (jnp.abs(second) <= SMOOTH * value)
    doubt = jnp.where(inner, jnp.where(smooth, 1 / 24, KINK) * jnp.abs(second), EDGE * step)
    if share is None:
        return together_of(amount, doubt)
    return together_of(greater(0, amount + jnp.where(smooth, share * second / 24, 0)), share * doubt)
