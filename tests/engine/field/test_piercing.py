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
from slabs_drawn import FORMS, SAMPLES, drawn

from jaxsph.engine.field.gather import gather
from jaxsph.engine.field.piercing import Piercing
from jaxsph.engine.field.sums import by_rays

KERNELS = "poly6", "cubic_spline", "wendland_c2"
EACH = [*((FORMS[0], kernel) for kernel in KERNELS), *((form, "poly6") for form in FORMS[1:])]  # neither knows of the other
AMID = 33  # places in an interval


@functools.partial(jax.jit, static_argnames="kernel", compiler_options=QUICKLY)
def bounded(ordered, rank, task, level, kernel):
    rays = Piercing.through(ordered, rank, task, kernel)
    return rays.bound(task.depth - rays.middle, level)


@functools.partial(jax.jit, static_argnames="kernel", compiler_options=QUICKLY)
def weighed(ordered, rank, task, depth, kernel):
    rays = Piercing.through(ordered, rank, task, kernel)
    place = jnp.moveaxis(depth - rays.middle[..., None], 1, 0)
    return jnp.moveaxis(jax.lax.map(rays.weights, place), 0, 1)


@functools.partial(jax.jit, static_argnames="kernel", compiler_options=QUICKLY)
def found_at(ordered, rank, task, depth, kernel):
    rays = Piercing.through(ordered, rank, task, kernel)
    found = rays.found(depth - rays.middle)
    return (found.weight, found.gradient), (rays.slope_u, rays.slope_v)


@functools.partial(jax.jit, static_argnames="kernel", compiler_options=QUICKLY)
def of_slabs(ordered, rank, task, kernel):
    return by_rays(gather(ordered, rank, task, kernel))[0]


def slabs(seed, form):
    return drawn(np.random.default_rng(seed), form)


def all_rays(task, depth):
    """Depths (tasks, places) as those of every ray."""
    return np.broadcast_to(np.asarray(depth)[..., None], (*depth.shape, task.shape[2]))


def weights_at(given, depth, kernel):
    """Weights at up to as many places as slabs have samples, (tasks, places, rays): one program for all numbers of them."""
    depth = np.asarray(depth)
    padded = np.pad(depth, ((0, 0), (0, SAMPLES - depth.shape[1]), (0, 0)), mode="edge")
    return np.asarray(weighed(*given, padded, kernel))[:, : depth.shape[1]]


@pytest.mark.parametrize(("form", "kernel"), EACH)
def test_the_field_is_that_of_slabs(form, kernel):
    with jax.enable_x64(True):
        given = slabs(1, form)
        expected = np.asarray(of_slabs(*given, kernel))
        found = weights_at(given, all_rays(given[2], given[2].depth), kernel)
        np.testing.assert_allclose(found, expected, atol=1e-12 * expected.max(), rtol=1e-9)
    assert (expected > 0).any() and (expected == 0).any()


@pytest.mark.parametrize(("form", "kernel"), EACH)
@examples(5)
@given(seed=st.integers(0, 2**32 - 1))
def test_between_two_depths_the_field_is_below_its_bound(form, kernel, seed):
    with jax.enable_x64(True):
        given = slabs(seed, form)
        depth = np.asarray(given[2].depth)
        begin, end = depth[:, :-1], depth[:, 1:]
        upper = np.asarray(bounded(*given, np.inf, kernel)[0])
        rounding = 64 * np.finfo(float).eps * upper.max(initial=0)
        for share in np.linspace(0, 1, AMID):
            inside = weights_at(given, all_rays(given[2], begin + share * (end - begin)), kernel)
            assert (inside <= upper + rounding).all()


@pytest.mark.parametrize("form", FORMS)
def test_where_one_particle_alone_reaches_a_level_its_foot_is_asked_for(form):
    with jax.enable_x64(True):
        given = slabs(2, form)
        depth, border = np.asarray(given[2].depth)[..., None], np.asarray(given[2].border)
        middle = 0.5 * (border[:, :1] + border[:, -1:])[..., None]
        upper, free = (np.asarray(one) for one in bounded(*given, np.inf, "poly6"))
        level = 0.25 * float(np.median(upper[upper > 0]))
        place = np.asarray(bounded(*given, level, "poly6")[1])
        alone = place != free
        assert alone.any()
        assert (weights_at(given, place + middle, "poly6")[alone] >= level * (1 - 1e-9)).all()
        assert ((place >= depth[:, :-1] - middle) & (place <= depth[:, 1:] - middle)).all()


@pytest.mark.parametrize("form", FORMS)
def test_gradients_are_differences(form):
    with jax.enable_x64(True):
        given = slabs(3, form)
        step, depth = 1e-6, all_rays(given[2], given[2].depth[:, 2:3])[:, 0]
        (weight, gradient), slopes = jax.tree.map(np.asarray, found_at(*given, depth, "poly6"))
        slope = gradient[0] * slopes[0] + gradient[1] * slopes[1] + gradient[2]
        ahead, there, behind = np.moveaxis(weights_at(given, np.stack([depth + step, depth, depth - step], 1), "poly6"), 1, 0)
        np.testing.assert_allclose(slope, (ahead - behind) / (2 * step), atol=1e-4 * np.abs(slope).max())
        np.testing.assert_allclose(weight, there, rtol=1e-12)
