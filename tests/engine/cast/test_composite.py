"""Depth of half transmittance and transmittance tell the same story."""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from derivatives import QUICKLY
from hypothesis import given
from hypothesis import strategies as st

import jaxsph as js
from jaxsph.engine.cast.batches import Batch
from jaxsph.engine.cast.composite import Together, composite, empty_segments, fresh_rays
from jaxsph.engine.runtime.tuning import CPU

RAYS, TOGETHER, FEW = 64, CPU.bundles_composited, CPU.half_depths_found


@pytest.mark.usefixtures("quick_programs")
@given(seed=st.integers(0, 2**32 - 1))
def test_depth_is_finite_exactly_where_transmittance_falls_to_one_half(frames, seed):
    rng = np.random.default_rng(seed)
    scene, camera = frames.scene(rng, decades=0.5), frames.camera(rng)
    image = js.render(scene, camera, frames.settings, plan=frames.plan())
    depth = np.asarray(image.depth)
    np.testing.assert_array_equal(np.isfinite(depth), np.asarray(image.transmittance) <= 0.5)
    assert not np.isnan(depth).any()
    assert (depth[np.isfinite(depth)] <= float(camera.far) * (1 + 1e-6)).all()


@functools.partial(jax.jit, static_argnums=3, compiler_options=QUICKLY)
def composited(transmittance, thickness, border, together):
    """One layer of slabs, one for each bundle, of four samples."""
    bundles, each = len(thickness), jnp.arange(len(thickness))
    light = empty_segments(bundles + 1, 4, RAYS, jnp.float32)
    put = (getattr(light, name).at[:bundles] for name in ("transmittance", "thickness"))
    left, passed = (part.set(value) for part, value in zip(put, (transmittance, thickness), strict=True))
    light = dataclasses.replace(light, transmittance=left, thickness=passed)
    batch = Batch(each, each, each, jnp.int32(0), jnp.int32(bundles), jnp.int32(1))
    starts = jnp.asarray([0, bundles], jnp.int32)
    rays = fresh_rays(bundles, RAYS, jnp.float32, together)
    return composite(rays, light, batch, lambda place: jnp.tile(border, (place.size, 1)), starts, together)


@pytest.mark.parametrize(("crossing", "tuning"), [
    *((crossing, CPU) for crossing in (0, 1, FEW, FEW + 1, TOGETHER + FEW + 1)),
    (FEW + 1, dataclasses.replace(CPU, bundles_composited=1 << 14)),
    (FEW + 1, dataclasses.replace(CPU, bundles_composited=1 << 14, half_depths_found=1 << 14)),
])  # fmt: skip
def test_depth_is_found_in_all_bundles_that_cross_however_many(crossing, tuning):
    """One layer of slabs of four samples: of every ray that falls to one half, where along its thickness that is."""
    rng, bundles = np.random.default_rng(crossing), TOGETHER + 2 * FEW
    thickness = rng.uniform(0.2, 0.6, (bundles, 4, RAYS)).astype(np.float32)
    thin = np.ones(bundles, bool)
    thin[rng.permutation(bundles)[:crossing]] = False
    thickness[thin] /= 16
    border = np.float32([1.0, 1.5, 2.5, 4.0, 4.25])
    state = composited(np.exp(-thickness.sum(1)), thickness, border, Together.of(bundles, tuning))
    behind = np.cumsum(np.concatenate([np.zeros((bundles, 1, RAYS)), thickness], 1), 1)
    wanted = np.full((bundles, RAYS), np.inf)
    for at in np.ndindex(wanted.shape):
        if behind[at[0], -1, at[1]] >= np.log(2):
            wanted[at] = np.interp(np.log(2), behind[at[0], :, at[1]], border)
    np.testing.assert_array_equal(np.isfinite(wanted).any(1), ~thin)
    np.testing.assert_allclose(np.asarray(state.depth)[:bundles], wanted, rtol=1e-5)
    np.testing.assert_allclose(np.asarray(state.transmittance)[:bundles], np.exp(-behind[:, -1]), rtol=1e-5)
