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
