"""Particles and points of a scene as media that can be asked at any point, such that each integrator can march them.

Flow: scene -> [in octree: plan -> build] -> scene.
"""

from __future__ import annotations

import dataclasses

from jaxsph.engine.access.octree_build import OctreePlan, plan_octree
from jaxsph.engine.media.octree_particles import OctreeParticles
from jaxsph.engine.media.octree_points import OctreePoints
from jaxsph.engine.media.octree_sums import reach_of
from jaxsph.engine.media.within import Within
from jaxsph.model import registry
from jaxsph.model.medium import Medium
from jaxsph.model.particles import Particles
from jaxsph.model.periodic import with_ghosts
from jaxsph.model.scene import Scene
from jaxsph.model.settings import Settings
from jaxsph.numerics.checks import is_traced


def in_octree(scene: Scene, plan: tuple[OctreePlan, ...] | None = None) -> Scene:
    """The same scene with its particles and points in octrees, to be rendered from anywhere, any number of times.

    Integrators that choose for themselves where they ask media (`"step_doubling"`) take any scene so. `jaxsph.render` does this
    for them by itself, in each call. With `"samples"` scenes are faster as they are: there rays share what they find.

    Args:
        scene: any; volumes and media stay as they are.
        plan: of particles, if there are any, and then of each point set, from `octree_plans`; by default made on the host, and to
            be given under jit.

    Differentiation:
        By all numbers of particles, transfer function and points; which leaf has which is held fixed.

    Raises:
        ValueError: under a trace without a plan, or of a periodic set; for another number of plans; for points that are spread
            at "feet" or "centres", or splats, which have no extinction at a point.
    """
    scene.check()
    sets = _sets(scene)
    if plan is None and is_traced(scene):
        raise ValueError("`plan` is needed under jit; make it outside by `jaxsph.octree_plans(scene)`")
    plans = (None,) * len(sets) if plan is None else plan
    if len(plans) != len(sets):
        raise ValueError(f"`plan` must have one for each of particles and point sets, {len(sets)}, got {len(plans)}")
    media: list[Medium] = []
    if scene.particles is not None and scene.transfer is not None:
        particles = OctreeParticles.from_particles(sets[0], scene.transfer, plans[0])
        media, plans = [Within.of(particles, scene.particles.box)], plans[1:]
    media += [OctreePoints.from_points(points, how) for points, how in zip(scene.point_sets, plans, strict=True)]
    return dataclasses.replace(scene, particles=None, transfer=None, points=None, media=(*media, *scene.media))


def octree_plans(scene: Scene) -> tuple[OctreePlan, ...]:
    """Plans for `in_octree`, of particles and of each point set (host side; values must be concrete)."""
    if is_traced(scene):
        raise ValueError("`octree_plans` needs concrete arrays to count; call it outside jit and pass `plan=` to `in_octree`")
    return tuple(plan_octree(*reach_of(one)) for one in _sets(scene))


def reachable(scene: Scene, settings: Settings) -> Scene:
    """A concrete scene that the integrator of some settings can march: in octrees, if it asks for points of its own choosing."""
    return in_octree(scene) if registry.integrator_class(settings.integrator).asks_points and _sets(scene) else scene


def _sets(scene: Scene) -> tuple[Particles, ...]:
    """Particles, with ghosts where they are periodic, and point sets, as spheres."""
    if is_traced(scene) and scene.particles is not None and scene.particles.box is not None:
        raise ValueError("a periodic set cannot be put into an octree under jit, as its images are counted; do it outside")
    of_particles = () if scene.particles is None else (with_ghosts(scene.particles),)
    return *of_particles, *(points.spheres() for points in scene.point_sets)
