"""Between two depths fields along single rays stay below their bound, and in slabs below that of all rays."""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from derivatives import QUICKLY
from examples import examples
from hypothesis import given, strategies as st

from jaxsph.engine.access.view import Ordered
from jaxsph.engine.field.piercing import Piercing, upper_of_packets
from jaxsph.engine.field.tasks import SlabSchedule, SlabTask

TASKS, SAMPLES, COLUMNS, ROWS, PARTICLES = 34, 5, 3, 4, 30  # more slabs than are looked at together
NEAR, FAR = 1.0, 4.0
FORMS = "perspective", "orthographic", "scattered"
KERNELS = "poly6", "cubic_spline", "wendland_c2"
EACH = [*((FORMS[0], kernel) for kernel in KERNELS), *((form, "poly6") for form in FORMS[1:])]  # neither knows of the other
AMID = 33  # places in an interval


@functools.partial(jax.jit, static_argnames="kernel", compiler_options=QUICKLY)
def bounded(ordered, rank, task, level, kernel):
    rays = Piercing.through(ordered, rank, task, kernel)
    return *rays.bound(task.depth - rays.middle, level), upper_of_packets(ordered, rank, task, kernel)


@functools.partial(jax.jit, static_argnames="kernel", compiler_options=QUICKLY)
def weighed(ordered, rank, task, depth, kernel):
    rays = Piercing.through(ordered, rank, task, kernel)
    place = jnp.moveaxis(depth - rays.middle[..., None], 1, 0)
    return jnp.moveaxis(jax.lax.map(rays.weights, place), 0, 1)


def slabs(seed, form):
    """Particles in two windows a slab, and slabs that tile a depth, their rays all about: without a camera or a grid."""
    rng = np.random.default_rng(seed)
    support = 0.7 * 10 ** -rng.uniform(0, 1.7, PARTICLES)
    x, y = rng.uniform(-0.7, 0.7, (2, PARTICLES))
    scale = 10 ** rng.uniform(-1, 1, PARTICLES)
    where = {"x": x, "y": y, "z": rng.uniform(NEAR, FAR, PARTICLES), "scale": scale, "size": scale * support}
    columns = where | {"quantity": rng.uniform(0, 1, PARTICLES)}
    unread = dict.fromkeys(field.name for field in dataclasses.fields(Ordered))
    ordered = Ordered(**unread | columns)
    begin = np.stack([np.zeros(TASKS), rng.integers(10, 20, TASKS)]).astype(np.int32)
    length = np.stack([rng.integers(0, 10, TASKS), rng.integers(0, 10, TASKS)]).astype(np.int32)
    reference = rng.uniform(0, 1, TASKS)
    zero = np.zeros(TASKS, np.int32)
    entry = SlabSchedule(np.ones(TASKS, bool), zero, begin, length, length.sum(0), (reference,))
    first = rng.uniform(NEAR, FAR, (TASKS, 1))
    border = first + rng.uniform(0.05, 0.5, (TASKS, 1)) * np.arange(SAMPLES + 1)
    depth = 0.5 * (border[:, 1:] + border[:, :-1])
    count = COLUMNS if form != "scattered" else ROWS
    u, v = rng.uniform(-0.4, 0.4, (TASKS, count)), rng.uniform(-0.4, 0.4, (TASKS, ROWS))
    task = SlabTask(entry, zero, zero, u, v, depth, border, form != "orthographic", form == "scattered", between=True)
    return ordered, rng.permutation(PARTICLES).astype(np.int32), task


def all_rays(task, depth):
    """Depths (tasks, places) as those of every ray."""
    return np.broadcast_to(np.asarray(depth)[..., None], (*depth.shape, task.shape[2]))


def weights_at(given, depth, kernel):
    """Weights at up to as many places as slabs have samples, (tasks, places, rays): one program for all numbers of them."""
    depth = np.asarray(depth)
    padded = np.pad(depth, ((0, 0), (0, SAMPLES - depth.shape[1]), (0, 0)), mode="edge")
    return np.asarray(weighed(*given, padded, kernel))[:, : depth.shape[1]]


@pytest.mark.parametrize(("form", "kernel"), EACH)
@examples(5)
@given(seed=st.integers(0, 2**32 - 1))
def test_between_two_depths_the_field_is_below_its_bound(form, kernel, seed):
    with jax.enable_x64(True):
        given = slabs(seed, form)
        depth = np.asarray(given[2].depth)
        begin, end = depth[:, :-1], depth[:, 1:]
        upper, _, of_all = (np.asarray(one) for one in bounded(*given, np.inf, kernel))
        rounding = 64 * np.finfo(float).eps * upper.max(initial=0)
        for share in np.linspace(0, 1, AMID):
            inside = weights_at(given, all_rays(given[2], begin + share * (end - begin)), kernel)
            assert (inside <= upper + rounding).all()
            assert (inside.max((1, 2)) <= of_all + rounding).all()


@pytest.mark.parametrize("form", FORMS)
def test_where_one_particle_alone_reaches_a_level_its_foot_is_asked_for(form):
    with jax.enable_x64(True):
        given = slabs(2, form)
        depth, border = np.asarray(given[2].depth)[..., None], np.asarray(given[2].border)
        middle = 0.5 * (border[:, :1] + border[:, -1:])[..., None]
        upper, free, _ = (np.asarray(one) for one in bounded(*given, np.inf, "poly6"))
        level = 0.25 * float(np.median(upper[upper > 0]))
        place = np.asarray(bounded(*given, level, "poly6")[1])
        alone = place != free
        assert alone.any()
        assert (weights_at(given, place + middle, "poly6")[alone] >= level * (1 - 1e-9)).all()
        assert ((place >= depth[:, :-1] - middle) & (place <= depth[:, 1:] - middle)).all()
