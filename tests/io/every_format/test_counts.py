"""Every count of every header made absurd: a valid table or a refusal by name, in memory that the file's size bounds."""

import base64
import gzip
import io as memory_io
import itertools
import re
import shutil
import zipfile

import pytest

COUNTS = (0, -1, 6, 8, 2**31 - 1, 10**10, 2**63 - 1, 10**25)
WORDS = (0, 2**31 - 1, *(pytest.param(word, marks=pytest.mark.slow) for word in (6, 8, 2**16, 2**31, 2**32 - 1)))
HEADER_BYTES = 700
LENGTH_BYTES = 16
"""What is read of an array in VTK XML before its data: how many blocks there are, and their lengths."""


def in_words(content, count, stop=HEADER_BYTES):
    """Copies of `content`, in each another number of its first bytes replaced by `count`."""
    for match in re.finditer(rb"\d+", content[:stop]):
        yield content[: match.start()] + b"%d" % count + content[match.end() :]


def in_bytes(content, word, order, stop, step):
    for place in range(0, stop, step):
        yield content[:place] + (word % 2**32).to_bytes(4, order) + content[place + 4 :]


def in_entries(content, count):
    """The same in each array of an npz file, whose size in the archive is right."""
    with zipfile.ZipFile(memory_io.BytesIO(content)) as archive:
        entries = {name: archive.read(name) for name in archive.namelist()}
    for name, entry in entries.items():
        for changed in in_words(entry, count, stop=128):
            packed = memory_io.BytesIO()
            with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
                for other, body in entries.items():
                    archive.writestr(other, changed if other == name else body)
            yield packed.getvalue()


def in_base64(content, word):
    """The same in the lengths that stand before each array of a VTK XML file."""
    for match in re.finditer(rb"(?<=\n)[A-Za-z0-9+/]{8,}={0,2}", content):
        lengths, rest = base64.b64decode(match[0][:24]), match[0][24:]
        for changed in in_bytes(lengths, word, "little", LENGTH_BYTES, 4):
            yield content[: match.start()] + base64.b64encode(changed) + rest + content[match.end() :]


@pytest.mark.parametrize("count", COUNTS)
@pytest.mark.parametrize(
    "name", ["polydata.vtk", "ascii.vtk", "five.vtk", "ascii.vtu", "plain.vtu", "big.ply", "ascii.ply", "a.xyz", "extended.xyz"]
)
def test_counts_in_words(name, count, written, tmp_path, reader_holds):
    for content in in_words((written / name).read_bytes(), count):
        (tmp_path / name).write_bytes(content)
        reader_holds(tmp_path / name)


@pytest.mark.parametrize("word", WORDS)
@pytest.mark.parametrize(
    ("name", "order", "stop", "step"),
    [
        ("plain.bgeo", "big", 110, 1),
        ("two.gadget", "little", 320, 4),
        ("one.gadget", "big", 320, 4),
        ("disc_00010", "little", 1700, 4),
    ],
)
def test_counts_in_bytes(name, order, stop, step, word, written, tmp_path, reader_holds):
    for content in in_bytes((written / name).read_bytes(), word, order, stop, step):
        (tmp_path / name).write_bytes(content)
        reader_holds(tmp_path / name)


@pytest.mark.parametrize("word", WORDS)
def test_counts_under_gzip(word, written, tmp_path, reader_holds):
    content = gzip.decompress((written / "zipped.bgeo").read_bytes())
    for changed in in_bytes(content, word, "big", 110, 1):
        (tmp_path / "zipped.bgeo").write_bytes(gzip.compress(changed, 1))
        reader_holds(tmp_path / "zipped.bgeo")


@pytest.mark.parametrize("count", COUNTS)
def test_counts_in_the_entries_of_an_archive(count, written, tmp_path, reader_holds):
    for content in in_entries((written / "a.npz").read_bytes(), count):
        (tmp_path / "a.npz").write_bytes(content)
        reader_holds(tmp_path / "a.npz")


@pytest.mark.parametrize("word", WORDS)
@pytest.mark.parametrize("name", ["a.vtu", "plain.vtu"])
def test_lengths_under_base64(name, word, written, tmp_path, reader_holds):
    for content in in_base64((written / name).read_bytes(), word):
        (tmp_path / name).write_bytes(content)
        reader_holds(tmp_path / name)


CHUNKED_SHAPES = [(8,), (10**9, 3), (10**12,)]
SHAPES = [
    *itertools.product(["contiguous"], [(), (0,), (7, 0), (0, 3), (0, 10**9), (10**12, 0), *CHUNKED_SHAPES]),
    *itertools.product(["chunked", "packed"], CHUNKED_SHAPES),
]


@pytest.mark.parametrize(("layout", "shape"), SHAPES)
@pytest.mark.parametrize("name", ["gadget.hdf5", "swift.hdf5", "phantom.h5", "points.hdf5"])
def test_shapes_of_hdf5(name, layout, shape, written, tmp_path, reader_holds):
    h5py = pytest.importorskip("h5py")
    options = {"contiguous": {}, "chunked": {"chunks": True}, "packed": {"chunks": True, "compression": "gzip"}}[layout]
    names = []
    with h5py.File(written / name) as file:
        file.visititems(lambda label, item: names.append(label) if isinstance(item, h5py.Dataset) else None)
    for label in names:
        shutil.copy(written / name, tmp_path / name)
        with h5py.File(tmp_path / name, "a") as file:
            del file[label]
            file.create_dataset(label, shape, "f8", **options)
        reader_holds(tmp_path / name)
