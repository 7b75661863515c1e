"""Depth of half transmittance and transmittance tell the same story; light and cotangents are put in place without a copy."""

from __future__ import annotations

import dataclasses
import functools
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from derivatives import QUICKLY
from hypothesis import given, strategies as st

import jaxsph as js
from jaxsph.engine.access.compaction import compact
from jaxsph.engine.cast.batches import Batch
from jaxsph.engine.cast.composite import (
    RayLayers,
    SlabLight,
    Together,
    composite,
    empty_segments,
    fresh_rays,
    fresh_replay,
    pull_composite,
)
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
    batch = Batch(each, each, each, jnp.int32(0), jnp.int32(bundles), jnp.int32(1), jnp.int32(1))
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


SLABS, BUNDLES, SAMPLES = 5, 331, 4
HELD = Together.of(BUNDLES, CPU)


def copies_in_loops(function, arguments, shape):
    """Copies of arrays whose shape ends in `shape`, anywhere but at the top of the compiled program."""
    copy = re.compile(rf"\w+\[(\d+,)*{','.join(map(str, shape))}\]\S* copy\(")
    found, top = [], False
    for line in jax.jit(function).lower(*arguments).compile().as_text().splitlines():
        if line.startswith(("%", "ENTRY")):
            top = line.startswith("ENTRY")
        elif not top and copy.search(line):
            found.append(line.strip())
    return found


@jax.jit
def batch_of(filled):
    """One batch that holds all slabs, light of none, and where the layers begin."""
    compacted, slots = compact(filled), SLABS * BUNDLES
    each = jnp.arange(slots)
    found = (each, each, each, jnp.int32(0), filled.sum(dtype=jnp.int32), jnp.int32(1), jnp.int32(1))
    return empty_segments(slots + 1, SAMPLES, RAYS, jnp.float32), found, compacted.start


def batch():
    return batch_of(np.random.default_rng(0).uniform(size=(SLABS, BUNDLES)) < 0.7)


def test_a_copy_in_a_loop_is_found():
    """So that finding none means something: each turn reads the image that it changes, after having changed it."""

    def turn(k, image):
        reversed_image = image[::-1]
        return image.at[k].set(reversed_image[k]) + reversed_image * (k > 3)

    image = np.zeros((7, 8, 64), np.float32)
    assert copies_in_loops(lambda image: jax.lax.fori_loop(0, 5, turn, image), (image,), image.shape) != []


def test_compositing_copies_no_image():
    rays = jax.jit(lambda: fresh_rays(BUNDLES, RAYS, jnp.float32, HELD))()
    borders = functools.partial(jnp.full, fill_value=0.0, dtype=jnp.float32)

    def put(rays, light, found, starts):
        return composite(rays, light, Batch(*found), lambda place: borders((place.shape[0], SAMPLES + 1)), starts, HELD)

    assert copies_in_loops(put, (rays, *batch()), rays.transmittance.shape) == []


def test_pulling_back_copies_no_image():
    image = RayLayers(np.zeros((3, BUNDLES, 8, 8), np.float32), np.ones((BUNDLES, 8, 8), np.float32))
    state = jax.jit(functools.partial(fresh_replay, together=HELD))(image, image, np.arange(BUNDLES))

    def pull(state, light, found, starts):
        return pull_composite(state, SlabLight(light.color, light.transmittance), Batch(*found), starts, HELD)

    assert copies_in_loops(pull, (state, *batch()), state.transmittance.shape) == []
