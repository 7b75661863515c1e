"""What slabs are worth is read and put in place, as light is; and control points are owed what their samples are worth."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsph as js
from jaxsph.access.compaction import stack
from jaxsph.cast.composite import composite, fresh, unlit
from jaxsph.cast.replay import Samples, owe_transfer, unseen, value_slabs
from jaxsph.model.transfer import SELECT_ALL
from tests.shared.programs import copies_in_loops

SLABS, BUNDLES, SAMPLES = 5, 331, 4


def stretch():
    """One stretch that holds all slabs: light of none, where each is held, where the layers begin."""
    filled = jnp.asarray(np.random.default_rng(0).uniform(size=(SLABS, BUNDLES)) < 0.7)
    stacks, held = stack(filled), SLABS * BUNDLES
    return unlit(held + 1, SAMPLES, jnp.float32), jnp.arange(held), stacks.start, jnp.int32(0), filled.sum(dtype=jnp.int32)


def test_a_copy_in_a_loop_is_found():
    """So that finding none means something: each turn reads the image that it changes, after having changed it."""

    def turn(k, image):
        reversed_image = image[::-1]
        return image.at[k].set(reversed_image[k]) + reversed_image * (k > 3)

    image = jnp.zeros((7, 8, 64))
    assert copies_in_loops(lambda image: jax.lax.fori_loop(0, 5, turn, image), (image,), image.shape) != []


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


@pytest.mark.parametrize("spacing", ["even", "uneven"])
@pytest.mark.parametrize("points", [2, SELECT_ALL, SELECT_ALL + 1, 40])
def test_control_points_are_owed_by_the_samples_between_them(points, spacing, x64):
    """However many there are: on either side of where they are searched rather than compared."""
    rng = np.random.default_rng(points)
    values = {"even": np.linspace(-1, 2, points), "uneven": np.sort(rng.uniform(-1, 2, points))}[spacing]
    segments = js.TransferFunction.from_points(values, np.zeros((points, 3)), np.zeros(points)).segments()
    found, *worth = rng.normal(0.5, 1, (6, 3, 4, 64))
    samples = Samples(None, None, [jnp.asarray(value) for value in worth[:4]], jnp.asarray(worth[4]), None, jnp.asarray(found))
    wanted = np.zeros((5, points))
    at = np.clip(np.searchsorted(values, found, side="right") - 1, 0, points - 2)
    part = np.clip((found - values[at]) / (values[at + 1] - values[at]), 0, 1)
    for row, value in zip(wanted, [*worth[:4], -worth[4]], strict=True):
        np.add.at(row, at, (1 - part) * value)
        np.add.at(row, at + 1, part * value)
    np.testing.assert_allclose(owe_transfer(samples, segments), wanted, rtol=1e-9, atol=1e-9)
