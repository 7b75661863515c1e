r"""Points as a medium that can be asked at any point: their extinctions, added up over the leaf of an octree that it is in.

Flow: points -> octree -> [octree points: leaf -> profiles -> sums] -> integrator.

At a point the extinction is $\sum_j \xi_j f(|d_j| / r_j)$, and colours weigh by extinction: the quadrature by an integrator's
own steps that Kaehler, Abel & Hege 2007 compare the projection of points to (section 3.2). What no step meets is missed: steps
must be shorter than points are wide, where `field.points` has the integral of each of them, however small.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxsph.engine.access.octree_build import OctreePlan
from jaxsph.engine.field.tasks import SlabTask
from jaxsph.engine.media.octree_sums import Columns, LeafSums, OctreeMedium, Place, SeenSpheres, octree_over
from jaxsph.engine.media.point_rays import NUM_COLUMNS, Row
from jaxsph.engine.media.points import PointsMedium
from jaxsph.model.camera.camera import Camera
from jaxsph.model.points import Points
from jaxsph.model.profiles import Profile, Shaped

MIN_EXTINCTION = 2.0**20  # times the least normal number: below it a sample is black, as one over it could overflow


@dataclasses.dataclass(frozen=True)
class OctreePoints(OctreeMedium):
    """A point set in an octree; make it with `from_points`.

    Rounding may take a sample at the very edge of a point for one outside of it, as for `OctreeParticles`.

    Attributes:
        points: as given; None in view space.
        names: of attributes, in the order of their columns; none for radial profiles, which read none.
    """

    num_sums = 4
    masked = NUM_COLUMNS  # attributes of a point that is not there may be any, but some point's
    points: Points | None
    names: tuple[str, ...] = ()

    @classmethod
    def from_points(cls, points: Points, plan: OctreePlan | None = None) -> OctreePoints:
        """Build the octree.

        Args:
            points: of `spread="chords"` without splats, as others have no extinction at a point.
            plan: by default what `access.octree_build.plan_octree` makes on the host; to be given under jit.

        Differentiation:
            By all numbers of the points; which leaf has which points is held fixed.

        Raises:
            ValueError: for another `spread`, or with `splats_beyond`.
        """
        given = {"spread": points.spread if points.spread != "chords" else None, "splats_beyond": points.splats_beyond}
        for name, value in given.items():
            if value is not None:
                raise ValueError(
                    f"`{name}` must be left at its default for points that are asked for their extinction at any position, "
                    f"got {value!r}: what lies all at one depth has none; leave it out, or give `integrator='samples'`"
                )
        names = tuple(sorted(points.attributes)) if isinstance(points.profile, Shaped) else ()
        return cls(octree_over(points.spheres(), plan), None, points, names)

    def seen_by(self, camera: Camera) -> OctreePoints:
        """In the view space of a camera."""
        if self.points is None:
            return self
        viewed = PointsMedium.seen(self.points, camera, 0)
        of_attributes = [viewed.attributes[name].astype(viewed.table.dtype)[:, None] for name in self.names]
        columns = jnp.concatenate([viewed.table, *of_attributes], 1)
        seen = SeenSpheres.of(columns, self.octree, camera, viewed.fault, common=(viewed.profile, viewed.axes))
        return OctreePoints(lax.stop_gradient(self.octree), seen, None, self.names)

    def contribution(self, columns: Columns, place: Place, common: Any, reference: Any) -> tuple[Array, ...]:
        """Extinction, and extinction times red, green and blue."""
        profile, axes = common
        row, attributes = Row(*columns[:NUM_COLUMNS]), dict(zip(self.names, columns[NUM_COLUMNS:], strict=False))
        away = [(at - own) * row.inverse for at, own in zip(place, row[:3], strict=True)]
        square = away[0] * away[0] + away[1] * away[1] + away[2] * away[2]
        inside = square < 1
        safe = [jnp.where(inside, part, 0) for part in (square, *away)]
        share = _share(profile, axes, safe[0], safe[1:], attributes)
        extinction = jnp.where(inside, share, 0) * row.strength * row.inverse
        return extinction, extinction * row.red, extinction * row.green, extinction * row.blue

    def extinction(self, gathered: LeafSums, task: SlabTask) -> tuple[Float[Array, "tasks samples rays"], LeafSums]:
        """The sum."""
        return gathered.sums[0], gathered

    def colors(self, samples: LeafSums, task: SlabTask, channels: slice) -> list[Float[Array, "tasks samples rays"]]:
        """Weighed by extinction."""
        extinction, *weighed = samples.sums
        solid = extinction > MIN_EXTINCTION * jnp.finfo(extinction.dtype).tiny
        return [jnp.where(solid, value / jnp.where(solid, extinction, 1), 0) for value in weighed[channels]]


def _share(profile: Profile, axes: Array, square: Array, away: list[Array], attributes: dict[str, Array]) -> Array:
    """What is left of extinctions at offsets in radii, along the axes of view space."""
    if not isinstance(profile, Shaped):
        return profile.at_square(square)
    x, y, z = (axes[0, k] * away[0] + axes[1, k] * away[1] + axes[2, k] * away[2] for k in range(3))
    return profile.function((x, y, z), attributes)


jax.tree_util.register_dataclass(OctreePoints, data_fields=["octree", "seen", "points"], meta_fields=["names"])
