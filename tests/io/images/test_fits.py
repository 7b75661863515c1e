"""FITS files as astropy reads them: values, places, units, and what they are."""

import dataclasses
import sys

import numpy as np
import pytest

import jaxsph as js

fits = pytest.importorskip("astropy.io.fits")
wcs = pytest.importorskip("astropy.wcs")
pytestmark = pytest.mark.usefixtures("by_reference")
WIDTH, HEIGHT = 6, 4


def particles(unit=""):
    position = np.array([[0.2, 0.3, 0.0], [-0.4, -0.2, 0.1]])
    if unit:
        position = pytest.importorskip("astropy.units").Quantity(position, unit)
    return js.Particles.from_arrays(position, 0.5, [1.0, 2.0], kernel="cubic_spline")


def camera(middle=(0.0, 0.0, 0.0)):
    eye = np.array(middle) + (0, 0, 3.0)
    return js.Camera.orthographic(eye, middle, view_height=2.0, width=WIDTH, height=HEIGHT, near=1, far=5)


def test_values_of_a_projection_are_read_with_the_lowest_row_first(tmp_path):
    image = js.project(particles("kpc"), camera(), of=np.ones(2), name="mass", unit="Msun/kpc**2")
    image.save(tmp_path / "a.fits")
    with fits.open(tmp_path / "a.fits") as found:
        np.testing.assert_array_equal(found[0].data, np.asarray(image.values)[::-1])
        header = found[0].header
        assert header["BTYPE"] == "mass" and header["CUNIT1"] == header["CUNIT2"] == "kpc"
        assert pytest.importorskip("astropy.units").Unit(header["BUNIT"]) == pytest.importorskip("astropy.units").Unit(
            "Msun/kpc2"
        )
        assert any("jaxsph.camera = orthographic" in line for line in header["COMMENT"])


def test_places_of_pixels_are_linear_in_lengths(tmp_path):
    js.project(particles(), camera()).save(tmp_path / "a.fits")
    with fits.open(tmp_path / "a.fits") as found:
        system = wcs.WCS(found[0].header)
        assert "CUNIT1" not in found[0].header and "BUNIT" not in found[0].header
    x, y = system.pixel_to_world_values(np.arange(WIDTH), np.zeros(WIDTH))
    np.testing.assert_allclose(x, (np.arange(WIDTH) + 0.5 - WIDTH / 2) * 0.5)
    np.testing.assert_allclose(y, -1 + 0.25)


def test_means_have_their_weights_as_an_extension(tmp_path):
    image = js.project(particles(), camera(), weight=[1.0, 3.0], name="temperature")
    image.save(tmp_path / "a.fits")
    with fits.open(tmp_path / "a.fits") as found:
        assert [part.name for part in found] == ["PRIMARY", "WEIGHT"]
        np.testing.assert_array_equal(found["WEIGHT"].data, np.asarray(image.weight)[::-1])
        np.testing.assert_array_equal(np.isnan(found[0].data), np.isnan(np.asarray(image.values))[::-1])
        assert found["WEIGHT"].header["CDELT1"] == 0.5


def test_with_perspective_axes_are_tangents(tmp_path):
    view = js.Camera.look_at((0, 0, 3), (0, 0, 0), width=WIDTH, height=HEIGHT, near=1, far=5)
    js.project(particles("kpc"), view).save(tmp_path / "a.fits")
    header = fits.getheader(tmp_path / "a.fits")
    assert header["CTYPE1"] == "X/Z" and "CUNIT1" not in header
    assert header["CDELT1"] == pytest.approx(2 * float(view.half_height) / HEIGHT, rel=1e-6)


def test_a_slice_has_the_coordinates_of_its_plane(tmp_path):
    found = js.slice(
        particles("kpc"), js.Plane((0, 0, 0.05), (0, 0, 1)), center=(0.1, 0.2, 0), view_height=1.0, width=6, height=4
    )
    found.save(tmp_path / "a.fits")
    with fits.open(tmp_path / "a.fits") as file:
        np.testing.assert_array_equal(file[0].data, found.values[::-1])
        x, y = wcs.WCS(file[0].header).wcs_pix2world(np.arange(6), np.full(6, 3), 0)
    np.testing.assert_allclose(x / x[0], found.positions()[0, :, 0] / found.positions()[0, 0, 0], rtol=1e-6)
    np.testing.assert_allclose(y / y[0], found.positions()[0, :, 1] / found.positions()[0, 0, 1], rtol=1e-6)
    assert found.length_unit == "kpc"


def test_units_that_the_standard_does_not_know_are_left_out_of_places_and_told_of_values(tmp_path):
    js.project(particles(), camera(), unit="code µ").save(tmp_path / "a.fits")
    assert fits.getheader(tmp_path / "a.fits")["BUNIT"] == "code ?"


def test_without_astropy_the_extra_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "astropy.io.fits", None)
    monkeypatch.setitem(sys.modules, "astropy", None)
    image = js.project(particles(), camera())
    with pytest.raises(ImportError, match=r"`astropy` is needed for FITS files: pip install \"jaxsph\[fits\]\""):
        image.save(tmp_path / "a.fits")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("unit", ["kpc", ""])
def test_projections_and_slices_of_one_middle_lie_at_one_place(unit, tmp_path):
    js.project(particles(unit), camera((0.3, -0.2, 0.1))).save(tmp_path / "a.fits")
    js.slice(particles(unit), js.Plane((0, 0, 0.1), (0, 0, 1)), center=(0.3, -0.2, 0), view_height=2.0, width=6, height=4).save(
        tmp_path / "b.fits"
    )
    one, other = (fits.getheader(tmp_path / name) for name in ("a.fits", "b.fits"))
    for card in ("CRPIX1", "CRPIX2", "CRVAL1", "CRVAL2", "CDELT1", "CDELT2"):
        assert one[card] == pytest.approx(other[card], rel=1e-6), card
    assert one["CRVAL1"] == pytest.approx(0.3) and one["CRVAL2"] == pytest.approx(-0.2)
    assert one.get("CUNIT1") == other.get("CUNIT1") == (unit or None)


def test_numbers_are_told_in_units_that_the_standard_spells(tmp_path):
    image = js.project(particles(), camera((0.3, -0.2, 0.1)), of=np.ones(2), unit="4e40*g*cm**-2")
    dataclasses.replace(image, length_unit="2e+20*cm").save(tmp_path / "a.fits")
    with fits.open(tmp_path / "a.fits") as found:
        header = found[0].header
        assert (header["CUNIT1"], header["BUNIT"]) == ("cm", "g cm-2")
        assert header["CRVAL1"] == pytest.approx(0.6e20) and header["CDELT1"] == pytest.approx(1e20)
        np.testing.assert_allclose(found[0].data, 4e40 * np.asarray(image.values, np.float64)[::-1])


def test_a_scale_factor_is_no_year_and_a_hubble_parameter_no_hour(tmp_path):
    image = js.project(particles(), camera((0.3, 0, 0)), of=np.ones(2), unit="4e40*g*cm**-2 h a^-2")
    dataclasses.replace(image, length_unit="kpc a h^-1").save(tmp_path / "a.fits")
    header = fits.getheader(tmp_path / "a.fits")
    assert "CUNIT1" not in header and header["BUNIT"] == "4e40*g*cm**-2 h a^-2" and header["CRVAL1"] == pytest.approx(0.3)
