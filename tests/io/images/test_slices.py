"""Slices as files: values come back as they are, pictures by their colours, and a file is whole or not there."""

import numpy as np
import OpenEXR
import pytest
from PIL import Image as Pillow

import jaxsph as js
from jaxsph import io
from jaxsph.analysis.slices import Slice
from jaxsph.io.images import slices

LOOK = js.TransferFunction.from_points([0, 1], [[0, 0, 0], [1, 0.5, 0]], [1, 1])


def made(dtype=np.float32):
    values = np.array([[0.0, 0.5, 1.0], [2.0, np.nan, 0.25]], dtype)
    camera = js.Camera.orthographic((0, 0, 0), (0, 0, -1), view_height=2.0, width=3, height=2, near=-1, far=1)
    return Slice(values, camera, (("jaxsph.slice", "point=[0, 0, 0] normal=[0, 0, 1]"),))


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_values_come_back_from_numpy_files_in_their_precision(tmp_path, dtype):
    made(dtype).save(tmp_path / "a.npy")
    found = np.load(tmp_path / "a.npy", allow_pickle=False)
    assert found.dtype == dtype
    np.testing.assert_array_equal(found, made(dtype).values)


def test_exr_files_hold_values_and_the_picture_where_there_is_one(tmp_path):
    made().save(tmp_path / "a.exr")
    made().save(tmp_path / "b.exr", LOOK)
    for name, channels in (("a.exr", {"value"}), ("b.exr", {"value", "R", "G", "B", "A"})):
        opened = OpenEXR.File(str(tmp_path / name), separate_channels=True)
        assert set(opened.channels()) == channels and "normal=[0, 0, 1]" in opened.header()["jaxsph.slice"]
        np.testing.assert_array_equal(opened.channels()["value"].pixels, made().values)
    image = io.read_image(tmp_path / "b.exr")
    np.testing.assert_allclose(image.color[0, 1], [0.5, 0.25, 0])
    light = [opened.channels()[name].pixels[0, 1] for name in "RGB"]  # of the sRGB curve, as other tools take it
    np.testing.assert_allclose(light, [0.21404114, 0.05087609, 0], rtol=1e-6)
    assert opened.header()["jaxsph.color"] == "linear Rec.709"
    np.testing.assert_array_equal(image.alpha, [[1, 1, 1], [1, 0, 1]])


def test_pictures_have_colours_where_there_are_values_and_are_black_elsewhere(tmp_path):
    made().save(tmp_path / "a.png", LOOK)
    with Pillow.open(tmp_path / "a.png") as opened:
        np.testing.assert_array_equal(np.asarray(opened)[0], [[0, 0, 0], [128, 64, 0], [255, 128, 0]])
        np.testing.assert_array_equal(np.asarray(opened)[1, 1], [0, 0, 0])
        assert "jaxsph.slice" in opened.text


@pytest.mark.parametrize("suffix", slices.SUFFIXES)
def test_a_file_is_written_whole_or_not_at_all(tmp_path, suffix, monkeypatch):
    path = tmp_path / f"a{suffix}"
    made().save(path, LOOK)
    before = path.read_bytes()

    def fails(*given, **more):
        raise OSError(28, "No space left on device")

    if suffix == ".fits":
        monkeypatch.setattr(pytest.importorskip("astropy.io.fits").HDUList, "writeto", lambda *given: fails())
    monkeypatch.setattr(np, "save", fails)
    monkeypatch.setattr(Pillow.Image, "save", fails)
    monkeypatch.setattr(OpenEXR.File, "write", lambda *given: fails())
    with pytest.raises((ValueError, OSError), match="No space"):
        made().save(path, LOOK)
    assert path.read_bytes() == before and list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(
    ("name", "transfer", "said"),
    [
        ("a.jpg", LOOK, r"a\.jpg: slices are written as \.npy, \.fits, \.exr, \.png, not as '\.jpg'"),
        ("a.png", None, "a picture needs colours"),
        ("none/a.npy", None, "the folder .*none does not exist"),
        ("none/a.exr", None, "the folder .*none does not exist"),
    ],
)
def test_what_cannot_be_written_is_said(tmp_path, name, transfer, said):
    with pytest.raises(ValueError, match=said):
        made().save(tmp_path / name, transfer)
