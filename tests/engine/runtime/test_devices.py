"""Devices that share a frame are named in several ways, and those that are not there are refused."""

from __future__ import annotations

import jax
import numpy as np
import pytest
from jax.sharding import AxisType, Mesh

from jaxsph.engine.runtime.devices import chosen_devices, mesh_of

HERE = tuple(jax.local_devices())


@pytest.mark.parametrize("devices", ["all", len(HERE), np.int64(len(HERE)), list(HERE), HERE, Mesh(np.array(HERE), ("a",))])
def test_all_ways_to_name_all_devices_mean_the_same(devices):
    assert chosen_devices(devices) == HERE
    assert mesh_of(devices).size == len(HERE)


def test_a_mesh_is_taken_as_it_is():
    mesh = Mesh(np.array(HERE), ("tiles",), axis_types=(AxisType.Explicit,))
    assert mesh_of(mesh) is mesh


@pytest.mark.parametrize("devices", [0, -1, len(HERE) + 1, [], "some", 1.5, True, ["cpu"], [HERE[0], HERE[0]]])
def test_what_is_not_there_is_refused_by_name(devices):
    with pytest.raises(ValueError, match="`devices` must be"):
        chosen_devices(devices)


def test_too_many_are_told_how_many_there_are():
    with pytest.raises(ValueError, match=rf"there (is|are) {len(HERE)} device"):
        chosen_devices(len(HERE) + 1)
