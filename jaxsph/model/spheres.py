"""Spheres: all parts of a scene that have centres and radii, in one set, such that one grid finds what a ray can meet.

Flow: particles, points -> [spheres] -> access.

Particles come first, then the point sets one after the other. To the field of particles points are particles without volume, and
to a point set all else is out of its range of numbers: each medium takes from a list what is its own.
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from jaxsph.model.particles import Particles
from jaxsph.model.scene import Scene


def spheres_of(scene: Scene) -> Particles:
    """Supports of particles, and points.

    Differentiation:
        By particles alone: where points can be met is held fixed.
    """
    sets = _sets(scene)
    if len(sets) == 1:
        return sets[0]
    dtype = scene.dtype
    columns: dict[str, Any] = {
        name: jnp.concatenate([one.columns.get(name, one.quantity).astype(dtype) for one in sets]) for name in sets[0].columns
    }
    rest = None
    if any(one.position_rest is not None for one in sets):
        rest = jnp.concatenate([_rest(one).astype(dtype) for one in sets])
    valid = jnp.concatenate([one.valid for one in sets])
    return Particles(**columns, valid=valid, kernel=scene.formulas.kernel, position_rest=rest)


def first_spheres(scene: Scene) -> tuple[int, ...]:
    """Number of the first sphere of each point set, static."""
    number = 0 if scene.particles is None else scene.particles.capacity
    first = []
    for points in scene.point_sets:
        first.append(number)
        number += points.capacity
    return tuple(first)


def num_spheres(scene: Scene) -> int:
    """Entries of all sets, padding included, static; at least 1."""
    return sum(one.capacity for one in ((scene.particles,) if scene.particles is not None else ()) + scene.point_sets) or 1


def _sets(scene: Scene) -> list[Particles]:
    points = [lax.stop_gradient(points.spheres()) for points in scene.point_sets]
    return points if scene.particles is None and points else [scene.particle_set, *points]


def _rest(spheres: Particles) -> Array:
    return jnp.zeros_like(spheres.position) if spheres.position_rest is None else spheres.position_rest
