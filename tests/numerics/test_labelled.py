import sys

import numpy as np
import pytest

import jaxsph as js
from jaxsph.numerics.labelled import places

pytestmark = pytest.mark.usefixtures("by_reference")

PARTICLES = js.Particles.from_arrays([[0.2, 0.3, 0.0], [-0.4, -0.2, 0.1]], 0.5, [1.0, 2.0], kernel="cubic_spline")
CAMERA = js.Camera.orthographic((0, 0, 3.0), (0, 0, 0), view_height=2.0, width=6, height=4, near=1, far=5)


def test_rows_begin_at_the_top_and_columns_at_the_left():
    found = places((2, 4), 0.5, (1.0, -1.0), "kpc")
    np.testing.assert_allclose(found["x"][1], [0.25, 0.75, 1.25, 1.75])
    np.testing.assert_allclose(found["y"][1], [-0.75, -1.25])
    assert found["x"][2]["units"] == "kpc" and "units" not in places((2, 4), 0.5, (0, 0), "")["x"][2]


def test_a_projection_is_a_dataset_with_places_and_weights():
    xarray = pytest.importorskip("xarray")
    image = js.project(PARTICLES, CAMERA, weight=[1.0, 3.0], name="temperature", unit="K")
    found = image.to_xarray()
    assert isinstance(found, xarray.Dataset) and dict(found.sizes) == {"row": 4, "column": 6}
    np.testing.assert_array_equal(found["values"], image.values)
    np.testing.assert_array_equal(found["weight"], image.weight)
    assert found["values"].attrs == {"long_name": "temperature", "units": "K"}
    np.testing.assert_allclose(found["x"], (np.arange(6) - 2.5) * 0.5)
    np.testing.assert_allclose(found["y"], (1.5 - np.arange(4)) * 0.5)
    assert found.attrs["jaxsph.pixel"] == "mean" and found.attrs["pixel_area"] == 0.25 and found.attrs["faults"] == 0


def test_with_perspective_pixels_have_no_place():
    pytest.importorskip("xarray")
    view = js.Camera.look_at((0, 0, 3), (0, 0, 0), width=6, height=4, near=1, far=5)
    assert not set(js.project(PARTICLES, view).to_xarray().coords)


def test_a_slice_is_a_dataset_over_its_plane():
    pytest.importorskip("xarray")
    found = js.slice(PARTICLES, js.Plane((0, 0, 0.05), (0, 0, 1)), center=(0.1, 0.2, 0), view_height=1.0, width=6, height=4)
    table = found.to_xarray()
    np.testing.assert_array_equal(table["values"], found.values)
    np.testing.assert_allclose(table["x"], found.positions()[0, :, 0], rtol=1e-6)
    np.testing.assert_allclose(table["y"], found.positions()[:, 0, 1], rtol=1e-6)


def test_without_xarray_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "xarray", None)
    with pytest.raises(ImportError, match=r"jaxsph\[xarray\]"):
        js.project(PARTICLES, CAMERA).to_xarray()
