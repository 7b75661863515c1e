r"""One ray in float64: what the quantity is along it, how light is lost, which particles it meets and what each takes.

Flow: scene, camera, pixel -> samples, or nodes of portions -> media there -> [along] -> Ray.

Light is lost as $-dT = T \sigma\,dl$. Of what particles take of it in all, each takes the share that it has of the field there,
$V_j W_j / \sum V W$.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxsph.model.camera.camera import Camera
from jaxsph.model.camera.snug import with_depths
from jaxsph.model.scene import Scene
from jaxsph.reference.chords import rays_of
from jaxsph.reference.image import sample_borders, sample_depths
from jaxsph.reference.light_integral import refined
from jaxsph.reference.looks import INTEGRATION, NODES, PLACE, AtNodes, Look, light_of
from jaxsph.reference.media import AllOfVolume, AllParticles, Part, at_nodes, parts_of
from jaxsph.reference.points import thickness
from jaxsph.reference.portions import Portions, cut
from jaxsph.reference.where import inside, places_of, to_world

TOLERANCE = 1e-6  # of the light integral, where that is what a ray is known by
POINT = 1e-9  # of a sample, the half of a portion about its middle by which a medium is asked for that place alone
MIDDLE = NODES // 2
WEIGHTS = INTEGRATION[-1][:, None]  # of the nodes of a portion


class Ray(NamedTuple):
    """What is along a ray, front to back.

    Attributes:
        depth: of the places that are looked at, ascending, length units; where portions meet, twice.
        quantities: of particles, else of the first volume, one or two; NaN where there is none.
        extinction: of all that is there, a unit length.
        transmittance: of all from near up to there; of samples, with what each of them stands for.
        particles: entries of the particles whose supports the ray passes through where they are shown, ascending.
        added: what each of these adds to alpha.
    """

    depth: Float[np.ndarray, " places"]
    quantities: tuple[Float[np.ndarray, " places"], ...]
    extinction: Float[np.ndarray, " places"]
    transmittance: Float[np.ndarray, " places"]
    particles: Int[np.ndarray, " particles"]
    added: Float[np.ndarray, " particles"]


def along(scene: Scene, camera: Camera, row: int, column: int, samples: int | None = None) -> Ray:
    """What the ray of a pixel meets, between near and far.

    Args:
        scene, camera: as for `jaxsph.reference.render`.
        row, column: of the pixel.
        samples: so many, as `jaxsph.reference.render` has them; None takes nodes of portions that are as short as
            `jaxsph.reference.integral` needs them for the light integral.

    Raises:
        ValueError: a scene of nothing, or of media unknown here.
    """
    scene.check()
    if scene.media:
        raise ValueError("`media` are unknown to the reference, which has particles, volumes and points; give `media=()`")
    camera = with_depths(camera, scene)
    asked = _Asked(scene, camera, row, column)
    return asked.integrated() if samples is None else asked.sampled(samples)


class _Asked:
    """A ray, the parts of a scene, and what it meets of them."""

    def __init__(self, scene: Scene, camera: Camera, row: int, column: int):
        self.scene, self.camera = scene, camera
        self.rays = rays_of(camera, np.array([row]), np.array([column]))
        self.wholes = parts_of(scene, camera)
        self.first = self.wholes[0].bare
        self.record = _Record(scene)
        if isinstance(self.first, AllParticles | AllOfVolume):
            self.first.look = self.record
        self.parts = [whole.seen_by(self.rays) for whole in self.wholes]
        self.roots = cut(self.rays, [part.cuts() for part in self.parts])
        self.shown, *_ = [part.lies_over(self.roots) for part in self.parts]

    def integrated(self) -> Ray:
        """By quadrature; what a portion takes in all is dealt out to its nodes as what is integrated there."""
        portions, *_ = refined(self.rays, self.parts, self.roots, TOLERANCE)
        seen = self.record.looked(self.parts, portions)
        middle, half = (portions.start + portions.end) / 2, (portions.end - portions.start) / 2
        thickness = light_of(seen, half * self.rays.slant).thickness.T
        behind = np.cumsum(thickness[-1])
        front = behind - thickness[-1]
        left = np.exp(-(front + thickness))
        each = WEIGHTS * left
        total = (each * seen.extinction).sum(0)
        taken = np.divide(np.exp(-front) - np.exp(-behind), total, out=np.zeros_like(total), where=total > 0)
        particles, added = self._particles(self.roots, portions, each * taken * self.record.extinction)
        depth = middle + PLACE[:, None] * half
        depth[0], depth[-1] = portions.start, portions.end  # such that depths ascend
        places = (depth, *self.record.quantities, seen.extinction, left)
        depth, *quantities, extinction, left = (value.T.ravel() for value in places)
        left = np.minimum.accumulate(left)  # where rounding has it rise
        return Ray(depth, tuple(quantities), extinction, left, particles, added)

    def sampled(self, samples: int) -> Ray:
        """By samples, each of which stands for what lies around it; points as they lie there."""
        depth, borders = sample_depths(self.camera, samples), sample_borders(self.camera, samples)
        path = np.diff(borders) * self.rays.slant
        portions = Portions(np.zeros(samples, int), depth - POINT * path, depth + POINT * path, np.arange(samples))
        parts = [whole.seen_by(self.rays) for whole in self.wholes[: len(self.scene.looks)]]
        for part in parts:
            part.lies_over(portions)
        extinction = self.record.looked(parts, portions).extinction[MIDDLE]
        places = to_world(self.rays.start + depth[:, None] * self.rays.direction, self.camera)
        visible = inside(self.scene.within, places)
        for points in self.scene.point_sets:
            total = thickness(points, self.camera, self.rays.u, self.rays.v, borders)[0][0, 0]
            extinction = extinction + np.where(visible, total / path, 0)
        left = np.cumprod(np.exp(-extinction * path))
        lost = np.append(1, left[:-1]) - left
        own = np.divide(lost, extinction, out=np.zeros(samples), where=extinction > 0)
        amounts = np.zeros((NODES, samples))
        amounts[MIDDLE] = own * self.record.extinction[MIDDLE]
        particles, added = self._particles(portions, portions, amounts)
        quantities = tuple(quantity[MIDDLE] for quantity in self.record.quantities)
        return Ray(depth, quantities, extinction, left, particles, added)

    def _particles(self, roots: Portions, portions: Portions, amounts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Entries of the particles that are met, and what each has of amounts at nodes of portions of some roots."""
        particles = self.scene.particles
        if particles is None or not isinstance(self.first, AllParticles):
            return np.zeros(0, int), np.zeros(0)
        met = self.first.seen_by(self.rays)
        entry = places_of(particles)[1]
        entry = entry[np.asarray(particles.volume)[entry] > 0][met.chords.sphere]  # of each chord
        met.lies_over(self.roots)
        found = np.unique(entry[met.met_in(self.shown)])
        met.lies_over(roots)
        added = np.bincount(entry, met.shared(amounts, portions), particles.capacity)
        return found, added[found]


class _Record(Look):
    """The look of the first part that has one, which remembers what it was asked for.

    Attributes:
        quantities, extinction: of that part, at nodes of the portions that were looked at.
    """

    def __init__(self, scene: Scene):
        if scene.looks:
            super().__init__(scene.looks[0])
        self._number = 1 if scene.particles is None else len(scene.particles.quantities)
        self._start: np.ndarray | None = None

    def looked(self, parts: list[Part], portions: Portions) -> AtNodes:
        """What parts have at nodes of portions of one ray."""
        shape = NODES, len(portions.start)
        self._start, self.extinction = portions.start, np.zeros(shape)
        self.quantities = [np.full(shape, np.nan) for _ in range(self._number)]
        return at_nodes(parts, portions)

    def add(self, seen: AtNodes, which: np.ndarray, quantities: list[np.ndarray], portions: Portions, slant: np.ndarray) -> None:
        """See `Look`."""
        before = seen.extinction[:, which].copy()
        super().add(seen, which, quantities, portions, slant)
        if self._start is not None:
            place = np.searchsorted(self._start, portions.start[which])  # in a clip, portions are some of all
            self.extinction[:, place] = seen.extinction[:, which] - before
            for all_of_ray, quantity in zip(self.quantities, quantities, strict=True):
                all_of_ray[:, place] = quantity
