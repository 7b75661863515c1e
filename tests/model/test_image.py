"""Promises of the image: how it is shown; and of pictures as labelled arrays."""

import dataclasses
import io
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image as Pillow

import jaxsph as js
from jaxsph.model.image import places


def image(color):
    flat = np.zeros(color.shape[:2])
    return js.Image(color, 1 - flat, flat, flat, flat, True, 0, {})


def test_uint8_clips_and_rounds_to_nearest():
    color = np.array([[[0, 0.5, 1], [-1, 2, np.nan], [0.498 / 255, 0.502 / 255, 254.6 / 255]]])
    assert image(color).to_uint8().tolist() == [[[0, 128, 255], [0, 255, 0], [0, 1, 255]]]


def seen(color, transmittance):
    layer = np.full((1, 2), transmittance)
    return js.Image(np.full((1, 2, 3), color), layer, layer, layer, layer, True, 0, {})


@pytest.mark.parametrize("background", ["white", "#fff", "#FFFFFF", (1, 1, 1), "1,1,1", np.ones(3)], ids=str)
def test_over_a_background_its_light_comes_through(background):
    np.testing.assert_allclose(seen(0.25, 0.5).over(background), 0.75)
    assert seen(0.25, 0.5).over(background).shape == (1, 2, 3)


def test_over_black_it_is_the_picture_itself_and_opaque_it_hides_what_is_behind():
    np.testing.assert_array_equal(seen(0.25, 0.5).over("black"), seen(0.25, 0.5).color)
    np.testing.assert_array_equal(seen(0.25, 0.0).over("red"), seen(0.25, 0.0).color)
    np.testing.assert_allclose(seen(0.0, 1.0).over("#ff8000")[0, 0], (1, 128 / 255, 0))


@pytest.mark.parametrize("color", ["whiet", "#12", "1,2,3", (0.5, 0.5), "", None, (0, 0, 2)], ids=str)
def test_what_is_no_colour_is_refused_by_name(color):
    with pytest.raises(ValueError, match="`color` must be a name such as white, #rrggbb, or R,G,B from 0 to 1"):
        seen(0.25, 0.5).over(color)
    with pytest.raises(ValueError, match="did you mean white"):
        seen(0.25, 0.5).over("whiet")


def test_a_png_has_no_transmittance_to_show_a_background_through(tmp_path):
    seen(0.25, 0.5).save(tmp_path / "a.png")
    with pytest.raises(ValueError, match="write EXR to keep it"):
        js.io.read_image(tmp_path / "a.png").over("white")


def test_files_have_a_background_or_alpha(tmp_path):
    made = seen(0.25, 0.5)
    made.save(tmp_path / "w.png", background="white")
    np.testing.assert_allclose(js.io.read_image(tmp_path / "w.png").color, 0.75, atol=0.51 / 255)
    made.save(tmp_path / "t.png", background="transparent")
    with Pillow.open(tmp_path / "t.png") as opened:
        assert opened.mode == "RGBA"
        color, alpha = (np.asarray(opened, np.float64)[0, 0] / 255)[[0, 3]]
    assert color * alpha == pytest.approx(0.25, abs=1 / 255) and alpha == pytest.approx(0.5, abs=0.51 / 255)
    seen(0.0, 1.0).save(tmp_path / "none.png", background="transparent")
    with Pillow.open(tmp_path / "none.png") as opened:
        assert opened.getpixel((0, 0)) == (0, 0, 0, 0)
    made.save(tmp_path / "a.exr", background="transparent")
    with pytest.raises(ValueError, match=r"is for \.png: .*b\.exr holds alpha"):
        made.save(tmp_path / "b.exr", background="white")


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


@pytest.mark.parametrize("count", [(2,), (3, 2)])
def test_a_batch_says_that_it_is_one_and_is_written_image_by_image(tmp_path, count):
    one = image(np.full((3, 5, 3), 0.5, np.float32))
    several = jax.tree.map(lambda layer: np.broadcast_to(layer, count + np.shape(layer)), one)
    assert several.shape == one.shape == (3, 5) and several.batch == count and one.batch == ()
    assert f"batch of {' x '.join(map(str, count))}, 5 x 3" in repr(several) and "batch" not in repr(one)
    verbs = {
        "save": lambda: several.save(tmp_path / "a.png"),
        "to_uint8": several.to_uint8,
        "to_xarray": several.to_xarray,
        "over": lambda: several.over("white"),
        "figure": several.figure,
        "_repr_html_": several._repr_html_,
    }
    for verb, call in verbs.items():
        with pytest.raises(ValueError, match=rf"`{verb}` takes one `Image`, this is a batch of .* by `jax.vmap`; take one, by"):
            call()
    assert not (tmp_path / "a.png").exists()
    np.testing.assert_array_equal(several[(0,) * len(count)].to_uint8(), one.to_uint8())
    with pytest.raises(TypeError, match="this is one `Image`"):
        one[0]


def test_layers_of_several_shapes_are_refused_by_name(tmp_path):
    given = dataclasses.replace(image(np.full((3, 5, 3), 0.5)), depth=np.zeros((3, 4)))
    with pytest.raises(ValueError, match=r"`depth` of `image` must have shape \(3, 5\), got \(3, 4\)"):
        given.save(tmp_path / "a.exr")


def test_what_is_traced_is_not_written(tmp_path):
    with pytest.raises(ValueError, match=r"`Image.save` needs concrete arrays, and `image` is traced"):
        jax.eval_shape(lambda shown: shown.save(tmp_path / "a.png"), image(np.full((3, 5, 3), 0.5)))


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
    for made in (js.project(PARTICLES, CAMERA), image(np.zeros((2, 2, 3)))):
        with pytest.raises(ImportError, match=r"jaxsph\[xarray\]"):
            made.to_xarray()
