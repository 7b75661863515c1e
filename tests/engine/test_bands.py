"""Promises of one frame over several devices: everything is done once, and no bit of the image tells."""

import dataclasses
import itertools
import json
from unittest import mock

import numpy as np
import pytest
from examples import examples
from forced import ran
from hypothesis import given, strategies as st

from jaxsph.engine.access import lists as access
from jaxsph.engine.access.grid import shard
from jaxsph.engine.access.lists import BUNDLE, bundle_origins

SAME_BITS = """
import json, sys
import numpy as np
import jaxsph as js

LAYERS = "color", "transmittance", "depth", "error_bound", "evaluations"
scene, camera = js.scenes.load(sys.argv[1], int(sys.argv[2]), width=int(sys.argv[3]), height=int(sys.argv[4]))
given, told = json.loads(sys.argv[5]), {}
settings = js.Settings(**given)
one = js.render(scene, camera, settings)
for devices in json.loads(sys.argv[6]):
    several = js.render(scene, camera, settings, devices=devices)
    same = [np.array_equal(getattr(one, layer), getattr(several, layer), equal_nan=True) for layer in LAYERS]
    same += [one.stats[name] == several.stats[name] for name in ("evaluations", "evaluations_full", "cells", "pairs")]
    told[str(devices)] = all(same) and one.certified == several.certified
try:
    js.render(scene, camera, settings, devices=5)
except ValueError as error:
    told["too many"] = str(error)
told["shown"] = float(one.alpha.mean())
told["bands"] = js.plan(scene, camera, settings).bands
told["share"] = one.stats["evaluations"] / one.stats["evaluations_full"]
print(json.dumps(told))
"""


def same_bits(name, particles, size, devices, **given):
    return ran(SAME_BITS, name, str(particles), *map(str, size), json.dumps(given), json.dumps(devices))


def test_two_devices_make_the_bits_of_one_and_five_of_four_are_refused():
    told = same_bits("checker_board", 400, (40, 24), [2], samples=16)
    assert told["2"] and told["shown"] > 0.1
    assert "there are 4 devices" in told["too many"] and "got 5" in told["too many"]


@pytest.mark.slow
@pytest.mark.parametrize(
    "given",
    [
        {"samples": 96, "tolerance": 0.05},
        {"samples": 96, "tolerance": 0.05, "estimator": "pilot"},
        {"samples": 64, "integrator": "segments"},
        {"samples": 64, "tolerance": 0.03, "screen": "quadtree"},
    ],
    ids=["bounds", "pilot", "segments", "quadtree"],
)
def test_any_number_of_devices_makes_the_bits_of_one(given):
    told = same_bits("checker_board", 3000, (150, 130), [1, 3, 4, "all"], **given)
    assert all(told[name] for name in ("1", "3", "4", "all")) and told["shown"] > 0.1
    if given.get("estimator") == "pilot":
        assert told["share"] < 0.8


@pytest.mark.slow
def test_several_bands_over_devices_make_the_bits_of_those_of_one_device():
    told = same_bits("checker_board", 3000, (150, 130), [2, 4], samples=64, tolerance=0.05, memory_limit=12_000_000)
    assert told["bands"] > 1 and told["2"] and told["4"]


@examples(8)
@given(shards=st.integers(1, 12), rows=st.integers(1, 3), columns=st.integers(1, 4), bands=st.integers(1, 2))
def test_every_pixel_is_of_exactly_one_shard(frames, shards, rows, columns, bands):
    plan = frames.plan()
    lists = dataclasses.replace(plan.lists, tile_rows=rows, tile_columns=columns)
    plan = dataclasses.replace(plan, bands=bands, lists=lists, width=16 * columns, height=16 * rows * bands).dealt(shards)
    cast = np.zeros((plan.height, 16 * plan.lists.tile_columns), int)
    for band, nth in itertools.product(range(bands), range(shards)):
        with mock.patch.object(access, "jnp", np):  # as they are, without a program for each shape
            origins = bundle_origins(plan.lists, band * plan.band_height)
        for row, column in zip(*shard(origins, nth, shards), strict=True):
            cast[row : row + BUNDLE, column : column + BUNDLE] += 1
    assert (cast[:, : plan.width] == 1).all()
