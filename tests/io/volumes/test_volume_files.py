"""Volumes are read as what a file says: values, place, axes; what is damaged or oblique is refused by name."""

from __future__ import annotations

import gzip

import numpy as np
import pytest

import jaxsph as js
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
    with pytest.raises(ValueError, match=rf"v{suffix}: has oblique axes .*resample"):
        js.io.read_volume(path)


@pytest.mark.parametrize("suffix", FORMATS)
@pytest.mark.parametrize("share", [0.0, 0.3, 0.9])
def test_a_file_cut_short_is_refused_by_name(suffix, share, tmp_path):
    path = write(tmp_path / f"v{suffix}", np.random.default_rng(1).normal(size=(9, 9, 9)).astype(np.float32))
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    with pytest.raises(ValueError, match=f"v{suffix}"):
        js.io.read_volume(path)


def test_values_that_are_no_numbers_are_refused_with_the_file_and_where(tmp_path):
    values = FLOATS.copy()
    values[1, 2, 3] = np.nan
    np.save(tmp_path / "v.npy", values)
    with pytest.raises(ValueError, match=r"v\.npy: `values` must be finite, but 1 of 120 are not, first values\[1, 2, 3\] = nan"):
        js.io.read_volume(tmp_path / "v.npy")


def test_pieces_of_an_image_are_put_where_they_belong(tmp_path):
    """Two pieces that share a plane of points, an extent that does not begin at 0, and a vector."""
    pieces = []
    for low, high in ((2, 3), (3, 5)):
        part = FLOATS[low - 2 : high - 1]
        text = " ".join(map(repr, part.T.ravel().tolist()))
        vector = " ".join(f"{x} {2 * x} 0" for x in part.T.ravel().tolist())
        pieces.append(
            f'<Piece Extent="{low} {high} 0 4 0 5"><PointData><DataArray type="Float32" Name="B" NumberOfComponents="3" '
            f'format="ascii">{vector}</DataArray><DataArray type="Float32" Name="rho" format="ascii">{text}</DataArray>'
            "</PointData></Piece>"
        )
    path = tmp_path / "v.vti"
    path.write_text(
        '<VTKFile type="ImageData" byte_order="LittleEndian"><ImageData WholeExtent="2 5 0 4 0 5" Origin="1 0 0" '
        f'Spacing="0.5 1 1">{"".join(pieces)}</ImageData></VTKFile>'
    )
    volume = js.io.read_volume(path)
    np.testing.assert_allclose(volume.values, FLOATS, rtol=1e-6)
    np.testing.assert_allclose(volume.bounds()[0], (2.0, 0, 0))
    np.testing.assert_allclose(js.io.read_volume(path, "B.y").values, 2 * FLOATS, rtol=1e-6)
    np.testing.assert_allclose(js.io.read_volume(path, "B.magnitude").values, np.sqrt(5) * FLOATS, rtol=1e-6)
    with pytest.raises(ValueError, match=r"has no quantity 'C'; it has B\.0, B\.1, B\.2, B\.magnitude, rho"):
        js.io.read_volume(path, "C")


def test_a_series_is_read_by_its_moments(tmp_path):
    import nibabel

    nibabel.save(nibabel.Nifti1Image(np.stack([FLOATS, 2 * FLOATS], -1), np.eye(4)), str(tmp_path / "v.nii"))
    np.testing.assert_array_equal(js.io.read_volume(tmp_path / "v.nii", "values.1").values, 2 * FLOATS)


def test_other_files_are_refused_by_name(tmp_path):
    (tmp_path / "v.raw").write_bytes(gzip.compress(b"0"))
    with pytest.raises(ValueError, match=r"v\.raw: volumes are read from \.vti"):
        js.io.read_volume(tmp_path / "v.raw")
    with pytest.raises(FileNotFoundError, match=r"w\.vti: there is no such file"):
        js.io.read_volume(tmp_path / "w.vti")
    with pytest.raises(ValueError, match=r"v\.nrrd: volumes are written as \.vti or \.npy"):
        js.io.write_volume(tmp_path / "v.nrrd", js.Volume.from_array(FLOATS))
    with pytest.raises(ValueError, match="spacing of"):
        along_axes({"values": FLOATS}, np.zeros(3), np.diag([1.0, 0.0, 1.0]), "test")
