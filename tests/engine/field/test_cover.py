"""Rays are told apart where no chord reaches, and slabs are looked at that may have a border."""

from __future__ import annotations

import functools
import types

import jax
import numpy as np
import pytest
from derivatives import QUICKLY
from examples import examples
from hypothesis import given, strategies as st

from jaxsph.engine.field.cover import bordered, pivot_of
from jaxsph.model.particles.kernels import KERNELS

SAMPLES = 5


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
