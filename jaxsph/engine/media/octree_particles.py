r"""Particles as a medium that can be asked at any point: CSPH sums over the leaf of an octree that the point is in.

Flow: particles -> octree -> [octree particles: leaf -> sums -> look-up] -> integrator.

$Q(x) = \sum q_j V_j W_j(x) / \sum V_j W_j(x)$ (Hochstetter et al. 2016, equation 2), where the sums go over those particles whose
support meets the leaf (Kaehler, Abel & Hege 2007, section 3.1). `field.particles` is many times as fast, as 64 rays share what it
finds; its lists are of slabs, while this medium takes points in any order and number.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxsph.engine.access.octree_build import OctreePlan
from jaxsph.engine.access.quantities import in_units_of
from jaxsph.engine.access.view import view_particles
from jaxsph.engine.field.tasks import SlabTask
from jaxsph.engine.media.octree_sums import Columns, LeafSums, OctreeMedium, Place, SeenSpheres, octree_over
from jaxsph.model import kernels
from jaxsph.model.camera.camera import Camera
from jaxsph.model.particles import Particles
from jaxsph.model.transfer.function import Segments, TransferFunction, find, read

EXTINCTION = slice(3, 4)
COLUMNS = ("x", "y", "z", "scale", "size", "quantity")  # of the table, see `access.view.Columns`
MIN_WEIGHT = 2.0**20  # times the least normal number: below it a sample has no cotangents, as one over it could overflow


@dataclasses.dataclass(frozen=True)
class OctreeParticles(OctreeMedium):
    """Particles in an octree; make them with `from_particles`.

    Rounding may take a sample at the very edge of a support for one outside of it, if the eye is further away than a few times
    the extent of all particles.

    Attributes:
        particles, transfer: as given; None in view space.
        kernel: name of the smoothing kernel.
    """

    num_sums = 2
    particles: Particles | None
    transfer: TransferFunction | None
    kernel: str = "poly6"

    @classmethod
    def from_particles(cls, particles: Particles, transfer: TransferFunction, plan: OctreePlan | None = None) -> OctreeParticles:
        """Build the octree.

        Args:
            particles: any; in an order such as `jaxsph.prepare` gives, they are found faster.
            transfer: maps their quantity to colour and extinction.
            plan: by default what `access.octree_build.plan_octree` makes on the host; to be given under jit.

        Differentiation:
            By particles and transfer function; which leaf has which particles is held fixed.

        Raises:
            ValueError: of particles that carry two quantities.
        """
        if particles.extinction_quantity is not None:
            raise ValueError(
                "`particles` in an octree carry one quantity, and these carry two (`quantity=(A, B)`); give "
                "`integrator='samples'` or `'segments'`, which take those as they are, or particles with a single `quantity`"
            )
        return cls(octree_over(particles, plan), None, particles, transfer, particles.kernel)

    def seen_by(self, camera: Camera) -> OctreeParticles:
        """In the view space of a camera."""
        if self.particles is None or self.transfer is None:
            return self
        dtype = jnp.promote_types(self.particles.dtype, camera.dtype)
        transfer = jax.tree.map(lambda leaf: leaf.astype(dtype), self.transfer)
        particles, transfer = in_units_of(self.particles, transfer)
        viewed = view_particles(particles, camera, jnp.stack([camera.near, camera.far]).astype(dtype), 1)
        columns = jnp.stack([getattr(viewed, name) for name in COLUMNS], 1)
        seen = SeenSpheres.of(columns, self.octree, camera, viewed.faults, look=transfer.segments())
        return OctreeParticles(lax.stop_gradient(self.octree), seen, None, None, self.kernel)

    def contribution(self, columns: Columns, place: Place, common: Any, reference: Any) -> tuple[Array, Array]:
        """Weight, and weight times quantity less the reference."""
        smooth, (x, y, z, scale, size, quantity, *_) = kernels.by_name(self.kernel), columns
        away = [(at - own) * scale for at, own in zip(place, (x, y, z), strict=True)]
        square = away[0] * away[0] + away[1] * away[1] + away[2] * away[2]
        weight = smooth.weigh(smooth.prepare(square, size), 0, size, jnp)
        return weight, weight * (quantity - reference)

    def reference(self, first: Columns) -> Array:
        """A quantity near by, such that a constant stays that constant."""
        return first[COLUMNS.index("quantity")]

    def extinction(self, gathered: LeafSums, task: SlabTask) -> tuple[Float[Array, "tasks samples rays"], tuple[Array, ...]]:
        """Extinction, and places in the transfer function."""
        segments: Segments = self.viewed.look
        place = find(segments, _quantity(gathered))
        (extinction,) = read(segments, place, EXTINCTION)
        return jnp.where(gathered.sums[0] > 0, extinction, 0), place

    def colors(self, samples: tuple[Array, ...], task: SlabTask, channels: slice) -> list[Float[Array, "tasks samples rays"]]:
        """Colours at places in the transfer function."""
        return read(self.viewed.look, samples, channels)


def _quantity(gathered: LeafSums) -> Float[Array, "tasks samples rays"]:
    """The field; where weights are so small that one over them could overflow, without derivatives."""
    solid = gathered.sums[0] > MIN_WEIGHT * jnp.finfo(gathered.sums[0].dtype).tiny
    weight, weighted = lax.stop_gradient(gathered.sums)
    thin = jnp.where(weight > 0, weighted / jnp.where(weight > 0, weight, 1), 0)
    return gathered.reference + jnp.where(solid, gathered.sums[1] / jnp.where(solid, gathered.sums[0], 1), thin)


jax.tree_util.register_dataclass(OctreeParticles, data_fields=["octree", "seen", "particles", "transfer"], meta_fields=["kernel"])
