"""Fields along single rays are those of slabs; between two depths they stay below their bound; gradients are differences."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from derivatives import QUICKLY
from examples import examples
from hypothesis import given
from hypothesis import strategies as st
from slabs_drawn import FORMS, drawn

from jaxsph.engine.field.gather import gather
from jaxsph.engine.field.piercing import Piercing, SlabRays
from jaxsph.engine.field.scattered import gather_scattered
from jaxsph.engine.field.sums import by_rays

KERNELS = "poly6", "cubic_spline", "wendland_c2"
AMID = 33  # places in an interval


@functools.partial(jax.jit, static_argnames="kernel", compiler_options=QUICKLY)
def bounded(ordered, rank, task, level, kernel):
    rays = Piercing.of(ordered, rank, task, kernel)
    return rays.bound(task.depth - rays.lines.middle, level)


@functools.partial(jax.jit, static_argnames="kernel", compiler_options=QUICKLY)
def weighed(ordered, rank, task, depth, kernel):
    rays = Piercing.of(ordered, rank, task, kernel)
    place = jnp.moveaxis(depth - rays.lines.middle[..., None], 1, 0)
    return jnp.moveaxis(jax.lax.map(rays.weights, place), 0, 1)


@functools.partial(jax.jit, static_argnames="kernel", compiler_options=QUICKLY)
def found_at(ordered, rank, task, depth, kernel):
    rays = Piercing.of(ordered, rank, task, kernel)
    return rays.found(depth - rays.lines.middle)


@functools.partial(jax.jit, static_argnames="kernel", compiler_options=QUICKLY)
def of_slabs(ordered, rank, task, kernel):
    return by_rays((gather_scattered if task.scattered else gather)(ordered, rank, task, kernel))[0]


def slabs(seed, form):
    return drawn(np.random.default_rng(seed), form)


def all_rays(task, depth):
    """Depths (tasks, places) as those of every ray."""
    return jnp.broadcast_to(depth[..., None], (*depth.shape, task.shape[2]))


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("form", FORMS)
def test_the_field_is_that_of_slabs(form, kernel):
    with jax.enable_x64(True):
        given = slabs(1, form)
        expected = np.asarray(of_slabs(*given, kernel))
        found = weighed(*given, all_rays(given[2], given[2].depth), kernel)
        np.testing.assert_allclose(found, expected, atol=1e-12 * expected.max(), rtol=1e-9)
    assert (expected > 0).any() and (expected == 0).any()


@pytest.mark.parametrize("form", FORMS)
@examples(5)
@given(seed=st.integers(0, 2**32 - 1), kernel=st.sampled_from(KERNELS))
def test_between_two_depths_the_field_is_below_its_bound(form, seed, kernel):
    with jax.enable_x64(True):
        given = slabs(seed, form)
        begin, end = given[2].depth[:, :-1], given[2].depth[:, 1:]
        bound = bounded(*given, jnp.inf, kernel)
        upper = np.asarray(bound.upper)
        rounding = 64 * np.finfo(float).eps * upper.max(initial=0)
        for share in np.linspace(0, 1, AMID):
            inside = weighed(*given, all_rays(given[2], begin + share * (end - begin)), kernel)
            assert (np.asarray(inside) <= upper + rounding).all()


@pytest.mark.parametrize("form", FORMS)
def test_where_one_particle_alone_reaches_a_level_its_foot_is_asked_for(form):
    with jax.enable_x64(True):
        given = slabs(2, form)
        middle = 0.5 * (given[2].border[:, :1] + given[2].border[:, -1:])[..., None]
        free = bounded(*given, jnp.inf, "poly6")
        level = 0.25 * float(np.median(np.asarray(free.upper)[np.asarray(free.upper) > 0]))
        found = bounded(*given, level, "poly6")
        alone = np.asarray(found.place) != np.asarray(free.place)
        assert alone.any()
        there = np.asarray(weighed(*given, found.place + middle, "poly6"))
        assert (there[alone] >= level * (1 - 1e-9)).all()
        begin, end = given[2].depth[:, :-1, None] - middle, given[2].depth[:, 1:, None] - middle
        assert ((found.place >= begin) & (found.place <= end)).all()


@pytest.mark.parametrize("form", FORMS)
def test_gradients_are_differences(form):
    with jax.enable_x64(True):
        given = slabs(3, form)
        task, step = given[2], 1e-6
        depth = all_rays(task, task.depth[:, 2:3])[:, 0]
        found, lines = found_at(*given, depth, "poly6"), SlabRays.of(task)
        slope = found.gradient[0] * lines.slope_u + found.gradient[1] * lines.slope_v + found.gradient[2]
        ahead, behind = (weighed(*given, (depth + move)[:, None], "poly6")[:, 0] for move in (step, -step))
        np.testing.assert_allclose(slope, (ahead - behind) / (2 * step), atol=1e-4 * float(jnp.abs(slope).max()))
        np.testing.assert_allclose(found.weight, weighed(*given, depth[:, None], "poly6")[:, 0], rtol=1e-12)
