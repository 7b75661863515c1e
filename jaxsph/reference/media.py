"""What a scene has along rays, in float64: particles, volumes and points at the nodes of portions.

Flow: scene, rays -> [media] -> cuts of rays; portions -> [media] -> extinction and emission at nodes.
"""

from __future__ import annotations

import abc
import itertools

import numpy as np

from jaxsph.model.camera.camera import Camera
from jaxsph.model.clips import Clip
from jaxsph.model.particles import kernels
from jaxsph.model.particles.particles import Particles
from jaxsph.model.points import Points
from jaxsph.model.scene import Scene
from jaxsph.model.transfer.function import TransferFunction
from jaxsph.model.volume import Volume
from jaxsph.reference.image import at_offset, kinks
from jaxsph.reference.looks import NODES, PLACE, AtNodes, look_up, tables_of
from jaxsph.reference.where import (
    NO_CHORDS,
    Chords,
    Cuts,
    Portions,
    Rays,
    batches,
    borders,
    chords_of,
    columns_of,
    crossings,
    cut,
    inside,
    ranges,
    shadows_of,
    to_view,
    to_world,
)

INWARDS = 1e-9  # of a portion: how far inside its ends particles are looked at, where those that begin there weigh something
PAIRS = 1 << 12  # of a portion and a chord, whose nodes are looked at at once: what a cache holds


class Part(abc.ABC):
    """One part of a scene in its clip, as a camera sees it; once rays `meet` it, the rest is about these.

    Attributes:
        chords: what rays have inside its spheres; none of a part that is not made of spheres.
        shown: mask of the roots that it has something in.
    """

    chords: Chords = NO_CHORDS
    shown: np.ndarray

    def __init__(self, camera: Camera, clip: Clip | None):
        self._camera, self._clip = camera, clip

    def meet(self, rays: Rays) -> list[Cuts]:
        """Where it begins or ends, and what else portions must not hold inside, as faces of its clip."""
        self._rays, self._start = rays, to_world(rays.start, self._camera)
        self._direction = rays.direction @ self._camera.exact_axes()
        if self._clip is None:
            return []
        depth = crossings(self._clip, self._start, self._direction)
        ray, place = np.nonzero(~np.isnan(depth))
        return [(ray, depth[ray, place])]

    def take(self, roots: Portions) -> None:
        """Have these for roots, which all other portions are parts of, and find those that it has something in."""
        middle = (roots.start + roots.end) / 2
        self.shown = inside(self._clip, self._start[roots.ray] + middle[:, None] * self._direction[roots.ray])

    @abc.abstractmethod
    def add(self, seen: AtNodes, portions: Portions) -> None:
        """Add what it has at nodes of portions."""

    def border_by(self, portions: Portions) -> np.ndarray:
        """The border nearest to the middle of each portion, where only a derivative jumps, or NaN."""
        return np.full(len(portions.ray), np.nan)


def parts_of(scene: Scene, camera: Camera) -> list[Part]:
    """All of a scene: particles, volumes, points."""
    parts: list[Part] = []
    if scene.particles is not None and scene.transfer is not None:
        parts.append(ParticlesPart(scene.particles, scene.transfer, camera, scene.particles_within))
    parts += [_VolumePart(volume, look, camera, scene.within) for volume, look in scene.volumes]
    return parts + [_PointsPart(points, camera, scene.within) for points in scene.point_sets]


def roots_of(parts: list[Part], rays: Rays, *, empty: bool = False) -> Portions:
    """The portions that rays are first cut into: those that any part has something in, or the `empty` ones, too."""
    roots = cut(rays, [cuts for part in parts for cuts in part.meet(rays)])
    for part in parts:
        part.take(roots)
    return roots if empty else roots.some(np.logical_or.reduce([part.shown for part in parts]))


def at_nodes(parts: list[Part], portions: Portions) -> AtNodes:
    """What parts have at nodes of portions, in all."""
    count = len(portions.ray)
    weight, doubt, evaluations = np.zeros((3, count))
    seen = AtNodes(np.zeros((NODES, count)), np.zeros((3, NODES, count)), np.full(count, np.nan), weight, doubt, evaluations, [])
    for part in parts:
        part.add(seen, portions)
    return seen


class _SpheresPart(Part):
    """What is made of spheres."""

    def __init__(self, position: np.ndarray, radius: np.ndarray, camera: Camera, clip: Clip | None):
        super().__init__(camera, clip)
        self._center, self._radius = to_view(position, camera), radius
        self._shadows = shadows_of(self._center, radius, camera.is_perspective)

    def meet(self, rays: Rays) -> list[Cuts]:
        self.chords = chords_of(self._center, self._radius, self._shadows, rays)
        return super().meet(rays)

    def take(self, roots: Portions) -> None:
        """List the chords, too, that lie over each root i: `_chord[_first[i] : _first[i] + _length[i]]`."""
        super().take(roots)
        rays, chords = self._rays, self.chords
        width = 2 * (rays.far - rays.near)

        def key(ray: np.ndarray, depth: np.ndarray) -> np.ndarray:
            return ray * width + np.clip(depth, rays.near, rays.far) - rays.near

        last = len(roots.ray) - 1
        first = np.searchsorted(key(roots.ray, roots.end), key(chords.ray, chords.entry)) - 1  # keys are rounded: one more
        beyond = np.searchsorted(key(roots.ray, roots.start), key(chords.ray, chords.exit)) + 1
        first, beyond = np.clip(first, 0, last), np.clip(beyond, 0, last + 1)
        chord, root = ranges(first, np.maximum(beyond - first, 0))
        over = (roots.ray[root] == chords.ray[chord]) & (chords.entry[chord] < roots.end[root])
        over &= chords.exit[chord] > roots.start[root]
        chord, root = chord[over], root[over]
        self._length = np.bincount(root, minlength=len(roots.ray))
        self._first = np.cumsum(self._length) - self._length
        small = root.astype(np.uint16) if last < 1 << 16 else root  # which sorts faster
        self._chord = chord[np.argsort(small, kind="stable")]
        self.shown &= self._length > 0

    def over(self, root: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pairs of a portion (a place in `root`) and a chord, portion by portion."""
        which, place = ranges(self._first[root], self._length[root])
        return which, self._chord[place]


class ParticlesPart(_SpheresPart):
    """Particles, each at its `entry` of the set, with copies where that is periodic; those of no volume are not there."""

    def __init__(self, particles: Particles, transfer: TransferFunction, camera: Camera, clip: Clip | None):
        columns = columns_of(particles)
        position, self.entry, support, volume, *quantities = (column[columns[3] > 0] for column in columns)
        super().__init__(position, support, camera, clip)
        strength = volume / support**3
        self._columns = strength / max(strength.max(initial=0), np.finfo(float).tiny), *quantities
        self._kernel, self._tables = kernels.by_name(particles.kernel), tables_of(transfer)

    def meet(self, rays: Rays) -> list[Cuts]:
        """See `Part`."""
        faces = super().meet(rays)
        self._scale = rays.slant[self.chords.ray] / self._radius[self.chords.sphere]
        self._strength, *self._quantities = (column[self.chords.sphere] for column in self._columns)
        return [*faces, borders(self.chords, 1 / self._scale)]

    def add(self, seen: AtNodes, portions: Portions) -> None:
        """See `Part`."""
        which = np.flatnonzero(self.shown[portions.root])
        count = self._length[portions.root[which]]
        seen.evaluations[which] += NODES * count
        means = np.empty((len(self._quantities), NODES, len(which)))
        for some in batches(count, PAIRS):
            means[:, :, some] = self._means(portions.some(which[some]))
        look_up(self._tables, seen, which, [_filled(quantity) for quantity in means], portions, self._rays.slant)

    def _weights(self, portions: Portions) -> tuple[np.ndarray, ...]:
        """Pairs of a portion and a chord over it, V W of each at nodes (nodes, pairs), first pairs of portions, sums over theirs.

        With t = 1 - (r / H)^2 as the product of the distances to entry and exit, which loses no digits near them.
        """
        which, chord = self.over(portions.root)
        middle, half = portions.middles()
        scale, at = self._scale[chord], middle[which]
        place = PLACE.copy()
        place[[0, -1]] *= 1 - INWARDS
        along = place[:, None] * (half[which] * scale)
        into, left = (at - self.chords.entry[chord]) * scale, (self.chords.exit[chord] - at) * scale
        inside = np.clip((into + along) * (left - along), 0, 1)
        weight = self._strength[chord] * self._kernel.of_square(1 - inside, np)
        first = np.searchsorted(which, np.arange(len(portions.ray)))
        return which, chord, weight, first, np.add.reduceat(weight, first, axis=1)

    def _means(self, portions: Portions) -> list[np.ndarray]:
        """All Q at nodes of portions (nodes, portions), relative to the first particle of each; NaN where nothing weighs."""
        which, chord, weight, first, total = self._weights(portions)
        found = []
        for quantity in self._quantities:
            base = quantity[chord[first]]
            moved = np.add.reduceat(weight * (quantity[chord] - base[which]), first, axis=1)
            found.append(base + np.divide(moved, total, out=np.full_like(total, np.nan), where=total > 0))
        return found

    def shared(self, amounts: np.ndarray, portions: Portions) -> np.ndarray:
        """What is at nodes of portions (nodes, portions), dealt out to chords as V W there."""
        found, held = np.zeros(len(self.chords.ray)), np.flatnonzero(self._length[portions.root])
        for some in batches(self._length[portions.root[held]], PAIRS):
            which, chord, weight, _, total = self._weights(portions.some(held[some]))
            each = np.divide(amounts[:, held[some]], total, out=np.zeros_like(total), where=total > 0)
            found += np.bincount(chord, (weight * each[:, which]).sum(0), len(found))
        return found

    def border_by(self, portions: Portions) -> np.ndarray:
        """See `Part`."""
        which, chord = self.over(portions.root)
        middle, half = portions.middles()
        which, border = np.tile(which, 2), np.concatenate([self.chords.entry[chord], self.chords.exit[chord]])
        off = np.abs(border - middle[which])
        near = off < half[which] / 2
        which, border, off = which[near], border[near], off[near]
        order = np.lexsort((-off, which))
        found = np.full(len(portions.ray), np.nan)
        found[which[order]] = border[order]  # the last is the nearest
        return found


def _filled(quantity: np.ndarray) -> np.ndarray:
    """With its neighbour's where nothing weighs in float64, as at an end that is less than an eps away."""
    for nodes in (quantity, quantity[::-1]):
        for before, node in itertools.pairwise(nodes):
            np.copyto(node, before, where=np.isnan(node))
    return quantity


class _VolumePart(Part):
    """A volume."""

    def __init__(self, volume: Volume, transfer: TransferFunction, camera: Camera, clip: Clip | None):
        super().__init__(camera, clip)
        self._values, self._tables = np.asarray(volume.values, np.float64), tables_of(transfer)
        self._lower, self._spacing = volume.bounds()[0], np.asarray(volume.spacing, np.float64)
        self._last = np.array(self._values.shape) - 1

    def meet(self, rays: Rays) -> list[Cuts]:
        """At planes of lattice points, inside the box alone."""
        faces = super().meet(rays)
        start, direction = (self._start - self._lower) / self._spacing, self._direction / self._spacing
        self._line = start, direction
        with np.errstate(divide="ignore", invalid="ignore"):
            planes = [(np.arange(last + 1) - start[:, [i]]) / direction[:, [i]] for i, last in enumerate(self._last)]
            enter, leave = np.sort(np.stack([-start, self._last - start]) / direction, 0)
        beside = (direction == 0) & ((start < 0) | (start > self._last))
        enter = np.where(direction == 0, -np.inf, enter).max(1)
        leave = np.where(beside, -np.inf, np.where(direction == 0, np.inf, leave)).min(1)
        depth = np.concatenate([enter[:, None], leave[:, None], *planes], 1)
        enter, leave = np.maximum(enter, rays.near), np.minimum(leave, rays.far)
        ray, place = np.nonzero((depth >= enter[:, None]) & (depth <= leave[:, None]))
        return [*faces, (ray, depth[ray, place])]

    def take(self, roots: Portions) -> None:
        super().take(roots)
        at = self._at(roots.ray, (roots.start + roots.end) / 2)
        self.shown &= np.all((at >= 0) & (at <= self._last), axis=-1)

    def add(self, seen: AtNodes, portions: Portions) -> None:
        """A portion is in one cell, whose cubic polynomial holds up to its ends."""
        which = np.flatnonzero(self.shown[portions.root])
        own = portions.some(which)
        middle, half = own.middles()
        cell = np.clip(self._at(own.ray, middle).astype(int), 0, self._last - 1)
        part = self._at(own.ray, middle + PLACE[:, None] * half) - cell
        quantity = np.zeros((NODES, len(which)))
        for corner in np.ndindex(2, 2, 2):
            share = np.where(corner, part, 1 - part).prod(-1)
            quantity += share * self._values[tuple((cell + corner).T)]
        there = ~np.isnan(quantity[0])  # else a corner of the cell is
        look_up(self._tables, seen, which[there], [quantity[:, there]], portions, self._rays.slant)

    def _at(self, ray: np.ndarray, depth: np.ndarray) -> np.ndarray:
        """Places in the lattice."""
        start, direction = self._line
        return start[ray] + depth[..., None] * direction[ray]


class _PointsPart(_SpheresPart):
    """A point set, by its true density: where its light is, whatever the `spread` by which renderers lay it along rays."""

    def __init__(self, points: Points, camera: Camera, clip: Clip | None):
        there, self._profile = np.flatnonzero(np.asarray(points.valid)), points.profile
        columns = points.radius, points.extinction, points.color
        radius, self._extinction, self._color = (np.asarray(column, np.float64)[there] for column in columns)
        self._attributes = {name: np.asarray(value, np.float64)[there] for name, value in points.attributes.items()}
        super().__init__(points.exact_position()[there], radius, camera, clip)

    def meet(self, rays: Rays) -> list[Cuts]:
        """At ends, feet, and where rays cross spheres at which a profile may have a kink."""
        faces, chords = super().meet(rays), self.chords
        foot, half = (chords.entry + chords.exit) / 2, (chords.exit - chords.entry) / 2
        scale = rays.slant[chords.ray] / self._radius[chords.sphere]
        depths = []
        for kink in kinks(self._profile)[:-1]:
            ring = np.sqrt(np.maximum(half**2 - (1 - kink**2) / scale**2, 0))
            depths += [foot - ring, foot + ring]
        depths += [chords.entry, chords.exit]
        return [*faces, (np.tile(chords.ray, len(depths)), np.concatenate(depths))]

    def add(self, seen: AtNodes, portions: Portions) -> None:
        axes, held = self._camera.exact_axes(), np.flatnonzero(self.shown[portions.root])
        for some in batches(self._length[portions.root[held]], PAIRS):
            own = portions.some(held[some])
            which, chord = self.over(own.root)
            ray, point = self.chords.ray[chord], self.chords.sphere[chord]
            middle, half = own.middles()
            depth = middle[which] + PLACE[:, None] * half[which]
            place = self._rays.start[ray] + depth[..., None] * self._rays.direction[ray]
            offset = (place - self._center[point]) / self._radius[point][:, None] @ axes
            attributes = {name: value[point] for name, value in self._attributes.items()}
            density = self._extinction[point] * at_offset(self._profile, offset, attributes)
            first = np.searchsorted(which, np.arange(len(some)))
            seen.extinction[:, held[some]] += np.add.reduceat(density, first, axis=1)
            seen.emission[:, :, held[some]] += np.add.reduceat(density * self._color[point].T[:, None], first, axis=2)
