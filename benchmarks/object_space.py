"""Particles and points that rays find by an octree: media of jaxsph, marched by the same rays at the same samples as without.

Flow: scene -> [in_object_space: octree] -> Scene(media=...) -> render.

Particles are summed up at samples, by the leaf that each of them is in. Points have integrals along chords, or all at feet, and
are met as rays go from leaf to leaf: of the leaves of a slab that list a point, the one with the place of the ray nearest to the
centre counts it, and no other. Forward only. Shapes: (tasks, samples, rays); where rays go for themselves, one row a ray.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from octree import Leaf, Octree, Rays, build

import jaxsph as js
from jaxsph.engine.access.precision import in_units_of
from jaxsph.engine.access.view import view_particles
from jaxsph.engine.access.volume_grid import MACROCELL, VolumeGrid
from jaxsph.engine.media.points import BLOCK, PointRays, PointsMedium, _Held
from jaxsph.model.medium import Medium
from jaxsph.model.particles import kernels
from jaxsph.model.transfer.function import find, read
from jaxsph.numerics.compiled import ratio
from jaxsph.numerics.trees import tree

COLUMNS = ("x", "y", "z", "scale", "size", "quantity")  # of particles in view space
WIDTH = 8  # of a row of the table: a power of two, such that few rows lie across two lines of the cache


def in_object_space(scene: js.Scene, **how: Any) -> js.Scene:
    """The same scene with its particles and points in octrees, see `octree.build` (host side)."""
    media: list[Medium] = []
    if scene.particles is not None:
        media.append(
            OctreeParticles(tree_over(scene.particles, **how), (scene.particles, scene.transfer), kernel=scene.particles.kernel)
        )
    for points in scene.point_sets:
        if points.spread == "centres" or points.splats_beyond is not None:
            raise ValueError("`points` that are splats lie beside their rays' leaves; give `spread='chords'` or `'feet'`")
        media.append(OctreePoints(tree_over(points.spheres(), **how), points))
    return dataclasses.replace(scene, particles=None, transfer=None, points=None, media=(*media, *scene.media))


def tree_over(spheres: js.Particles, **how: Any) -> Octree:
    """The octree over those that there are."""
    valid = np.asarray(spheres.valid)
    made = build(np.asarray(spheres.position)[valid], np.asarray(spheres.support)[valid], **how)
    return dataclasses.replace(made, entry=jnp.asarray(np.flatnonzero(valid).astype(np.int32))[made.entry])


def slab_by_slab(gather: Callable[[Any], Any], task: Any) -> Any:
    """`gather` of each slab by itself: in loops over all of them each would take as long as the fullest."""
    each = jnp.arange(task.shape[0])
    return jax.tree.map(lambda of_one: of_one[:, 0], lax.map(lambda nth: gather(task.at(nth[None])), each))


@dataclasses.dataclass(frozen=True)
class InOctree(Medium):
    """What is the same for both.

    Attributes:
        octree: in world space.
        given: what it is over; None of what a camera sees.
        seen: what a camera sees, else None.
        grid: where the octree's box is in view space, in quarters of cells of its dense grid.
    """

    octree: Octree
    given: Any
    seen: Any = None
    grid: VolumeGrid | None = None

    @property
    def dtype(self) -> Any:
        """That of spheres."""
        return self.octree.side.dtype

    def with_data(self, given: Any) -> Any:
        """With nodes and entries of what it was made of, or without."""
        without = dataclasses.replace(self.octree, node=self.octree.node[:0], entry=self.octree.entry[:0])
        return dataclasses.replace(self, octree=without if given is None else given.octree)

    def occupied(self, slabs: Any) -> jax.Array:
        """Slabs that may meet a cell of the dense grid which any sphere meets."""
        return self.grid.touched(self.octree.before, slabs)

    def in_view(self, camera: js.Camera, seen: Any) -> Any:
        """In the view space of a camera, with what that sees."""
        rows = camera.axes.T * ((MACROCELL << self.octree.top) / self.octree.side)
        grid = VolumeGrid(jnp.zeros((1, 1, 1)), camera.to_view(self.octree.lower).astype(self.dtype), rows.astype(self.dtype))
        return dataclasses.replace(self, given=None, seen=seen, grid=grid)

    def in_cube(self, view: Any) -> list[jax.Array]:
        """Of places in view space, those in the unit cube."""
        return [at / (MACROCELL << self.octree.top) for at in self.grid.coordinates(view)]

    def listed(self, leaf: Leaf, nth: Any) -> tuple[jax.Array, jax.Array]:
        """Rows of the table of the nth spheres of leaves, and whether they are there."""
        there = nth < leaf.length
        sphere = self.octree.entry.at[jnp.where(there, leaf.begin + nth, 0)].get(mode="promise_in_bounds")
        return self.table.at[sphere].get(mode="promise_in_bounds"), there


@tree(static=("kernel",))
class OctreeParticles(InOctree):
    """Particles that carry one quantity; `given` has them and their transfer function, `seen` columns and segments of it."""

    kernel: str = "poly6"

    @property
    def table(self) -> jax.Array:
        """Rows of particles in view space."""
        return self.seen[0]

    def seen_by(self, camera: js.Camera) -> OctreeParticles:
        """See `Medium`."""
        if self.given is None:
            return self
        particles, transfer = in_units_of(*self.given)
        viewed = view_particles(particles, camera, jnp.stack([camera.near, camera.far]), 1)
        table = jnp.stack([getattr(viewed, name) for name in COLUMNS], 1)
        return self.in_view(camera, (jnp.pad(table, ((0, 0), (0, WIDTH - len(COLUMNS)))), transfer.segments()))

    def gather(self, task: Any) -> tuple[jax.Array, jax.Array]:
        """Sums of weights, and the quantity, by the leaves that samples are in."""
        return slab_by_slab(self._gathered, task)

    def _gathered(self, task: Any) -> tuple[jax.Array, jax.Array]:
        place, smooth = task.positions(), kernels.by_name(self.kernel)
        leaf = self.octree.leaf_of(self.octree.cells_at(self.in_cube(place)))
        near_by = self.listed(leaf, 0)[0][..., 5]  # such that a constant stays that constant

        def add(nth: jax.Array, sums: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
            rows, there = self.listed(leaf, nth)
            x, y, z, scale, size, quantity = (rows[..., k] for k in range(len(COLUMNS)))
            size = jnp.where(there, size, 0)
            away = [(at - own) * scale for at, own in zip(place, (x, y, z), strict=True)]
            square = away[0] ** 2 + away[1] ** 2 + away[2] ** 2
            weight = jnp.where(there, smooth.weigh(smooth.prepare(square, size), 0, size, jnp), 0)
            return sums[0] + weight, sums[1] + weight * (quantity - near_by)

        zero = jnp.zeros(task.shape, self.dtype)
        weight, weighted = lax.fori_loop(0, leaf.length.max(initial=0), add, (zero, zero))
        return weight, near_by + ratio(weighted, weight)

    def extinction(self, gathered: Any, task: Any) -> tuple[jax.Array, Any]:
        """Extinction, and places in the transfer function."""
        place = find(self.seen[1], gathered[1])
        return jnp.where(gathered[0] > 0, read(self.seen[1], place, slice(3, 4))[0], 0), place

    def colors(self, samples: Any, task: Any, channels: slice) -> list[jax.Array]:
        """Colours at places in the transfer function."""
        return read(self.seen[1], samples, channels)


@tree()
class OctreePoints(InOctree):
    """Points; `given` has them, `seen` is them as the medium that they are without an octree."""

    between_samples = exact_means = True

    @property
    def table(self) -> jax.Array:
        """Rows of points in view space."""
        return self.seen.table

    @property
    def fault(self) -> jax.Array:
        """Of numbers that mean nothing."""
        return self.seen.fault

    def seen_by(self, camera: js.Camera) -> OctreePoints:
        """See `Medium`."""
        return self if self.given is None else self.in_view(camera, PointsMedium.seen(self.given, camera, 0))

    def gather(self, task: Any) -> tuple[jax.Array, ...]:
        """Thickness of all samples, and thickness times red, green and blue."""
        return slab_by_slab(self._gathered, task)

    def _gathered(self, task: Any) -> tuple[jax.Array, ...]:
        tasks, samples, number = task.shape
        u, v = (coordinates.reshape(-1) for coordinates in task.ray_coordinates())
        border = jnp.repeat(task.border, number, 0)
        shown = PointRays(u[:, None], v[:, None], border[..., None], jnp.ones_like(u[:, None]), task.perspective)
        if task.perspective:
            shown = shown._replace(slant=jnp.sqrt(1 + u * u + v * v)[:, None])
        nothing, one = jnp.zeros_like(u), jnp.ones_like(u)
        start = self.in_cube((nothing, nothing, nothing) if task.perspective else (u, v, nothing))
        ahead = self.in_cube((u, v, one))
        way = [there - here for here, there in zip(start, ahead, strict=True)]
        rays = Rays(start, way, border[:, 0], border[:, -1]).in_box()

        def visit(sums: list[jax.Array], leaf: Leaf, enters: Any, leaves: Any, last: Any) -> list[jax.Array]:
            leaf, enters, leaves, last = jax.tree.map(lambda of_ray: of_ray[:, None], (leaf, enters, leaves, last))

            def add(nth: jax.Array, sums: list[jax.Array]) -> list[jax.Array]:
                rows, there = self.listed(leaf, nth * BLOCK + jnp.arange(BLOCK, dtype=jnp.int32))
                row = _Held(there, None).row(rows)
                foot = shown.nearest(type(row)(*(column[:, :, None] for column in row)))[0][..., 0]
                nearest = jnp.clip(foot, rays.begin[:, None], rays.end[:, None])
                counts = _Held(there & (nearest >= enters) & ((nearest < leaves) | last), None)
                weights = (jnp.ones_like(row.red), row.red, row.green, row.blue)

                def counted(sums: list[jax.Array]) -> list[jax.Array]:
                    thickness = self.seen._thickness(counts.row(rows), rows, counts, shown)[..., 0]
                    return [old + (w[:, :, None] * thickness).sum(1) for old, w in zip(sums, weights, strict=True)]

                return lax.cond(counts.inside.any(), counted, lambda sums: sums, sums)

            return lax.fori_loop(0, (leaf.length.max(initial=0) + BLOCK - 1) // BLOCK, add, sums)

        sums = self.octree.along(rays, visit, [jnp.zeros((tasks * number, samples), self.dtype)] * 4)
        return tuple(one.reshape(tasks, number, samples).swapaxes(1, 2) for one in sums)

    def extinction(self, gathered: Any, task: Any) -> tuple[jax.Array, Any]:
        """Mean extinction of samples."""
        return self.seen.extinction(gathered, task)

    def colors(self, samples: Any, task: Any, channels: slice) -> list[jax.Array]:
        """Weighed by thickness."""
        return self.seen.colors(samples, task, channels)
