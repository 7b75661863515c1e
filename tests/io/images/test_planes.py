"""Projections and slices as files: raw values come back, pictures have their colours, and a file is whole or not there."""

import dataclasses
import sys

import numpy as np
import OpenEXR
import pytest
from PIL import Image as Pillow
from refusals import refused

import jaxsph as js
from jaxsph import io
from jaxsph.analysis.slices import Slice
from jaxsph.io.images.planes import SUFFIXES, converted
from jaxsph.model.projection import Projection
from jaxsph.numerics.checks import array_of


def made(mean=False, name="column.mass"):
    values = np.geomspace(1e-3, 10, 12, dtype=np.float32).reshape(3, 4)
    weight = np.where(np.arange(12).reshape(3, 4) == 5, 0, 1).astype(np.float32)
    values = np.where(weight > 0, values, np.nan) if mean else np.where(weight > 0, values, 0)
    known = (("jaxsph.kernel", "cubic_spline"),)
    return Projection(
        array_of(values), array_of(weight) if mean else None, np.float32(0.25), False, 0, name, "Msun/kpc**2", known
    )


@pytest.mark.parametrize("mean", [False, True])
@pytest.mark.parametrize("name", ["column.mass", "Z", "log10:Density of gas"])
def test_exr_files_come_back_with_all_that_is_known(tmp_path, mean, name):
    image = made(mean, name)
    image.save(tmp_path / "a.exr")
    found = io.read_projection(tmp_path / "a.exr")
    np.testing.assert_array_equal(found.values, image.values)
    assert (found.weight is None) != mean and (found.name, found.unit, found.perspective) == (name, "Msun/kpc**2", False)
    np.testing.assert_allclose(found.pixel_area, 0.25)
    assert ("jaxsph.kernel", "cubic_spline") in found.metadata
    if not mean:
        np.testing.assert_allclose(found.total(), np.asarray(image.values).sum() * 0.25, rtol=1e-6)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_numpy_files_hold_values_in_their_precision(tmp_path, dtype, x64):
    for image in (dataclasses.replace(made(), values=np.asarray(made().values, dtype)), made_slice(dtype)):
        image.save(tmp_path / "a.npy")
        found = np.load(tmp_path / "a.npy", allow_pickle=False)
        assert found.dtype == dtype
        np.testing.assert_array_equal(found, image.values)


def test_pictures_have_the_colours_of_a_map_black_where_no_mean_is(tmp_path):
    made(mean=True).save(tmp_path / "a.png", colormap="heat", norm="log", range=(1e-3, 10))
    with Pillow.open(tmp_path / "a.png") as opened:
        picture = np.asarray(opened)
        assert opened.text["jaxsph.colors"] == "log 0.001 to 10" and opened.text["jaxsph.unit"] == "Msun/kpc**2"
    assert (picture[1, 1] == 0).all() and picture[2, 3].sum() > picture[0, 0].sum()
    np.testing.assert_array_equal(picture, made(mean=True).to_uint8("heat", "log", (1e-3, 10)))
    amounts = made().to_uint8("viridis")  # nothing is as dark as the least that is shown
    np.testing.assert_array_equal(amounts[1, 1], made().to_uint8("viridis", "log", (1.0, 10))[0, 0])


def test_what_cannot_be_written_is_said(tmp_path, x64):
    with pytest.raises(ValueError, match=r"written as \.exr or \.npy or \.fits or \.png, not as '\.jpg'"):
        made().save(tmp_path / "a.jpg")
    with pytest.raises(ValueError, match="`colormap` is for pictures"):
        made().save(tmp_path / "a.exr", colormap="heat")
    large = dataclasses.replace(made(), values=np.full((2, 2), 1e300))
    refused("that float32 cannot hold", large.save, tmp_path / "a.exr")
    assert not list(tmp_path.iterdir())


def test_what_is_no_projection_is_refused_by_name(tmp_path):
    with pytest.raises(FileNotFoundError, match="none"):
        io.read_projection(tmp_path / "none.exr")
    layer = np.zeros((4, 5), np.float32)
    io.write_image(tmp_path / "light.exr", js.Image(np.zeros((4, 5, 3), np.float32), layer, layer, layer, layer, True, 0, {}, ()))
    refused(r"light\.exr.*holds no projection.*read_image", io.read_projection, tmp_path / "light.exr")
    made().save(tmp_path / "a.exr")
    whole = (tmp_path / "a.exr").read_bytes()
    for stop in (0, 3, 40, len(whole) // 2):
        (tmp_path / "cut.exr").write_bytes(whole[:stop])
        refused(r"cut\.exr", io.read_projection, tmp_path / "cut.exr")


def test_totals_are_of_amounts_in_parallel_rays():
    with pytest.raises(ValueError, match="means are not added up"):
        made(mean=True).total()
    with pytest.raises(ValueError, match="pixels of a perspective camera have no area"):
        dataclasses.replace(made(), perspective=True).total()


LOOK = js.TransferFunction.from_points([0, 1], [[0, 0, 0], [1, 0.5, 0]], [1, 1])


def made_slice(dtype=np.float32):
    values = np.array([[0.0, 0.5, 1.0], [2.0, np.nan, 0.25]], dtype)
    camera = js.Camera.orthographic((0, 0, 0), (0, 0, -1), view_height=2.0, width=3, height=2, near=-1, far=1)
    return Slice(values, camera, (("jaxsph.slice", "point=[0, 0, 0] normal=[0, 0, 1]"),))


def test_exr_files_hold_values_and_the_picture_where_there_is_one(tmp_path):
    made_slice().save(tmp_path / "a.exr")
    made_slice().save(tmp_path / "b.exr", LOOK)
    for name, channels in (("a.exr", {"value"}), ("b.exr", {"value", "R", "G", "B", "A"})):
        opened = OpenEXR.File(str(tmp_path / name), separate_channels=True)
        assert set(opened.channels()) == channels and "normal=[0, 0, 1]" in opened.header()["jaxsph.slice"]
        np.testing.assert_array_equal(opened.channels()["value"].pixels, made_slice().values)
    image = io.read_image(tmp_path / "b.exr")
    np.testing.assert_allclose(image.color[0, 1], [0.5, 0.25, 0])
    light = [opened.channels()[name].pixels[0, 1] for name in "RGB"]  # of the sRGB curve, as other tools take it
    np.testing.assert_allclose(light, [0.21404114, 0.05087609, 0], rtol=1e-6)
    assert opened.header()["jaxsph.color"] == "linear Rec.709"
    np.testing.assert_array_equal(image.alpha, [[1, 1, 1], [1, 0, 1]])


def test_pictures_have_colours_where_there_are_values_and_are_black_elsewhere(tmp_path):
    made_slice().save(tmp_path / "a.png", LOOK)
    with Pillow.open(tmp_path / "a.png") as opened:
        np.testing.assert_array_equal(np.asarray(opened)[0], [[0, 0, 0], [128, 64, 0], [255, 128, 0]])
        np.testing.assert_array_equal(np.asarray(opened)[1, 1], [0, 0, 0])
        assert "jaxsph.slice" in opened.text


@pytest.mark.parametrize("save", [lambda path: made().save(path), lambda path: made_slice().save(path, LOOK)])
@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_file_is_written_whole_or_not_at_all(tmp_path, suffix, save, monkeypatch):
    path = tmp_path / f"a{suffix}"
    save(path)
    before = path.read_bytes()

    def fails(*given, **more):
        raise OSError(28, "No space left on device")

    for holder, name in ((fits.HDUList, "writeto"), (np, "save"), (Pillow.Image, "save"), (OpenEXR.File, "write")):
        monkeypatch.setattr(holder, name, fails)
    with pytest.raises((ValueError, OSError), match="No space"):
        save(path)
    assert path.read_bytes() == before and list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(
    ("name", "transfer", "said"),
    [
        ("a.jpg", LOOK, r"a\.jpg: slices are written as \.exr or \.npy or \.fits or \.png, not as '\.jpg'"),
        ("a.png", None, "a picture needs colours"),
        ("none/a.npy", None, "the folder .*none does not exist"),
        ("none/a.exr", None, "the folder .*none does not exist"),
    ],
)
def test_what_cannot_be_written_of_a_slice_is_said(tmp_path, name, transfer, said):
    with pytest.raises(ValueError, match=said):
        made_slice().save(tmp_path / name, transfer)


fits = pytest.importorskip("astropy.io.fits")
wcs, units = pytest.importorskip("astropy.wcs"), pytest.importorskip("astropy.units")
pytestmark = pytest.mark.usefixtures("by_reference")
WIDTH, HEIGHT = 6, 4


def particles(unit=""):
    position = np.array([[0.2, 0.3, 0.0], [-0.4, -0.2, 0.1]])
    if unit:
        position = units.Quantity(position, unit)
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
        assert units.Unit(header["BUNIT"]) == units.Unit("Msun/kpc2")
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


@pytest.mark.parametrize(("unit", "spelled"), [("4e40*g*cm**-2", None), ("1e10*Msun/kpc^2", "10**10 solMass kpc-2")])
def test_lengths_are_told_in_units_that_the_standard_spells(unit, spelled, tmp_path):
    image = js.project(particles(), camera((0.3, -0.2, 0.1)), of=np.ones(2), unit=unit)
    dataclasses.replace(image, length_unit="2e+20*cm").save(tmp_path / "a.fits")
    with fits.open(tmp_path / "a.fits") as found:
        header = found[0].header
        assert (header["CUNIT1"], header.get("BUNIT")) == ("cm", spelled)
        assert header["CRVAL1"] == pytest.approx(0.6e20) and header["CDELT1"] == pytest.approx(1e20)
        np.testing.assert_array_equal(found[0].data, np.asarray(image.values)[::-1])  # as all other files have them
        assert f"unit of values = {unit}" in header["COMMENT"]


def test_a_scale_factor_is_no_year_and_a_hubble_parameter_no_hour(tmp_path):
    image = js.project(particles(), camera((0.3, 0, 0)), of=np.ones(2), unit="4e40*g*cm**-2 h a^-2")
    for unit, told in ((image.unit, f"{image.unit} (a is the scale factor, h the Hubble parameter)"), ("code µ", "code ?")):
        dataclasses.replace(image, unit=unit, length_unit="kpc a h^-1").save(tmp_path / "a.fits")
        header = fits.getheader(tmp_path / "a.fits")
        assert "CUNIT1" not in header and "BUNIT" not in header and header["CRVAL1"] == pytest.approx(0.3)
        assert f"unit of values = {told}"[:72] in header["COMMENT"]  # longer ones go on in the next card


@pytest.mark.parametrize("along", [None, "max"])
@pytest.mark.parametrize("view", ["x", "y", "z", (1.0, 2.0, 1.5)])
def test_coordinates_of_pixels_are_those_of_the_axes_they_name(view, along, tmp_path):
    held = particles()
    middle, how = np.array([0.1, -0.2, 0.05]), {"view_height": 2.0, "width": 6, "height": 4, "near": 1, "far": 5}
    away = {"x": (3, 0, 0), "y": (0, 3, 0), "z": (0, 0, 3)}.get(view, view)
    seen = js.Camera.orthographic(middle + away, middle, up=(0, 0, 1) if view == "y" else (0, 1, 0), **how)
    js.project(held, seen, of=np.ones(2), along=along).save(tmp_path / "a.fits")
    header = fits.getheader(tmp_path / "a.fits")
    found = wcs.WCS(header).wcs_pix2world([[2.5, 1.5], [3.5, 1.5], [2.5, 2.5]], 0)  # the middle, to the right of it, above it
    axes, eye = np.asarray(seen.axes, np.float64)[:2], seen.exact_eye()
    pixel = 2 * float(seen.half_height) / 4
    places = eye + np.array([0 * axes[0], pixel * axes[0], pixel * axes[1]])
    for nth in range(2):
        name = header[f"CTYPE{nth + 1}"]
        wanted = places @ axes[nth] if name in ("RIGHT", "UP") else places[:, "XYZ".index(name)]
        assert (name in ("RIGHT", "UP")) == (not isinstance(view, str))
        np.testing.assert_allclose(found[:, nth], wanted, atol=1e-6)


@pytest.mark.parametrize("factor", [1e38, 1e-40])
def test_values_beyond_float32_are_converted_to_float64(factor, tmp_path):
    values = np.array([[10.0, 20.0], [np.nan, 0.0]], np.float32)
    found = converted(values, factor)
    np.testing.assert_allclose(found, values.astype(np.float64) * factor)
    assert found.dtype == np.float64 and converted(values, 2.0).dtype == np.float32
    image = Projection(found, None, np.float64(2e50), False, name="mass")
    np.testing.assert_allclose(image.total(), np.sum(found) * 2e50)
    with pytest.raises(ValueError, match="float32 cannot hold, as EXR needs it; give them in another unit"):
        image.save(tmp_path / "a.exr")
