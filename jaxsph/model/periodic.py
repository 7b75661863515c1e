r"""Periodic boxes: copies of the particles whose supports reach over a face, so that nothing else needs to know of periods.

Flow: particles -> [periodic: wrap -> ghosts] -> spheres -> access.

The field of a periodic set is $\sum_n \sum_j$ over all periods n and particles j. In the box itself only images count whose
support reaches into it: of supports up to the length of a side these are among the 26 around it. They are *ghosts*, appended to
the particles; derivatives by a ghost are those by the particle that it is an image of. What is shown is one period: the medium
ends at the faces of the box (`field.within`).
"""

from __future__ import annotations

import dataclasses
import itertools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jax import lax
from jaxtyping import Array, Float, Int

from jaxsph.model.clips.shapes import Box
from jaxsph.model.particles import Particles, capacity_class
from jaxsph.numerics import faults
from jaxsph.numerics.checks import is_traced, require_finite, require_shape
from jaxsph.numerics.given import in_unit

IMAGES = np.array([image for image in itertools.product((-1, 0, 1), repeat=3) if any(image)])
"""Periods around the box, in which ghosts can lie."""
ROUNDING = 16  # eps of coordinates and supports that a distance to a face may be off by
VARYING = 1.5  # times the least support, from which supports are taken to tell of densities
COUNTED = 32  # eps: the same where ghosts are counted, such that never more are made


class Gaps(NamedTuple):
    """How far particles are from lower and from upper faces, and how far they reach."""

    below: Float[Array, "particles 3"]
    above: Float[Array, "particles 3"]
    reach: Float[Array, " particles"]


class Period(NamedTuple):
    """Sides of a box, and what rounding them has left."""

    sides: Float[Array, "3"]
    rest: Float[Array, "3"]

    @classmethod
    def of(cls, box: Box) -> Period:
        """Of a box."""
        sides, left = _two_sum(box.upper, -box.lower)
        return cls(*_two_sum(sides, left + (box.rest[1] - box.rest[0])))


def wrapped(particles: Particles) -> Particles:
    """The same particles with all positions in the box.

    Differentiation:
        Positions are moved by whole periods, which are held fixed.
    """
    if particles.box is None:
        return particles
    period = Period.of(particles.box)
    turns = jnp.floor((lax.stop_gradient(particles.position) - particles.box.lower) / period.sides)
    return _moved(particles, jnp.where(jnp.isfinite(turns), -turns, 0), period)


def unfolded(particles: Particles, room: int, margin: Any = 0.0) -> tuple[Particles, Int[Array, ""]]:
    """Particles of no period, with room for so many ghosts behind them; and a fault word.

    As `with_sources` says it.
    """
    found, _, word = with_sources(particles, room, margin)
    return found, word


def with_sources(particles: Particles, room: int, margin: Any = 0.0) -> tuple[Particles, Int[Array, " entries"], Int[Array, ""]]:
    """Particles of no period, with room for so many ghosts behind them; which entry each is of; and a fault word.

    Args:
        particles: with a box.
        room: entries for ghosts, static; `num_ghosts` says how many are needed.
        margin: how far outside of the box the field is asked for, up to a period; length units.

    Differentiation:
        By all that particles are made of, and by the sides of the box. Which have ghosts is held fixed.
    """
    assert particles.box is not None
    home, period = wrapped(particles), Period.of(particles.box)
    bare = dataclasses.replace(home, box=None)
    usable = (period.sides > 0).all() & jnp.isfinite(period.sides).all()
    fits = jnp.where(particles.valid, particles.support, 0).max(initial=0) <= period.sides.min()
    word = faults.raised(faults.BAD_BOX, ~(usable & fits))
    near, gaps = _near(home, margin, ROUNDING)
    capacity = particles.capacity
    own = jnp.arange(capacity, dtype=jnp.int32)
    if room == 0:
        return bare, own, word | faults.raised(faults.GHOST_OVERFLOW, near.any())
    source = jnp.nonzero(near, size=room, fill_value=capacity)[0].astype(jnp.int32)
    inside = jnp.minimum(source, capacity - 1)
    of_images = jnp.stack([_reaches(Gaps(*(gap[inside] for gap in gaps)), image) for image in IMAGES], 1)
    made = of_images & (source < capacity)[:, None]
    number = made.sum(dtype=jnp.int32)
    place = jnp.nonzero(made.ravel(), size=room, fill_value=0)[0].astype(jnp.int32)
    exists = jnp.arange(room, dtype=jnp.int32) < number
    origin = inside[place // len(IMAGES)]
    ghosts = bare.at(origin)
    ghosts = _moved(ghosts, jnp.asarray(IMAGES, home.dtype)[place % len(IMAGES)], period)
    ghosts = dataclasses.replace(ghosts, valid=ghosts.valid & exists)
    word |= faults.raised(faults.GHOST_OVERFLOW, (number > room) | (near.sum(dtype=jnp.int32) > room))
    together = jax.tree.map(lambda home, more: jnp.concatenate([home, more]), bare, ghosts)
    return together, jnp.concatenate([own, origin]), word


def num_ghosts(particles: Particles, margin: Any = 0.0) -> int:
    """How many ghosts particles have, or a few more (host side); 0 without a box."""
    return 0 if particles.box is None else int(_counted(particles, jnp.asarray(margin, particles.dtype)))


def with_ghosts(particles: Particles) -> Particles:
    """Particles of no period, with the ghosts they have (host side); to be shown within their box.

    Raises:
        ValueError: a box that is not usable.
    """
    if particles.box is None:
        return particles
    found, word = _unfolded(particles, room=capacity_class(num_ghosts(particles)))
    if int(word):
        raise ValueError(f"these particles cannot be repeated across the faces of their box: {faults.describe(int(word))}")
    return found


def centered(particles: Particles, at: Any) -> Particles:
    """See `Particles.centered`."""
    if particles.box is None:
        raise ValueError("particles must have a periodic box to be centred; give `box=(Lx, Ly, Lz)` to `Particles.from_arrays`")
    if isinstance(at, str):
        if at != "densest":
            raise ValueError(f"`at` must be x, y and z or 'densest', got {at!r}")
        at = densest(particles)
    at = in_unit("at", at, particles.length_unit)
    if is_traced(at, particles):
        half = 0.5 * particles.box.sides
        lower = jnp.asarray(at, particles.dtype) - half
        return wrapped(dataclasses.replace(particles, box=Box(lower, lower + particles.box.sides)))
    require_shape("at", at, (3,), "give x, y and z, or 'densest'")
    require_finite("at", at, "give x, y and z, or 'densest'")
    ends = particles.box.corners()
    half = (ends[1] - ends[0]) / 2
    corners = (np.asarray(at, np.float64) + sign * half for sign in (-1, 1))
    return wrapped(dataclasses.replace(particles, box=Box(*corners).of_dtype(particles.dtype)))


def densest(particles: Particles) -> np.ndarray:
    """Where most particles lie within a support, for its volume, (3,) float64 (host side); across faces, too.

    Raises:
        ValueError: no particles.
    """
    valid = np.asarray(particles.valid)
    if not valid.any():
        raise ValueError("there are no particles, so none is the densest; give x, y and z")
    position, support = particles.exact_position()[valid], np.asarray(particles.support, np.float64)[valid]
    if support.max() > VARYING * support.min():  # codes adapt supports to the number density
        return np.asarray(position[support.argmin()])
    place, period = position, None
    if particles.box is not None:
        lower, upper = particles.box.corners()
        period = upper - lower
        place = np.mod(position - lower, period)
        place = np.where(place >= period, 0, place)
    tree = scipy.spatial.KDTree(place, boxsize=period)
    number = tree.query_ball_point(place, support, return_length=True, workers=-1)
    return np.asarray(position[(number / support**3).argmax()])


_unfolded = jax.jit(unfolded, static_argnames="room")


@jax.jit
def _counted(particles: Particles, margin: Float[Array, ""]) -> Int[Array, ""]:
    near, gaps = _near(wrapped(particles), margin, COUNTED)
    return sum(((near & _reaches(gaps, image)).sum(dtype=jnp.int32) for image in IMAGES), jnp.int32(0))


def _near(particles: Particles, margin: Any, rounding: int) -> tuple[Array, Gaps]:
    """Particles that reach over a face or so near to it, and how far all are from faces."""
    assert particles.box is not None
    particles = lax.stop_gradient(particles)
    box, eps = particles.box, rounding * jnp.finfo(particles.dtype).eps
    assert box is not None
    size = jnp.maximum(jnp.abs(box.lower), jnp.abs(box.upper)).max() + margin
    below, above = particles.position - box.lower, box.upper - particles.position
    reach = (particles.support + margin) * (1 + eps) + eps * size
    near = particles.valid & (jnp.minimum(below, above) < reach[:, None]).any(1)
    return near, Gaps(below, above, reach)


def _reaches(gaps: Gaps, image: np.ndarray) -> Array:
    """Whether an image reaches into the box: one a period further up is as far above as the particle is from the lower face."""
    away = [(gaps.below if step > 0 else gaps.above)[:, k] for k, step in enumerate(image) if step]
    return jnp.sum(jnp.maximum(jnp.stack(away), 0) ** 2, 0) < gaps.reach * gaps.reach


def _moved(particles: Particles, periods: Float[Array, "particles 3"], period: Period) -> Particles:
    """By so many periods; with what that rounds off, where what rounding has left is kept."""
    position, left = _two_sum(particles.position, periods * period.sides)
    if particles.position_rest is None:
        return dataclasses.replace(particles, position=position)
    rest = particles.position_rest + (left + periods * period.rest)
    return dataclasses.replace(particles, position=position, position_rest=rest)


def _two_sum(first: Array, second: Array) -> tuple[Array, Array]:
    """A sum, and what rounding it has left (Knuth 1969, section 4.2.2)."""
    total = first + second
    part = lax.stop_gradient(total - first)
    left = (lax.stop_gradient(first) - (lax.stop_gradient(total) - part)) + (lax.stop_gradient(second) - part)
    return total, left
