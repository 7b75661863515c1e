"""From the optics of media at samples to the light of slabs: the interface of all integrators.

Flow: media -> [integrator] -> composite.
"""

from __future__ import annotations

from typing import Any, ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsph.engine.field.tasks import SlabTask
from jaxsph.model.medium import Medium
from jaxsph.numerics.trees import tree

Optics = list[Float[Array, "tasks samples rays"]]  # red, green, blue, and extinction a unit length


@tree()
class Segment:
    """Slabs as seen from right in front of each.

    Attributes:
        color: red, green and blue that a slab emits.
        transmittance: what it lets through, the exponential of minus the sum of `thickness`.
        thickness: optical thickness between borders.
        error: how wrong colours and transmittance are estimated to be, whatever shines behind; None where that is not asked for.
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
        asks_points: whether it chooses for itself where it asks media: it is made with a tolerance and the samples of a ray.
        forward_only: what is said where reverse mode is asked for; None where there is that.
    """

    between: ClassVar[bool] = False
    estimates: ClassVar[bool] = False
    asks_points: ClassVar[bool] = False
    forward_only: ClassVar[str | None] = None

    def segment(self, optics: Optics, path: Float[Array, "tasks samples rays"]) -> tuple[Optics, Array]:
        """Colour of slabs, and the optical thickness of their samples; differentiable.

        Args:
            optics: of all media together, see `Medium.optics`; no colour counts where extinction is 0.
            path: path length of each sample.

        Raises:
            NotImplementedError: of integrators that are `forward_only`, which have a `__call__` of their own.
        """
        raise NotImplementedError(self.forward_only or f"`{type(self).__name__}` has no `segment`: define it")

    def compared(self, medium: Medium, gathered: Any, task: SlabTask) -> Segment:
        """Light of slabs with an estimate of its error, for integrators that a tolerance can be kept with."""
        raise NotImplementedError(f"`{type(self).__name__}` estimates no errors: define `compared`, or give `tolerance=None`")

    def __call__(self, medium: Medium, gathered: Any, task: SlabTask) -> Segment:
        """Light of slabs, by what their medium has gathered there; for one that wants its passes over memory otherwise."""
        color, thickness = self.segment(medium.optics(gathered, task), task.path())
        return Segment(tuple(color), jnp.exp(-thickness.sum(1)), thickness)  # type: ignore[arg-type]
