r"""Sums over the spheres of the leaf that a point is in: what media in octrees have in common, and the transpose of it.

Flow: octree, spheres -> [octree sums: leaf -> spheres -> sums] -> octree particles, octree points.

Every leaf has an entry for each sphere that meets it (Kaehler, Abel & Hege 2007, section 3.1), so a point looks at one leaf
alone, and points may come in any order and number. Shapes: (tasks, samples, rays).
"""

from __future__ import annotations

import abc
import dataclasses
from typing import Any, ClassVar, NamedTuple, Self

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxsph.engine.access.octree import Leaf, Octree
from jaxsph.engine.access.octree_build import OctreePlan, build_octree, plan_octree
from jaxsph.engine.field.tasks import SlabTask
from jaxsph.engine.media.volume_grid import VolumeGrid
from jaxsph.model.camera.camera import Camera
from jaxsph.model.medium import Medium, OfPlaces, Total
from jaxsph.model.particles import Particles

WIDTH = 8  # columns of a table, or a multiple: a power of two, such that few rows lie across two lines of the cache
ROUNDING = 64  # eps of the box that spheres are widened by, as leaves are found by view coordinates
Columns = list[Float[Array, "tasks samples rays"]]
Place = tuple[Float[Array, "tasks samples rays"], ...]
Spheres = tuple[Float[Array, "spheres 3"], Float[Array, " spheres"], Bool[Array, " spheres"]]


class LeafSums(NamedTuple):
    """Sums over the spheres of a leaf, and what they are relative to, if to anything."""

    sums: tuple[Float[Array, "tasks samples rays"], ...]
    reference: Any


@dataclasses.dataclass(frozen=True)
class SeenSpheres:
    """Spheres in view space.

    Attributes:
        table: columns of each sphere in a row, the rest is 0; centres come first.
        common: what the contributions of all spheres depend on, floating alone.
        look: what optics at samples are made of sums by.
        grid: where the octree's box is, in macrocells of its dense grid; without values.
        fault: fault word.
    """

    table: Float[Array, "spheres columns"]
    common: Any
    look: Any
    grid: VolumeGrid
    fault: Int[Array, ""]

    @classmethod
    def of(
        cls, columns: Float[Array, "spheres columns"], octree: Octree, camera: Camera, fault: Array, **more: Any
    ) -> SeenSpheres:
        """With columns of view space, in a table of whole lines."""
        dtype = columns.dtype
        octree, still = lax.stop_gradient((octree, camera))
        cells = (still.axes.T * (octree.rate * octree.occupancy_cells)).astype(dtype)
        grid = VolumeGrid(jnp.zeros((1, 1, 1), dtype), still.to_view(octree.lower).astype(dtype), cells)
        table = jnp.pad(columns, ((0, 0), (0, -columns.shape[1] % WIDTH)))
        return cls(table, grid=grid, fault=octree.fault | fault, **({"common": (), "look": ()} | more))


@dataclasses.dataclass(frozen=True)
class OctreeMedium(Medium):
    """Spheres in an octree, each of which adds to sums what it has at a point; and nothing outside of it.

    Attributes:
        octree: over spheres, in world space.
        seen: what a camera sees; None in world space.
        num_sums: that contributions are added up in.
        masked: the first so many columns are 0 where a leaf has no more spheres, such that these contribute 0.
    """

    num_sums: ClassVar[int]
    masked: ClassVar[int] = WIDTH
    octree: Octree
    seen: SeenSpheres | None

    @abc.abstractmethod
    def contribution(self, columns: Columns, place: Place, common: Any, reference: Any) -> tuple[Array, ...]:
        """What spheres, given by their columns, add to each sum."""

    def reference(self, first: Columns) -> Any:
        """What sums are taken relative to, by the first sphere of each leaf; by default nothing."""
        return None

    @property
    def dtype(self) -> Any:
        """That of spheres."""
        return self.octree.side.dtype

    def without_data(self) -> Self:
        """Without nodes and entries."""
        empty = dataclasses.replace(self.octree, node=self.octree.node[:0], entry=self.octree.entry[:0])
        return dataclasses.replace(self, octree=empty)

    def with_data(self, given: OctreeMedium) -> Self:
        """With those of what it was made of."""
        return dataclasses.replace(self, octree=lax.stop_gradient(given.octree))

    @property
    def viewed(self) -> SeenSpheres:
        """What a camera sees."""
        if self.seen is None:
            raise ValueError(f"`{type(self).__name__}` is in world space; ask what `seen_by` made of it")
        return self.seen

    def faults(self) -> Int[Array, ""]:
        """Of the octree's plan, and of spheres that are not usable."""
        return self.octree.fault if self.seen is None else self.seen.fault

    def occupied(self, slabs: Any) -> Bool[Array, "slabs bundles"]:
        """Slabs that may meet a cell of the dense grid which any sphere meets."""
        return self.viewed.grid.touched(self.octree.occupancy, slabs)

    def leaf_of(self, place: Place) -> Leaf:
        """The leaf that holds each point of view space."""
        macrocells = self.viewed.grid.coordinates(lax.stop_gradient(place))
        return self.octree.leaf_in_cube([at / self.octree.occupancy_cells for at in macrocells])[0]

    def gather(self, task: SlabTask) -> LeafSums:
        """Sums over the spheres of the leaf that each sample is in.

        Differentiation:
            Forward mode; `pull` is its transpose.
        """
        place, seen = task.positions(), self.viewed
        leaf = self.leaf_of(place)
        reference = lax.stop_gradient(self.reference(self._columns(leaf, jnp.int32(0))))

        def add(nth: Array, sums: tuple[Array, ...]) -> tuple[Array, ...]:
            here = self.contribution(self._columns(leaf, nth), place, seen.common, reference)
            return tuple(old + new for old, new in zip(sums, here, strict=True))

        zero = (jnp.zeros(task.shape, seen.table.dtype),) * self.num_sums
        return LeafSums(lax.fori_loop(0, leaf.length.max(initial=0), add, zero), reference)

    def pull(self, total: Total, gathered: LeafSums, task: SlabTask, cotangents: list[Array]) -> tuple[Total, OfPlaces]:
        """See `Medium.pull`; the spheres of leaves are gone through once more, and what they get is scattered."""
        seen = self.viewed

        def optics(sums: LeafSums, look: Any) -> list[Array]:
            return dataclasses.replace(self, seen=dataclasses.replace(seen, look=look)).optics(sums, task)

        of_sums, of_look = jax.vjp(optics, gathered, seen.look)[1](cotangents)
        place, moved = jax.vjp(lambda depth, factor: _moved(task, depth, factor), task.depth, jnp.ones_like(task.depth[0, 0]))
        leaf = self.leaf_of(place)

        def add(nth: Array, found: tuple[Array, Any, Place]) -> tuple[Array, Any, Place]:
            def contribution(columns: Columns, common: Any, place: Place) -> tuple[Array, ...]:
                return self.contribution(columns, place, common, gathered.reference)

            inputs = self._columns(leaf, nth), seen.common, place
            of_columns, *more = jax.vjp(contribution, *inputs)[1](of_sums.sums)
            of_rows = jnp.where((nth < leaf.length)[..., None], jnp.stack(of_columns, -1), 0)
            table = found[0].at[self._sphere(leaf, nth)].add(of_rows, mode="promise_in_bounds")
            return table, *jax.tree.map(jnp.add, found[1:], tuple(more))

        nothing = jax.tree.map(jnp.zeros_like, (seen.table, seen.common, place))
        of_table, of_common, of_place = lax.fori_loop(0, leaf.length.max(initial=0), add, nothing)
        of_depth, of_factor = moved(of_place)
        places = OfPlaces.none(task)._replace(depth=of_depth, factor=of_factor)
        return _added(total, (of_table, of_common, of_look)), places

    def _sphere(self, leaf: Leaf, nth: Array) -> Int[Array, "tasks samples rays"]:
        """The nth sphere of each leaf; of leaves that have less, any."""
        return self.octree.entry.at[jnp.where(nth < leaf.length, leaf.begin + nth, 0)].get(mode="promise_in_bounds")

    def _columns(self, leaf: Leaf, nth: Array) -> Columns:
        """Columns of the nth sphere of each leaf; of leaves that have less, those that are `masked` are 0."""
        rows, there = self.viewed.table.at[self._sphere(leaf, nth)].get(mode="promise_in_bounds"), nth < leaf.length
        return [jnp.where(there, rows[..., k], 0) if k < self.masked else rows[..., k] for k in range(rows.shape[-1])]


def octree_over(spheres: Particles, plan: OctreePlan | None) -> Octree:
    """The octree over supports, widened by what view coordinates may be off."""
    reaching = reach_of(spheres)
    return build_octree(*reaching, plan=plan_octree(*reaching) if plan is None else plan)


def reach_of(spheres: Particles) -> Spheres:
    """Centres and widened radii, and which there are: what `plan_octree` counts and `build_octree` builds by."""
    fixed = lax.stop_gradient(spheres)
    extent = jnp.where(fixed.valid[:, None], jnp.abs(fixed.position - fixed.position[0]), 0).max(initial=0)
    reach = fixed.support + ROUNDING * jnp.finfo(fixed.dtype).eps * (extent + fixed.support)
    if fixed.position_rest is not None:
        reach = reach + jnp.abs(fixed.position_rest).sum(1)
    return fixed.position, reach, fixed.valid


def _moved(task: SlabTask, depth: Array, factor: Array) -> Place:
    return dataclasses.replace(task, depth=depth, u=task.u * factor, v=task.v * factor).positions()


def _added(total: Any, more: tuple[Any, ...]) -> Any:
    """Cotangents of what is seen with those of more slabs: of its table, what is common, and its look."""
    before = total.seen.table, total.seen.common, total.seen.look
    added = [
        old if new.dtype == jax.dtypes.float0 else old + new
        for old, new in zip(jax.tree.leaves(before), jax.tree.leaves(more), strict=True)
    ]
    table, common, look = jax.tree.unflatten(jax.tree.structure(before), added)
    return dataclasses.replace(total, seen=dataclasses.replace(total.seen, table=table, common=common, look=look))


jax.tree_util.register_dataclass(
    SeenSpheres, data_fields=[field.name for field in dataclasses.fields(SeenSpheres)], meta_fields=[]
)
