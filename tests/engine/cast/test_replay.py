"""Cotangents of slabs are put in place as light is, and no image is copied for either."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
from programs import copies_in_loops

from jaxsph.engine.access.compaction import compact
from jaxsph.engine.cast.batches import Batch
from jaxsph.engine.cast.composite import Together, composite, empty_segments, fresh_rays, fresh_replay, pull_composite
from jaxsph.engine.runtime.tuning import CPU

SLABS, BUNDLES, SAMPLES, RAYS = 5, 331, 4, 64
TOGETHER = Together.of(BUNDLES, CPU)


@jax.jit
def batch_of(filled):
    """One batch that holds all slabs, light of none, and where the layers begin."""
    compacted, slots = compact(filled), SLABS * BUNDLES
    each = jnp.arange(slots)
    found = (each, each, each, jnp.int32(0), filled.sum(dtype=jnp.int32), jnp.int32(1))
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
    rays = jax.jit(lambda: fresh_rays(BUNDLES, RAYS, jnp.float32, TOGETHER))()
    borders = functools.partial(jnp.full, fill_value=0.0, dtype=jnp.float32)

    def put(rays, light, found, starts):
        return composite(rays, light, Batch(*found), lambda place: borders((place.shape[0], SAMPLES + 1)), starts, TOGETHER)

    assert copies_in_loops(put, (rays, *batch()), rays.transmittance.shape) == []


def test_pulling_back_copies_no_image():
    image = np.zeros((3, BUNDLES, 8, 8), np.float32), np.ones((BUNDLES, 8, 8), np.float32)
    state = jax.jit(functools.partial(fresh_replay, together=TOGETHER))(image, image, np.arange(BUNDLES))

    def pull(state, light, found, starts):
        return pull_composite(state, (*light.color, light.transmittance), Batch(*found), starts, TOGETHER)

    assert copies_in_loops(pull, (state, *batch()), state.transmittance.shape) == []
