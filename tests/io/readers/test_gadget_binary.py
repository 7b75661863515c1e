import numpy as np
import pytest
from refusals import refused

import jaxsph.io as io


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("form", [1, 2])
@pytest.mark.parametrize("masses", [True, False])
def test_both_formats_of_both_byte_orders_are_read(order, form, masses, samples, tmp_path):
    p = samples.particles()
    samples.write_gadget_binary(tmp_path / "snapshot_001", p, order, form, dark=3, masses=masses)
    table = io.read_table(tmp_path / "snapshot_001")
    np.testing.assert_array_equal(table.position, p.position)
    np.testing.assert_array_equal(table.columns["velocity"], p.velocity)
    np.testing.assert_array_equal(table.columns["id"], p.id)
    np.testing.assert_array_equal(table.columns["density"], p.density)
    np.testing.assert_array_equal(table.columns["internal_energy"], p.density + 1)
    np.testing.assert_array_equal(table.columns["mass"], np.full(7, 3.0 if masses else 2.0))
    np.testing.assert_array_equal(table.support, np.full(7, 0.5))
    assert table.box_size == (16, 16, 16)


def record(data, order="<"):
    length = np.array(len(data), f"{order}u4").tobytes()
    return length + data + length


def write_types(path, counts, blocks, order="<", form=2, header="old"):
    """Blocks behind POS, VEL and ID: name to numbers; masses are those of the header, 0.5 + the type."""
    kinds, total, mass = len(counts), sum(counts), 0.5 + np.arange(len(counts))
    real, whole = f"{order}f8", f"{order}i8" if header == "new" else f"{order}u4"
    ends = [np.array(counts, whole).tobytes(), mass.astype(real).tobytes()]
    if header == "new":
        head = (
            ends[0] * 2
            + ends[1]
            + np.array([0.5, 0.25, 10.0], real).tobytes()
            + np.array([1, 7, 0, 0, 0, 0], f"{order}i4").tobytes()
        )
    else:
        flags = np.zeros(2, f"{order}i4").tobytes()
        head = ends[1].join([ends[0], np.array([0.5, 0.25], real).tobytes()]) + flags + ends[0]
        head = (head + np.array([0, 1], f"{order}i4").tobytes() + np.array([10.0, 0, 0, 0], real).tobytes()).ljust(256, b"\0")
    position = np.arange(3.0 * total).reshape(-1, 3)
    blocks = {"HEAD": head, "POS": position, "VEL": position / 2, "ID": np.arange(total, dtype="u4")} | blocks
    content = b""
    for name, data in blocks.items():
        data = data if isinstance(data, bytes) else np.asarray(data).astype(order + ("u4" if name == "ID" else "f4")).tobytes()
        label = name.ljust(4).encode() + np.array(len(data) + 8, f"{order}u4").tobytes()
        content += (record(label, order) if form == 2 else b"") + record(data, order)
    path.write_bytes(content)
    assert kinds == 6 or header == "new"
    return position


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("form", [1, 2])
@pytest.mark.parametrize("counts", [(5, 3), (5, 3, 0, 0, 4, 0), (0, 3, 2, 0, 4, 0, 1, 0)])
def test_headers_of_gadget4_of_any_number_of_types_are_read(order, form, counts, tmp_path):
    gas = {name: np.full(counts[0], value) for name, value in (("U", 1.0), ("RHO", 2.0), ("HSML", 0.25))} if counts[0] else {}
    position = write_types(tmp_path / "snapshot_003", counts, gas, order, form, "new")
    begin = 0
    for kind, count in enumerate(counts):
        if count:
            table = io.read_table(tmp_path / "snapshot_003", part_type=kind)
            np.testing.assert_array_equal(table.position, position[begin : begin + count])
            np.testing.assert_array_equal(table.columns["mass"], np.full(count, 0.5 + kind))
            assert table.box_size == (10.0,) * 3 and table.time == 0.5 and (table.support is None) == (kind > 0)
        begin += count


@pytest.mark.parametrize("form", [1, 2])
@pytest.mark.parametrize("header", ["old", "new"])
def test_blocks_of_some_types_are_known_by_name_or_length(form, header, tmp_path):
    counts, path = (50, 31, 0, 0, 14, 1), tmp_path / "snap"
    gas = {name: np.full(50, 1.0) for name in ("U", "RHO", "HSML")}
    blocks = {"AGE": np.arange(14.0), "Z": np.arange(64.0), "BHMA": np.array([7.0]), "ODD": np.zeros(2)}
    write_types(path, counts, gas | blocks, form=form, header=header)
    stars, holes, first = (io.read_table(path, part_type=kind) for kind in (4, 5, 0))
    np.testing.assert_array_equal(stars.columns["AGE"], np.arange(14.0))
    np.testing.assert_array_equal(stars.columns["Z"], np.arange(50.0, 64.0))
    np.testing.assert_array_equal(first.columns["Z"], np.arange(50.0))
    assert "AGE" not in first.columns and 7.0 in [
        column[0] for name, column in holes.columns.items() if name not in ("id", "velocity")
    ]
    assert any("left out" in said and "8 bytes fit no number" in said for said in stars.conventions)


def test_a_block_that_may_be_of_either_type_is_left_out_and_said(tmp_path):
    gas = {name: np.full(5, 1.0) for name in ("U", "RHO", "HSML")}
    write_types(tmp_path / "snap", (5, 0, 0, 0, 5, 0), gas | {"AGE": np.arange(5.0), "TMP": np.arange(5.0)})
    stars, first = (io.read_table(tmp_path / "snap", part_type=kind) for kind in (4, 0))
    assert "AGE" in stars.columns and "AGE" not in first.columns
    said = r"left out TMP: its 20 bytes may be 1 of types \(0\) or 1 of types \(4\) numbers"
    refused(f"no quantity 'TMP'.*{said}", io.read_particles, tmp_path / "snap", "TMP")


def test_another_type_has_no_gas_columns_and_each_tells_of_the_other(samples, tmp_path):
    samples.write_gadget_binary(tmp_path / "a.gadget", samples.particles(), dark=3)
    for chosen, said in ((0, "3 of type 1 (dark matter)"), (1, "7 of type 0 (gas)")):
        table = io.read_table(tmp_path / "a.gadget", part_type=chosen)
        assert f"also holds {said}: `part_type=` or --part-type reads another" in table.conventions
    np.testing.assert_array_equal(table.position, np.zeros((3, 3)))
    np.testing.assert_array_equal(table.columns["mass"], [4, 4, 4])
    assert table.support is None and "density" not in table.columns
    refused("no particles of type 4; `part_type` can be 0, 1", io.read_table, tmp_path / "a.gadget", part_type=4)


def number(value):
    return np.float64(value).tobytes()


MASS, TIME, BOX, MATTER, HUBBLE = 4 + 24, 4 + 72, 4 + 128, 4 + 136, 4 + 152
"""Where they stand in the header of format 1, after its first length and the counts."""


@pytest.mark.parametrize(
    ("form", "place", "new", "said"),
    [
        (2, 16 + 4 + 256, b"\1\1", "begins with length 256 and ends with another one"),  # the length after the header
        (2, 20, b"\x08", "which fits no number of its particles"),  # one gas particle more in the header
        (2, b"VEL ", b"POS ", "has the block `POS` twice"),
        *((form, None, bytes(2**22), "has more than 512 records .*at byte") for form in (1, 2)),
        *((1, MASS, number(m), f"has mass {m:g} for particles of type 0 in its header; correct") for m in (-1, np.nan, np.inf)),
    ],
)  # fmt: skip
def test_what_does_not_fit_is_refused(form, place, new, said, samples, tmp_path):
    samples.write_gadget_binary(tmp_path / "a.gadget", samples.particles(), form=form)
    content = (tmp_path / "a.gadget").read_bytes()
    at = len(content) if place is None else content.index(place) if isinstance(place, bytes) else place
    (tmp_path / "a.gadget").write_bytes(content[:at] + new + content[at + len(new) :])
    refused(rf"a\.gadget: .*({said})", io.read_table, tmp_path / "a.gadget")


@pytest.mark.parametrize("size", [np.nan, np.inf, -1.0, 0.0])
def test_a_box_that_is_none_is_said(size, samples, tmp_path):
    samples.write_gadget_binary(tmp_path / "a.gadget", samples.particles(), form=1)
    content = (tmp_path / "a.gadget").read_bytes()
    (tmp_path / "a.gadget").write_bytes(content[:BOX] + number(size) + content[BOX + 8 :])
    table = io.read_table(tmp_path / "a.gadget")
    said = any(f"not periodic: a box of {size:g}" in sentence for sentence in table.conventions)
    assert table.box_size is None and said == (size != 0)


@pytest.mark.parametrize(("time", "redshift"), [(1.0, 0.0), (0.25, None)])
def test_a_cosmological_run_of_today_is_known_by_its_matter_and_its_time(time, redshift, samples, tmp_path):
    samples.write_gadget_binary(tmp_path / "a.gadget", samples.particles(), form=1)
    content = bytearray((tmp_path / "a.gadget").read_bytes())
    for place, value in ((TIME, time), (MATTER, 0.3), (HUBBLE, 0.7)):
        content[place : place + 8] = number(value)
    (tmp_path / "a.gadget").write_bytes(content)
    assert io.read_table(tmp_path / "a.gadget").units.redshift == redshift
