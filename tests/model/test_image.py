"""Promises of the image: how it is shown."""

import dataclasses
import io
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image as Pillow

import jaxsph as js


def image(color):
    flat = np.zeros(color.shape[:2])
    return js.Image(color, 1 - flat, flat, flat, flat, True, 0, {})


def test_uint8_clips_and_rounds_to_nearest():
    color = np.array([[[0, 0.5, 1], [-1, 2, np.nan], [0.498 / 255, 0.502 / 255, 254.6 / 255]]])
    assert image(color).to_uint8().tolist() == [[[0, 128, 255], [0, 255, 0], [0, 1, 255]]]


def test_a_notebook_shows_it_as_png_of_its_size():
    shown = Pillow.open(io.BytesIO(image(np.full((3, 5, 3), 0.5))._repr_png_()))
    assert shown.size == (5, 3)
    assert shown.getpixel((0, 0)) == (128, 128, 128)


@pytest.mark.parametrize("suffix", [".png", ".exr"])
def test_an_image_writes_itself_as_what_its_path_says(tmp_path, suffix):
    given, path = image(np.full((3, 5, 3), 0.25)), tmp_path / f"image{suffix}"
    given.save(path)
    if suffix == ".png":
        assert np.asarray(Pillow.open(path)).tolist() == given.to_uint8().tolist()
    else:
        np.testing.assert_allclose(js.io.read_image(path).color, given.color, rtol=0, atol=1e-6)


def test_numpy_takes_it_for_the_picture():
    color = np.random.default_rng(0).random((3, 5, 3), np.float32)
    found = np.asarray(image(color))
    assert found.dtype == np.float32 and found.shape == (3, 5, 3)
    np.testing.assert_array_equal(found, color)
    np.testing.assert_array_equal(np.asarray(image(jnp.asarray(color)), np.float64), color.astype(np.float64))
    copied = np.array(image(color))
    copied[:] = 0
    assert color.max() > 0
    with pytest.raises(ValueError, match="copy"):
        np.array(image(color), np.float64, copy=False)


def test_matplotlib_shows_it():
    figure = pytest.importorskip("matplotlib.figure").Figure()
    shown = figure.add_subplot().imshow(image(np.full((3, 5, 3), 0.5, np.float32)))
    np.testing.assert_array_equal(shown.get_array(), np.full((3, 5, 3), 0.5))


def test_jax_takes_it_for_a_tree_of_layers():
    given = image(np.full((3, 5, 3), 0.5, np.float32))
    assert len(jax.tree.leaves(given)) == 7
    doubled = jax.jit(lambda shown: jax.tree.map(lambda layer: 2 * layer, shown))(given)
    assert isinstance(doubled, js.Image) and float(doubled.color[0, 0, 0]) == 1


def test_alpha_is_what_is_not_transmitted():
    assert image(np.zeros((2, 2, 3))).alpha.tolist() == [[0, 0], [0, 0]]


def test_a_notebook_shows_size_time_and_error_below_it():
    shown = dataclasses.replace(image(np.full((3, 5, 3), 0.5)), stats={"seconds": {"grid": 0.25, "cast": 0.5}})
    shown = dataclasses.replace(shown, error_bound=np.full((3, 5), 0.004), certified=False)
    text = shown._repr_html_()
    assert "5 &times; 3, 0.75 s, error at most 0.004, estimated" in text
    assert text.count("data:image/png;base64,") == 1


def test_labelled_arrays_hold_every_layer_and_where_they_are_from():
    xarray = pytest.importorskip("xarray")
    given = dataclasses.replace(image(np.full((3, 5, 3), 0.25)), metadata=(("jaxsph.tolerance", 0.004),))
    found = given.to_xarray()
    assert isinstance(found, xarray.Dataset) and dict(found.sizes) == {"row": 3, "column": 5, "channel": 3}
    np.testing.assert_array_equal(found["color"].sel(channel="green"), np.full((3, 5), 0.25))
    assert set(found.data_vars) == {"color", "transmittance", "depth", "error_bound", "evaluations"}
    assert found.attrs["jaxsph.tolerance"] == 0.004 and found.attrs["certified"] == "true"


def test_labelled_arrays_name_their_library_where_it_is_missing(monkeypatch):
    monkeypatch.setitem(sys.modules, "xarray", None)
    with pytest.raises(ImportError, match=r"jaxsph\[xarray\]"):
        image(np.zeros((2, 2, 3))).to_xarray()
