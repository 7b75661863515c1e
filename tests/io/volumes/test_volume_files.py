"""Volumes are read as what a file says: values, place, axes; what is damaged or oblique is refused by name."""

from __future__ import annotations

import bz2
import gzip
import itertools
import re

import numpy as np
import pytest
from refusals import refused

import jaxsph as js
from jaxsph.io.opening.opened import load
from jaxsph.io.volumes.volume_files import nothing_there
from jaxsph.io.volumes.volume_table import along_axes

BYTES = np.random.default_rng(0).integers(0, 255, (4, 5, 6)).astype(np.uint8)
FLOATS = BYTES.astype(np.float32) / 7
LOWER, SPACING = (-1.5, 2.0, 0.25), (0.5, 0.25, 2.0)
FORMATS = (".vti", ".nrrd", ".nii", ".nii.gz", ".npy")


def write(path, values, lower=LOWER, steps=None):
    """By the library of each format: the index along axis k moves by column k of `steps`."""
    steps = np.diag(SPACING) if steps is None else np.asarray(steps, float)
    suffix = "".join(path.suffixes)
    if suffix == ".nrrd":
        import nrrd

        header = {"space": "left-posterior-superior", "space directions": steps.T, "space origin": np.asarray(lower)}
        nrrd.write(str(path), values, header, index_order="F")
    elif suffix.startswith(".nii"):
        import nibabel

        affine = np.eye(4)
        affine[:3, :3], affine[:3, 3] = steps, lower
        nibabel.save(nibabel.Nifti1Image(values, affine), str(path))
    elif suffix == ".npy":
        np.save(path, values)
    else:
        js.io.write_volume(path, js.Volume.from_array(values, lower, np.diag(steps)))
    return path


def place(path):
    return {"lower": LOWER, "spacing": SPACING} if path.suffix == ".npy" else {}


@pytest.mark.parametrize("values", [BYTES, FLOATS], ids=["bytes", "floats"])
@pytest.mark.parametrize("suffix", FORMATS)
def test_values_and_place_are_those_that_were_written(suffix, values, tmp_path):
    path = write(tmp_path / f"v{suffix}", values)
    volume = js.io.read_volume(path, **place(path))
    assert volume.values.dtype == values.dtype
    np.testing.assert_array_equal(volume.values, values)
    np.testing.assert_allclose(volume.bounds()[0], LOWER)
    np.testing.assert_allclose(volume.spacing, SPACING)


@pytest.mark.parametrize("suffix", [".nrrd", ".nii"])
def test_axes_are_permuted_and_flipped_into_x_y_z(suffix, tmp_path):
    """The file's first index runs down z, its second along x, its third along y."""
    steps = np.array([[0, 0.5, 0], [0, 0, 0.25], [-2.0, 0, 0]])
    path = write(tmp_path / f"v{suffix}", FLOATS, LOWER, steps)
    volume = js.io.read_volume(path)
    np.testing.assert_array_equal(volume.values, np.moveaxis(FLOATS[::-1], (1, 2, 0), (0, 1, 2)))
    np.testing.assert_allclose(volume.bounds()[0], (LOWER[0], LOWER[1], LOWER[2] - 2.0 * 3))
    np.testing.assert_allclose(volume.spacing, (0.5, 0.25, 2.0))


@pytest.mark.parametrize("suffix", [".nrrd", ".nii"])
def test_oblique_axes_are_refused_with_a_remedy(suffix, tmp_path):
    path = write(tmp_path / f"v{suffix}", FLOATS, LOWER, [[1, 0.1, 0], [-0.1, 1, 0], [0, 0, 1]])
    refused(rf"v{suffix}: has oblique axes .*resample", js.io.read_volume, path)


@pytest.mark.parametrize("suffix", FORMATS)
@pytest.mark.parametrize("share", [0.0, 0.3, 0.9])
def test_a_file_cut_short_is_refused_by_name(suffix, share, tmp_path):
    path = write(tmp_path / f"v{suffix}", np.random.default_rng(1).normal(size=(9, 9, 9)).astype(np.float32))
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    refused(f"v{suffix}", js.io.read_volume, path)


def test_infinite_values_are_refused_with_the_file_and_where(tmp_path):
    values = FLOATS.copy()
    values[1, 2, 3] = np.inf
    np.save(tmp_path / "v.npy", values)
    told = r"v\.npy: the array values must be finite, but 1 of 120 are not, first values\[1, 2, 3\] = inf"
    refused(told, js.io.read_volume, tmp_path / "v.npy")


@pytest.mark.parametrize("suffix", FORMATS)
def test_values_that_are_nan_are_kept_and_counted(suffix, tmp_path):
    values = FLOATS.copy()
    values[1, 2:, 3] = np.nan
    path = write(tmp_path / f"v{suffix}", values)
    volume = js.io.read_volume(path)
    np.testing.assert_array_equal(np.isnan(volume.values), np.isnan(values))
    scene, _ = js.io.read_scene(path)
    (look,) = [transfer for _, transfer in scene.volumes]
    assert np.isfinite([*np.ravel(look.values), *np.ravel(look.extinction)]).all() and np.ptp(look.values) > 0
    assert nothing_there(volume) == f"{np.isnan(values).sum()} of 120 points are NaN: the cells around them are empty"


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("suffix", FORMATS)
def test_a_single_plane_is_refused_with_the_file_its_array_and_its_shape(suffix, axis, tmp_path):
    plane, zero = np.take(FLOATS, [1], axis), np.zeros(3, np.float32)
    path = tmp_path / f"v{suffix}"
    if suffix == ".vti":
        js.io.write_volume(path, js.Volume(plane, zero, zero + 1, zero))
    else:
        write(path, plane)
    shape = re.escape(str(plane.shape))
    for read in (js.io.read_volume, load):
        refused(rf"v{suffix}: the array values must have at least two points .*{shape}; repeat", read, path)


def test_pieces_of_an_image_are_put_where_they_belong(tmp_path):
    """Two pieces that share a plane of points, an extent that does not begin at 0, and a vector."""
    pieces = []
    for low, high in ((2, 3), (3, 5)):
        values = FLOATS[low - 2 : high - 1].T.ravel().tolist()
        vector = " ".join(f"{x} {2 * x} 0" for x in values)
        array = '<DataArray type="Float32" Name="{}" NumberOfComponents="{}" format="ascii">{}</DataArray>'
        arrays = array.format("B", 3, vector) + array.format("rho", 1, " ".join(map(repr, values)))
        pieces.append(f'<Piece Extent="{low} {high} 0 4 0 5"><PointData>{arrays}</PointData></Piece>')
    path = tmp_path / "v.vti"
    path.write_text(
        '<VTKFile type="ImageData" byte_order="LittleEndian"><ImageData WholeExtent="2 5 0 4 0 5" Origin="1 0 0" '
        f'Spacing="0.5 1 1">{"".join(pieces)}</ImageData></VTKFile>'
    )
    for name, factor in ((None, 1), ("B.y", 2), ("B.magnitude", np.sqrt(5))):
        np.testing.assert_allclose(js.io.read_volume(path, name).values, factor * FLOATS, rtol=1e-6)
    np.testing.assert_allclose(js.io.read_volume(path).bounds()[0], (2.0, 0, 0))
    for wrong in ("C", "B.yz", "B.\u00b2"):
        refused(rf"has no quantity '{wrong}'; it has B\.0, B\.1, B\.2, B\.magnitude, rho", js.io.read_volume, path, wrong)


def test_a_series_is_read_by_its_moments(tmp_path):
    import nibabel

    nibabel.save(nibabel.Nifti1Image(np.stack([FLOATS, 2 * FLOATS], -1), np.eye(4)), str(tmp_path / "v.nii"))
    np.testing.assert_array_equal(js.io.read_volume(tmp_path / "v.nii", "values.1").values, 2 * FLOATS)


def image(path, pieces, whole="0 2 0 1 0 1"):
    """A VTI of pieces: extent, type and values of `rho`, or of several arrays of that name."""
    text = f'<VTKFile type="ImageData" byte_order="LittleEndian"><ImageData WholeExtent="{whole}" Origin="0 0 0" Spacing="1 1 1">'
    for extent, kind, *arrays in pieces:
        each = (f'<DataArray type="{kind}" Name="rho" format="ascii">{" ".join(map(str, one))}</DataArray>' for one in arrays)
        text += f'<Piece Extent="{extent}"><PointData>{"".join(each)}</PointData></Piece>'
    path.write_text(text + "</ImageData></VTKFile>")
    return path


LEFT, RIGHT, ALL = "0 1 0 1 0 1", "1 2 0 1 0 1", "0 2 0 1 0 1"
EIGHT, ODD = range(8), [1, 1, 3, 3, 5, 5, 7, 7]
WRONG = [
    ([(LEFT, "Int16", EIGHT)], "not for 4 points of a grid of 12"),
    ([(LEFT, "Int16", EIGHT), (LEFT, "Int16", EIGHT)], "not for 4 points of a grid of 12"),
    ([(LEFT, "Int16", EIGHT), (RIGHT, "Int16", ODD), (LEFT, "Int16", range(1, 9))], "two values of `rho` at one point"),
    ([(ALL, "Int16", range(12)), (ALL, "Int16", range(1, 13))], "two values of `rho` at one point"),
    ([(LEFT, "Int16", EIGHT), (RIGHT, "Float64", ODD)], "as float64, 1 a point and as int16, 1 a point"),
    ([(ALL, "Int16", range(12), range(1, 13))], "the array `rho` twice"),
]


@pytest.mark.parametrize(("pieces", "said"), WRONG)
def test_pieces_that_leave_points_out_or_disagree_are_refused(pieces, said, tmp_path):
    refused(rf"v\.vti: has .*{said}", js.io.read_volume, image(tmp_path / "v.vti", pieces))


@pytest.mark.parametrize("whole", ["0 2.5 0 1 0 1", "0.5 2.5 0 1 0 1", "0 1e300 0 1 0 1"])
def test_extents_are_whole_numbers(whole, tmp_path):
    path = image(tmp_path / "v.vti", [(ALL, "Int16", range(12))], whole)
    refused(r"v\.vti: has the extent .* not of whole numbers", js.io.read_volume, path)


def test_pieces_that_claim_a_huge_grid_take_no_memory(tmp_path, measured):
    path = image(tmp_path / "v.vti", [("0 0 0 0 0 0", "Int16", [1])], "0 3000 0 3000 0 3000")
    with measured() as memory, pytest.raises(ValueError, match="not for 27027009000 points"):
        js.io.read_volume(path)
    assert memory.peak < 2**22


def nrrd_file(path, fields, content=b""):
    header = {"type": "short", "dimension": 3, "sizes": "4 5 6", "encoding": "raw", "endian": "big", **fields}
    lines = "".join(f"{name}: {value}\n" for name, value in header.items())
    path.write_bytes(f"NRRD0004\n{lines}\n".encode() + content)
    return path


STORED = BYTES.astype(">i2").tobytes(order="F")
PACKED = {"gzip": gzip.compress, "bzip2": bz2.compress}


@pytest.mark.parametrize("encoding", PACKED)
def test_packed_values_end_where_their_stream_ends(encoding, tmp_path):
    packed = PACKED[encoding](b"skip" + STORED)
    path = nrrd_file(tmp_path / "v.nrrd", {"encoding": encoding, "byte skip": 4}, packed)
    np.testing.assert_array_equal(js.io.read_volume(path).values, BYTES)
    for content in (packed[:-5], packed + b"behind", PACKED[encoding](STORED), PACKED[encoding](b"skip" + STORED + b"1")):
        refused(r"v\.nrrd: ", js.io.read_volume, nrrd_file(path, {"encoding": encoding, "byte skip": 4}, content))


@pytest.mark.parametrize("encoding", PACKED)
def test_no_more_is_unpacked_than_the_header_announces(encoding, tmp_path, measured):
    bomb = PACKED[encoding](bytes(2**26))
    with measured() as memory, pytest.raises(ValueError, match=r"v\.nrrd: unpacks to more than the 240 bytes"):
        js.io.read_volume(nrrd_file(tmp_path / "v.nrrd", {"encoding": encoding}, bomb))
    assert memory.peak < 2**23


def test_lines_and_bytes_before_values_are_skipped(tmp_path):
    for skipped, begin in itertools.product((0, 3, -1), (0, 2)):
        before = b"a line\n" * begin + b"xyz"[: 3 * (skipped != 0)]
        fields = {"line skip": begin, "byte skip": skipped}
        path = nrrd_file(tmp_path / "v.nrrd", fields, before + STORED)
        np.testing.assert_array_equal(js.io.read_volume(path).values, BYTES)
    text = " ".join(map(str, BYTES.ravel(order="F"))).encode()
    np.testing.assert_array_equal(js.io.read_volume(nrrd_file(path, {"encoding": "ascii"}, text)).values, BYTES)
    for wrong in (text[:-5], text + b" 3", text.replace(b" 1", b" 1_0", 1)):
        refused(r"v\.nrrd: ", js.io.read_volume, nrrd_file(path, {"encoding": "ascii"}, wrong))


def test_values_beside_a_header_lie_in_its_folder(tmp_path):
    (tmp_path / "sub").mkdir()
    for place in ("v.raw", "sub/v.raw"):
        (tmp_path / place).write_bytes(STORED)
        path = nrrd_file(tmp_path / "v.nhdr", {"data file": place})
        np.testing.assert_array_equal(js.io.read_volume(path).values, BYTES)
    for place in ("../v.raw", tmp_path / "v.raw"):
        path = nrrd_file(tmp_path / "sub" / "v.nhdr", {"data file": place})
        refused(r"v\.nhdr: has its data in .*, which .* not opened", js.io.read_volume, path)


@pytest.mark.parametrize(
    ("fields", "lower", "spacing"),
    [
        ({"centerings": "node node node"}, (1, -2, 0), (3, 2, 0.2)),
        ({"centers": "cell cell cell"}, (2.125, -1.2, 1 / 12), (2.25, 1.6, 1 / 6)),
        ({}, (2.125, -1.2, 1 / 12), (2.25, 1.6, 1 / 6)),
        ({"spacings": "2.25 NaN nan", "centerings": "cell node node"}, (2.125, -2, 0), (2.25, 2, 0.2)),
    ],
)
def test_a_volume_lies_between_the_ends_of_its_axes(fields, lower, spacing, tmp_path):
    path = nrrd_file(tmp_path / "v.nrrd", {"axis mins": "1 -2 0", "axis maxs": "10 6 1", **fields}, STORED)
    volume = js.io.read_volume(path)
    np.testing.assert_allclose(volume.bounds()[0], lower, atol=1e-6)
    np.testing.assert_allclose(volume.spacing, spacing, rtol=1e-6)
    assert "axis mins" in " ".join(js.io.read_volume_table(path).conventions)


def test_other_files_are_refused_by_name(tmp_path):
    (tmp_path / "v.raw").write_bytes(gzip.compress(b"0"))
    refused(r"v\.raw: volumes are read from \.vti", js.io.read_volume, tmp_path / "v.raw")
    with pytest.raises(FileNotFoundError, match=r"w\.vti: there is no such file"):
        js.io.read_volume(tmp_path / "w.vti")
    with pytest.raises(ValueError, match=r"v\.nrrd: volumes are written as \.vti or \.npy"):
        js.io.write_volume(tmp_path / "v.nrrd", js.Volume.from_array(FLOATS))
    refused("spacing of", along_axes, {"values": FLOATS}, np.zeros(3), np.diag([1.0, 0.0, 1.0]), "test")
