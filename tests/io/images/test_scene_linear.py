"""Colours of EXR files: the sRGB decoding of what is displayed, and back, whatever the numbers are."""

import numpy as np
import pytest

from jaxsph.io.damage import DataError
from jaxsph.io.images.scene_linear import CHROMATICITIES, DISPLAYED, LIGHT, color_of, header_of, is_light, light_of

EPS = np.finfo(np.float32).eps


def srgb(value):
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
    np.testing.assert_allclose([srgb(value) for value in light_of(displayed).tolist()], displayed, rtol=0, atol=1e-6)


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
    monkeypatch.setattr("jaxsph.io.images.scene_linear.BLOCK", 7)
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


def test_colours_of_an_unknown_kind_are_refused():
    with pytest.raises(DataError, match=r"jaxsph\.color = 'ACEScg', which is neither 'linear Rec\.709' nor"):
        is_light({"jaxsph.color": "ACEScg"})


def test_what_is_said_of_colours():
    assert header_of(displayed=False) == {"jaxsph.color": LIGHT, "chromaticities": CHROMATICITIES}
    assert header_of(displayed=True) == {"jaxsph.color": DISPLAYED}
