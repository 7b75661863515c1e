"""A volume is checked when it is made: what cannot be a grid is refused by name, and numbers stay what they are."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

import jaxsph as js

VALUES = np.arange(24, dtype=np.float32).reshape(2, 3, 4)


def holed(value=np.nan):
    values = VALUES.copy()
    values[1, 0, 2:] = value
    return values


@pytest.mark.parametrize(
    ("changed", "match"),
    [
        ({"values": np.full((2, 2, 2), np.nan)}, r"`values` must hold a number, but all of them are NaN"),
        ({"values": holed(np.inf)}, r"2 of 24 are not, first values\[1, 0, 2\] = inf; repair"),
        ({"values": np.where(VALUES == 3, np.nan, holed(np.inf))}, r"2 of 24 are not, first values\[1, 0, 2\] = inf; repair"),
        ({"values": holed(1.0).astype(np.float64) * 1e300}, r"overflow float32"),
        ({"values": VALUES[0]}, r"`values` must have shape \(Nx, Ny, Nz\), got \(3, 4\)"),
        ({"values": VALUES[:1]}, r"`values` must have at least two points along each axis, got shape \(1, 3, 4\)"),
        ({"values": VALUES.astype(complex)}, r"`values` must hold real numbers, got dtype complex"),
        ({"spacing": 0.0}, r"`spacing` must be > 0, but spacing\[0\] = 0.0"),
        ({"spacing": (1, -2, 1)}, r"`spacing` must be > 0, but spacing\[1\] = -2"),
        ({"spacing": np.inf}, r"`spacing` must be finite"),
        ({"spacing": (1, 2)}, r"`spacing` must have shape \(3,\), got \(2,\)"),
        ({"spacing": 1e-60}, r"underflows float32"),
        ({"lower": (0, np.nan, 0)}, r"`lower` must be finite, .* first lower\[1\] = nan"),
        ({"lower": 1.0}, r"`lower` must have shape \(3,\), got \(\)"),
    ],
)
def test_what_is_no_grid_is_refused_by_name(changed, match):
    with pytest.raises(ValueError, match=match):
        js.Volume.from_array(**{"values": VALUES, "lower": (0, 0, 0), "spacing": 1.0} | changed)


@pytest.mark.parametrize("axis", range(3))
def test_a_single_plane_that_is_put_in_is_refused_by_name(axis):
    volume = dataclasses.replace(js.Volume.from_array(VALUES), values=np.take(VALUES, [0], axis))
    transfer = js.TransferFunction.from_points([0, 1], np.eye(3)[:2], [0, 1])
    scene = js.Scene(volume=volume, volume_transfer=transfer)
    for shown in (scene.check, lambda: js.IsoSurface.from_volume(volume, 3)):
        with pytest.raises(ValueError, match="`values` of `volume` must have at least two points along each axis, got shape"):
            shown()


@pytest.mark.parametrize(
    ("given", "kept"),
    [(np.uint8, np.uint8), (np.int16, np.int16), (np.int32, np.float32), (np.float16, np.float32), (np.float64, np.float32)],
)
def test_small_integers_stay_integers_and_all_else_is_a_float(given, kept):
    volume = js.Volume.from_array(VALUES.astype(given), (1, 2, 3), (1, 2, 3))
    assert volume.values.dtype == kept and volume.dtype == np.float32
    np.testing.assert_array_equal(volume.values, VALUES)
    np.testing.assert_array_equal(volume.bounds(), [[1, 2, 3], [2, 6, 12]])


def test_float64_is_kept_where_it_is_enabled(x64):
    volume = js.Volume.from_array(VALUES.astype(np.float64))
    assert volume.values.dtype == volume.dtype == jnp.float64


def test_a_place_far_away_is_kept():
    lower = (1e7 + 0.125, -3e7, 1e6)
    volume = js.Volume.from_array(VALUES, lower, 0.01)
    np.testing.assert_allclose(volume.bounds()[0], lower, rtol=1e-13)
