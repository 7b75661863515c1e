"""Parts of a band that are cast side by side make the image that one would."""

from __future__ import annotations

import importlib
import os

import jax.numpy as jnp
import numpy as np
import pytest

import jaxsph as js
from jaxsph.cast.shards import MAX_SHARDS, joined, shards_at_hand
from jaxsph.cast.march import Rays


def test_what_is_dealt_is_joined_in_its_place():
    number, parts = 8, 4
    color, rest = np.arange(3 * number * 64.0).reshape(3, number, 8, 8), np.arange(number * 64.0).reshape(number, 8, 8)
    shard = [Rays(color[:, k::parts], rest[k::parts], -rest[k::parts], rest[k::parts, 0, 0]) for k in range(parts)]
    found = joined(tuple(shard))
    np.testing.assert_array_equal(found.color, color)
    np.testing.assert_array_equal(found.transmittance, rest)
    np.testing.assert_array_equal(found.depth, -rest)
    np.testing.assert_array_equal(found.evaluations, rest[:, 0, 0])


@pytest.mark.parametrize(("cores", "parts"), [(1, 1), (2, 2), (3, 2), (4, 4), (7, 4), (64, MAX_SHARDS)])
def test_parts_are_as_many_as_cores_but_divide_any_band(monkeypatch, cores, parts):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(cores)), raising=False)
    assert shards_at_hand(jnp.zeros(1)) == parts
    assert 4 % parts == 0, "a tile has four bundles"


@pytest.mark.parametrize("estimator", ["interval", "pilot", pytest.param(None, marks=pytest.mark.slow)])
def test_any_number_of_parts_makes_the_same_image(monkeypatch, estimator):
    scene, camera = js.scenes.load("checker_board", 3000, width=150, height=130)
    settings = js.Settings(samples=96) if estimator is None else js.Settings(samples=96, tolerance=0.05, estimator=estimator)
    plan, images = js.plan(scene, camera, settings), []
    for parts in (1, MAX_SHARDS):
        monkeypatch.setattr(importlib.import_module("jaxsph.render"), "shards_at_hand", lambda _, parts=parts: parts)
        images.append(js.render(scene, camera, settings, plan=plan))
    if estimator == "pilot":  # slabs are interpolated
        assert images[0].stats["evaluations"] < 0.5 * images[0].stats["evaluations_full"]
    for layer in ("color", "transmittance", "depth", "error_bound", "evaluations"):
        np.testing.assert_array_equal(*(np.asarray(getattr(image, layer)) for image in images))
