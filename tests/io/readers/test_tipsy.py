"""Tipsy files are read in either byte order, and refused when their numbers do not add up."""

import os

import numpy as np
import pytest
from refusals import refused

import jaxsph as js
from jaxsph.io.readers.changa import HEADER, RECORDS, arrays_beside

COUNTS = {0: 4, 1: 3, 4: 2}
VALUES = np.arange(1, 10, dtype=np.float32) / 8


def records():
    rng = np.random.default_rng(0)
    return {kind: rng.random((COUNTS[kind], len(fields))).astype(np.float32) for kind, (_, fields) in RECORDS.items()}


def write(path, order=">", padded=True):
    header = np.array((0.25, 9, 3, 4, 3, 2), HEADER.newbyteorder(order))
    found = records()
    parts = [header.tobytes(), b"\0" * 4 * padded] + [found[kind].astype(f"{order}f4").tobytes() for kind in RECORDS]
    path.write_bytes(b"".join(parts))
    return path


@pytest.mark.parametrize("order", "<>")
@pytest.mark.parametrize("padded", [True, False])
@pytest.mark.parametrize("kind", [0, 1, 4])
def test_each_type_is_read_as_it_was_written(tmp_path, order, padded, kind):
    table = js.io.read_table(write(tmp_path / "run.00010", order, padded), part_type=kind)
    wanted = records()[kind]
    np.testing.assert_array_equal(table.position, wanted[:, 1:4])
    np.testing.assert_array_equal(table.columns["mass"], wanted[:, 0])
    np.testing.assert_array_equal(table.columns["velocity"], wanted[:, 4:7])
    assert (table.source, table.time, table.part_type) == ("Tipsy", 0.25, kind)


def test_gas_is_what_is_shown_without_a_type(tmp_path):
    assert len(js.io.read_table(write(tmp_path / "run.00010"))) == 4


def test_a_file_cut_short_says_so(tmp_path):
    path = write(tmp_path / "run.tipsy")
    path.write_bytes(path.read_bytes()[:-8])
    refused("cut short", js.io.read_table, path)


def test_a_type_that_is_not_there_names_those_that_are(tmp_path):
    refused("type 2; `part_type` can be 0, 1, 4", js.io.read_table, write(tmp_path / "run.tipsy"), part_type=2)


def test_the_padding_of_the_standard_is_zero(tmp_path):
    """Else four bytes too many anywhere would be taken for it."""
    path = write(tmp_path / "run.00010", padded=False)
    content = path.read_bytes()
    path.write_bytes(content[:200] + b"\1\2\3\4" + content[200:])
    refused(r"run\.00010: has \d more bytes than its header and its records", js.io.read_table, path)


def gas(path, **columns):
    """Two thousand gas particles, two dark ones, and values of gas records by name."""
    rng = np.random.default_rng(0)
    position = (rng.normal(size=(2000, 3)) * 10 ** rng.uniform(-2, 0, (2000, 1))).astype(np.float32)
    names = RECORDS[0][1]
    values = np.zeros((2000, len(names)), np.float32)
    values[:, 1:4] = position
    for name, column in {"mass": 0.25, "rho": 1.0, "temp": 1e4, "hsmooth": 0.1, **columns}.items():
        values[:, names.index(name)] = column
    header = np.array((0.25, 2002, 3, 2000, 2, 0), HEADER.newbyteorder(">"))
    dark = np.ones((2, len(RECORDS[1][1])))
    path.write_bytes(header.tobytes() + b"\0" * 4 + values.astype(">f4").tobytes() + dark.astype(">f4").tobytes())
    return position


def test_a_softening_and_a_density_of_one_are_not_used_and_that_is_said(tmp_path):
    position = gas(tmp_path / "run.00010")
    _, report = js.io.particles_from_table(js.io.read_table(tmp_path / "run.00010"))
    assert report.support == "distance to neighbour 32" and report.volume.startswith("1 / sum of kernels")
    assert any("`hsmooth` is not used" in note for note in report.notes)
    assert any("`rho` is not used for volumes: it is 1 everywhere" in note for note in report.notes)
    assert len(position) == report.num_particles


def test_smoothing_lengths_and_densities_in_the_records_are_used(tmp_path):
    h = js.io.nearest_neighbour_supports(gas(tmp_path / "run.00010")) / 2
    position = gas(tmp_path / "run.00010")
    rho = js.io.kernel_sum(position, 2 * h, np.full(2000, 0.25), kernel="cubic_spline")
    gas(tmp_path / "run.00010", hsmooth=h, rho=rho)
    table = js.io.read_table(tmp_path / "run.00010")
    _, report = js.io.particles_from_table(table)
    np.testing.assert_allclose(table.support, 2 * h, rtol=1e-6)
    assert report.support.startswith("support = 2 x hsmooth") and report.volume.startswith("mass / rho (the stored density is 1 ")


def test_smoothing_lengths_beside_the_file_come_before_the_softening_in_it(tmp_path):
    h = js.io.nearest_neighbour_supports(gas(tmp_path / "run.00010")) / 2
    beside = [2002, *h.tolist(), 1, 1]
    (tmp_path / "run.00010.smoothlength").write_text("\n".join(map(str, beside)))
    table = js.io.read_table(tmp_path / "run.00010")
    np.testing.assert_allclose(table.support, 2 * h)
    assert "column `smoothlength` is of run.00010.smoothlength" in table.conventions
    assert js.io.read_table(tmp_path / "run.00010", part_type=1).columns["smoothlength"].tolist() == [1, 1]


def test_units_are_those_of_the_file_of_parameters_beside_it(tmp_path):
    gas(tmp_path / "run.00010")
    (tmp_path / "any.param").write_text("dKpcUnit = 1\ndMsolUnit = 1\n")
    table = js.io.read_table(tmp_path / "run.00010")
    assert table.units.columns["velocity"].cgs == pytest.approx(207.386, rel=1e-5)  # sqrt(G Msun / kpc), cm/s
    assert table.units.columns["temp"].cgs == 1 and table.units.time == 0.25


def as_bytes(values, order):
    return np.array(len(values), f"{order}i4").tobytes() + values.astype(f"{order}f4").tobytes()


def as_text(values):
    return "\n".join([str(len(values)), *map(str, values.tolist())]).encode() + b"\n"


@pytest.mark.parametrize("content", [as_bytes(VALUES, ">"), as_bytes(VALUES, "<"), as_text(VALUES)])
def test_text_and_bytes_in_either_order_are_read(tmp_path, content):
    (tmp_path / "run.00010.smoothlength").write_bytes(content)
    columns, said = arrays_beside(tmp_path / "run.00010", 9, 4, slice(4, 7))
    np.testing.assert_array_equal(columns["smoothlength"], VALUES[4:7])
    assert said == ["column `smoothlength` is of run.00010.smoothlength"]


def test_an_array_of_gas_alone_is_of_gas_alone(tmp_path):
    (tmp_path / "run.den").write_bytes(as_text(VALUES[:4]))
    np.testing.assert_array_equal(arrays_beside(tmp_path / "run", 9, 4, slice(0, 4))[0]["den"], VALUES[:4])
    columns, said = arrays_beside(tmp_path / "run", 9, 4, slice(4, 7))
    assert columns == {} and said == ["run.den is not used: it holds gas alone"]


@pytest.mark.parametrize(
    "content, told",
    [
        (as_text(VALUES[:8]), "states 8 numbers and has 8, but there are 9 particles"),
        (as_text(VALUES)[:-6], "states 9 numbers and has 8"),
        (as_bytes(VALUES, ">")[:-1], "neither text of numbers nor floats"),
        (b"", "neither text"),
        (b"nine " * 9, "neither text"),
        (b"1e400 " * 9, "neither text"),
        (b" " * 10_000, "has 10000 bytes, too many"),
    ],
)
def test_what_does_not_fit_is_said_and_not_used(tmp_path, content, told):
    (tmp_path / "run.den").write_bytes(content)
    columns, said = arrays_beside(tmp_path / "run", 9, 4, slice(0, 4))
    assert columns == {} and said[0].startswith("run.den is not used: it ") and told in said[0]


def test_only_files_are_opened(tmp_path):
    os.mkfifo(tmp_path / "run.den")  # would wait for ever
    (tmp_path / "run.smoothlength").mkdir()
    assert arrays_beside(tmp_path / "run", 9, 4, slice(0, 4)) == ({}, [])
