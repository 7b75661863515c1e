"""From the optics of media at samples to the light of slabs: the interface of all integrators, and point samples.

Flow: media -> [integrator] -> composite.

A point sample stands for what lies around it: Hochstetter et al. 2016, equation 2 and section 2.2. In a slab it adds its colour
times the light it takes away, $t_{k-1} - t_k$: however thin the samples, colours then add up to the alpha that is lost. And
$t_k$ is the exponential of the thickness up to there: one rounding, where a product would round at every sample, and always the
same way in a uniform medium.

In few passes over memory: two colours travel as one complex number, such that XLA makes one kernel of them, and per sample only
thickness and what colours are read by is kept.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsph.engine.field.tasks import SlabTask
from jaxsph.model.medium import Medium, optics
from jaxsph.numerics.compiled import apart_of, barriers_kept, fusion_barrier, together_of
from jaxsph.numerics.trees import tree

Optics = list[Float[Array, "tasks samples rays"]]  # red, green, blue, and extinction a unit length


@tree()
class Segment:
    """Slabs as seen from right in front of each.

    Attributes:
        color: red, green and blue that a slab emits.
        transmittance: what it lets through, the exponential of minus the sum of `thickness`.
        thickness: optical thickness between borders.
        error: how wrong colours and transmittance are estimated to be, whatever shines behind, 1 where rounding may choose what
            is shown; None where that is not asked for.
        stop: where rays end, see `Medium.stops`; None where nothing ends them so.
    """

    color: tuple[Float[Array, "slabs rays"], Float[Array, "slabs rays"], Float[Array, "slabs rays"]]
    transmittance: Float[Array, "slabs rays"]
    thickness: Float[Array, "slabs samples rays"]
    error: Float[Array, "slabs rays"] | None = None
    stop: Float[Array, "slabs 4 rays"] | None = None


class Integrator:
    """How samples become light.

    What a slab does to light must not depend on what lies in front of it: slabs are marched in any order.

    Attributes:
        between: whether it is given means over what samples stand for, from border to border; else optics at samples.
        estimates: whether `compared` estimates its error, against the light integral: a tolerance is then kept by more samples.
    """

    between: ClassVar[bool] = False
    estimates: ClassVar[bool] = False

    def segment(self, optics: Optics, path: Float[Array, "tasks samples rays"]) -> tuple[Optics, Array]:
        """Colour of slabs, and the optical thickness of their samples; differentiable.

        Args:
            optics: of all media together, see `model.medium.optics`; no colour counts where extinction is 0.
            path: path length of each sample.
        """
        raise NotImplementedError(f"`{type(self).__name__}` has no `segment`: define it")

    def compared(self, medium: Medium, gathered: Any, task: SlabTask) -> Segment:
        """Light of slabs with an estimate of its error, for integrators that a tolerance can be kept with."""
        raise NotImplementedError(f"`{type(self).__name__}` estimates no errors: define `compared`, or give `tolerance=None`")

    def __call__(self, medium: Medium, gathered: Any, task: SlabTask) -> Segment:
        """Light of slabs, by what their medium has gathered there; for one that wants its passes over memory otherwise."""
        color, thickness = self.segment(optics(medium, gathered, task), task.path())
        return Segment(tuple(color), jnp.exp(-thickness.sum(1)), thickness)  # type: ignore[arg-type]


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
        colors = self.colors(medium, samples, task)

        def shown(channels: slice) -> list[Array]:
            return emitted([in_samples(color) for color in colors(channels)], left)[:-1]

        red_green = fusion_barrier(always, lambda: together_of(*shown(slice(0, 2))))
        return Segment((*apart_of(red_green), *fusion_barrier(always, lambda: shown(slice(2, 3)))), left[:, -1], thickness)

    def colors(self, medium: Medium, samples: Any, task: SlabTask) -> Callable[[slice], list[Float[Array, "tasks samples rays"]]]:
        """Of some channels, those of samples."""
        return functools.partial(medium.colors, samples, task)


def thickness_of(medium: Medium, gathered: Any, task: SlabTask) -> tuple[Array, Any]:
    """Optical thickness of samples, and what colours are read by."""
    extinction, samples = medium.extinction(gathered, task)
    return extinction * task.path(), samples


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
