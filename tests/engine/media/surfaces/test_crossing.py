"""Brackets hold the first change of sign that borders show, or one in front of it; and the root, once they are narrowed."""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from derivatives import QUICKLY
from examples import examples
from hypothesis import given
from hypothesis import strategies as st
from slabs_drawn import drawn

from jaxsph.engine.field.piercing import Piercing
from jaxsph.engine.media.surfaces.crossing import at_crossings, first_crossings

KERNEL = "cubic_spline"


def on_borders(seed, form):
    ordered, rank, task = drawn(np.random.default_rng(seed), form)
    return ordered, rank, dataclasses.replace(task, depth=task.border)


@functools.partial(jax.jit, compiler_options=QUICKLY)
def looked_for(ordered, rank, task, level):
    """The field on borders, brackets, the ends of narrowed ones, and the field at the ends of the first and at the roots."""

    def rays_of(some):
        return Piercing.through(ordered, rank, some, KERNEL)

    rays, shape = rays_of(task), (task.shape[0], task.shape[2])

    def field(depth):
        return rays.weights(jnp.broadcast_to(depth[:, None], shape))

    weight = jnp.moveaxis(jax.lax.map(field, (task.border - rays.middle).T), 0, 1)
    found = first_crossings(rays_of, task, weight, level, None)

    def look(bracket, _, again):  # nowhere off the level: it is not asked for again
        return jnp.stack([bracket.low, bracket.high, bracket.secant(), jnp.where(again, jnp.nan, 0 * bracket.low)], 1)

    low, high, root, _ = jnp.moveaxis(at_crossings(rays_of, task, found, level, look, 4), 1, 0)
    return weight, found, (low, high), [rays.weights(at) for at in (found.low, found.high, root)]


def level_for(given, share):
    """Of what fields have where they have any."""
    weight = np.asarray(looked_for(*given, 1.0)[0])
    return float(np.quantile(weight[weight > 0], share)) if (weight > 0).any() else 1.0


@pytest.mark.parametrize("form", ["perspective", "scattered"])  # all forms: see `test_piercing.py`
@examples(6)
@given(seed=st.integers(0, 2**32 - 1), share=st.floats(0.3, 0.95))
def test_brackets_hold_the_first_crossing_of_borders_or_one_in_front_of_it(form, seed, share):
    with jax.enable_x64(True):
        given = on_borders(seed, form)
        level = level_for(given, share)
        weight, found, ends, (low, high, at_root) = (jax.tree.map(np.asarray, one) for one in looked_for(*given, level))
        inside = weight >= level
        crossed = inside[:, 1:] != inside[:, :-1]
        first = np.where(crossed.any(1), crossed.argmax(1), np.inf)
        met = found.interval >= 0
        assert (met >= crossed.any(1)).all() and (found.interval <= first)[met].all()
        np.testing.assert_allclose(low[met] - level, found.at_low[met], atol=1e-10 * level)
        np.testing.assert_allclose(high[met] - level, found.at_high[met], atol=1e-10 * level)
        assert ((low >= level) != (high >= level))[met].all() and (found.low <= found.high)[met].all()
        assert ((ends[0] >= found.low - 1e-12) & (ends[1] <= found.high + 1e-12))[met].all()
        np.testing.assert_allclose(at_root[met], level, rtol=1e-6)  # however far apart borders are
