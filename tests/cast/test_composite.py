"""Depth of half transmittance and transmittance tell the same story."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

import jaxsph as js


@given(seed=st.integers(0, 2**32 - 1))
def test_depth_is_finite_exactly_where_transmittance_falls_to_one_half(frames, seed):
    rng = np.random.default_rng(seed)
    scene, camera = frames.scene(rng, decades=0.5), frames.camera(rng)
    image = js.render(scene, camera, frames.settings, plan=frames.plan())
    depth = np.asarray(image.depth)
    np.testing.assert_array_equal(np.isfinite(depth), np.asarray(image.transmittance) <= 0.5)
    assert not np.isnan(depth).any()
    assert (depth[np.isfinite(depth)] <= float(camera.far) * (1 + 1e-6)).all()
