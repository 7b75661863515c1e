import gzip
import struct

import numpy as np
import pytest
from refusals import refused

import jaxsph.io as io


@pytest.mark.parametrize("compressed", [True, False])
@pytest.mark.parametrize("names", [(), ("id",), ("velocity", "density", "id")])
def test_positions_and_any_attributes_are_read(compressed, names, samples, tmp_path):
    p = samples.particles()
    samples.write_bgeo(tmp_path / "a.bgeo", p, names, compressed)
    table = io.read_table(tmp_path / "a.bgeo")
    np.testing.assert_array_equal(table.position, p.position)
    assert tuple(table.columns) == names
    for name in names:
        np.testing.assert_array_equal(table.columns[name], getattr(p, name))


TWICE = "x coordinates were overwritten by"


@pytest.mark.parametrize(
    ("how", "said"),
    [
        ({"overwrite": True}, rf"a\.bgeo: its {TWICE} the attribute `id`.*requested twice"),
        ({"overwrite": True, "names": ("density",)}, f"{TWICE} integers"),
        ({"names": ("id", "density", "id")}, "has the attribute `id` twice"),
    ],
)
def test_positions_and_attributes_that_were_written_over_are_refused_and_the_cause_is_named(how, said, samples, tmp_path):
    samples.write_bgeo(tmp_path / "a.bgeo", samples.particles(), **how)
    refused(said, io.read_table, tmp_path / "a.bgeo")


def test_particles_in_a_plane_through_the_origin_are_not_taken_for_overwritten(samples, tmp_path):
    p = samples.particles()
    p.position[:, 0], p.id[:] = 0, 0
    samples.write_bgeo(tmp_path / "a.bgeo", p)
    np.testing.assert_array_equal(io.read_table(tmp_path / "a.bgeo").position[:, 0], 0)


def test_points_cut_off_inside_whole_compression_are_counted(samples, tmp_path):
    samples.write_bgeo(tmp_path / "a.bgeo", samples.particles())
    content = gzip.decompress((tmp_path / "a.bgeo").read_bytes())
    (tmp_path / "a.bgeo").write_bytes(gzip.compress(content[:-60]))
    refused("is cut short: 7 points are announced, 5 are there", io.read_table, tmp_path / "a.bgeo")


def header(count, attributes, num_attributes=None):
    """The header of `count` points with `attributes` of (name, width, kind, what follows)."""
    number = len(attributes) if num_attributes is None else num_attributes
    out = b"BgeoV" + struct.pack(">9i", 5, count, 0, 0, 0, number, 0, 0, 0)
    for name, width, kind, rest in attributes:
        out += struct.pack(">H", len(name)) + name.encode() + struct.pack(">Hi", width, kind) + rest
    return out


def test_a_number_of_strings_that_cannot_be_is_refused_and_newer_files_are_told_how_to_be_saved(tmp_path):
    for count in (-1, 2**31 - 1):
        attribute = ("name", 1, 4, struct.pack(">i", count))
        (tmp_path / "a.bgeo").write_bytes(header(1, [attribute]) + np.ones(5, ">f4").tobytes())
        refused(rf"a\.bgeo: has attribute `name` with {count} strings", io.read_table, tmp_path / "a.bgeo")
    (tmp_path / "a.bgeo").write_bytes(b"\x7fNSJb" + bytes(50))
    refused("saved as", io.read_table, tmp_path / "a.bgeo")


def test_strings_are_passed_over_and_their_indices_read(tmp_path):
    strings = struct.pack(">i", 2) + struct.pack(">H", 5) + b"water" + struct.pack(">H", 0)
    content = header(1, [("name", 1, 4, strings)]) + np.array([1, 2, 3, 1], ">f4").tobytes() + struct.pack(">i", 1)
    (tmp_path / "a.bgeo").write_bytes(content)
    table = io.read_table(tmp_path / "a.bgeo")
    assert table.position.tolist() == [[1, 2, 3]] and table.columns["name"].tolist() == [1]


def test_as_many_attributes_as_there_can_be_are_told_apart(tmp_path):
    attributes = [(f"a{index}", 1, 0, bytes(4)) for index in range(2**15 - 1)]
    (tmp_path / "a.bgeo").write_bytes(header(1, attributes) + np.ones(2**15 + 3, ">f4").tobytes())
    assert len(io.read_table(tmp_path / "a.bgeo").columns) == 2**15 - 1


def test_what_follows_the_points_is_checked_but_never_held(samples, tmp_path, measured):
    samples.write_bgeo(tmp_path / "a.bgeo", samples.particles(), compressed=False)
    content = (tmp_path / "a.bgeo").read_bytes()
    assert content[13:17] == bytes(4)
    with_primitives = content[:13] + struct.pack(">i", 1) + content[17:]
    packed = gzip.compress(with_primitives + bytes(2**26))
    (tmp_path / "a.bgeo").write_bytes(packed)
    with measured() as memory:
        table = io.read_table(tmp_path / "a.bgeo")
    assert len(table) == 7 and memory.peak < 2**26
    (tmp_path / "a.bgeo").write_bytes(packed[:-8] + bytes(8))
    refused(r"a\.bgeo: .*CRC", io.read_table, tmp_path / "a.bgeo")
