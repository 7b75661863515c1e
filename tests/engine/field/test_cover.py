"""What a cover says of rays is what a union of chords says in float64, one by one."""

from __future__ import annotations

import functools
import types

import jax
import numpy as np
import pytest
from derivatives import QUICKLY
from examples import examples
from hypothesis import given
from hypothesis import strategies as st
from slabs_drawn import FORMS, SAMPLES, TASKS, drawn

from jaxsph.engine.field.cover import bordered, cover_of, pivot_of
from jaxsph.model.particles.kernels import KERNELS


def chords_of(ordered, rank, task, rays, item):
    """Of a slab: depths (rays, particles) at which its rays enter and leave particles, and those particles."""
    begin, length = np.asarray(task.entry.begin), np.asarray(task.entry.length)
    places = np.concatenate([begin[k, item] + np.arange(length[k, item]) for k in range(2)])
    some = np.asarray(rank)[places]
    x, y, z, scale, size = (np.asarray(getattr(ordered, name))[some] for name in ("x", "y", "z", "scale", "size"))
    u, v = (np.asarray(value)[item][:, None] for value in rays)
    slope = np.stack([u, v, np.ones_like(u)], -1) if task.perspective else np.broadcast_to([0.0, 0.0, 1.0], (*u.shape, 3))
    center = np.stack([x, y, z], -1)[None] - (0 if task.perspective else np.stack([u, v, 0 * u], -1))
    length = (slope**2).sum(-1)
    foot = (center * slope).sum(-1) / length
    inner = (size / scale) ** 2 - ((center - foot[..., None] * slope) ** 2).sum(-1)
    half = np.sqrt(np.maximum(inner, 0) / length)
    first, last = np.asarray(task.border)[item, [0, -1]]
    met = (inner > 0) & (foot + half > first) & (foot - half < last)
    return np.where(met, foot - half, np.inf), np.where(met, foot + half, -np.inf), some


def chords_and_inside(ordered, rank, task):
    """Chords of each slab, and which samples lie within one."""
    rays, at = ray_coordinates(task), np.asarray(task.depth)[:, :, None, None]
    found = [chords_of(ordered, rank, task, rays, item) for item in range(TASKS)]
    return found, np.stack([((begin < at[item]) & (end > at[item])).any(-1) for item, (begin, end, _) in enumerate(found)])


@jax.jit
def ray_coordinates(task):
    return task.ray_coordinates()


@functools.partial(jax.jit, compiler_options=QUICKLY)
def covers(ordered, rank, task, inside):
    """Pieces, what they cover between the borders, and their pivots."""
    pivot = pivot_of(inside.astype(float), 3, task)
    cover = cover_of(ordered, rank, task, pivot)
    return cover, cover.length(task.border[:, :-1, None], task.border[:, 1:, None]), pivot


@pytest.mark.parametrize("form", FORMS)
@examples(5)
@given(seed=st.integers(0, 2**32 - 1))
def test_pieces_are_those_of_the_chords_in_front_of_the_pivot_and_behind_it(form, seed):
    with jax.enable_x64(True):
        ordered, rank, task = drawn(np.random.default_rng(seed), form)
        found, inside = chords_and_inside(ordered, rank, task)
        depth, border = np.asarray(task.depth), np.asarray(task.border)
        cover, length, pivots = jax.tree.map(np.asarray, covers(ordered, rank, task, inside))
        for item, (begin, end, some) in enumerate(found):
            for ray in np.flatnonzero(~inside[item].all(0)) if len(some) else ():
                pivot, covered = pivots[item, ray], 0
                assert pivot in depth[item][~inside[item, :, ray]]
                for piece, mine in enumerate((end[ray] < pivot, end[ray] >= pivot)):
                    of_piece = [one[piece, item, ray] for one in cover]
                    mine &= end[ray] > begin[ray]
                    if not mine.any():
                        assert of_piece[0] > of_piece[1]
                        continue
                    first, last = np.where(mine, begin[ray], np.inf).argmin(), np.where(mine, end[ray], -np.inf).argmax()
                    np.testing.assert_allclose(of_piece, [begin[ray, first], end[ray, last], first, last], rtol=1e-9, atol=1e-9)
                    within = np.minimum(border[item, 1:], end[ray, last]) - np.maximum(border[item, :-1], begin[ray, first])
                    covered = covered + np.maximum(within, 0)
                np.testing.assert_allclose(length[item, :, ray], covered, atol=1e-9)


@functools.partial(jax.jit, static_argnames="edge", compiler_options=QUICKLY)
def pivots(weight, depth, border, edge):
    return pivot_of(weight, edge, types.SimpleNamespace(depth=depth, border=border, part=None))


@examples(30)
@given(seed=st.integers(0, 2**32 - 1))
def test_no_chord_reaches_over_the_pivot(seed):
    """It is an outer sample where there is one: the first behind an inner one, if any is."""
    inside = np.random.default_rng(seed).uniform(size=(6, SAMPLES, 7)) < 0.5
    border = np.broadcast_to(np.arange(SAMPLES + 1.0, dtype=np.float32), (6, SAMPLES + 1))
    depth = border[:, 1:] - np.float32(0.5)
    pivot = np.asarray(pivots(inside.astype(np.float32), depth, border, 3))
    for item in range(6):
        for ray in range(7):
            outer = np.flatnonzero(~inside[item, :, ray])
            behind = [k for k in outer if inside[item, :k, ray].any()]
            wanted = np.inf if not outer.size else depth[item, behind[0] if behind else outer[-1]]
            assert pivot[item, ray] == wanted


def weights_along(kernel, feet, away, radius, samples):
    """Of a ray past some particles, at samples; lengths in samples. And where chords begin and end."""
    half = radius * np.sqrt(1 - away**2)
    square = away**2 + ((samples - np.asarray(feet)[:, None]) / radius) ** 2
    weight = (np.asarray(KERNELS[kernel].of_square(square, np), float) * (square < 1)).sum(0)
    return weight, np.asarray(feet) - half, np.asarray(feet) + half


@pytest.mark.parametrize("kernel", KERNELS)
@examples(30)
@given(foot=st.floats(-6, 6), away=st.floats(0, 0.95), radius=st.floats(4, 40))
def test_slabs_are_looked_at_that_end_within_half_a_sample_of_a_border(kernel, foot, away, radius):
    weight, (begin,), (end,) = weights_along(kernel, [foot], away, radius, np.arange(4.0))
    outer, falls, rises = (np.asarray(one)[0, :, 0] for one in bordered(weight[None, :, None], KERNELS[kernel].edge))
    if end - begin > 4 and (-0.5 < begin < 3.5 or -0.5 < end < 3.5):
        assert (outer | falls | rises).any()
    np.testing.assert_array_equal(outer, weight <= 0)


@pytest.mark.parametrize("kernel", KERNELS)
@examples(30)
@given(place=st.floats(0.01, 0.98), gap=st.floats(0.01, 0.97), away=st.floats(0, 0.9), radius=st.floats(8, 40))
def test_the_pivot_lies_between_the_middles_of_chords_with_a_gap_between_two_inner_samples(kernel, place, gap, away, radius):
    half, place, border = radius * np.sqrt(1 - away**2), 1 + min(place, 0.99 - gap), np.arange(5.0) - 0.5
    feet = place - half, place + gap + half
    weight, _, _ = weights_along(kernel, feet, away, radius, np.arange(4.0))
    pivot = pivots(*(one[None].astype(np.float32) for one in (weight[:, None], np.arange(4.0), border)), KERNELS[kernel].edge)
    if (weight > 0).all() and place > 1:
        assert feet[0] < float(pivot[0, 0]) < feet[1]
