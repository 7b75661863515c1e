import numpy as np
from PIL import Image as Pillow
from png_chunks import with_check_sum_apart
from refusals import refused

import jaxsph.io as io
from jaxsph.model.image import Image


def make_image(color):
    layer = np.zeros(color.shape[:2], np.float32)
    return Image(color, layer, layer, layer, layer, True, 0, {}, (("tolerance", 0.25),))


def test_colours_are_written_as_they_are_clipped_and_rounded_to_nearest(tmp_path):
    color = np.array([[[0.0, 1.0, 0.5], [-1.0, 2.0, 0.2]]], np.float32)
    io.write_image(tmp_path / "a.png", make_image(color))
    with Pillow.open(tmp_path / "a.png") as opened:
        assert opened.mode == "RGB"
        np.testing.assert_array_equal(np.asarray(opened), [[[0, 255, 128], [0, 255, 51]]])
        assert opened.text == {"tolerance": "0.25"}


def test_colours_come_back_within_half_a_step_and_other_layers_are_unknown(tmp_path):
    color = np.random.default_rng(0).random((3, 4, 3)).astype(np.float32)
    io.write_image(tmp_path / "a.png", make_image(color))
    got = io.read_image(tmp_path / "a.png")
    np.testing.assert_allclose(got.color, color, rtol=0, atol=0.5 / 255 + np.finfo(np.float32).eps)
    assert np.isnan(got.transmittance).all() and np.isinf(got.error_bound).all() and got.certified is False


def test_a_cut_image_is_refused_by_name(tmp_path):
    io.write_image(tmp_path / "a.png", make_image(np.random.default_rng(0).random((30, 40, 3)).astype(np.float32)))
    whole = (tmp_path / "a.png").read_bytes()
    for stop in (0, 10, 60, len(whole) // 2):
        (tmp_path / "a.png").write_bytes(whole[:stop])
        refused(r"a\.png", io.read_image, tmp_path / "a.png")


def test_no_bit_of_a_png_file_changes_colours_unseen(tmp_path):
    path = tmp_path / "a.png"
    io.write_image(path, make_image(np.random.default_rng(0).random((30, 40, 3)).astype(np.float32)))
    path.write_bytes(with_check_sum_apart(path.read_bytes()))
    whole, color = path.read_bytes(), io.read_image(path).color
    for bit in np.random.default_rng(1).integers(0, 8 * len(whole), 200):
        damaged = bytearray(whole)
        damaged[bit // 8] ^= 1 << bit % 8
        path.write_bytes(damaged)
        try:
            found = io.read_image(path).color
        except ValueError as error:
            assert "a.png: " in str(error)
        else:
            np.testing.assert_array_equal(found, color)
