"""Shares, the sample more of each ray, and ranges are what NumPy finds in float64, ray by ray."""

from __future__ import annotations

import functools

import jax
import numpy as np
import pytest
from derivatives import QUICKLY
from examples import examples
from hypothesis import given
from hypothesis import strategies as st
from slabs_drawn import FORMS, SAMPLES, TASKS, drawn

from jaxsph.engine.field.gather import gather
from jaxsph.engine.media.between import PLACE, covered, ranges_of
from jaxsph.model.particles.kernels import KERNELS

KERNEL = "poly6"


@functools.partial(jax.jit, compiler_options=QUICKLY)
def found_of(ordered, rank, task):
    """Sums at samples, what is covered, sums where samples are taken, shares, and ranges."""
    sums = gather(ordered, rank, task, KERNEL)
    found = covered(ordered, rank, task, sums, KERNEL)
    chosen, share = found.chosen(task)
    return found.cover, found.rows[:, PLACE], chosen, share, ranges_of(chosen, share, task), task.ray_coordinates()


def sums_along(ordered, rank, task, rays, item, ray, depth):
    """Sums of weights and of quantities less the reference, at depths of a ray."""
    begin, length = np.asarray(task.entry.begin), np.asarray(task.entry.length)
    some = np.asarray(rank)[np.concatenate([begin[k, item] + np.arange(length[k, item]) for k in range(2)])]
    x, y, z, scale, size, quantity = (
        np.asarray(getattr(ordered, name))[some] for name in ("x", "y", "z", "scale", "size", "quantity")
    )
    u, v = (value[item, ray] * (depth if task.perspective else np.ones_like(depth)) for value in rays)
    square = sum(((at[:, None] - own) * scale) ** 2 for at, own in ((u, x), (v, y), (depth, z)))
    kernel = KERNELS[KERNEL]
    weight = kernel.weigh(kernel.prepare(square, size), 0.0, size, np)
    return weight.sum(1), (weight * (quantity - np.asarray(task.entry.references[0])[item])).sum(1)


@pytest.mark.parametrize("form", FORMS)
@examples(4)
@given(seed=st.integers(0, 2**32 - 1))
def test_samples_count_as_far_as_they_are_covered_and_are_taken_where_they_are(form, seed):
    with jax.enable_x64(True):
        ordered, rank, task = drawn(np.random.default_rng(seed), form)
        cover, place, (weight, weighted), share, ((near, far),), rays = jax.tree.map(np.asarray, found_of(ordered, rank, task))
        border, middle = np.asarray(task.border), np.asarray(task.depth)
        for item, ray in np.ndindex(TASKS, weight.shape[2]):
            own, _ = sums_along(ordered, rank, task, rays, item, ray, middle[item])
            where = np.where(own > 0, middle[item], place[item, ray])
            at, of = sums_along(ordered, rank, task, rays, item, ray, where)
            np.testing.assert_allclose(weight[item, :, ray], at, atol=1e-12)
            np.testing.assert_allclose(weighted[item, :, ray], of, atol=1e-12)
            begin, end = border[item, :-1], border[item, 1:]
            pieces = zip(*(np.clip(ends[:, item, ray], -99, 99) for ends in cover[:2]), strict=True)
            length = sum(np.maximum(np.minimum(end, back) - np.maximum(begin, front), 0) for front, back in pieces)
            np.testing.assert_allclose(share[item, :, ray], np.where(at > 0, length / (end - begin), 0), atol=1e-9)
            there = share[item, :, ray] > 0
            quantity = np.asarray(task.entry.references[0])[item] + np.divide(of, at, out=np.zeros_like(of), where=at > 0)
            np.testing.assert_allclose(0.5 * (near + far)[item, :, ray][there], quantity[there], atol=1e-9)
            steps = [[quantity[n] - quantity[k] for n in (k - 1, k + 1) if 0 <= n < SAMPLES and there[n]] for k in range(SAMPLES)]
            wide = [abs(np.diff(one)[0] / 2 if len(one) == 2 else sum(one)) for one in steps]
            np.testing.assert_allclose(np.abs(far - near)[item, :, ray][there], (wide * share[item, :, ray])[there], atol=1e-9)


@functools.partial(jax.jit, static_argnames="level", compiler_options=QUICKLY)
def parts_of(task, level):
    return [task.refined(np.int32(level), np.int32(nth)) for nth in range(1 << level)]


@pytest.mark.parametrize("level", [0, 2])
def test_parts_of_a_slab_divide_each_of_its_samples_evenly(level):
    with jax.enable_x64(True):
        _, _, task = drawn(np.random.default_rng(1), "perspective")
        parts = [jax.tree.map(np.asarray, part) for part in parts_of(task, level)]
        number, border = 1 << level, np.asarray(task.border)
        shares = np.arange(number) / number
        inner = (border[:, :-1, None] + shares * np.diff(border)[..., None]).reshape(TASKS, -1)
        found = np.concatenate([part.border[:, :-1] for part in parts] + [parts[-1].border[:, -1:]], 1)
        np.testing.assert_allclose(found, np.concatenate([inner, border[:, -1:]], 1), rtol=1e-12)
        for part in parts:
            np.testing.assert_allclose(part.depth, 0.5 * (part.border[:, 1:] + part.border[:, :-1]), rtol=1e-12)
