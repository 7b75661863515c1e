"""Parts of a band that are cast side by side make the image that one would."""

from __future__ import annotations

import importlib

import jax.numpy as jnp
import numpy as np
import pytest

import jaxsph as js
from jaxsph.cast.parts import MOST, joined, parts_at_hand
from jaxsph.cast.points import Rays


def test_what_is_dealt_is_joined_in_its_place():
    number, parts = 8, 4
    color, rest = np.arange(3 * number * 64.0).reshape(3, number, 8, 8), np.arange(number * 64.0).reshape(number, 8, 8)
    dealt = [Rays(color[:, k::parts], rest[k::parts], -rest[k::parts], rest[k::parts, 0, 0]) for k in range(parts)]
    found = joined(tuple(dealt))
    np.testing.assert_array_equal(found.color, color)
    np.testing.assert_array_equal(found.transmittance, rest)
    np.testing.assert_array_equal(found.depth, -rest)
    np.testing.assert_array_equal(found.evaluations, rest[:, 0, 0])


def test_parts_divide_any_band():
    assert parts_at_hand(jnp.zeros(1)) in (1, 2, MOST)


@pytest.mark.parametrize("estimator", [None, "interval", "pilot"])
def test_any_number_of_parts_makes_the_same_image(monkeypatch, estimator):
    scene, camera = js.scenes.load("checker_board", 6000, width=90, height=70)
    settings = js.Settings(samples=96) if estimator is None else js.Settings(samples=96, tolerance=0.02, estimator=estimator)
    plan, images = js.plan(scene, camera, settings), []
    for parts in (1, MOST):
        monkeypatch.setattr(importlib.import_module("jaxsph.render"), "parts_at_hand", lambda _, parts=parts: parts)
        images.append(js.render(scene, camera, settings, plan=plan))
    # what is interpolated may be rounded otherwise beside other slabs, where XLA compiles another path for them
    close = np.testing.assert_array_equal if estimator != "pilot" else lambda a, b: np.testing.assert_allclose(a, b, atol=3e-6)
    for layer in ("color", "transmittance", "depth", "error_bound", "evaluations"):
        close(*(np.asarray(getattr(image, layer)) for image in images))
