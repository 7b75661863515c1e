"""Depth of half transmittance and transmittance tell the same story."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import jaxsph as js
from jaxsph.cast.composite import FEW, RAYS, TOGETHER, composite, fresh, unlit


@given(seed=st.integers(0, 2**32 - 1))
def test_depth_is_finite_exactly_where_transmittance_falls_to_one_half(frames, seed):
    rng = np.random.default_rng(seed)
    scene, camera = frames.scene(rng, decades=0.5), frames.camera(rng)
    image = js.render(scene, camera, frames.settings, plan=frames.plan())
    depth = np.asarray(image.depth)
    np.testing.assert_array_equal(np.isfinite(depth), np.asarray(image.transmittance) <= 0.5)
    assert not np.isnan(depth).any()
    assert (depth[np.isfinite(depth)] <= float(camera.far) * (1 + 1e-6)).all()


@pytest.mark.parametrize("crossing", [0, 1, FEW, FEW + 1, TOGETHER + FEW + 1])
def test_depth_is_found_in_all_bundles_that_cross_however_many(crossing):
    """One layer of slabs of four samples: of every ray that falls to one half, where along its thickness that is."""
    rng, bundles = np.random.default_rng(crossing), TOGETHER + 2 * FEW
    thickness = rng.uniform(0.2, 0.6, (bundles, 4, RAYS)).astype(np.float32)
    thin = np.ones(bundles, bool)
    thin[rng.permutation(bundles)[:crossing]] = False
    thickness[thin] /= 16
    *color, left, _ = unlit(bundles + 1, 4, jnp.float32)
    left = left.at[:bundles].set(np.exp(-thickness.sum(1)))
    light = *color, left, jnp.zeros((bundles + 1, 4, RAYS)).at[:bundles].set(thickness)
    border, each = jnp.asarray([1.0, 1.5, 2.5, 4.0, 4.25]), jnp.arange(bundles)
    start, first, number = jnp.asarray([0, bundles], jnp.int32), jnp.int32(0), jnp.int32(bundles)
    state = composite(fresh(bundles, jnp.float32), light, each, lambda at: jnp.tile(border, (at.size, 1)), start, first, number)
    behind = np.cumsum(np.concatenate([np.zeros((bundles, 1, RAYS)), thickness], 1), 1)
    wanted = np.full((bundles, RAYS), np.inf)
    for at in np.ndindex(wanted.shape):
        if behind[at[0], -1, at[1]] >= np.log(2):
            wanted[at] = np.interp(np.log(2), behind[at[0], :, at[1]], border)
    np.testing.assert_array_equal(np.isfinite(wanted).any(1), ~thin)
    np.testing.assert_allclose(state[-1][:bundles], wanted, rtol=1e-5)
