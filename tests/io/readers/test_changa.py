"""Snapshots of ChaNGa are read as they were written, as files or folders, and refused when their numbers do not add up."""

import os

import numpy as np
import pytest
from refusals import refused

import jaxsph as js
from jaxsph.io.readers.changa import FIELD, HEADER, MAGIC, RECORDS, TYPES, arrays_beside
from jaxsph.sequence import Snapshots

COUNTS = {0: 4, 1: 3, 4: 2}
VALUES = np.arange(1, 10, dtype=np.float32) / 8


def records():
    rng = np.random.default_rng(0)
    return {kind: rng.random((COUNTS[kind], len(fields))).astype(np.float32) for kind, (_, fields) in RECORDS.items()}


def write(path, order=">", padded=True, padding=bytes(4), wide=("f4", "f4")):
    header = np.array((0.25, 9, 3, 4, 3, 2), HEADER.newbyteorder(order))
    found, parts = records(), [header.tobytes(), padding * padded]
    for rows in found.values():
        kinds = ["f4", *3 * [wide[0]], *3 * [wide[1]], *(rows.shape[1] - 7) * ["f4"]]
        stored = np.zeros(len(rows), [(str(nth), order + each) for nth, each in enumerate(kinds)])
        for nth, column in enumerate(rows.T):
            stored[str(nth)] = column.astype("f8") + 1e-9 * (kinds[nth] == "f8")
        parts.append(stored.tobytes())
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


@pytest.mark.parametrize("order", "<>")
@pytest.mark.parametrize("wide", [("f8", "f4"), ("f8", "f8")])
@pytest.mark.parametrize("kind", [0, 1, 4])
def test_positions_and_velocities_of_eight_bytes_are_read(tmp_path, order, wide, kind):
    table, wanted = js.io.read_table(write(tmp_path / "run.std", order, wide=wide), part_type=kind), records()[kind].astype("f8")
    np.testing.assert_array_equal(table.position, wanted[:, 1:4] + 1e-9)
    np.testing.assert_array_equal(table.columns["velocity"], wanted[:, 4:7] + 1e-9 * (wide[1] == "f8"))
    np.testing.assert_array_equal(table.columns["mass"], wanted[:, 0])
    np.testing.assert_array_equal(table.columns["phi"], wanted[:, -1])


@pytest.mark.parametrize("padding", [b"\0\0\0\1", b"\1\0\0\0", b"\xde\xad\xbe\xef", b"\x7f\x2a\x00\x10"])
@pytest.mark.parametrize("order", "<>")
def test_what_stands_in_the_padding_is_no_matter(tmp_path, order, padding):
    table = js.io.read_table(write(tmp_path / "run.std", order, padding=padding))
    np.testing.assert_array_equal(table.position, records()[0][:, 1:4])


def test_what_does_not_add_up_is_refused_and_a_type_that_is_not_there_names_those_that_are(tmp_path):
    path = write(tmp_path / "run.tipsy")
    assert len(js.io.read_table(path)) == 4  # gas, without a type
    refused("type 2; `part_type` can be 0, 1, 4", js.io.read_table, path, part_type=2)
    path.write_bytes(path.read_bytes()[:-8])
    refused("cut short", js.io.read_table, path)
    content = write(path, padded=False).read_bytes()  # the padding of the standard is zero
    path.write_bytes(content[:200] + b"\1\2\3\4" + content[200:])
    refused(r"run\.tipsy: has \d more bytes than its header and its records", js.io.read_table, path)


def cloud():
    rng = np.random.default_rng(0)
    return (rng.normal(size=(2000, 3)) * 10 ** rng.uniform(-2, 0, (2000, 1))).astype(np.float32)


def gas(path, **columns):
    """Two thousand gas particles, two dark ones, and values of gas records by name."""
    names, position = RECORDS[0][1], cloud()
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
    position = cloud()
    h = js.io.nearest_neighbour_supports(position) / 2
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


def write_field(file, values, time=0.5):
    values = np.asarray(values)
    code = next(code for code, name in TYPES.items() if np.dtype(name) == values.dtype)
    table = values.reshape(len(values), -1)
    header = np.array((MAGIC, time, len(table) >> 32, len(table) & 0xFFFFFFFF, table.shape[1], code), FIELD)
    file.parent.mkdir(parents=True, exist_ok=True)
    ends = [table.min(0), table.max(0)] if len(table) else [np.zeros(table.shape[1])] * 2
    big = values.dtype.newbyteorder(">")
    file.write_bytes(header.tobytes() + b"".join(np.asarray(part).astype(big).tobytes() for part in (*ends, table)))


@pytest.fixture
def snapshot(tmp_path):
    """Five gas and three dark particles."""
    rng, folder = np.random.default_rng(0), tmp_path / "run.000100"
    for kind, count in (("gas", 5), ("dark", 3)):
        write_field(folder / kind / "pos", rng.random((count, 3)).astype(np.float32))
        write_field(folder / kind / "vel", rng.random((count, 3)))
        write_field(folder / kind / "iOrder", np.arange(count, dtype=np.int64))
    write_field(folder / "gas" / "temperature", rng.random(5).astype(np.float32))
    (folder / "description.xml").write_text("<simulation/>")
    (folder / "gas" / "notes.txt").write_text("no field")
    return folder


def test_gas_is_read_with_all_its_columns_and_the_time(snapshot):
    table = js.io.read_table(snapshot)
    rng = np.random.default_rng(0)
    np.testing.assert_array_equal(table.position, rng.random((5, 3)).astype(np.float32))
    np.testing.assert_array_equal(table.columns["vel"], rng.random((5, 3)))
    assert sorted(table.columns) == ["iOrder", "temperature", "vel"] and table.columns["iOrder"].tolist() == [0, 1, 2, 3, 4]
    assert (table.source, table.time, table.part_type) == ("NChilada", 0.5, 0)


def test_a_column_that_is_written_again_makes_another_mark_of_a_sequence(snapshot):
    mark = Snapshots.from_files([snapshot]).fingerprint(0.5)
    os.utime(snapshot / "gas" / "vel", ns=(0, 0))
    assert Snapshots.from_files([snapshot]).fingerprint(0.5) != mark


def test_other_types_are_read_when_asked_for_and_named_when_missing(snapshot):
    assert len(js.io.read_table(snapshot, part_type=1)) == 3
    refused("type 4; `part_type` can be 0, 1", js.io.read_table, snapshot, part_type=4)


def test_files_that_are_cut_short_or_of_another_snapshot_are_named(snapshot):
    write_field(snapshot / "gas" / "temperature", np.zeros(4, np.float32))
    wrong = "gas/temperature has 4 values, but there are 5 positions"
    refused(f"left out temperature: {wrong}", js.io.read_particles, snapshot, "temperature", 0.5)
    (snapshot / "gas" / "pos").write_bytes((snapshot / "gas" / "pos").read_bytes()[:-4])
    refused(r"gas/pos is cut short", js.io.read_table, snapshot)


def galaxy(folder, **columns):
    """A snapshot of two thousand gas particles as ChaNGa writes one, with the least smoothing length that it has."""
    position = cloud()
    h = js.io.nearest_neighbour_supports(position) / 2
    h = np.maximum(h, np.quantile(h, 0.11)).astype(np.float32)
    mass = np.full(2000, 0.25, np.float32)
    rho = js.io.kernel_sum(position, 2.0 * h, mass, kernel="cubic_spline").astype(np.float32)
    found = {"pos": position, "mass": mass, "smoothlength": h, "GasDensity": rho, "temperature": rho**0.5, **columns}
    for name, values in found.items():
        write_field(folder / "gas" / name, values)
    return found


def test_smoothing_lengths_and_densities_of_a_run_are_used_and_the_floor_is_said(tmp_path):
    found = galaxy(tmp_path / "run.000100")
    table = js.io.read_table(tmp_path / "run.000100")
    particles, report = js.io.particles_from_table(table, "density")
    np.testing.assert_array_equal(particles.to_numpy()["support"], 2 * found["smoothlength"])
    np.testing.assert_array_equal(particles.to_numpy()["quantity"], found["GasDensity"])
    np.testing.assert_allclose(particles.to_numpy()["volume"], found["mass"] / found["GasDensity"], rtol=1e-6)
    assert report.support.startswith("support = 2 x smoothlength") and report.volume.startswith("mass / GasDensity")
    assert any("11.0% of `smoothlength` is its least" in note for note in report.notes)


def test_units_are_those_of_the_file_of_parameters_beside_the_folder(tmp_path):
    galaxy(tmp_path / "run.000100")
    (tmp_path / "run.param").write_text("dKpcUnit = 1\ndMsolUnit = 1e9\nachOutName = run\n")
    table = js.io.read_table(tmp_path / "run.000100")
    assert table.conventions[1] == "units of run.param: dKpcUnit = 1, dMsolUnit = 1e+09"
    labels = js.io.labels_of(table, "temperature", 1e4, length_unit="pc")
    assert (labels.unit, labels.factor) == ("K", 1.0)
    assert labels.length_as(1.0) == (pytest.approx(1000, rel=1e-6), "pc")
    density = js.io.labels_of(table, "GasDensity", unit="Msun/kpc**3")
    assert density.factor == pytest.approx(1e9, rel=1e-4) and density.moment.startswith("t = 7.4")  # Myr
