r"""Periodic boxes: copies of the particles whose supports reach over a face, so that nothing else needs to know of periods.

Flow: particles -> [periodic: ghosts] -> spheres -> access; project.

The field of a periodic set is $\sum_n \sum_j$ over all periods n and particles j. In the box itself only images count whose
support reaches into it: of supports up to the length of a side these are among the 26 around it. They are *ghosts*, appended to
the particles; derivatives by a ghost are those by the particle that it is an image of. What is shown is one period: the medium
ends at the faces of the box (`field.within`).

A projection along an axis of the box has what the box holds, with images that reach into it: rays and pixels end at its faces.
Rays *through* the box, from face to face, need no images along themselves: what a support loses at one face its image brings in
at the other, so that $\sum_n \int_0^L W(x + nL) dx = \int W dx$, the whole column of each particle.
Along other directions faces cut rays at depths that differ from ray to ray, which column integrals do not know: there each
particle is taken once, with all of its support.
"""

from __future__ import annotations

import dataclasses
import itertools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxsph.model.camera.camera import Camera
from jaxsph.model.clips import Box
from jaxsph.model.particles.particles import Particles, sides_of
from jaxsph.numerics import faults
from jaxsph.numerics.compiled import clamped, greater, lesser

IMAGES = np.array([image for image in itertools.product((-1, 0, 1), repeat=3) if any(image)])
"""Periods around the box, in which ghosts can lie."""
ROUNDING = 16  # eps of coordinates and supports that a distance to a face may be off by
ALIGNED = 1e-6  # of its length, that a line of sight may be off an axis
COUNTED = 32  # eps: the same where ghosts are counted, such that never more are made
Gaps = tuple[Any, Any, Any]  # how far particles are from lower and from upper faces along each axis, and how far they reach


def unfolded(
    particles: Particles, room: int, margin: Any = 0.0, through: int | None = None
) -> tuple[Particles, Int[Array, " entries"], Int[Array, ""]]:
    """Particles of no period, with room for so many ghosts behind them; which entry each is of; and a fault word.

    Args:
        particles: with a box.
        room: entries for ghosts, static; `num_ghosts` says how many are needed.
        margin: how far outside of the box the field is asked for, up to a period; length units.
        through: axis across whose faces there are none, as `runs_through` has it.

    Differentiation:
        By all that particles are made of, and by the sides of the box. Which have ghosts is held fixed.
    """
    assert particles.box is not None
    home, (sides, _) = particles.wrapped(), sides_of(particles.box)
    bare = dataclasses.replace(home, box=None)
    usable = (sides > 0).all() & jnp.isfinite(sides).all()
    fits = jnp.where(particles.valid, particles.support, 0).max(initial=0) <= sides.min()
    word = faults.raised(faults.BAD_BOX, ~(usable & fits))
    near, (below, above, reach) = _near(home, margin, through)
    capacity = particles.capacity
    own = jnp.arange(capacity, dtype=jnp.int32)
    if room == 0:
        return bare, own, word | faults.raised(faults.GHOST_OVERFLOW, near.any())
    source = jnp.nonzero(near, size=room, fill_value=capacity)[0].astype(jnp.int32)
    inside = jnp.minimum(source, capacity - 1)
    of_images = jnp.stack([_reaches((below[inside], above[inside], reach[inside]), image) for image in IMAGES], 1)
    made = of_images & (source < capacity)[:, None]
    number = made.sum(dtype=jnp.int32)
    place = jnp.nonzero(made.ravel(), size=room, fill_value=0)[0].astype(jnp.int32)
    exists = jnp.arange(room, dtype=jnp.int32) < number
    origin = inside[place // len(IMAGES)]
    ghosts = bare.at(origin).moved(jnp.asarray(IMAGES, home.dtype)[place % len(IMAGES)], particles.box)
    ghosts = dataclasses.replace(ghosts, valid=ghosts.valid & exists)
    word |= faults.raised(faults.GHOST_OVERFLOW, (number > room) | (near.sum(dtype=jnp.int32) > room))
    together = jax.tree.map(lambda home, more: jnp.concatenate([home, more]), bare, ghosts)
    return together, jnp.concatenate([own, origin]), word


def num_ghosts(particles: Particles, margin: Any = 0.0, through: int | None = None) -> int:
    """How many ghosts particles have, or a few more (host side); 0 without a box."""
    if particles.box is None:
        return 0
    box, valid, eps = particles.box, np.asarray(particles.valid), COUNTED * float(jnp.finfo(particles.dtype).eps)
    lower, upper = (np.asarray(corner, np.float64) for corner in (box.lower, box.upper))
    position, support = (np.asarray(value, np.float64)[valid] for value in (particles.position, particles.support))
    with np.errstate(invalid="ignore", divide="ignore"):
        below = (position - lower) % (upper - lower)
        above = upper - lower - below
        if through is not None:
            below[:, through] = above[:, through] = np.inf
        size = np.maximum(np.abs(lower), np.abs(upper)).max() + np.abs(position).max(1, initial=0)
        reach = (support + margin) * (1 + eps) + eps * (size + margin)
        near = np.minimum(below, above).min(1) < reach
        gaps = below[near], above[near], reach[near]
        return sum(int(np.count_nonzero(_reaches(gaps, image))) for image in IMAGES)


def _near(particles: Particles, margin: Any, through: int | None) -> tuple[Array, Gaps]:
    """Particles that reach over a face or so near to it, and how far all are from faces: infinitely from those not asked for."""
    assert particles.box is not None
    particles = lax.stop_gradient(particles)
    box, eps = particles.box, ROUNDING * jnp.finfo(particles.dtype).eps
    assert box is not None
    size = jnp.maximum(jnp.abs(box.lower), jnp.abs(box.upper)).max() + margin
    asked = jnp.arange(3) != (-1 if through is None else through)
    below, above = (jnp.where(asked, gap, jnp.inf) for gap in (particles.position - box.lower, box.upper - particles.position))
    reach = (particles.support + margin) * (1 + eps) + eps * size
    near = particles.valid & (jnp.minimum(below, above) < reach[:, None]).any(1)
    return near, (below, above, reach)


def _reaches(gaps: Gaps, image: np.ndarray) -> Any:
    """Whether an image reaches into the box; one a period further up is as far above the box as the particle is within."""
    below, above, reach = gaps
    away = [(below if step > 0 else above)[:, k] for k, step in enumerate(image) if step]
    return sum(gap.clip(0) ** 2 for gap in away) < reach * reach


def sees_images(particles: Particles, camera: Camera) -> bool:
    """Whether images of a periodic set count: for parallel rays along one of its axes, upright (host side)."""
    if particles.box is None or camera.is_perspective:
        return False
    return bool((np.abs(camera.exact_axes()).max(1) > 1 - ALIGNED).all())


def runs_through(camera: Camera, box: Box, axis: int) -> Bool[Array, ""]:
    """Whether rays run along this axis of a box from outside of it through both faces; strictly, so that no depth matters."""
    low, high = _faces(camera, box)
    return (jnp.abs(camera.axes[2, axis]) > 1 - ALIGNED) & (camera.near < low[2]) & (camera.far > high[2])


def past_faces(camera: Camera, box: Box) -> Camera:
    """The camera with depths that cut no support, as none is larger than the shortest side."""
    low, high = _faces(camera, box)
    beyond = 2 * box.sides.min()
    return dataclasses.replace(camera, near=low[2] - beyond, far=high[2] + beyond)


def _faces(camera: Camera, box: Box) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
    """Lower and upper view coordinates of a box along the axes of a camera."""
    ends = jnp.stack([camera.to_view(corner, rest) for corner, rest in zip((box.lower, box.upper), box.rest, strict=True)])
    return ends.min(0), ends.max(0)


def between_faces(camera: Camera, box: Box, pixel: str) -> tuple[Camera, Float[Array, "height width"]]:
    """The camera with its depths cut off at the faces of a box, and what share of each pixel lies between the others.

    Args:
        camera: that `sees_images`.
        box: a period.
        pixel: `"mean"`, or `"ray"`, of which the middle counts.
    """
    low, high = _faces(camera, box)
    near, far = greater(camera.near, low[2]), lesser(camera.far, high[2])
    meets = near < far
    inside = dataclasses.replace(camera, near=jnp.where(meets, near, camera.near), far=jnp.where(meets, far, camera.far))
    across = _shares(camera.column, camera.width, low[0], high[0], pixel)
    down = _shares(camera.row, camera.height, low[1], high[1], pixel)
    return inside, jnp.where(meets, down[:, None] * across, 0)


def _shares(place: Any, number: int, low: Array, high: Array, pixel: str) -> Float[Array, " pixels"]:
    """Of pixels in a row or column, how much lies between two coordinates."""
    if pixel == "ray":
        middle = place(jnp.arange(number) + 0.5)
        return ((middle >= low) & (middle <= high)).astype(low.dtype)
    edges = place(jnp.arange(number + 1))
    lower, upper = lesser(edges[:-1], edges[1:]), greater(edges[:-1], edges[1:])
    return clamped(lesser(upper, high) - greater(lower, low), 0, upper - lower) / (upper - lower)
