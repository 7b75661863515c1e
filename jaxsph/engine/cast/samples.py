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

from jaxsph.engine.cast.integrator import Integrator, Optics, Segment
from jaxsph.engine.field.tasks import SlabTask
from jaxsph.model.medium import Medium
from jaxsph.numerics.fusion import barriers_kept, fusion_barrier


class PointSamples(Integrator):
    """Samples in the middles of what they stand for."""

    def segment(self, optics: Optics, path: Float[Array, "tasks samples rays"]) -> tuple[Optics, Array]:
        """See `Integrator`."""
        thickness = optics[3] * path
        return emitted([in_samples(color) for color in optics[:3]], transmitted(thickness))[:3], thickness

    def __call__(self, medium: Medium, gathered: Any, task: SlabTask) -> Segment:
        """See `Integrator`."""
        if not barriers_kept():
            return super().__call__(medium, gathered, task)
        always = task.slab[0] >= 0
        thickness, samples = fusion_barrier(always, thickness_of, medium, gathered, task)
        left = fusion_barrier(always, transmitted, thickness)
        red_green, blue = (
            fusion_barrier(always, functools.partial(_emitted, channels=channels), medium, samples, task, left)
            for channels in (slice(0, 2), slice(2, 3))
        )
        return Segment((red_green.real, red_green.imag, blue.real), left[:, -1], thickness)


def thickness_of(medium: Medium, gathered: Any, task: SlabTask) -> tuple[Array, Any]:
    """Optical thickness of samples, and what colours are read by."""
    extinction, samples = medium.extinction(gathered, task)
    return extinction * task.path(), samples


def _emitted(medium: Medium, samples: Any, task: SlabTask, left: Array, *, channels: slice) -> Array:
    """One or two colours of slabs, as real and imaginary part."""
    first, *second, _ = emitted([in_samples(color) for color in medium.colors(samples, task, channels)], left)
    return lax.complex(first, second[0] if second else jnp.zeros_like(first))


def transmitted(thickness: Float[Array, "slabs samples rays"]) -> Float[Array, "slabs samples rays"]:
    """What is left behind each sample of slabs of what enters them."""
    behind, through = jnp.arange(thickness.shape[1])[:, None], thickness[:, :1]
    for k in range(1, thickness.shape[1]):  # one exponential, where sums that are stacked have one each
        through = jnp.where(behind >= k, through + thickness[:, k : k + 1], through)
    return jnp.exp(-through)


def in_samples(value: Float[Array, "slabs samples rays"]) -> list[Float[Array, "slabs rays"]]:
    """One by one."""
    return [value[:, k] for k in range(value.shape[1])]


def emitted(colors: list[list[Array]], left_behind: Float[Array, "slabs samples rays"]) -> list[Float[Array, "slabs rays"]]:
    """Colours of slabs, each sample by sample, as seen from right in front, and their transmittance."""
    left, total = jnp.ones_like(left_behind[:, 0]), [jnp.zeros_like(left_behind[:, 0])] * len(colors)
    for k, behind in enumerate(in_samples(left_behind)):
        total, left = [added + (left - behind) * color[k] for added, color in zip(total, colors, strict=True)], behind
    return [*total, left]
