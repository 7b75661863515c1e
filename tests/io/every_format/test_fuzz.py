"""Files damaged in their structure: a valid table or a refusal by name, in memory that the file's size bounds.

Damage is done where a format keeps its structure: under the compression of npz and bgeo, in the base64 of VTU, through
h5py in HDF5; else in the bytes. Fields are renamed, repeated and dropped, counts and lengths become others.
"""

import base64
import contextlib
import gzip
import io as memory_io
import re
import shutil
import warnings
import zipfile

import numpy as np
import pytest
from examples import examples
from files_written import HDF5, WRITERS
from fuzzing import COMPRESSED, KINDS, Kind, changed, counted, table, write_all
from hypothesis import HealthCheck, given, strategies as st

NUMBERS = (0, 1, -1, 2, 6, 8, 255, 2**15, 2**16, 2**31 - 1, 2**31, 2**32 - 1, 10**10, 2**62, 2**63 - 1, 2**63, 10**25)
SLOW = (40, False), (200, True)
PLAIN = Kind(table)  # of which nothing is known that it betrays
SECONDS_A_FILE = 5
"""A guard against what never ends; none of these files takes a hundredth of it."""


def change(draw, content):
    """Bytes cut, inserted, taken out, repeated, overwritten, or a bit of them turned."""
    return changed(content, PLAIN, np.random.default_rng(draw(st.integers(0, 2**32))))[0] if content else content


def overwrite_count(draw, content):
    """Another number in two, four or eight bytes, or one more or less than stands there."""
    size, order = draw(st.sampled_from([2, 4, 8])), draw(st.sampled_from(["little", "big"]))
    place = draw(st.integers(0, max(0, len(content) - size)))
    stands = int.from_bytes(content[place : place + size], order)
    value = draw(st.sampled_from([*NUMBERS, stands + 1, stands - 1])) % 256**size
    return content[:place] + value.to_bytes(size, order) + content[place + size :]


def replace_match(draw, content, pattern, choices):
    found = list(re.finditer(pattern, content))
    if not found:
        return content
    match = draw(st.sampled_from(found))
    return content[: match.start()] + draw(st.sampled_from(choices(match, found))) + content[match.end() :]


def renumber(draw, content):
    def others(match, found):
        stands = int(match[0][:20])
        return [b"%d" % number for number in (*NUMBERS, stands + 1, stands - 1)] + [b"nan", b"1e999", b"0.5", b""]

    return replace_match(draw, content, rb"-?\d+", others)


def rename(draw, content):
    return replace_match(draw, content, rb"[A-Za-z_]+", lambda match, found: [b"", b"support", *(other[0] for other in found)])


def move_lines(draw, content):
    """Lines repeated, dropped or moved."""
    lines = content.split(b"\n")
    start, stop = sorted(draw(st.lists(st.integers(0, len(lines)), min_size=2, max_size=2)))
    kept = [*lines[:start], *lines[stop:]]
    place = draw(st.integers(0, len(kept)))
    return b"\n".join([*kept[:place], *(lines[start:stop] * draw(st.integers(0, 2))), *kept[place:]])


DAMAGE = (change, change, change, overwrite_count, renumber, rename, move_lines)


def damaged(draw, content):
    for _ in range(draw(st.integers(1, 3))):
        content = draw(st.sampled_from(DAMAGE))(draw, content)
    return content


def damaged_archive(draw, content):
    """Entries renamed, repeated, dropped, packed otherwise, or damaged; the archive around them is whole."""
    with zipfile.ZipFile(memory_io.BytesIO(content)) as archive:
        entries = [(name, archive.read(name)) for name in archive.namelist()]
    names = [name for name, _ in entries]
    for _ in range(draw(st.integers(1, 3))):
        index = draw(st.integers(0, len(entries) - 1))
        name, body = entries[index]
        other = draw(st.sampled_from([*names, "support.npy", "volume.npy", "note.txt"]))
        choices = [[], [(name, body), (other, body)], [(other, body)], [(name, damaged(draw, body))]]
        entries[index : index + 1] = draw(st.sampled_from(choices))
        if not entries:
            break
    packed = memory_io.BytesIO()
    with zipfile.ZipFile(packed, "w", draw(st.sampled_from([zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED]))) as archive:
        for name, body in entries:
            archive.writestr(name, body)
    return packed.getvalue()


def damaged_gzip(draw, content):
    return gzip.compress(damaged(draw, gzip.decompress(content)), mtime=0)


def damaged_base64(draw, content):
    """One array of a VTU file, its lengths among the bytes, damaged under its base64."""
    found = list(re.finditer(rb"(?<=[\n=])[A-Za-z0-9+/]{8,}={0,2}", content))
    match = draw(st.sampled_from(found))
    inside = damaged(draw, base64.b64decode(match[0] + b"=" * (-len(match[0]) % 4)))
    return content[: match.start()] + base64.b64encode(inside) + content[match.end() :]


def damage_hdf5(draw, path):
    """Data sets, groups and attributes renamed, repeated, dropped or replaced; what is announced may never be written."""
    h5py = pytest.importorskip("h5py")
    with h5py.File(path, "a") as file:
        names = []
        file.visit(names.append)
        for _ in range(draw(st.integers(1, 3))):
            name, other = draw(st.sampled_from(names)), draw(st.sampled_from([*names, "support", "PartType1", "x"]))
            if name not in file:
                continue
            what = draw(st.sampled_from(["drop", "move", "copy", "group", "data", "attribute"]))
            if what in ("move", "copy"):
                with contextlib.suppress(ValueError, RuntimeError):  # a name that is taken, or under a data set
                    getattr(file, what)(name, other)
            elif what == "attribute":
                damage_attribute(draw, file[name].attrs)
            else:
                del file[name]
            if what == "group":
                file.create_group(name)
            if what == "data":
                replace_dataset(draw, file, name)


def damage_attribute(draw, attributes):
    import h5py

    values = [h5py.Empty("f8"), np.zeros(0), *map(np.float64, (0, -1, np.nan, 1e300)), 10**15, "words", np.ones((2, 3))]
    attributes[draw(st.sampled_from([*attributes, "Code", "BoxSize"]))] = draw(st.sampled_from(values))


def replace_dataset(draw, file, name):
    shape = draw(st.sampled_from([(), (0,), (6,), (7,), (8,), (7, 0), (7, 1), (7, 3), (3, 7), (7, 3, 1), (0, 3), (10**9, 3)]))
    dataset = file.create_dataset(name, shape, draw(st.sampled_from(["f4", ">f8", "i8", "u1", "?", "S4"])))
    if dataset.size and dataset.size < 100 and draw(st.booleans()):
        dataset[...] = np.ones(shape, dataset.dtype)


fuzzed = examples(60, deadline=1000 * SECONDS_A_FILE, suppress_health_check=[HealthCheck.function_scoped_fixture])


@pytest.mark.parametrize("name", WRITERS)
@given(data=st.data())
@fuzzed
def test_damaged_bytes_are_read_or_refused_by_name(name, data, written, tmp_path, reader_holds):
    (tmp_path / name).write_bytes(damaged(data.draw, (written / name).read_bytes()))
    reader_holds(tmp_path / name)


@pytest.mark.parametrize(
    ("name", "damage"),
    [("a.npz", damaged_archive), ("zipped.bgeo", damaged_gzip), ("a.vtu", damaged_base64), ("plain.vtu", damaged_base64)],
)
@given(data=st.data())
@fuzzed
def test_what_is_damaged_under_its_packing_is_read_or_refused_by_name(name, damage, data, written, tmp_path, reader_holds):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of names that are there twice
        (tmp_path / name).write_bytes(damage(data.draw, (written / name).read_bytes()))
    reader_holds(tmp_path / name)


@pytest.mark.parametrize("name", HDF5)
@given(data=st.data())
@fuzzed
def test_hdf5_of_another_structure_is_read_or_refused_by_name(name, data, written, tmp_path, reader_holds):
    shutil.copy(written / name, tmp_path / name)
    damage_hdf5(data.draw, tmp_path / name)
    reader_holds(tmp_path / name)


@pytest.fixture(scope="module")
def originals(samples, tmp_path_factory):
    for library in ("nibabel", "nrrd", "h5py", "meshio", "OpenEXR"):
        pytest.importorskip(library)
    folder = tmp_path_factory.mktemp("originals")
    write_all(folder, samples)
    return folder


@pytest.mark.parametrize(("number", "bits"), [(12, False), *(pytest.param(*more, marks=pytest.mark.slow) for more in SLOW)])
@pytest.mark.parametrize("name", KINDS)
def test_no_change_that_a_file_betrays_is_read(name, number, bits, originals, tmp_path):
    """Of volumes and images too: changes, and single bits of all that is compressed."""
    if bits and name not in COMPRESSED:
        pytest.skip("nothing of it is compressed")
    counts, wrong = counted(name, originals / name, tmp_path, number, seed=number, bits=bits)
    print(name, "bits" if bits else "changes", dict(counts))
    assert not wrong and counts.total() == number, "\n".join(wrong)
