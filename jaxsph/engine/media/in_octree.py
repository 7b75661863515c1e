"""Particles and points of a scene as media that can be asked at any point, such that each integrator can march them.

Flow: scene -> [in octree] -> scene.
"""

from __future__ import annotations

import dataclasses

from jaxsph.engine.media.octree_medium import OctreeParticles, OctreePoints
from jaxsph.engine.media.within import Within
from jaxsph.model import registry
from jaxsph.model.medium import Medium
from jaxsph.model.particles.periodic import with_ghosts
from jaxsph.model.scene import Scene
from jaxsph.model.settings import Settings
from jaxsph.numerics.checks import is_traced


def in_octree(scene: Scene) -> Scene:
    """The same scene with its particles and points in octrees, to be rendered from anywhere, any number of times (host side).

    Integrators that choose for themselves where they ask media (`"step_doubling"`) take any scene so. `jaxsph.render` does this
    for them by itself, in each call. With `"samples"` scenes are faster as they are: there rays share what they find.

    Differentiation:
        By all numbers of particles, transfer function and points that the scene given back holds in its media; which leaf has
        which is held fixed.

    Raises:
        ValueError: under a trace; for particles of two quantities; for points that are spread at "feet" or "centres", or splats,
            which have no extinction at a point.
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


def reachable(scene: Scene, settings: Settings) -> Scene:
    """A concrete scene that the integrator of some settings can march: in octrees, if it asks for points of its own choosing."""
    spheres = scene.particles is not None or bool(scene.point_sets)
    return in_octree(scene) if spheres and registry.integrator_class(settings.integrator_used).asks_points else scene
