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
from jaxsph.model.scene import Scene
from jaxsph.reference.columns import thickness
from jaxsph.reference.image import sample_borders, sample_depths
from jaxsph.reference.light_integral import refined
from jaxsph.reference.looks import INTEGRATION, NODES, PLACE, AtNodes, light_of
from jaxsph.reference.media import Part, ParticlesPart, at_nodes, parts_of, roots_of
from jaxsph.reference.where import Portions, Rays, asked_for, inside, rays_of, to_world

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
    particles: Int[np.ndarray, " particles"] = np.zeros(0, int)
    added: Float[np.ndarray, " particles"] = np.zeros(0)


def along(scene: Scene, camera: Camera, row: int, column: int, samples: int | None = None) -> Ray:
    """What the ray of a pixel meets, between near and far.

    Args:
        scene, camera: as for `jaxsph.reference.render`.
        row, column: of the pixel.
        samples: so many, as `jaxsph.reference.render` has them; None takes nodes of portions that are as short as
            `jaxsph.reference.integral` needs them for the light integral.

    Raises:
        ValueError: a scene of nothing, of a surface, or of media unknown here.
    """
    camera = asked_for(scene, camera)
    rays, parts = rays_of(camera, np.array([row]), np.array([column])), parts_of(scene, camera)
    roots = roots_of(parts, rays, empty=True)
    ray, portions, amounts = _integrated(rays, parts, roots) if samples is None else _sampled(scene, camera, rays, parts, samples)
    first = parts[0]
    if not isinstance(first, ParticlesPart):
        return ray
    entry = first.entry[first.chords.sphere]
    added = np.bincount(entry, first.shared(amounts, portions), scene.particle_set.capacity)
    first.take(roots)
    found = np.unique(entry[first.over(np.flatnonzero(first.shown))[1]])
    return ray._replace(particles=found, added=added[found])


def _integrated(rays: Rays, parts: list[Part], roots: Portions) -> tuple[Ray, Portions, np.ndarray]:
    """By quadrature; with the portions, and what the first part takes at nodes: of a portion's loss what is integrated there."""
    portions, *_ = refined(rays, parts, roots, TOLERANCE)
    seen, quantities, own = _looked(parts, portions)
    middle, half = (portions.start + portions.end) / 2, (portions.end - portions.start) / 2
    thickness = light_of(seen, half * rays.slant).thickness.T
    behind = np.cumsum(thickness[-1])
    front = behind - thickness[-1]
    left = np.exp(-(front + thickness))
    each = WEIGHTS * left
    total = (each * seen.extinction).sum(0)
    taken = np.divide(np.exp(-front) - np.exp(-behind), total, out=np.zeros_like(total), where=total > 0)
    depth = middle + PLACE[:, None] * half
    depth[0], depth[-1] = portions.start, portions.end  # such that depths ascend
    at, *values, extinction, transmittance = (value.T.ravel() for value in (depth, *quantities, seen.extinction, left))
    transmittance = np.minimum.accumulate(transmittance)  # where rounding has it rise
    return Ray(at, tuple(values), extinction, transmittance), portions, each * taken * own


def _sampled(scene: Scene, camera: Camera, rays: Rays, parts: list[Part], samples: int) -> tuple[Ray, Portions, np.ndarray]:
    """The same by samples, each of which stands for what lies around it; points as they lie there."""
    depth, borders = sample_depths(camera, samples), sample_borders(camera, samples)
    path = np.diff(borders) * rays.slant
    portions = Portions(np.zeros(samples, int), depth - POINT * path, depth + POINT * path, np.arange(samples))
    parts = parts[: len(scene.looks)]
    for part in parts:
        part.take(portions)
    seen, quantities, first = _looked(parts, portions)
    extinction = seen.extinction[MIDDLE]
    visible = inside(scene.within, to_world(rays.start + depth[:, None] * rays.direction, camera))
    for points in scene.point_sets:
        total = thickness(points, camera, rays.u, rays.v, borders)[0][0, 0]
        extinction = extinction + np.where(visible, total / path, 0)
    left = np.cumprod(np.exp(-extinction * path))
    lost = np.append(1, left[:-1]) - left
    own = np.divide(lost, extinction, out=np.zeros(samples), where=extinction > 0)
    amounts = np.zeros((NODES, samples))
    amounts[MIDDLE] = own * first[MIDDLE]
    return Ray(depth, tuple(quantity[MIDDLE] for quantity in quantities), extinction, left), portions, amounts


def _looked(parts: list[Part], portions: Portions) -> tuple[AtNodes, np.ndarray, np.ndarray]:
    """What parts have at nodes of portions; and quantities and extinction of the first that has a transfer function."""
    seen = at_nodes(parts, portions)
    quantities, extinction = np.full((1, *seen.extinction.shape), np.nan), np.zeros_like(seen.extinction)
    for which, given, own, _ in seen.looked[:1]:
        quantities = np.full((len(given), *extinction.shape), np.nan)
        quantities[:, :, which], extinction[:, which] = given, own
    return seen, quantities, extinction
