"""A file that is longer than its header says has damaged data or a damaged header: it is refused, by name."""

import gzip
import struct

import numpy as np
import pytest
from refusals import refused

import jaxsph.io as io

VALUES = np.random.default_rng(0).random((6, 7, 8)).astype(np.float32)


def volume(path):
    """A file of `VALUES`, and where its values begin."""
    suffix = "".join(path.suffixes)
    if suffix == ".npy":
        np.save(path, VALUES)
        return 128
    if suffix == ".nrrd":
        nrrd = pytest.importorskip("nrrd")
        nrrd.write(str(path), VALUES, {"encoding": "raw"})
        return path.read_bytes().index(b"\n\n") + 2
    nibabel = pytest.importorskip("nibabel")
    nibabel.save(nibabel.Nifti1Image(VALUES, np.eye(4)), str(path))
    return 352


def test_a_header_of_fewer_values_than_there_are_is_refused(tmp_path):
    volume(tmp_path / "v.npy")
    content = (tmp_path / "v.npy").read_bytes()
    (tmp_path / "v.npy").write_bytes(content.replace(b"(6, 7, 8)", b"(6, 7, 3)"))
    refused(r"v\.npy: has 840 more bytes than \(6, 7, 3\) of float32", io.read_volume, tmp_path / "v.npy")
    volume(tmp_path / "v.nii")
    content = (tmp_path / "v.nii").read_bytes()
    (tmp_path / "v.nii").write_bytes(content[:46] + struct.pack("<h", 3) + content[48:])
    refused(r"v\.nii: has 840 more bytes", io.read_volume, tmp_path / "v.nii")


@pytest.mark.parametrize(
    "change",
    [lambda c: c[:-8], lambda c: c[:-8] + bytes(8), lambda c: c + b"more", lambda c: gzip.compress(gzip.decompress(c) + b"1")],
)
@pytest.mark.parametrize("name", ["v.nii.gz", "v.nrrd"])
def test_the_end_of_compressed_volumes_is_read(name, change, tmp_path):
    if name == "v.nrrd":
        nrrd = pytest.importorskip("nrrd")
        nrrd.write(str(tmp_path / name), VALUES)
    else:
        volume(tmp_path / name)
    content = (tmp_path / name).read_bytes()
    start = content.index(b"\x1f\x8b")
    (tmp_path / name).write_bytes(content[:start] + change(content[start:]))
    refused(rf"{name}: ", io.read_volume, tmp_path / name)


def test_a_volume_that_shrinks_while_it_is_held_stays_as_it_was_read(tmp_path):
    for name in ("v.npy", "v.nii"):
        volume(tmp_path / name)
        (values,) = io.read_volume_table(tmp_path / name).arrays.values()
        (tmp_path / name).write_bytes(b"")
        np.testing.assert_array_equal(values, VALUES)


def test_an_announced_size_takes_no_memory(tmp_path, measured):
    volume(tmp_path / "v.nii")
    content = (tmp_path / "v.nii").read_bytes()
    header = content[:42] + struct.pack("<3h", 3000, 3000, 100) + content[48:352]
    for name, written in (("v.nii", header + content[352:]), ("v.nii.gz", gzip.compress(header + content[352:]))):
        (tmp_path / name).write_bytes(written)
        with measured() as memory, pytest.raises(ValueError, match=rf"{name}: is cut short: its header announces 3600000352"):
            io.read_volume(tmp_path / name)
        assert memory.peak < 2**22


def ply(samples, path):
    samples.write_ply(path, samples.particles(), "binary_little_endian")
    return path.read_bytes()


def bgeo(samples, path, **how):
    samples.write_bgeo(path, samples.particles(), compressed=False)
    return path.read_bytes()


INT = struct.Struct(">i").pack
POINTS = r"has \d+ more bytes than \d points"


@pytest.mark.parametrize(
    ("made", "change", "said"),
    [
        (ply, lambda c: c.replace(b"property float density\n", b""), r"has \d+ more bytes than \d vertices"),
        (ply, lambda c: c.replace(b"vertex 7", b"vertex 6"), r"has \d+ more bytes than \d vertices"),
        (ply, lambda c: c[:-100] + b"1234" + c[-100:], r"has \d+ more bytes than \d vertices"),
        *(
            (bgeo, change, POINTS)
            for pack in (gzip.compress, bytes)
            for change in (
                lambda c, pack=pack: pack(c[:-50] + b"\1\2\3\4" + c[-50:]),
                lambda c, pack=pack: pack(c.replace(INT(7), INT(6), 1)),
            )
        ),
    ],
)
def test_points_that_do_not_fill_a_file_are_refused(made, change, said, samples, tmp_path):
    path = tmp_path / f"a.{made.__name__}"
    path.write_bytes(change(made(samples, path)))
    refused(rf"{path.name}: {said}", io.read_table, path)
