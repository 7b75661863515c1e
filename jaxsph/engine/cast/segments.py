r"""The light integral: samples that count as far as there is anything, and how much they are wrong by.

Flow: media -> [segments] -> composite.

As point samples, each in the middle of what it stands for, but media give means from border to border as good as they know them:
particles count samples as far as supports cover them, volumes integrate the transfer function over the range of the quantity
(Engel, Kraus & Ertl 2001), of points there are integrals along their chords. So the borders of what is there lie where they are,
and where the field is smooth the error falls with the square of the samples' length.

**How wrong.** Of a function f that is smooth over three samples of length h the mean over the middle one is its value there and
$h^2 f'' / 24$ more, a 24th of the second difference: that is taken out. Where f has a kink within a sample it may be wrong by
three times as much. Where no three in a row are known (at borders, in what is thin) that is a quarter of the difference to a
neighbour, but an eighth of all there is at least: values may be alike by chance. Means between borders of what is linear there
are wrong by a 12th, and stay as they are. As samples are wrong by either sign here and there, their errors add up as independent
ones do, each as it is seen through what lies in front.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsph.engine.cast.integrator import PointSamples, Segment, emitted, in_samples, thickness_of, transmitted
from jaxsph.engine.field.tasks import SlabTask
from jaxsph.model.medium import Medium
from jaxsph.numerics.extremes import clamped, greater, ratio
from jaxsph.numerics.fusion import apart_of, fusion_barrier, side_by_side, together_of

SMOOTH = 0.25  # of a sample, that a second difference may be where the light is taken to be smooth over three
KINK, EDGE = 1 / 8, 1 / 4  # of second differences where it is not (or of all), of differences at borders: how wrong samples are


class Segments(PointSamples):
    """Samples with means from border to border."""

    between = True
    estimates = True

    def colors(self, medium: Medium, samples: Any, task: SlabTask) -> Callable[[slice], list[Array]]:
        """At hand before they are composited: a loop over samples would find them anew for each."""
        always = task.slab[0] >= 0
        red_green = fusion_barrier(always, lambda: together_of(*medium.colors(samples, task, slice(0, 2))))
        blue = fusion_barrier(always, lambda: medium.colors(samples, task, slice(2, 3))[0])
        return [*apart_of(red_green), blue].__getitem__

    def compared(self, medium: Medium, gathered: Any, task: SlabTask) -> Segment:
        """With quadratic errors taken out where the light is smooth, and with an estimate of the error."""
        always = task.slab[0] >= 0
        plain, samples = fusion_barrier(always, thickness_of, medium, gathered, task)
        share = medium.covered(samples, task)
        covered = None if share is None else (share, fusion_barrier(always, ratio, 1.0, share))
        known = functools.partial(smoothed, covered=covered, exact=medium.exact_means)
        colors = self.colors(medium, samples, task)(slice(0, 3))
        thickness = fusion_barrier(always, lambda: side_by_side(known(plain)[0], 1))
        left = fusion_barrier(always, transmitted, thickness)

        def shown(channel: int) -> tuple[Array, list[Array]]:
            """What slabs emit of a colour, and what of its samples may be wrong by."""
            emission, doubts = known(colors[channel] * plain)
            mixed = [clamped(ratio(one, thickness[:, k]), 0, 1) for k, one in enumerate(emission)]
            return emitted([mixed], left)[0], doubts

        def blue_and_error() -> Any:
            (blue, *doubts), of_thickness = shown(2), known(plain)[1]
            several = zip(*doubts, *(shown(channel)[1] for channel in (0, 1)), of_thickness, strict=True)
            square, before = jnp.zeros_like(blue), jnp.ones_like(blue)
            for after, each in zip(in_samples(left), several, strict=True):
                square, before = square + before * after * functools.reduce(greater, each) ** 2, after
            return together_of(blue, jnp.sqrt(square))

        red, green = apart_of(fusion_barrier(always, lambda: together_of(shown(0)[0], shown(1)[0])))
        blue, error = apart_of(fusion_barrier(always, blue_and_error))
        return Segment((red, green, blue), left[:, -1], thickness, error)


def smoothed(
    amount: Float[Array, "tasks samples rays"], covered: tuple[Array, Array] | None, exact: bool
) -> tuple[list[Float[Array, "tasks rays"]], list[Float[Array, "tasks rays"]]]:
    """What samples emit or absorb, with quadratic errors taken out where it is smooth; and how much it may be wrong by.

    Written out sample by sample: nothing between is held.

    Args:
        covered: what share of each sample holds any, which is known in the middle of that, and 1 over it; None: means are given.
        exact: whether these are exact.
    """
    given = in_samples(amount)
    if exact:
        return given, [EDGE * one * one * jnp.exp(-one) for one in given]
    whole = jnp.ones_like(given[0])
    shares, values, curved = [whole] * len(given), given, 1 / 12
    if covered is not None:
        shares, inverse = map(in_samples, covered)
        values, curved = [one * per for one, per in zip(given, inverse, strict=True)], 1 / 24
    both = [before * after > 0 for before, after in itertools.pairwise(shares)]
    rise = [jnp.where(there, after - before, 0) for there, (before, after) in zip(both, itertools.pairwise(values), strict=True)]
    second = [after - before for before, after in itertools.pairwise(rise)]
    inner = [before & after for before, after in itertools.pairwise(both)]
    found, doubts = [], []
    for k in range(len(given)):
        beside = [n for n in (k - 1, k) if 0 <= n < len(rise)]
        doubt = functools.reduce(greater, [EDGE * jnp.abs(rise[n]) for n in beside], KINK * values[k])
        n, more = min(max(k - 1, 0), len(second) - 1), jnp.zeros_like(whole)
        if second:
            smooth = inner[n] & (jnp.abs(second[n]) <= SMOOTH * values[k])
            doubt = jnp.where(inner[n], jnp.where(smooth, curved, KINK) * jnp.abs(second[n]), doubt)
            more = jnp.where(smooth, second[n] / 24, more)
        found.append(given[k] if covered is None else greater(0, given[k] + shares[k] * more))
        doubts.append(shares[k] * doubt)
    return found, doubts
