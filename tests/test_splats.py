"""No pixel of splats is further from chords than its bound, whatever is attempted; and what is not wrong has hardly any bound."""

import dataclasses

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

import jaxsph as js

SETTINGS = js.Settings(samples=21)
EPS = np.finfo(np.float64).eps
ROUNDING = (4 * SETTINGS.samples + 64) * EPS
COUNT = 6
unit = st.floats(0, 1, width=32)


def numbers(*shape):
    return hnp.arrays(np.float64, shape, elements=unit, fill=st.nothing())


def camera(projection="perspective", near=1.6, far=3.4, size=12):
    frame = {"width": size, "height": size - 1, "near": near, "far": far}
    if projection == "perspective":
        return js.Camera.look_at(np.array([0.1, 0.2, -2.5]), np.zeros(3), fov_degrees=40.0, **frame)
    return js.Camera.orthographic(np.array([0.1, 0.2, -2.5]), np.zeros(3), view_height=1.8, **frame)


@st.composite
def point_sets(draw, **given):
    """Few points: apart, overlapping, in the same place, cut by near and far; from nothing to walls."""
    centre = draw(st.sampled_from([1.0, 0.3, 0.0])) * (2 * draw(numbers(COUNT, 3)) - 1)
    centre[:, 2] += draw(st.sampled_from([0.0, -0.8, 0.8]))
    radius = draw(st.sampled_from([0.02, 0.2, 0.8])) * (0.1 + draw(numbers(COUNT)))
    weight = draw(hnp.arrays(np.float64, COUNT, elements=st.sampled_from([0.0, 0.1, 1.0, 5.0, 1e3, 1e9]), fill=st.nothing()))
    color = np.round(draw(numbers(COUNT, 3)))
    return js.Points.from_arrays(centre, radius, color, weight / radius, draw(st.sampled_from(["gaussian", "ball"])), **given)


def chords(scene):
    points = tuple(dataclasses.replace(one, spread="chords", splats_beyond=None) for one in scene.point_sets)
    return dataclasses.replace(scene, points=points)


def wrong(scene, view, settings):
    """By how much splats differ from chords, in the worst of channels and alpha; and the bound."""
    splats, truth = js.render(scene, view, settings), js.render(chords(scene), view, settings)
    layers = [(np.asarray(image.color), np.asarray(image.alpha)[..., None]) for image in (splats, truth)]
    difference = np.abs(np.concatenate(layers[0], -1) - np.concatenate(layers[1], -1)).max(-1)
    return difference, np.asarray(js.splat_bound(scene, view, settings))


def volume():
    values = np.linspace(0, 1, 27).reshape(3, 3, 3)
    look = js.TransferFunction.from_points(np.array([0.0, 1.0]), np.array([[0.0, 1, 0], [1, 0, 1]]), np.array([0.0, 3.0]))
    return {"volume": js.Volume.from_array(values, np.full(3, -0.6), 0.6), "volume_transfer": look}


@pytest.mark.parametrize("projection", ["perspective", "orthographic"])
@settings(max_examples=25)
@given(st.data())
def test_no_pixel_is_further_off_than_its_bound(projection, data):
    with jax.enable_x64(True):
        spread = data.draw(st.sampled_from([{"spread": "centres"}, {"spread": "feet"}, {"splats_beyond": 2.5}]))
        others = volume() if data.draw(st.booleans()) else {}
        scene = js.Scene(points=data.draw(point_sets(**spread)), **others)
        difference, bound = wrong(scene, camera(projection), SETTINGS)
        assert (difference <= bound).all()
        assert (bound <= 1).all()
