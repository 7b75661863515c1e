"""Point samples, each of which stands for what lies around it: Hochstetter et al. 2016, equation 2 and section 2.2.

Flow: media -> [samples] -> composite.

In a slab a sample adds its colour times the light it takes away, $t_{k-1} - t_k$: however thin the samples, colours then add up
to the alpha that is lost. And $t_k$ is the exponential of the thickness up to there: one rounding, where a product would round
at every sample, and always the same way in a uniform medium.

In few passes over memory: two colours travel as one complex number, such that XLA makes one kernel of them, and per sample only
thickness and what colours are read by is kept.
"""

from __future__ import annotations

import functools
from typing import Any

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxsph.cast.integrator import Integrator, Optics, Segment
from jaxsph.field.tasks import SlabTask
from jaxsph.model.medium import Medium, mixed_colors, mixed_extinction
from jaxsph.numerics.fusion import barriers_kept, fusion_barrier


class PointSamples(Integrator):
    """Samples in the middles of what they stand for."""

    def segment(self, optics: Optics, path: Float[Array, "tasks samples rays"]) -> tuple[Optics, Array]:
        """See `Integrator`."""
        thickness = optics[3] * path
        return emitted(optics[:3], transmitted(thickness))[:3], thickness

    def __call__(self, media: tuple[Medium, ...], gathered: tuple[Any, ...], task: SlabTask) -> Segment:
        """See `Integrator`."""
        if not barriers_kept():
            return super().__call__(media, gathered, task)
        always = task.slab[0] >= 0
        thickness, found = fusion_barrier(always, _thickness, media, gathered, task)
        left = fusion_barrier(always, transmitted, thickness)
        red_green, blue = (
            fusion_barrier(always, functools.partial(_emitted, channels=channels), media, found, task, left)
            for channels in (slice(0, 2), slice(2, 3))
        )
        return Segment((red_green.real, red_green.imag, blue.real), left[:, -1], thickness)


def _thickness(media: tuple[Medium, ...], gathered: tuple[Any, ...], task: SlabTask) -> tuple[Array, list[Any]]:
    """Optical thickness of samples; and of each medium its extinction, if there are several, and what its colours are read by."""
    found = [medium.extinction(sums, task) for medium, sums in zip(media, gathered, strict=True)]
    thickness = mixed_extinction([extinction for extinction, _ in found]) * task.path()
    return thickness, [(extinction if len(media) > 1 else (), samples) for extinction, samples in found]


def _emitted(media: tuple[Medium, ...], found: list[Any], task: SlabTask, left: Array, *, channels: slice) -> Array:
    """One or two colours of slabs, as real and imaginary part."""
    colors = [medium.colors(samples, task, channels) for medium, (_, samples) in zip(media, found, strict=True)]
    first, *second, _ = emitted(mixed_colors(colors, [extinction for extinction, _ in found]), left)
    return lax.complex(first, second[0] if second else jnp.zeros_like(first))


def transmitted(thickness: Float[Array, "slabs samples rays"]) -> Float[Array, "slabs samples rays"]:
    """What is left behind each sample of slabs of what enters them."""
    through = [thickness[:, 0]]
    for k in range(1, thickness.shape[1]):
        through.append(through[-1] + thickness[:, k])
    return jnp.exp(-jnp.stack(through, 1))


def emitted(colors: Optics, left_behind: Float[Array, "slabs samples rays"]) -> list[Float[Array, "slabs rays"]]:
    """Colours of slabs of samples, as seen from right in front, and their transmittance."""
    left, total = jnp.ones_like(left_behind[:, 0]), [jnp.zeros_like(left_behind[:, 0])] * len(colors)
    for k in range(left_behind.shape[1]):
        behind = left_behind[:, k]
        total = [added + (left - behind) * color[:, k] for added, color in zip(total, colors, strict=True)]
        left = behind
    return [*total, left]
