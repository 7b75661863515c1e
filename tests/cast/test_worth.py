"""What slabs are worth is read and put in place, as light is."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np

from jaxsph.access.stacks import stack
from jaxsph.cast.composite import composite, fresh, unlit
from jaxsph.cast.worth import unseen, value_slabs
from tests.shared.programs import copies_in_loops

SLABS, BUNDLES, SAMPLES = 5, 331, 4


def stretch():
    """One stretch that holds all slabs: light of none, where each is held, where the layers begin."""
    filled = jnp.asarray(np.random.default_rng(0).uniform(size=(SLABS, BUNDLES)) < 0.7)
    stacks, held = stack(filled), SLABS * BUNDLES
    return unlit(held + 1, SAMPLES, jnp.float32), jnp.arange(held), stacks.start, jnp.int32(0), filled.sum(dtype=jnp.int32)


def test_compositing_copies_no_image():
    state, (light, *where) = fresh(BUNDLES, jnp.float32), stretch()
    borders = functools.partial(jnp.full, fill_value=0.0, dtype=jnp.float32)

    def put(state, light, *where):
        return composite(state, light, where[0], lambda at: borders((at.shape[0], SAMPLES + 1)), *where[1:])

    assert copies_in_loops(put, (state, light, *where), state[0].shape) == []


def test_valuing_copies_no_image():
    image = jnp.zeros((3, BUNDLES, 8, 8)), jnp.ones((BUNDLES, 8, 8))
    seen = jax.jit(unseen)(image, image, jnp.arange(BUNDLES))
    assert copies_in_loops(value_slabs, (seen, *stretch()), seen.transmittance.shape) == []
