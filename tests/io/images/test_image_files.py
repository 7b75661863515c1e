"""Images: every layer of OpenEXR comes back, and colours are the sRGB decoding of what is displayed and a PNG shows."""

import os
import re

import numpy as np
import pytest
from examples import examples
from hypothesis import given, strategies as st
from PIL import Image as Pillow
from png_chunks import with_check_sum_apart
from refusals import refused

import jaxsph
import jaxsph.io as io
from jaxsph.io.images.image_files import CHROMATICITIES, DISPLAYED, LIGHT, color_of, header_of, hushed, is_light, light_of
from jaxsph.model.image import Image

OpenEXR = pytest.importorskip("OpenEXR")

METADATA = (("tolerance", 0.004), ("estimator", "interval"), ("camera", "perspective 4x3"), ("samples", 256), ("x", None))


def make_image(**changes):
    rng = np.random.default_rng(0)
    layer = lambda: rng.random((3, 4), np.float32)  # noqa: E731
    depth = layer()
    depth[0, 0] = np.inf
    fields = {
        "color": rng.random((3, 4, 3), np.float32), "transmittance": layer(), "depth": depth, "error_bound": layer(),
        "evaluations": np.arange(12, dtype=np.float32).reshape(3, 4), "certified": True, "faults": 0, "stats": {},
        "metadata": METADATA,
    }  # fmt: skip
    return Image(**{**fields, **changes})


def flat(height, width):
    """Layers of another size, all 0."""
    names = "transmittance", "depth", "error_bound", "evaluations"
    return {name: np.zeros((height, width), np.float32) for name in names}


def test_every_layer_and_the_metadata_come_back_with_the_version_added(tmp_path):
    image = make_image()
    io.write_image(tmp_path / "a.exr", image)
    got = io.read_image(tmp_path / "a.exr")
    for name in ("depth", "error_bound", "evaluations"):
        np.testing.assert_array_equal(getattr(got, name), getattr(image, name))
        assert getattr(got, name).dtype == np.float32
    np.testing.assert_allclose(got.color, image.color, rtol=0, atol=1e-6)
    np.testing.assert_allclose(got.transmittance, image.transmittance, rtol=0, atol=np.finfo(np.float32).eps)
    assert got.certified is True and got.faults == 0
    told = dict(got.metadata)
    assert {name: told[name] for name, _ in METADATA} == dict(METADATA)
    assert told["jaxsph.version"] == jaxsph.__version__ and told["certified"] is True
    assert not {"jaxsph.color", "chromaticities"} & set(told)  # of the file and not of the image
    got.save(tmp_path / "b.exr")
    np.testing.assert_allclose(io.read_image(tmp_path / "b.exr").color, got.color, rtol=0, atol=1e-7)


def test_the_channels_have_the_names_that_compositors_know(tmp_path):
    image = make_image()
    image.save(tmp_path / "a.exr")
    file = OpenEXR.File(str(tmp_path / "a.exr"), separate_channels=True)
    assert set(file.channels()) == {"R", "G", "B", "A", "Z", "error.bound", "work.evaluations"}
    np.testing.assert_array_equal(file.channels()["A"].pixels, 1 - image.transmittance)
    assert {channel.pixels.dtype for channel in file.channels().values()} == {np.dtype(np.float32)}
    assert file.header()["certified"] == "true"


def test_a_bracket_comes_back_around_its_colours(tmp_path):
    color, alpha = np.asarray(make_image().color), 1 - np.asarray(make_image().transmittance)
    pixels = np.concatenate([color, alpha[..., None]], -1)
    image = make_image(lower=pixels - np.float32(0.1), upper=pixels + np.float32(0.1))
    image.save(tmp_path / "a.exr")
    layers = OpenEXR.File(str(tmp_path / "a.exr"), separate_channels=True).channels()
    for name in "RGBA":
        assert (layers[f"lower.{name}"].pixels <= layers[name].pixels).all()
        assert (layers[f"upper.{name}"].pixels >= layers[name].pixels).all()
    got = io.read_image(tmp_path / "a.exr")
    np.testing.assert_allclose(got.lower, image.lower, atol=1e-6)
    np.testing.assert_allclose(got.upper, image.upper, atol=1e-6)
    with pytest.raises(ValueError, match="over black"):
        io.write_image(tmp_path / "b.exr", image, background="transparent")


def srgb(light):
    """IEC 61966-2-1, as tools encode linear light to show it."""
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)


def layers_of(path):
    """Colours and header as another program finds them."""
    file = OpenEXR.File(str(path), separate_channels=True)
    return np.stack([file.channels()[name].pixels for name in "RGB"], -1), file.header()


def test_tools_that_take_a_file_for_linear_light_show_what_the_png_shows(tmp_path):
    image = make_image(color=np.linspace(0, 1, 768, dtype=np.float32).reshape(16, 16, 3), **flat(16, 16))
    image.save(tmp_path / "a.exr")
    image.save(tmp_path / "a.png")
    light, header = layers_of(tmp_path / "a.exr")
    with Pillow.open(tmp_path / "a.png") as opened:
        shown = np.asarray(opened).astype(int)
    assert np.abs(np.round(255 * srgb(light.astype(np.float64))) - shown).max() <= 1
    assert header["jaxsph.color"] == "linear Rec.709"
    np.testing.assert_allclose(header["chromaticities"], (0.64, 0.33, 0.3, 0.6, 0.15, 0.06, 0.3127, 0.329), rtol=1e-6)


def test_a_part_keeps_the_bits_of_its_colours_and_says_so(tmp_path):
    image = make_image(metadata=(("jaxsph.first_row", 16), ("jaxsph.rows", 40)))
    image.save(tmp_path / "a.exr")
    numbers, header = layers_of(tmp_path / "a.exr")
    assert header["jaxsph.color"] == "sRGB, display-referred" and "chromaticities" not in header
    np.testing.assert_array_equal(numbers, image.color)
    np.testing.assert_array_equal(io.read_image(tmp_path / "a.exr").color, image.color)


def write_foreign(path, header=(), value=1.0, names="RGB"):
    OpenEXR.File(dict(header), dict.fromkeys(names, np.full((2, 2), value, np.float32))).write(str(path))


@pytest.mark.parametrize(("header", "expected"), [({"jaxsph.version": "0.1.0"}, 0.5), ({}, 0.7353569830524495)])
def test_files_that_do_not_say_are_display_referred_if_of_jaxsph_and_linear_if_foreign(tmp_path, header, expected):
    write_foreign(tmp_path / "a.exr", header, 0.5)
    got = io.read_image(tmp_path / "a.exr")
    np.testing.assert_allclose(got.color, expected, rtol=1e-6)
    assert np.isnan(got.transmittance).all() and np.isinf(got.error_bound).all() and got.certified is False


def test_what_is_no_colour_image_is_refused(tmp_path):
    write_foreign(tmp_path / "a.exr", {"jaxsph.color": "ACEScg"})
    refused(r"a\.exr: has jaxsph\.color = 'ACEScg'", io.read_image, tmp_path / "a.exr")
    write_foreign(tmp_path / "a.exr", names="Z")
    refused(r"a\.exr: has no channel R G B, only Z", io.read_image, tmp_path / "a.exr")
    refused(r"a\.jpg: images are written and read as \.exr or \.png", io.write_image, tmp_path / "a.jpg", make_image())
    refused(r"a\.jpg", io.read_image, tmp_path / "a.jpg")
    with pytest.raises(FileNotFoundError, match=r"gone\.exr"):
        io.read_image(tmp_path / "gone.exr")


@pytest.mark.parametrize(("name", "most"), [("a.exr", 1), ("a.png", 0.5)])  # behind its colours a PNG says nothing more
@given(fraction=st.floats(0, 1, exclude_max=True))
@examples(15)
def test_an_image_cut_anywhere_is_refused_by_name(name, most, fraction, tmp_path_factory):
    path = tmp_path_factory.mktemp("cut") / name
    io.write_image(path, make_image())
    path.write_bytes(path.read_bytes()[: int(most * fraction * path.stat().st_size)])
    refused(re.escape(name), io.read_image, path)


def test_an_announced_size_takes_no_memory(tmp_path, measured):
    io.write_image(tmp_path / "a.exr", make_image())
    content = (tmp_path / "a.exr").read_bytes()
    place = content.index(b"dataWindow\0box2i\0") + len(b"dataWindow\0box2i\0") + 4 + 8
    (tmp_path / "a.exr").write_bytes(content[:place] + np.array([30_000, 30_000], "<i4").tobytes() + content[place + 8 :])
    with measured() as memory:
        refused(r"a\.exr: ", io.read_image, tmp_path / "a.exr")
    assert memory.peak < 2**22


def test_what_is_packed_to_next_to_nothing_is_read(tmp_path):
    given = {"compression": OpenEXR.DWAB_COMPRESSION, "type": OpenEXR.scanlineimage}
    with OpenEXR.File(given, {"RGB": np.zeros((2048, 2048, 3), np.float16)}) as file:
        file.write(str(tmp_path / "a.exr"))
    assert not np.asarray(io.read_image(tmp_path / "a.exr").color).any()


def test_metadata_names_of_the_format_itself_are_refused(tmp_path):
    with pytest.raises(ValueError, match="'compression', which OpenEXR uses itself"):
        io.write_image(tmp_path / "a.exr", make_image(metadata=(("compression", "none"),)))
    assert list(tmp_path.iterdir()) == []


EPS = np.finfo(np.float32).eps


def displayed_of(value):
    """IEC 61966-2-1, one number, from linear light to what is displayed."""
    return 12.92 * value if value <= 0.0031308 else 1.055 * value ** (1 / 2.4) - 0.055


def ends():
    """Numbers of [0, 1] with all their neighbours about the border of the curve, the least that there are, and a grid."""
    least = np.arange(0, 300, dtype=np.uint32).view(np.float32)
    border = (np.float32(0.04045).view(np.uint32) + np.arange(-3000, 3000)).astype(np.uint32).view(np.float32)
    grid = np.arange(0, 0x3F800001, 4099, dtype=np.uint32).view(np.float32)
    return np.concatenate([least, border, grid, np.float32([0, 0.5, 1])])


def test_light_is_what_the_standard_decodes():
    known = {0.0: 0.0, 0.04045: 0.0031308049535603713, 0.5: 0.21404114048223255, 1.0: 1.0}
    np.testing.assert_allclose(light_of(list(known)), list(known.values()), rtol=EPS)
    displayed = np.linspace(0, 1, 256)
    np.testing.assert_allclose([displayed_of(value) for value in light_of(displayed).tolist()], displayed, rtol=0, atol=1e-6)


def test_colours_come_back_over_all_that_is_displayed():
    given = ends()
    found = color_of(light_of(given))
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, given, rtol=2 * EPS, atol=13 * np.finfo(np.float32).smallest_subnormal)


def test_more_light_is_a_brighter_colour():
    given = np.sort(ends())
    assert (np.diff(light_of(given)) >= 0).all() and (np.diff(color_of(given)) >= 0).all()


def test_numbers_that_no_display_shows_are_kept():
    given = np.float32([1 + EPS, 1.5, 40, -0.2, np.nan, np.inf, -np.inf])
    np.testing.assert_allclose(color_of(light_of(given)), given, rtol=2 * EPS)


def test_conversion_is_of_any_shape_and_size(monkeypatch):
    monkeypatch.setattr("jaxsph.io.images.image_files.BLOCK", 7)
    given = np.random.default_rng(0).random((5, 3, 3))[::2]
    found = light_of(given)
    assert found.shape == given.shape and light_of(np.zeros((0, 4, 3))).shape == (0, 4, 3)
    np.testing.assert_array_equal(found[1, 2], light_of(given[1, 2]))


@pytest.mark.parametrize(
    ("header", "light"),
    [({}, True), ({"owner": "me"}, True), ({"jaxsph.version": "0.1.0"}, False), (header_of(displayed=True), False),
     (header_of(displayed=False), True)],
)  # fmt: skip
def test_a_header_says_what_colours_are_and_silence_is_read_as_it_was_meant(header, light):
    assert is_light(header) is light
    assert header_of(displayed=False) == {"jaxsph.color": LIGHT, "chromaticities": CHROMATICITIES}
    assert header_of(displayed=True) == {"jaxsph.color": DISPLAYED}


def test_colours_are_written_as_they_are_clipped_and_rounded_to_nearest(tmp_path):
    color = np.array([[[0.0, 1.0, 0.5], [-1.0, 2.0, 0.2]]], np.float32)
    io.write_image(tmp_path / "a.png", make_image(color=color, metadata=(("tolerance", 0.25),), **flat(*color.shape[:2])))
    with Pillow.open(tmp_path / "a.png") as opened:
        assert opened.mode == "RGB"
        np.testing.assert_array_equal(np.asarray(opened), [[[0, 255, 128], [0, 255, 51]]])
        assert opened.text == {"tolerance": "0.25"}


def test_colours_come_back_within_half_a_step_and_other_layers_are_unknown(tmp_path):
    color = np.random.default_rng(0).random((3, 4, 3)).astype(np.float32)
    io.write_image(tmp_path / "a.png", make_image(color=color, metadata=(("tolerance", 0.25),), **flat(*color.shape[:2])))
    got = io.read_image(tmp_path / "a.png")
    np.testing.assert_allclose(got.color, color, rtol=0, atol=0.5 / 255 + np.finfo(np.float32).eps)
    assert np.isnan(got.transmittance).all() and np.isinf(got.error_bound).all() and got.certified is False


def test_of_a_png_with_alpha_come_its_colours_over_black_and_grey_of_16_bits_is_no_white(tmp_path):
    image = make_image(transmittance=np.linspace(0, 1, 12, dtype=np.float32).reshape(3, 4))
    image = make_image(color=image.color * image.alpha[..., None], transmittance=image.transmittance)
    io.write_image(tmp_path / "a.png", image, background="transparent")
    got = io.read_image(tmp_path / "a.png")
    half = 0.5 / 255 + np.finfo(np.float32).eps
    np.testing.assert_allclose(got.color, image.color, rtol=0, atol=half)
    np.testing.assert_allclose(got.transmittance, image.transmittance, rtol=0, atol=half)
    grey = np.array([[0, 40_000, 65_535]], np.uint16)
    Pillow.fromarray(grey).save(tmp_path / "grey.png")
    np.testing.assert_allclose(io.read_image(tmp_path / "grey.png").color[..., 1], grey / 65_535, rtol=1e-6)


def test_exr_in_front_of_nothing_is_laid_over_any_background_as_light(tmp_path):
    alpha = np.geomspace(1e-6, 1, 12).astype(np.float32).reshape(3, 4)
    alpha[0, 0] = 0
    white = make_image(color=np.repeat(alpha[..., None], 3, -1), transmittance=1 - alpha)
    io.write_image(tmp_path / "w.exr", white, background="transparent")
    rgba = OpenEXR.File(str(tmp_path / "w.exr")).channels()["RGBA"].pixels
    np.testing.assert_allclose(rgba[..., :3] + 1 - rgba[..., 3:], 1, atol=1e-6)  # white in front of white
    hue = np.random.default_rng(0).random((3, 4, 3)).astype(np.float32)
    image = make_image(color=hue * alpha[..., None], transmittance=1 - alpha)
    image = make_image(
        color=np.where(alpha[..., None] > 0, image.color, 0.25), transmittance=1 - alpha
    )  # light that hides nothing
    io.write_image(tmp_path / "a.exr", image, background="transparent")
    found = io.read_image(tmp_path / "a.exr")
    np.testing.assert_allclose(found.color, image.color, rtol=0, atol=1e-6)
    light = OpenEXR.File(str(tmp_path / "a.exr")).channels()["RGBA"].pixels[..., :3]
    opaque = alpha == 1
    np.testing.assert_allclose(light[opaque], light_of(image.color)[opaque], rtol=1e-6)


def test_no_bit_of_a_png_file_changes_colours_unseen(tmp_path):
    path = tmp_path / "a.png"
    io.write_image(path, make_image(color=np.random.default_rng(0).random((30, 40, 3), np.float32), **flat(30, 40)))
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


def test_what_is_written_past_python_is_not_seen_inside_and_is_again_behind(capfd):
    with hushed():
        os.write(2, b"of a library")
        os.write(1, b"of a library")
    os.write(2, b"of ours")
    assert capfd.readouterr() == ("", "of ours")


def test_a_damaged_exr_is_refused_in_one_message_and_prints_nothing(tmp_path, capfd):
    color, layer = np.random.default_rng(0).random((48, 64, 3)).astype(np.float32), np.zeros((48, 64), np.float32)
    io.write_image(tmp_path / "a.exr", Image(color, layer, layer, layer, layer, True, 0, {}, ()))
    content = bytearray((tmp_path / "a.exr").read_bytes())
    content[len(content) // 2] ^= 255
    (tmp_path / "a.exr").write_bytes(content)
    refused(r"a\.exr: cannot be read as OpenEXR", io.read_image, tmp_path / "a.exr")
    assert capfd.readouterr() == ("", "")
