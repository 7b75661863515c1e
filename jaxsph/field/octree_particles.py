r"""Particles as a medium that can be asked at any point: CSPH sums over the leaf of an octree that the point is in.

Flow: particles -> octree -> [octree particles: leaf -> sums -> look-up] -> integrator.

$Q(x) = \sum q_j V_j W_j(x) / \sum V_j W_j(x)$ (Hochstetter et al. 2016, equation 2), where the sums go over those particles whose
support meets the leaf (Kaehler, Abel & Hege 2007, section 3.1). `field.particles` is many times as fast, as 64 rays share what it
finds; its lists are of slabs, while this medium takes points in any order and number.
"""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxsph.access.octree import Leaf, Octree
from jaxsph.access.octree_build import OctreePlan, build_octree, plan_octree
from jaxsph.access.quantities import rescaled
from jaxsph.access.view import view_particles
from jaxsph.field.tasks import SlabTask
from jaxsph.field.volume_grid import VolumeGrid
from jaxsph.model import kernels
from jaxsph.model.camera import Camera
from jaxsph.model.medium import Medium, OfPlaces, Total
from jaxsph.model.particles import Particles
from jaxsph.model.transfer import Segments, TransferFunction, find, read

EXTINCTION = slice(3, 4)
COLUMNS = ("x", "y", "z", "scale", "size", "quantity")  # of the table, see `access.view.Columns`
WIDTH = 8  # of its rows: a power of two, such that none lies across two lines of the cache
MIN_WEIGHT = 2.0**20  # times the least normal number: below it a sample has no cotangents, as one over it could overflow
ROUNDING = 64  # eps of the box that supports are widened by, as leaves are found by view coordinates
Place = tuple[Float[Array, "tasks samples rays"], ...]


class LeafSums(NamedTuple):
    """Sums over the particles of a leaf: of weights, and of weights times quantity less the reference."""

    weight: Float[Array, "tasks samples rays"]
    weighted: Float[Array, "tasks samples rays"]
    reference: Float[Array, "tasks samples rays"]


@dataclasses.dataclass(frozen=True)
class SeenParticles:
    """Particles in view space.

    Attributes:
        table: `COLUMNS` of each particle in a row, the rest is 0.
        segments: of the transfer function.
        grid: where the octree's box is, in macrocells of its dense grid; without values.
        fault: fault word.
    """

    table: Float[Array, "particles 8"]
    segments: Segments
    grid: VolumeGrid
    fault: Int[Array, ""]


@dataclasses.dataclass(frozen=True)
class OctreeParticles(Medium):
    """Particles in an octree; make them with `from_particles`.

    Rounding may take a sample at the very edge of a support for one outside of it, if the eye is further away than a few times
    the extent of all particles.

    Attributes:
        particles, transfer: as given; None in view space.
        octree: over supports, in world space.
        seen: what a camera sees; None in world space.
        kernel: name of the smoothing kernel.
    """

    particles: Particles | None
    transfer: TransferFunction | None
    octree: Octree
    seen: SeenParticles | None = None
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
        """
        fixed = lax.stop_gradient(particles)
        extent = jnp.where(fixed.valid[:, None], jnp.abs(fixed.position - fixed.position[0]), 0).max(initial=0)
        reach = fixed.support + ROUNDING * jnp.finfo(fixed.dtype).eps * (extent + fixed.support)
        if fixed.position_rest is not None:
            reach = reach + jnp.abs(fixed.position_rest).sum(1)
        spheres = fixed.position, reach, fixed.valid
        plan = plan_octree(*spheres) if plan is None else plan
        return cls(particles, transfer, build_octree(*spheres, plan=plan), kernel=particles.kernel)

    def seen_by(self, camera: Camera) -> OctreeParticles:
        """In the view space of a camera."""
        if self.particles is None or self.transfer is None:
            return self
        dtype = jnp.promote_types(self.particles.dtype, camera.dtype)
        transfer = jax.tree.map(lambda leaf: leaf.astype(dtype), self.transfer)
        quantity, transfer = rescaled(self.particles.quantity.astype(dtype), transfer)
        particles = dataclasses.replace(self.particles, quantity=quantity)
        viewed = view_particles(particles, camera, jnp.stack([camera.near, camera.far]).astype(dtype), 1)
        table = jnp.stack([getattr(viewed, name) for name in COLUMNS], 1)
        octree, still = lax.stop_gradient((self.octree, camera))
        cells = (still.axes.T * (octree.rate * octree.occupancy_cells)).astype(dtype)
        grid = VolumeGrid(jnp.zeros((1, 1, 1), dtype), still.to_view(octree.lower).astype(dtype), cells)
        fault = octree.fault | viewed.faults
        seen = SeenParticles(jnp.pad(table, ((0, 0), (0, WIDTH - len(COLUMNS)))), transfer.segments(), grid, fault)
        return OctreeParticles(None, None, octree, seen, self.kernel)

    def without_data(self) -> OctreeParticles:
        """Without nodes and entries."""
        empty = dataclasses.replace(self.octree, node=self.octree.node[:0], entry=self.octree.entry[:0])
        return dataclasses.replace(self, octree=empty)

    def with_data(self, given: OctreeParticles) -> OctreeParticles:
        """With those of what it was made of."""
        return dataclasses.replace(self, octree=lax.stop_gradient(given.octree))

    def _viewed(self) -> SeenParticles:
        if self.seen is None:
            raise ValueError("`OctreeParticles` is in world space; ask what `seen_by` made of it")
        return self.seen

    def faults(self) -> Int[Array, ""]:
        """Of the octree's plan, and of particles that are not usable."""
        return self.octree.fault if self.seen is None else self.seen.fault

    def occupied(self, slabs: Any) -> Bool[Array, "slabs bundles"]:
        """Slabs that may meet a cell of the dense grid which any support meets."""
        return self._viewed().grid.touched(self.octree.occupancy, slabs)

    def leaf_of(self, place: Place) -> Leaf:
        """The leaf that holds each point of view space."""
        macrocells = self._viewed().grid.coordinates(lax.stop_gradient(place))
        return self.octree.leaf_in_cube([at / self.octree.occupancy_cells for at in macrocells])[0]

    def gather(self, task: SlabTask) -> LeafSums:
        """Sums over the particles of the leaf that each sample is in.

        Differentiation:
            Forward mode; `pull` is its transpose.
        """
        place, table = task.positions(), self._viewed().table
        leaf = self.leaf_of(place)
        reference = lax.stop_gradient(_rows(table, self.octree, leaf, jnp.int32(0))[5])

        def add(nth: Array, sums: tuple[Array, Array]) -> tuple[Array, Array]:
            here = self._contribution(_rows(table, self.octree, leaf, nth), place, reference)
            return sums[0] + here[0], sums[1] + here[1]

        zero = jnp.zeros_like(reference)
        weight, weighted = lax.fori_loop(0, leaf.length.max(initial=0), add, (zero, zero))
        return LeafSums(weight, weighted, reference)

    def extinction(self, gathered: LeafSums, task: SlabTask) -> tuple[Float[Array, "tasks samples rays"], tuple[Array, ...]]:
        """Extinction, and places in the transfer function."""
        place = find(self._viewed().segments, _quantity(gathered))
        (extinction,) = read(self._viewed().segments, place, EXTINCTION)
        return jnp.where(gathered.weight > 0, extinction, 0), place

    def colors(self, samples: tuple[Array, ...], task: SlabTask, channels: slice) -> list[Float[Array, "tasks samples rays"]]:
        """Colours at places in the transfer function."""
        return read(self._viewed().segments, samples, channels)

    def pull(self, total: Total, gathered: LeafSums, task: SlabTask, cotangents: list[Array]) -> tuple[Total, OfPlaces]:
        """See `Medium.pull`; the particles of leaves are gone through once more, and what they get is scattered."""
        seen = self._viewed()

        def optics(sums: LeafSums, segments: Segments) -> list[Array]:
            return dataclasses.replace(self, seen=dataclasses.replace(seen, segments=segments)).optics(sums, task)

        of_sums, of_segments = jax.vjp(optics, gathered, seen.segments)[1](cotangents)
        place, spread = jax.vjp(lambda depth, factor: _moved(task, depth, factor), task.depth, jnp.ones_like(task.depth[0, 0]))
        leaf = self.leaf_of(place)

        def add(nth: Array, found: tuple[Array, Place]) -> tuple[Array, Place]:
            rows = _rows(seen.table, self.octree, leaf, nth)
            pulled = jax.vjp(lambda rows, place: self._contribution(rows, place, gathered.reference), rows, place)[1]
            of_rows, of_place = pulled((of_sums.weight, of_sums.weighted))
            filled = jnp.pad(jnp.stack(of_rows, -1), [(0, 0)] * 3 + [(0, WIDTH - len(COLUMNS))])
            filled = jnp.where((nth < leaf.length)[..., None], filled, 0)
            table = found[0].at[_particle(self.octree, leaf, nth)].add(filled, mode="promise_in_bounds")
            return table, tuple(old + new for old, new in zip(found[1], of_place, strict=True))

        nothing = jnp.zeros_like(seen.table), tuple(jnp.zeros_like(part) for part in place)
        of_table, of_place = lax.fori_loop(0, leaf.length.max(initial=0), add, nothing)
        of_depth, of_factor = spread(of_place)
        places = OfPlaces.none(task)._replace(depth=of_depth, factor=of_factor)
        return _added(total, of_table, of_segments), places  # type: ignore[return-value]

    def _contribution(self, rows: list[Array], place: Place, reference: Array) -> tuple[Array, Array]:
        """What particles add to both sums."""
        smooth, (x, y, z, scale, size, quantity) = kernels.by_name(self.kernel), rows
        away = [(at - own) * scale for at, own in zip(place, (x, y, z), strict=True)]
        square = away[0] * away[0] + away[1] * away[1] + away[2] * away[2]
        weight = smooth.weigh(smooth.prepare(square, size), 0, size, jnp)
        return weight, weight * (quantity - reference)


def _particle(octree: Octree, leaf: Leaf, nth: Array) -> Int[Array, "tasks samples rays"]:
    """The nth particle of each leaf; of leaves that have less, any."""
    return octree.entry.at[jnp.where(nth < leaf.length, leaf.begin + nth, 0)].get(mode="promise_in_bounds")


def _rows(table: Array, octree: Octree, leaf: Leaf, nth: Array) -> list[Float[Array, "tasks samples rays"]]:
    """Columns of the nth particle of each leaf; of leaves that have less, one without size or quantity."""
    rows = table.at[_particle(octree, leaf, nth)].get(mode="promise_in_bounds")
    rows = jnp.where((nth < leaf.length)[..., None], rows, 0)
    return [rows[..., k] for k in range(len(COLUMNS))]


def _quantity(sums: LeafSums) -> Float[Array, "tasks samples rays"]:
    """The field; where weights are so small that one over them could overflow, without derivatives."""
    solid = sums.weight > MIN_WEIGHT * jnp.finfo(sums.weight.dtype).tiny
    weight, weighted = lax.stop_gradient((sums.weight, sums.weighted))
    thin = jnp.where(weight > 0, weighted / jnp.where(weight > 0, weight, 1), 0)
    return sums.reference + jnp.where(solid, sums.weighted / jnp.where(solid, sums.weight, 1), thin)


def _moved(task: SlabTask, depth: Array, factor: Array) -> Place:
    return dataclasses.replace(task, depth=depth, u=task.u * factor, v=task.v * factor).positions()


def _added(total: Any, table: Array, segments: Any) -> Any:
    """Cotangents with those of more slabs."""
    of_segments = [
        old if more.dtype == jax.dtypes.float0 else old + more
        for old, more in zip(jax.tree.leaves(total.seen.segments), jax.tree.leaves(segments), strict=True)
    ]
    segments = jax.tree.unflatten(jax.tree.structure(total.seen.segments), of_segments)
    seen = dataclasses.replace(total.seen, table=total.seen.table + table, segments=segments)
    return dataclasses.replace(total, seen=seen)


jax.tree_util.register_dataclass(
    SeenParticles, data_fields=[field.name for field in dataclasses.fields(SeenParticles)], meta_fields=[]
)
jax.tree_util.register_dataclass(OctreeParticles, data_fields=["particles", "transfer", "octree", "seen"], meta_fields=["kernel"])
