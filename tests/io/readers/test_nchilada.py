"""NChilada snapshots are read as they were written, and refused where their files do not agree."""

import numpy as np
import pytest
from refusals import refused

import jaxsph as js
from jaxsph.io.readers.changa import FIELD, MAGIC, TYPES


def write(file, values, time=0.5):
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
        write(folder / kind / "pos", rng.random((count, 3)).astype(np.float32))
        write(folder / kind / "vel", rng.random((count, 3)))
        write(folder / kind / "iOrder", np.arange(count, dtype=np.int64))
    write(folder / "gas" / "temperature", rng.random(5).astype(np.float32))
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


def test_other_types_are_read_when_asked_for_and_named_when_missing(snapshot):
    assert len(js.io.read_table(snapshot, part_type=1)) == 3
    refused("type 4; `part_type` can be 0, 1", js.io.read_table, snapshot, part_type=4)


def test_files_that_are_cut_short_or_of_another_snapshot_are_named(snapshot):
    write(snapshot / "gas" / "temperature", np.zeros(4, np.float32))
    refused("gas/temperature has 4 values, but there are 5 positions", js.io.read_table, snapshot)
    (snapshot / "gas" / "pos").write_bytes((snapshot / "gas" / "pos").read_bytes()[:-4])
    refused(r"gas/pos is cut short", js.io.read_table, snapshot)


def test_other_folders_are_refused(tmp_path):
    refused("is a folder", js.io.read_table, tmp_path)


def test_it_renders(snapshot):
    particles = js.io.read_particles(snapshot, support=0.5)
    assert particles.num_particles == 5


def galaxy(folder, **columns):
    """A snapshot of two thousand gas particles as ChaNGa writes one, with the least smoothing length that it has."""
    rng = np.random.default_rng(0)
    position = (rng.normal(size=(2000, 3)) * 10 ** rng.uniform(-2, 0, (2000, 1))).astype(np.float32)
    h = js.io.nearest_neighbour_supports(position) / 2
    h = np.maximum(h, np.quantile(h, 0.11)).astype(np.float32)
    mass = np.full(2000, 0.25, np.float32)
    rho = js.io.kernel_sum(position, 2.0 * h, mass, kernel="cubic_spline").astype(np.float32)
    found = {"pos": position, "mass": mass, "smoothlength": h, "GasDensity": rho, "temperature": rho**0.5, **columns}
    for name, values in found.items():
        write(folder / "gas" / name, values)
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


def test_what_a_run_calls_a_smoothing_length_and_is_none_is_said(tmp_path):
    galaxy(tmp_path / "run.000100", smoothlength=np.full(2000, 0.1, np.float32))
    _, report = js.io.particles_from_table(js.io.read_table(tmp_path / "run.000100"), "temperature")
    assert report.support == "distance to neighbour 32"
    assert any("`smoothlength` is not used: twice of it reaches" in note for note in report.notes)


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
