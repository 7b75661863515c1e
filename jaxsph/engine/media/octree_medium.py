r"""Particles or points as a medium that can be asked at any point: sums over the spheres of the leaf that the point is in.

Flow: scene -> [octree_medium: in_octree] -> scene; [octree_medium: leaf -> spheres -> sums -> optics] -> integrator.

Every leaf has an entry for each sphere that meets it (Kaehler, Abel & Hege 2007, section 3.1), so a point looks at one leaf
alone, and points may come in any order and number. `field.particles` and `field.points` are faster at samples, where the rays of
a bundle share what they find, but their lists are of slabs. Shapes: (tasks, samples, rays).

Of particles the field is $Q(x) = \sum q_j V_j W_j(x) / \sum V_j W_j(x)$ (Hochstetter et al. 2016, equation 2). Of points the
extinction is $\sum_j \xi_j f(|d_j| / r_j)$, and colours weigh by extinction: the quadrature by an integrator's own steps that
Kaehler, Abel & Hege 2007 compare the projection of points to (section 3.2). What no step meets is missed: steps must be shorter
than points are wide, where `field.points` has the integral of each of them, however small.

Rounding may take a sample at the very edge of a sphere for one outside of it, if the eye is further away than a few times the
extent of all spheres.
"""

from __future__ import annotations

import abc
import dataclasses
import functools
from typing import Any, ClassVar, NamedTuple, Self

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxsph.engine.access.octree import Leaf, Octree, build_octree
from jaxsph.engine.access.precision import in_units_of
from jaxsph.engine.access.view import view_particles
from jaxsph.engine.access.volume_grid import VolumeGrid
from jaxsph.engine.field.sums import pull_blocks
from jaxsph.engine.field.tasks import SlabTask
from jaxsph.engine.media.points import NUM_COLUMNS, PointsMedium, Row
from jaxsph.engine.media.shown import Within
from jaxsph.model.camera.camera import Camera
from jaxsph.model.medium import Cotangents, Medium, Places
from jaxsph.model.particles import kernels
from jaxsph.model.particles.particles import Particles
from jaxsph.model.particles.periodic import with_ghosts
from jaxsph.model.points import Points, Shaped
from jaxsph.model.scene import Scene
from jaxsph.model.transfer.function import Segments, TransferFunction, find, read
from jaxsph.numerics.checks import is_traced
from jaxsph.numerics.compiled import ratio
from jaxsph.numerics.trees import tree

WIDTH = 8  # columns of a table, or a multiple: a power of two, such that few rows lie across two lines of the cache
ROUNDING = 64  # eps of the box that spheres are widened by, as leaves are found by view coordinates
EXTINCTION = slice(3, 4)
OF_PARTICLES = ("x", "y", "z", "scale", "size", "quantity")  # columns, see `access.view.Columns`
Columns = list[Float[Array, "tasks samples rays"]]
Place = tuple[Float[Array, "tasks samples rays"], ...]
Found = tuple[tuple[Array, ...], Any]  # sums over the spheres of a leaf, and what they are relative to, if to anything


class SeenSpheres(NamedTuple):
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
    def of(cls, columns: Array, octree: Octree, camera: Camera, fault: Array, common: Any = (), look: Any = ()) -> SeenSpheres:
        """With columns of view space, in a table of whole lines."""
        dtype, still = columns.dtype, lax.stop_gradient(camera)
        cells = (still.axes.T * (octree.occupancy_cells / octree.side)).astype(dtype)
        grid = VolumeGrid(jnp.zeros((1, 1, 1), dtype), still.to_view(octree.lower).astype(dtype), cells)
        return cls(jnp.pad(columns, ((0, 0), (0, -columns.shape[1] % WIDTH))), common, look, grid, fault)


@dataclasses.dataclass(frozen=True)
class OctreeMedium(Medium):
    """Spheres in an octree, each of which adds to sums what it has at a point; and nothing outside of it.

    Differentiation:
        By all numbers of the spheres, and of what they look like; which leaf has which is held fixed.

    Attributes:
        octree: over spheres, in world space.
        seen: what a camera sees; None in world space.
        num_sums: that contributions are added up in.
    """

    num_sums: ClassVar[int]
    octree: Octree
    seen: SeenSpheres | None

    @abc.abstractmethod
    def contribution(self, columns: Columns, place: Place, common: Any, reference: Any) -> tuple[Array, ...]:
        """What spheres, given by their columns, add to each sum; nothing where the first `WIDTH` are 0."""

    def reference(self, first: Columns) -> Any:
        """What sums are taken relative to, by the first sphere of each leaf; by default nothing."""
        return None

    @property
    def dtype(self) -> Any:
        """That of spheres."""
        return self.octree.side.dtype

    def with_data(self, given: OctreeMedium | None) -> Self:
        """With nodes and entries of what it was made of, or without."""
        without = dataclasses.replace(self.octree, node=self.octree.node[:0], entry=self.octree.entry[:0])
        return dataclasses.replace(self, octree=without if given is None else lax.stop_gradient(given.octree))

    @property
    def viewed(self) -> SeenSpheres:
        """What a camera sees."""
        if self.seen is None:
            raise ValueError(f"`{type(self).__name__}` is in world space; ask what `seen_by` made of it")
        return self.seen

    @property
    def fault(self) -> Int[Array, ""]:  # type: ignore[override]
        """Of spheres that are not usable."""
        return self.viewed.fault

    def occupied(self, slabs: Any) -> Bool[Array, "slabs bundles"]:
        """Slabs that may meet a cell of the dense grid which any sphere meets."""
        return self.viewed.grid.touched(self.octree.occupancy, slabs)

    def leaf_of(self, place: Place) -> Leaf:
        """The leaf that holds each point of view space."""
        macrocells = self.viewed.grid.coordinates(lax.stop_gradient(place))
        return self.octree.leaf_at([at / self.octree.occupancy_cells for at in macrocells])

    def gather(self, task: SlabTask) -> Found:
        """Sums over the spheres of the leaf that each sample is in.

        Differentiation:
            Forward mode; `pull_gather` is its transpose.
        """
        place, seen = task.positions(), self.viewed
        leaf = self.leaf_of(place)
        _, first, there = self._fetch(leaf, jnp.int32(0))
        reference = lax.stop_gradient(self.reference(_columns(first, there)))

        def add(nth: Array, sums: tuple[Array, ...]) -> tuple[Array, ...]:
            _, rows, there = self._fetch(leaf, nth)
            here = self.contribution(_columns(rows, there), place, seen.common, reference)
            return tuple(old + new for old, new in zip(sums, here, strict=True))

        zero = (jnp.zeros(task.shape, seen.table.dtype),) * self.num_sums
        return lax.fori_loop(0, leaf.length.max(initial=0), add, zero), reference

    def pull_gather(self, total: Cotangents, gathered: Found, task: SlabTask, cotangents: Found) -> tuple[Cotangents, Places]:
        """See `Medium.pull_gather`: the spheres of leaves are gone through once more."""
        place, moved = jax.vjp(lambda places: places.moved(task).positions(), Places.of(task))
        leaf, seen = self.leaf_of(place), total.own.seen

        def sums(rows: Array, shared: tuple[Any, Place], there: Array) -> tuple[Array, ...]:
            common, place = shared
            return self.contribution(_columns(rows, there), place, common, gathered[1])

        fetch, turns = functools.partial(self._fetch, leaf), (0, leaf.length.max(initial=0))
        table, (common, of_place) = pull_blocks(sums, fetch, turns, seen.table, (self.viewed.common, place), cotangents[0])
        seen = seen._replace(table=table, common=jax.tree.map(jnp.add, seen.common, common))
        return total._replace(own=dataclasses.replace(total.own, seen=seen)), moved(of_place)[0]

    def _fetch(self, leaf: Leaf, nth: Array) -> tuple[Int[Array, "tasks samples rays"], Array, Array]:
        """The nth sphere of each leaf, its row of the table, and whether it is there; of leaves that have less it is any."""
        there = nth < leaf.length
        sphere = self.octree.entry.at[jnp.where(there, leaf.begin + nth, 0)].get(mode="promise_in_bounds")
        return sphere, self.viewed.table.at[sphere].get(mode="promise_in_bounds"), there


def _columns(rows: Float[Array, "tasks samples rays columns"], there: Bool[Array, "tasks samples rays"]) -> Columns:
    """Of rows of the table; where none is `there` the first `WIDTH` are 0."""
    return [jnp.where(there, rows[..., k], 0) if k < WIDTH else rows[..., k] for k in range(rows.shape[-1])]


@tree(static=("kernel",))
class OctreeParticles(OctreeMedium):
    """Particles in an octree; make them with `of`.

    Attributes:
        particles, transfer: as given; None in view space.
        kernel: name of the smoothing kernel.
    """

    num_sums = 2
    particles: Particles | None
    transfer: TransferFunction | None
    kernel: str = "poly6"

    @classmethod
    def of(cls, particles: Particles, transfer: TransferFunction) -> OctreeParticles:
        """Build the octree (host side).

        Args:
            particles: any; in an order such as `jaxsph.prepare` gives, they are found faster.
            transfer: maps their quantity to colour and extinction.

        Raises:
            ValueError: of particles that carry two quantities.
        """
        if particles.extinction_quantity is not None:
            raise ValueError(
                "`particles` in an octree carry one quantity, and these carry two (`quantity=(A, B)`); give "
                "`integrator='samples'` or `'segments'`, which take those as they are, or particles with a single `quantity`"
            )
        return cls(octree_over(particles), None, particles, transfer, particles.kernel)

    def seen_by(self, camera: Camera) -> OctreeParticles:
        """In the view space of a camera."""
        if self.particles is None or self.transfer is None:
            return self
        dtype = jnp.promote_types(self.particles.dtype, camera.dtype)
        transfer = jax.tree.map(lambda leaf: leaf.astype(dtype), self.transfer)
        particles, transfer = in_units_of(self.particles, transfer)
        viewed = view_particles(particles, camera, jnp.stack([camera.near, camera.far]).astype(dtype), 1)
        columns, octree = jnp.stack([getattr(viewed, name) for name in OF_PARTICLES], 1), lax.stop_gradient(self.octree)
        seen = SeenSpheres.of(columns, octree, camera, viewed.faults, look=transfer.segments())
        return OctreeParticles(octree, seen, None, None, self.kernel)

    def contribution(self, columns: Columns, place: Place, common: Any, reference: Any) -> tuple[Array, Array]:
        """Weight, and weight times quantity less the reference."""
        smooth, (x, y, z, scale, size, quantity, *_) = kernels.by_name(self.kernel), columns
        square, _ = _offset(place, (x, y, z), scale)
        weight = smooth.weigh(smooth.prepare(square, size), 0, size, jnp)
        return weight, weight * (quantity - reference)

    def reference(self, first: Columns) -> Array:
        """A quantity near by, such that a constant stays that constant."""
        return first[OF_PARTICLES.index("quantity")]

    def extinction(self, gathered: Found, task: SlabTask) -> tuple[Float[Array, "tasks samples rays"], tuple[Array, ...]]:
        """Extinction, and places in the transfer function."""
        segments: Segments = self.viewed.look
        weight, weighted = gathered[0]
        place = find(segments, gathered[1] + ratio(weighted, weight))
        (extinction,) = read(segments, place, EXTINCTION)
        return jnp.where(weight > 0, extinction, 0), place

    def colors(self, samples: tuple[Array, ...], task: SlabTask, channels: slice) -> list[Float[Array, "tasks samples rays"]]:
        """Colours at places in the transfer function."""
        return read(self.viewed.look, samples, channels)


@tree(static=("names",))
class OctreePoints(OctreeMedium):
    """A point set in an octree; make it with `of`.

    Attributes:
        points: as given; None in view space.
        names: of attributes, see `PointsMedium`.
    """

    num_sums = 4
    points: Points | None
    names: tuple[str, ...] = ()

    @classmethod
    def of(cls, points: Points) -> OctreePoints:
        """Build the octree (host side).

        Args:
            points: of `spread="chords"` without splats, as others have no extinction at a point.

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
        return cls(octree_over(points.spheres()), None, points)

    def seen_by(self, camera: Camera) -> OctreePoints:
        """In the view space of a camera."""
        if self.points is None:
            return self
        viewed, octree = PointsMedium.seen(self.points, camera, 0), lax.stop_gradient(self.octree)
        seen = SeenSpheres.of(viewed.table, octree, camera, viewed.fault, common=(viewed.profile, viewed.axes))
        return OctreePoints(octree, seen, None, viewed.names)

    def contribution(self, columns: Columns, place: Place, common: Any, reference: Any) -> tuple[Array, ...]:
        """Extinction, and extinction times red, green and blue."""
        (profile, axes), row = common, Row(*columns[:NUM_COLUMNS])
        square, away = _offset(place, row[:3], row.inverse)
        inside = square < 1
        square, x, y, z = (jnp.where(inside, part, 0) for part in (square, *away))
        if isinstance(profile, Shaped):
            attributes = dict(zip(self.names, columns[NUM_COLUMNS:], strict=False))
            in_world = [axes[0, k] * x + axes[1, k] * y + axes[2, k] * z for k in range(3)]
            share = profile.function((in_world[0], in_world[1], in_world[2]), attributes)
        else:
            share = profile.at_square(square)
        extinction = jnp.where(inside, share, 0) * row.strength * row.inverse
        return extinction, extinction * row.red, extinction * row.green, extinction * row.blue

    def extinction(self, gathered: Found, task: SlabTask) -> tuple[Float[Array, "tasks samples rays"], Found]:
        """The sum."""
        return gathered[0][0], gathered

    def colors(self, samples: Found, task: SlabTask, channels: slice) -> list[Float[Array, "tasks samples rays"]]:
        """Weighed by extinction."""
        extinction, *weighed = samples[0]
        return [ratio(value, extinction) for value in weighed[channels]]


def octree_over(spheres: Particles) -> Octree:
    """The octree over supports, widened by what view coordinates may be off (host side)."""
    position, support, valid = (np.asarray(column) for column in (spheres.position, spheres.support, spheres.valid))
    with np.errstate(over="ignore", invalid="ignore"):  # of what is not usable `faults` tells
        extent = np.abs(position - position[:1])[valid].max(initial=0)
        reach = support + ROUNDING * np.finfo(support.dtype).eps * (extent + support)
        if spheres.position_rest is not None:
            reach = reach + np.abs(np.asarray(spheres.position_rest)).sum(1)
        return build_octree(position, reach, valid)


def _offset(place: Place, centre: tuple[Array, ...], scale: Array) -> tuple[Array, Columns]:
    """Squares of distances from centres, in units of one over `scale`, and the offsets."""
    x, y, z = ((at - own) * scale for at, own in zip(place, centre, strict=True))
    return x * x + y * y + z * z, [x, y, z]


def in_octree(scene: Scene) -> Scene:
    """The same scene with its particles and points in octrees, to be rendered from anywhere, any number of times (host side).

    Integrators that choose for themselves where they ask media (`"step_doubling"`) take any scene so. `jaxsph.render` does this
    for them by itself, in each call. With `"samples"` scenes are faster as they are: there rays share what they find.

    Differentiation:
        By all numbers of particles, transfer function and points that the scene given back holds in its media; which leaf has
        which is held fixed.

    Raises:
        ValueError: under a trace; for particles of two quantities; for points that are spread at "centres", or
            splats, which have no extinction at a point.
    """
    scene.check_without_surface("octrees")
    if is_traced(scene):
        raise ValueError(
            "`scene` must be of concrete arrays, as octrees are built on the host; call `in_octree` outside of `jax.jit` and "
            "`jax.grad`, and give them the scene that it returns"
        )
    media: list[Medium] = []
    if scene.particles is not None and scene.transfer is not None:
        particles = OctreeParticles.of(with_ghosts(scene.particles), scene.transfer)
        media = [Within.of(particles, scene.particles.box)]
    media += [OctreePoints.of(points) for points in scene.point_sets]
    return dataclasses.replace(scene, particles=None, transfer=None, points=None, media=(*media, *scene.media))
