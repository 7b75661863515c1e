"""Every count of every header made absurd: a valid table or a refusal by name, in memory that the file's size bounds."""

import base64
import gzip
import io as memory_io
import itertools
import re
import shutil
import zipfile

import pytest
from files_written import HDF5

COUNTS = (0, -1, 6, 8, 2**31 - 1, 10**10, 2**63 - 1, 10**25)
WORDS = (0, 2**31 - 1, *(pytest.param(word, marks=pytest.mark.slow) for word in (6, 8, 2**16, 2**31, 2**32 - 1)))
LENGTH_BYTES = 16
"""What is read of an array in VTK XML before its data: how many blocks there are, and their lengths."""


def in_words(content, count, stop=700):
    """Copies of `content`, in each another number of its first bytes replaced by `count`."""
    for match in re.finditer(rb"\d+", content[:stop]):
        yield content[: match.start()] + b"%d" % count + content[match.end() :]


def in_bytes(order, stop, step):
    """The same of numbers of four bytes."""

    def changed(content, word):
        for place in range(0, stop, step):
            yield content[:place] + (word % 2**32).to_bytes(4, order) + content[place + 4 :]

    return changed


def under_gzip(content, word):
    return (gzip.compress(changed, 1) for changed in in_bytes("big", 110, 1)(gzip.decompress(content), word))


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
        for changed in in_bytes("little", LENGTH_BYTES, 4)(lengths, word):
            yield content[: match.start()] + base64.b64encode(changed) + rest + content[match.end() :]


AS_TEXT = ["polydata.vtk", "ascii.vtk", "five.vtk", "ascii.vtu", "plain.vtu", "big.ply", "ascii.ply", "a.xyz", "extended.xyz"]
AS_BYTES = {
    "plain.bgeo": in_bytes("big", 110, 1), "two.gadget": in_bytes("little", 320, 4), "one.gadget": in_bytes("big", 320, 4),
    "disc_00010": in_bytes("little", 1700, 4), "zipped.bgeo": under_gzip, "a.vtu": in_base64,
}  # fmt: skip
WAYS = [(name, in_words, COUNTS) for name in AS_TEXT] + [("a.npz", in_entries, COUNTS), ("plain.vtu", in_base64, WORDS)]
WAYS += [(name, way, WORDS) for name, way in AS_BYTES.items()]


@pytest.mark.parametrize(
    ("name", "way", "count"),
    [
        pytest.param(name, way, *getattr(count, "values", (count,)), marks=getattr(count, "marks", ()))
        for name, way, counts in WAYS
        for count in counts
    ],
)
def test_absurd_counts_are_refused_or_harmless(name, way, count, written, tmp_path, reader_holds):
    for content in way((written / name).read_bytes(), count):
        (tmp_path / name).write_bytes(content)
        reader_holds(tmp_path / name)


CHUNKED_SHAPES = [(8,), (10**9, 3), (10**12,)]
SHAPES = [
    *itertools.product(["contiguous"], [(), (0,), (7, 0), (0, 3), (0, 10**9), (10**12, 0), *CHUNKED_SHAPES]),
    *itertools.product(["chunked", "packed"], CHUNKED_SHAPES),
]


@pytest.mark.parametrize(("layout", "shape"), SHAPES)
@pytest.mark.parametrize("name", HDF5)
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
