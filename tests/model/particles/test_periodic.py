"""Ghosts are the images that reach into a box, no fewer and not many more; and what is wrong with a period is said."""

from __future__ import annotations

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsph as js
from jaxsph.model.particles import periodic
from jaxsph.model.particles.periodic import num_ghosts
from jaxsph.numerics import faults

pytestmark = pytest.mark.usefixtures("quick_programs")

SIDES = np.array([1.0, 1.5, 0.8])
unfolded = jax.jit(periodic.unfolded, static_argnames="room")


def particles(count=60, largest=0.3, dtype=np.float32, lower=0.0, **more):
    rng = np.random.default_rng(0)
    position = lower + rng.uniform(0, 1, (count, 3)) * SIDES
    columns = rng.uniform(0.05, largest, count), rng.uniform(0, 1, count), rng.uniform(0.5, 1, count)
    box = js.Box(np.full(3, lower), lower + SIDES) if lower else SIDES
    return js.Particles.from_arrays(position.astype(dtype), *columns, box=box, **more)


def images(given, margin=0.0):
    """All images of all particles that reach to the box or so near, in float64: entries and places."""
    lower, upper = given.box.corners()
    position, support = given.exact_position()[: given.num_particles], np.asarray(given.support, np.float64)
    found = []
    for turns in itertools.product(range(-2, 3), repeat=3):
        place = position + np.array(turns) * (upper - lower)
        gap = np.linalg.norm(np.maximum(np.maximum(lower - place, place - upper), 0), axis=1)
        found += [(i, *place[i]) for i in np.flatnonzero(gap < support[: len(place)] + margin) if any(turns)]
    return np.array(found)


@pytest.mark.parametrize(("largest", "margin"), [(0.3, 0.0), (0.78, 0.0), (0.2, 0.15)], ids=["small", "beyond a half", "margin"])
def test_every_image_that_reaches_into_the_box_is_a_ghost(largest, margin):
    given = particles(largest=largest)
    truth = images(given, margin)
    room = num_ghosts(given, margin)
    assert len(truth) <= room <= len(truth) + 2
    found, _, word = unfolded(given, room=room, margin=margin)
    assert int(word) == faults.NONE and found.box is None
    ghosts = found.to_numpy()["position"][given.num_particles :]
    distance = np.linalg.norm(ghosts[:, None] - truth[:, 1:], axis=-1)
    assert (distance.min(0) < 1e-6).all()  # each image has its ghost
    assert len(ghosts) <= len(truth) + 2
    carried = found.to_numpy()["quantity"][given.num_particles :]
    assert np.array_equal(carried, np.asarray(given.quantity)[truth[distance.argmin(1), 0].astype(int)])


def test_positions_outside_of_the_box_are_wrapped_with_all_their_digits():
    """By whole periods, of a box whose lower corner is not the origin."""
    given = particles(lower=1e4)
    shifted = given.exact_position()[:60] + np.random.default_rng(1).integers(-3, 4, (60, 3)) * SIDES
    moved = js.Particles.from_arrays(shifted, np.asarray(given.support)[:60], 0.5, box=given.box)
    assert moved.position_rest is not None
    home = moved.wrapped().exact_position()[:60]
    turns = (home - given.exact_position()[:60]) / SIDES
    assert np.abs(turns - np.round(turns)).max() < 1e-6
    assert (home > 1e4 - 1e-6).all() and (home < 1e4 + SIDES + 1e-6).all()


def test_too_little_room_is_a_fault_and_no_loss_goes_unsaid():
    given = particles()
    for room in (0, 1, num_ghosts(given) // 2):
        assert int(unfolded(given, room=room)[-1]) == faults.GHOST_OVERFLOW
    assert int(unfolded(given, room=num_ghosts(given) + 7)[-1]) == faults.NONE


def test_a_period_that_shrinks_under_jit_is_a_fault():
    given = particles()
    word = jax.jit(lambda upper: unfolded(dataclasses.replace(given, box=js.Box(np.zeros(3), upper)), room=500)[-1])
    assert int(word(np.float32(SIDES))) == faults.NONE
    for upper in ([1, -1, 1], [1, 0.2, 1], [1, np.nan, 1]):
        assert int(word(np.float32(upper))) & faults.BAD_BOX


def test_derivatives_by_ghosts_are_those_by_the_particles_that_they_are_of(x64):
    given = particles(12, dtype=np.float64)
    room = num_ghosts(given)
    weight = np.random.default_rng(2).normal(size=(given.capacity + room, 3))

    def total(position):
        found, *_ = unfolded(dataclasses.replace(given, position=position), room=room)
        return jnp.where(found.valid[:, None], weight * found.position, 0).sum()

    gradient = np.asarray(jax.jit(jax.grad(total))(given.position))
    found, *_ = unfolded(given, room=room)
    expected = weight[: given.capacity].copy()
    expected[~np.asarray(given.valid)] = 0
    original = np.asarray(given.position)
    for ghost in np.flatnonzero(np.asarray(found.valid))[12:]:
        turns = (np.asarray(found.position)[ghost] - original[:12]) / SIDES
        own = np.abs(turns - np.round(turns)).max(1).argmin()
        expected[own] += weight[ghost]
    np.testing.assert_allclose(gradient, expected, atol=1e-12)


def test_a_set_is_centred_on_a_point_or_where_it_is_densest():
    rng = np.random.default_rng(3)
    position = np.concatenate([rng.uniform(0, 1, (200, 3)) * SIDES, np.mod(rng.normal(0, 0.03, (60, 3)), SIDES)])
    for support in (0.1, np.where(np.arange(260) < 200, 0.2, 0.08)):
        given = js.Particles.from_arrays(position, support, 0.0, box=SIDES)
        lower, upper = given.centered("densest").bounds()
        off = (lower + upper) / 2 / SIDES
        assert np.abs(off - np.round(off)).max() < 0.15  # the crowd is at a corner, on both sides of each face
    at = (0.9, 0.1, 0.7)
    moved = given.centered(at)
    lower, upper = moved.bounds()
    np.testing.assert_allclose((lower + upper) / 2, at, atol=1e-6)
    place = moved.to_numpy()["position"]
    assert (place >= lower - 1e-6).all() and (place <= upper + 1e-6).all()
    assert np.allclose(jax.jit(lambda point: given.centered(point).position)(np.float32(at)), moved.position, atol=1e-6)


def test_the_box_goes_with_the_particles_through_padding_and_preparation():
    given = particles()
    for other in (given.padded(200), js.prepare(given), given.at(slice(10))):
        assert other.box is not None and np.allclose(other.box.upper, SIDES)


@pytest.mark.parametrize(
    ("box", "words"),
    [
        ((1, 2), "`box` must have shape"),
        ((1, -1, 1), "`box` must be > 0"),
        ((1, np.inf, 1), "`box` must be finite"),
        ((1, 0.2, 1), "no side shorter than the largest support, but 0.2 < 0.29"),
    ],
)
def test_bad_periods_are_refused_by_name(box, words):
    with pytest.raises(ValueError, match=words):
        js.Particles.from_arrays(np.zeros((2, 3)), [0.1, 0.29], 0.0, box=box)


def test_only_periodic_sets_are_centred():
    with pytest.raises(ValueError, match="must have a periodic box"):
        js.Particles.from_arrays(np.zeros((2, 3)), 0.1, 0.0).centered((0, 0, 0))
    with pytest.raises(ValueError, match="`at` must be"):
        particles().centered("middle")
