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


def test_other_types_are_told(samples, tmp_path):
    samples.write_gadget_binary(tmp_path / "a.gadget", samples.particles(), dark=3)
    for chosen, said in ((0, "3 of type 1 (dark matter)"), (1, "7 of type 0 (gas)")):
        table = io.read_table(tmp_path / "a.gadget", part_type=chosen)
        assert f"also holds {said}: `part_type=` or --part-type reads another" in table.conventions


def test_another_type_has_no_gas_columns(samples, tmp_path):
    samples.write_gadget_binary(tmp_path / "a.gadget", samples.particles(), dark=3)
    table = io.read_table(tmp_path / "a.gadget", part_type=1)
    np.testing.assert_array_equal(table.position, np.zeros((3, 3)))
    np.testing.assert_array_equal(table.columns["mass"], [4, 4, 4])
    assert table.support is None and "density" not in table.columns


def test_a_type_that_is_not_there_is_answered_with_those_that_are(samples, tmp_path):
    samples.write_gadget_binary(tmp_path / "a.gadget", samples.particles(), dark=3)
    refused("no particles of type 4; `part_type` can be 0, 1", io.read_table, tmp_path / "a.gadget", part_type=4)


def test_block_lengths_that_disagree_are_refused(samples, tmp_path):
    samples.write_gadget_binary(tmp_path / "a.gadget", samples.particles())
    content = bytearray((tmp_path / "a.gadget").read_bytes())
    content[16 + 4 + 256] ^= 1  # the length after the header
    (tmp_path / "a.gadget").write_bytes(content)
    refused("begins with length 256 and ends with another one", io.read_table, tmp_path / "a.gadget")


def test_a_block_that_fits_no_number_of_particles_is_refused(samples, tmp_path):
    samples.write_gadget_binary(tmp_path / "a.gadget", samples.particles())
    content = bytearray((tmp_path / "a.gadget").read_bytes())
    content[20] += 1  # one gas particle more in the header
    (tmp_path / "a.gadget").write_bytes(content)
    refused("which fits no number of its particles", io.read_table, tmp_path / "a.gadget")


def test_two_blocks_of_one_name_are_refused(samples, tmp_path):
    samples.write_gadget_binary(tmp_path / "a.gadget", samples.particles())
    content = (tmp_path / "a.gadget").read_bytes()
    (tmp_path / "a.gadget").write_bytes(content.replace(b"VEL ", b"POS "))
    refused(r"a\.gadget: has the block `POS` twice", io.read_table, tmp_path / "a.gadget")


@pytest.mark.parametrize("form", [1, 2])
def test_a_tail_of_zeros_is_not_read_as_a_million_empty_blocks(form, samples, tmp_path):
    samples.write_gadget_binary(tmp_path / "a.gadget", samples.particles(), form=form)
    with (tmp_path / "a.gadget").open("ab") as file:
        file.write(bytes(2**22))
    refused(r"a\.gadget: has more than 512 records .*at byte", io.read_table, tmp_path / "a.gadget")


MASS, BOX = 4 + 24, 4 + 128
"""Where they stand in the header of format 1, after its first length and the counts."""


def with_number(folder, samples, place, value):
    samples.write_gadget_binary(folder / "a.gadget", samples.particles(), form=1)
    content = bytearray((folder / "a.gadget").read_bytes())
    content[place : place + 8] = np.float64(value).tobytes()
    (folder / "a.gadget").write_bytes(content)
    return folder / "a.gadget"


@pytest.mark.parametrize("mass", [-1.0, np.nan, np.inf])
def test_a_mass_in_the_header_that_is_none_is_refused(mass, samples, tmp_path):
    with pytest.raises(ValueError, match=rf"a\.gadget: has mass {mass:g} for particles of type 0 in its header; correct"):
        io.read_table(with_number(tmp_path, samples, MASS, mass))


@pytest.mark.parametrize("size", [np.nan, np.inf, -1.0, 0.0])
def test_a_box_that_is_none_is_said(size, samples, tmp_path):
    table = io.read_table(with_number(tmp_path, samples, BOX, size))
    said = any(f"not periodic: a box of {size:g}" in sentence for sentence in table.conventions)
    assert table.box_size is None and said == (size != 0)
