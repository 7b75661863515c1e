"""What a scene has along rays, in float64: particles, volumes and points at the nodes of portions.

Flow: scene, rays -> [media] -> cuts of rays; portions -> [media] -> extinction and emission at nodes.
"""

from __future__ import annotations

import abc
import dataclasses

import numpy as np

from jaxsph.model.camera.camera import Camera
from jaxsph.model.clips.clips import Clip
from jaxsph.model.particles import kernels
from jaxsph.model.particles.particles import Particles
from jaxsph.model.points import Points
from jaxsph.model.scene import Scene
from jaxsph.model.transfer.function import TransferFunction
from jaxsph.model.volume import Volume
from jaxsph.reference.chords import NO_CHORDS, Chords, Rays, Spheres
from jaxsph.reference.looks import NODES, PLACE, AtNodes, Look
from jaxsph.reference.points import at_offset, kinks
from jaxsph.reference.portions import Cuts, Lists, Portions, borders, cut, lists
from jaxsph.reference.where import columns_of, crossings, inside, to_view

INWARDS = 1e-9  # of a portion: how far inside its ends particles are looked at, where those that begin there weigh something


class Part(abc.ABC):
    """One part of a scene, as some rays meet it; made by `seen_by`.

    Attributes:
        chords: what rays have inside its spheres; none of a part that is not made of spheres.
    """

    chords: Chords = NO_CHORDS

    @abc.abstractmethod
    def cuts(self) -> Cuts:
        """Where it begins or ends, and what else portions must not hold inside."""

    @abc.abstractmethod
    def lies_over(self, roots: Portions) -> np.ndarray:
        """Mask of the portions that it has something in."""

    @abc.abstractmethod
    def keep(self, which: np.ndarray) -> None:
        """Number roots anew: only those of a mask are left."""

    @abc.abstractmethod
    def add(self, seen: AtNodes, portions: Portions) -> None:
        """Add what it has at their nodes."""

    def border_by(self, portions: Portions) -> np.ndarray:
        """The border nearest to the middle of each portion, where only a derivative jumps, or NaN."""
        return np.full(len(portions.ray), np.nan)


class Whole(abc.ABC):
    """One part of a scene as a camera sees it."""

    @property
    def bare(self) -> Whole:
        """The same without the clip that it may be in."""
        return self

    @abc.abstractmethod
    def seen_by(self, rays: Rays) -> Part:
        """As some rays meet it."""


def parts_of(scene: Scene, camera: Camera) -> list[Whole]:
    """All of a scene."""
    parts: list[Whole] = []
    if scene.particles is not None and scene.transfer is not None:
        own: Whole = AllParticles(scene.particles, scene.transfer, camera)
        parts.append(own if scene.particles_within is None else _AllWithin(own, scene.particles_within, camera))
    others: list[Whole] = [AllOfVolume(volume, look, camera) for volume, look in scene.volumes]
    others += [AllPoints(points, camera) for points in scene.point_sets]
    return parts + [one if scene.within is None else _AllWithin(one, scene.within, camera) for one in others]


def met(wholes: list[Whole], rays: Rays) -> tuple[list[Part], Portions]:
    """Parts as rays meet them, and the portions that rays are first cut into: those that any part has something in."""
    parts = [whole.seen_by(rays) for whole in wholes]
    roots = cut(rays, [part.cuts() for part in parts])
    held: np.ndarray = np.logical_or.reduce([part.lies_over(roots) for part in parts])
    for part in parts:
        part.keep(held)
    return parts, roots.some(held)._replace(root=np.arange(held.sum()))


def at_nodes(parts: list[Part], portions: Portions) -> AtNodes:
    """What all parts have at nodes of portions."""
    seen = AtNodes.nothing(len(portions.ray))
    for part in parts:
        part.add(seen, portions)
    return seen


class AllParticles(Whole):
    """Particles; those of no volume are not there."""

    def __init__(self, particles: Particles, transfer: TransferFunction, camera: Camera):
        columns = columns_of(particles)
        position, self.support, volume, *self.quantities = (column[columns[2] > 0] for column in columns)
        center = to_view(position, camera)
        strength = volume / self.support**3
        self.strength = strength / max(strength.max(initial=0), np.finfo(float).tiny)
        self.spheres = Spheres(center, self.support, camera.is_perspective)
        self.kernel, self.look = kernels.by_name(particles.kernel), Look(transfer)

    def seen_by(self, rays: Rays) -> ParticlesMet:
        """See `Whole`."""
        return ParticlesMet(self, rays)


class _MetByChords(Part):
    """What is made of spheres, as some rays meet it."""

    def __init__(self, spheres: Spheres, rays: Rays):
        self._rays, self.chords = rays, spheres.chords(rays)

    def lies_over(self, roots: Portions) -> np.ndarray:
        self._lists: Lists = lists(self._rays, roots, self.chords)
        return self._lists.length > 0

    def keep(self, which: np.ndarray) -> None:
        self._lists = self._lists.some(which)

    def met_in(self, roots: np.ndarray) -> np.ndarray:
        """Numbers of the chords that lie over any of a mask of the roots."""
        return np.unique(self._lists.over(np.flatnonzero(roots))[1])


class ParticlesMet(_MetByChords):
    """Particles that some rays meet."""

    def __init__(self, whole: AllParticles, rays: Rays):
        super().__init__(whole.spheres, rays)
        self._whole = whole
        self._scale = rays.slant[self.chords.ray] / whole.support[self.chords.sphere]
        self._strength = whole.strength[self.chords.sphere]
        self._quantities = [quantity[self.chords.sphere] for quantity in whole.quantities]

    def cuts(self) -> Cuts:
        """See `Part`."""
        return borders(self.chords, 1 / self._scale)

    def add(self, seen: AtNodes, portions: Portions) -> None:
        """See `Part`."""
        count = self._lists.length[portions.root]
        which = np.flatnonzero(count)
        seen.evaluations += NODES * count
        means = np.empty((len(self._quantities), NODES, len(which)))
        for some in self._lists.batches(portions.root[which]):
            means[:, :, some] = self._means(portions.some(which[some]))
        self._whole.look.add(seen, which, [_filled(quantity) for quantity in means], portions, self._rays.slant)

    def _weights(self, portions: Portions) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Pairs of a portion and a chord over it, portion by portion, and V W of each at nodes (nodes, pairs).

        With t = 1 - (r / H)^2 as the product of the distances to entry and exit, which loses no digits near them.
        """
        which, chord = self._lists.over(portions.root)
        middle, half = (portions.start + portions.end) / 2, (portions.end - portions.start) / 2
        scale, at = self._scale[chord], middle[which]
        place = PLACE.copy()
        place[[0, -1]] *= 1 - INWARDS
        along = place[:, None] * (half[which] * scale)
        into, left = (at - self.chords.entry[chord]) * scale, (self.chords.exit[chord] - at) * scale
        inside = np.clip((into + along) * (left - along), 0, 1)
        return which, chord, self._strength[chord] * self._whole.kernel.of_square(1 - inside, np)

    def _means(self, portions: Portions) -> list[np.ndarray]:
        """All Q at nodes of portions (nodes, portions), relative to the first particle of each; NaN where nothing weighs."""
        which, chord, weight = self._weights(portions)
        first = np.searchsorted(which, np.arange(len(portions.ray)))
        total, found = np.add.reduceat(weight, first, axis=1), []
        for quantity in self._quantities:
            base = quantity[chord[first]]
            moved = np.add.reduceat(weight * (quantity[chord] - base[which]), first, axis=1)
            found.append(base + np.divide(moved, total, out=np.full_like(total, np.nan), where=total > 0))
        return found

    def shared(self, amounts: np.ndarray, portions: Portions) -> np.ndarray:
        """What is at nodes of portions (nodes, portions), dealt out to chords as V W there."""
        found, held = np.zeros(len(self.chords.ray)), np.flatnonzero(self._lists.length[portions.root])
        for some in self._lists.batches(portions.root[held]):
            which, chord, weight = self._weights(portions.some(held[some]))
            total = np.add.reduceat(weight, np.searchsorted(which, np.arange(len(some))), axis=1)
            each = np.divide(amounts[:, held[some]], total, out=np.zeros_like(total), where=total > 0)
            found += np.bincount(chord, (weight * each[:, which]).sum(0), len(found))
        return found

    def border_by(self, portions: Portions) -> np.ndarray:
        """See `Part`."""
        which, chord = self._lists.over(portions.root)
        middle, half = (portions.start + portions.end) / 2, (portions.end - portions.start) / 2
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
    for nodes in (range(1, NODES), range(NODES - 2, -1, -1)):
        for node in nodes:
            before = node - 1 if nodes.step > 0 else node + 1
            quantity[node] = np.where(np.isnan(quantity[node]), quantity[before], quantity[node])
    return quantity


class _AllWithin(Whole):
    """A part in a clip alone."""

    def __init__(self, whole: Whole, clip: Clip, camera: Camera):
        self.clip, self._whole, self._axes, self._eye = clip, whole, np.asarray(camera.axes, np.float64), camera.exact_eye()

    @property
    def bare(self) -> Whole:
        return self._whole

    def seen_by(self, rays: Rays) -> Part:
        return _MetWithin(self._whole.seen_by(rays), self.clip, rays.start @ self._axes + self._eye, rays.direction @ self._axes)


class _MetWithin(Part):
    """A part in a clip, as some rays meet it; portions are cut where rays may pass its faces, so that each is in it or not."""

    def __init__(self, part: Part, clip: Clip, start: np.ndarray, direction: np.ndarray):
        self._part, self._clip, self._start, self._direction = part, clip, start, direction
        self.chords = part.chords
        self._shown: np.ndarray = np.zeros(0, bool)

    def cuts(self) -> Cuts:
        depth = crossings(self._clip, self._start, self._direction)
        ray, place = np.nonzero(~np.isnan(depth))
        rays, depths = self._part.cuts()
        return np.concatenate([rays, ray]), np.concatenate([depths, depth[ray, place]])

    def lies_over(self, roots: Portions) -> np.ndarray:
        middle = (roots.start + roots.end) / 2
        self._shown = inside(self._clip, self._start[roots.ray] + middle[:, None] * self._direction[roots.ray])
        return self._part.lies_over(roots) & self._shown

    def keep(self, which: np.ndarray) -> None:
        self._shown = self._shown[which]
        self._part.keep(which)

    def add(self, seen: AtNodes, portions: Portions) -> None:
        some = np.flatnonzero(self._shown[portions.root])
        part = dataclasses.replace(seen, **{name: column[..., some] for name, column in vars(seen).items()})
        self._part.add(part, portions.some(some))
        for name, column in vars(seen).items():
            column[..., some] = getattr(part, name)

    def border_by(self, portions: Portions) -> np.ndarray:
        return self._part.border_by(portions)


class AllOfVolume(Whole):
    """A volume."""

    def __init__(self, volume: Volume, transfer: TransferFunction, camera: Camera):
        self.values, self.look = np.asarray(volume.values, np.float64), Look(transfer)
        self._lower, self._spacing = volume.bounds()[0], np.asarray(volume.spacing, np.float64)
        self._axes, self._eye = np.asarray(camera.axes, np.float64), camera.exact_eye()

    def seen_by(self, rays: Rays) -> Part:
        """See `Whole`."""
        start = (rays.start @ self._axes + self._eye - self._lower) / self._spacing
        return _VolumeMet(self, rays, start, rays.direction @ self._axes / self._spacing)


class _VolumeMet(Part):
    """A volume that some rays meet; they are given in its lattice."""

    def __init__(self, whole: AllOfVolume, rays: Rays, start: np.ndarray, direction: np.ndarray):
        self._whole, self._rays, self._start, self._direction = whole, rays, start, direction
        self._last = np.array(whole.values.shape) - 1
        self._over: np.ndarray = np.zeros(0, bool)

    def cuts(self) -> Cuts:
        """Planes of lattice points, inside the box alone."""
        start, direction = self._start, self._direction
        with np.errstate(divide="ignore", invalid="ignore"):
            planes = [(np.arange(last + 1) - start[:, [i]]) / direction[:, [i]] for i, last in enumerate(self._last)]
            enter, leave = np.sort(np.stack([-start, self._last - start]) / direction, 0)
        beside = (direction == 0) & ((start < 0) | (start > self._last))
        enter = np.where(direction == 0, -np.inf, enter).max(1)
        leave = np.where(beside, -np.inf, np.where(direction == 0, np.inf, leave)).min(1)
        depth = np.concatenate([enter[:, None], leave[:, None], *planes], 1)
        enter, leave = np.maximum(enter, self._rays.near), np.minimum(leave, self._rays.far)
        ray, place = np.nonzero((depth >= enter[:, None]) & (depth <= leave[:, None]))
        return ray, depth[ray, place]

    def lies_over(self, roots: Portions) -> np.ndarray:
        at = self._at(roots.ray, (roots.start + roots.end) / 2)
        self._over = np.all((at >= 0) & (at <= self._last), axis=-1)
        return self._over

    def keep(self, which: np.ndarray) -> None:
        self._over = self._over[which]

    def add(self, seen: AtNodes, portions: Portions) -> None:
        """A portion is in one cell, whose cubic polynomial holds up to its ends."""
        which = np.flatnonzero(self._over[portions.root])
        own = portions.some(which)
        middle, half = (own.start + own.end) / 2, (own.end - own.start) / 2
        cell = np.clip(self._at(own.ray, middle).astype(int), 0, self._last - 1)
        part = self._at(own.ray, middle + PLACE[:, None] * half) - cell
        quantity = np.zeros((NODES, len(which)))
        for corner in np.ndindex(2, 2, 2):
            share = np.where(corner, part, 1 - part).prod(-1)
            quantity += share * self._whole.values[tuple((cell + corner).T)]
        self._whole.look.add(seen, which, [quantity], portions, self._rays.slant)

    def _at(self, ray: np.ndarray, depth: np.ndarray) -> np.ndarray:
        return self._start[ray] + depth[..., None] * self._direction[ray]


class AllPoints(Whole):
    """A point set, by its true density: where its light is, whatever the `spread` by which renderers lay it along rays."""

    def __init__(self, points: Points, camera: Camera):
        self.there = np.flatnonzero(np.asarray(points.valid))
        self.points, self.axes = points, np.asarray(camera.axes, np.float64)
        self.radius, self.extinction, self.color = (self._column(name) for name in ("radius", "extinction", "color"))
        self.attributes = {name: np.asarray(value, np.float64)[self.there] for name, value in points.attributes.items()}
        self.spheres = Spheres(to_view(points.exact_position()[self.there], camera), self.radius, camera.is_perspective)

    def _column(self, name: str) -> np.ndarray:
        return np.asarray(getattr(self.points, name), np.float64)[self.there]

    def seen_by(self, rays: Rays) -> Part:
        """See `Whole`."""
        return _PointsMet(self, rays)


class _PointsMet(_MetByChords):
    """Points that some rays meet."""

    def __init__(self, whole: AllPoints, rays: Rays):
        super().__init__(whole.spheres, rays)
        self._whole = whole

    def cuts(self) -> Cuts:
        """Ends, feet, and where rays cross spheres at which a profile may have a kink."""
        chords = self.chords
        foot, half = (chords.entry + chords.exit) / 2, (chords.exit - chords.entry) / 2
        scale = self._rays.slant[chords.ray] / self._whole.radius[chords.sphere]
        depths = []
        for kink in kinks(self._whole.points.profile)[:-1]:
            ring = np.sqrt(np.maximum(half**2 - (1 - kink**2) / scale**2, 0))
            depths += [foot - ring, foot + ring]
        depths += [chords.entry, chords.exit]
        return np.tile(chords.ray, len(depths)), np.concatenate(depths)

    def add(self, seen: AtNodes, portions: Portions) -> None:
        for some in self._lists.batches(portions.root):
            self._add(seen, some, portions.some(some))

    def _add(self, seen: AtNodes, some: np.ndarray, portions: Portions) -> None:
        which, chord = self._lists.over(portions.root)
        if not len(which):
            return
        whole, ray, point = self._whole, self.chords.ray[chord], self.chords.sphere[chord]
        middle, half = (portions.start + portions.end) / 2, (portions.end - portions.start) / 2
        depth = middle[which] + PLACE[:, None] * half[which]
        place = self._rays.start[ray] + depth[..., None] * self._rays.direction[ray]
        offset = (place - whole.spheres.center[point]) / whole.radius[point][:, None] @ whole.axes
        attributes = {name: value[point] for name, value in whole.attributes.items()}
        density = whole.extinction[point] * at_offset(whole.points.profile, offset, attributes)
        held, first = np.unique(which, return_index=True)
        seen.extinction[:, some[held]] += np.add.reduceat(density, first, axis=1)
        seen.emission[:, :, some[held]] += np.add.reduceat(density * whole.color[point].T[:, None], first, axis=2)
