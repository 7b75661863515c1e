"""What a cover says of rays is what a union of chords says in float64, one by one."""

from __future__ import annotations

import dataclasses
import functools

import jax
import numpy as np
import pytest
from derivatives import QUICKLY
from examples import examples
from hypothesis import given
from hypothesis import strategies as st
from slabs_drawn import FORMS, SAMPLES, TASKS, drawn

from jaxsph.engine.field.cover import cover_of, outer_pivot


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
    """By quantities, by places, and measured."""
    measured = dataclasses.replace(task, measured=True)
    return [
        cover_of(ordered, rank, some, inside, label)
        for some, label in ((task, "quantity"), (task, "place"), (measured, "quantity"))
    ]


@pytest.mark.parametrize("form", FORMS)
@examples(5)
@given(seed=st.integers(0, 2**32 - 1))
def test_pieces_are_those_of_the_chords_in_front_of_the_pivot_and_behind_it(form, seed):
    with jax.enable_x64(True):
        ordered, rank, task = drawn(np.random.default_rng(seed), form)
        found, inside = chords_and_inside(ordered, rank, task)
        depth, references = np.asarray(task.depth), np.asarray(task.entry.references[0])
        cover, by_place, _ = jax.tree.map(np.asarray, covers(ordered, rank, task, inside))
        for item, (begin, end, some) in enumerate(found):
            quantity = np.asarray(ordered.quantity)[some] - references[item]
            for ray in np.flatnonzero(~inside[item].all(0)) if len(some) else ():
                pivot = cover.pivot[item, ray]
                assert pivot in depth[item][~inside[item, :, ray]]
                for piece, mine in enumerate((end[ray] < pivot, end[ray] >= pivot)):
                    of_piece = [getattr(cover, name)[piece, item, ray] for name in ("front", "back", "of_front", "of_back")]
                    mine &= end[ray] > begin[ray]
                    if not mine.any():
                        assert of_piece[0] > of_piece[1]
                        continue
                    first, last = np.where(mine, begin[ray], np.inf).argmin(), np.where(mine, end[ray], -np.inf).argmax()
                    wanted = begin[ray, first], end[ray, last], quantity[first], quantity[last]
                    np.testing.assert_allclose(of_piece, wanted, rtol=1e-9, atol=1e-9)
                    places = [getattr(by_place, name)[piece, item, ray] for name in ("of_front", "of_back")]
                    assert places == [first, last]


pivots = jax.jit(outer_pivot)


@examples(30)
@given(seed=st.integers(0, 2**32 - 1))
def test_no_chord_reaches_over_the_pivot(seed):
    """It is an outer sample where there is one: the first behind an inner one, if any is."""
    inside = np.random.default_rng(seed).uniform(size=(6, SAMPLES, 7)) < 0.5
    depth = np.cumsum(np.ones((6, SAMPLES)), 1)
    pivot = np.asarray(pivots(inside, depth.astype(np.float32)))
    for item in range(6):
        for ray in range(7):
            outer = np.flatnonzero(~inside[item, :, ray])
            behind = [k for k in outer if inside[item, :k, ray].any()]
            wanted = np.inf if not outer.size else depth[item, behind[0] if behind else outer[-1]]
            assert pivot[item, ray] == wanted


@pytest.mark.parametrize("form", FORMS)
def test_the_length_of_all_chords_in_a_slab_is_measured_where_it_is_asked_for(form):
    with jax.enable_x64(True):
        ordered, rank, task = drawn(np.random.default_rng(5), form)
        found, inside = chords_and_inside(ordered, rank, task)
        unmeasured, _, cover = covers(ordered, rank, task, inside)
        assert unmeasured.length is None
        length, (first, last) = np.asarray(cover.length), (np.asarray(task.border)[:, k] for k in (0, -1))
        for item, (begin, end, _) in enumerate(found):
            expected = np.clip(np.minimum(end, last[item]) - np.maximum(begin, first[item]), 0, None).sum(-1)
            looked_at = (~inside[item]).any()
            np.testing.assert_allclose(length[:, item].sum(0), expected if looked_at else 0, atol=1e-12)
