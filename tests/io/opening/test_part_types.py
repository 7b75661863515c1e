"""Several types of particles as one set: the sum of what each is by itself, or a refusal by name."""

import dataclasses

import numpy as np
import pytest

import jaxsph.io as io
from jaxsph.io import DataError
from jaxsph.io.opening.opened import load
from jaxsph.io.opening.options import Source
from jaxsph.io.opening.part_types import read_types
from jaxsph.io.table import ParticleTable

h5py = pytest.importorskip("h5py")
GAS, DARK, STARS, HOLES = 0, 1, 4, 5


@pytest.fixture
def path(tmp_path):
    """Gas with supports, dark matter whose mass is in the header, stars whose ids are of another width, holes, no bulge."""
    rng, path = np.random.default_rng(0), tmp_path / "types.hdf5"
    counts = {GAS: 70, DARK: 50, 3: 0, STARS: 40, HOLES: 3}
    with h5py.File(path, "w") as file:
        table = np.array([0, 5.0, 0, 0, 0, 0])
        number = np.array([counts.get(kind, 0) for kind in range(6)])
        file.create_group("Header").attrs.update({"MassTable": table, "BoxSize": 4.0, "NumPart_ThisFile": number})
        for kind, count in counts.items():
            group = file.create_group(f"PartType{kind}")
            group["Coordinates"] = rng.uniform(0, 4, (count, 3)).astype("f4" if kind else "f8")
            group["ParticleIDs"] = np.arange(count, dtype="u8" if kind else "u4") + 100 * kind
            group["Velocities"] = rng.normal(size=(count, 3)).astype("f4")
            if kind != DARK:
                group["Masses"] = rng.uniform(1, 2, count).astype("f4")
        file["PartType0/SmoothingLength"] = np.full(70, 0.9, "f4")
        file["PartType0/InternalEnergy"], file["PartType0/Metallicity"] = np.ones(70), np.full(70, 0.1)
        file["PartType4/Metallicity"], file["PartType4/Level"] = np.full(40, 0.2), np.arange(40)
        file["PartType5/BH_Mass"] = np.full(3, 99.0)
    return path


@pytest.mark.parametrize("named", ["gas,dm,stars,bh", "0, 1,4,5"])
def test_one_set_has_what_each_type_has_by_itself(path, named):
    table = io.read_table(path, part_type=named)
    each = [io.particles_from_table(io.read_table(path, part_type=kind), "x")[0].to_numpy() for kind in (0, 1, 4, 5)]
    for name in ("support", "volume"):
        np.testing.assert_allclose(getattr(table, name), np.concatenate([one[name] for one in each]), rtol=1e-6)
    with h5py.File(path) as file:
        masses = [file["PartType0/Masses"][:], np.full(50, 5.0), file["PartType4/Masses"][:], file["PartType5/Masses"][:]]
        np.testing.assert_allclose(table.columns["Masses"], np.concatenate(masses), rtol=1e-7)
    assert len(np.unique(table.columns["ParticleIDs"])) == len(table) and table.columns["ParticleIDs"].dtype.kind == "u"
    particles, report = io.particles_from_table(table, "density")
    density = [io.particles_from_table(io.read_table(path, part_type=kind), "density")[0].to_numpy() for kind in (0, 1, 4, 5)]
    np.testing.assert_allclose(particles.to_numpy()["quantity"], np.concatenate([one["quantity"] for one in density]), rtol=1e-5)
    assert f"{named.split(',')[0]}: SmoothingLength" in report.support and "that of each type" in report.volume


def test_what_a_type_lacks_is_refused_by_name(path):
    table = io.read_table(path, part_type="gas,stars")
    np.testing.assert_allclose(np.unique(table.columns["Metallicity"]), [0.1, 0.2])
    with pytest.raises(
        ValueError, match=r"no quantity 'InternalEnergy'.*left out InternalEnergy.*: of gas, and not of all types"
    ):
        io.particles_from_table(table, "InternalEnergy")
    with pytest.raises(ValueError, match="left out Level: of stars"):
        io.particles_from_table(table, "x", where="Level > 3")
    with pytest.raises(DataError, match=r"type dm.*no quantity 'SmoothingLength'"):
        io.read_particles(path, part_type="gas,dm", support="2*SmoothingLength")


def test_a_type_without_masses_is_not_added(path):
    with h5py.File(path, "r+") as file:
        del file["PartType4/Masses"]
    with pytest.raises(DataError, match="type stars has no masses, and gas has"):
        io.read_table(path, part_type="gas,stars")


def test_columns_in_another_unit_are_left_out(path):
    with h5py.File(path, "r+") as file:
        none = dict.fromkeys(("velocity_scaling", "a_scaling", "h_scaling"), 0.0)
        for kind, cgs in (("0", 2e33), ("4", 4e33)):
            file[f"PartType{kind}/Metallicity"].attrs.update(none | {"length_scaling": 0, "mass_scaling": 1, "to_cgs": cgs})
    table = io.read_table(path, part_type="gas,stars")
    assert "Metallicity" not in table.columns and "left out InternalEnergy, Metallicity" in " ".join(table.conventions)


def test_types_named_twice_are_taken_once_and_said(path):
    table = io.read_table(path, part_type="gas,0,stars,gas")
    assert len(table) == 110 and sum("is taken once" in one for one in table.conventions) == 2
    assert load(path, Source(part_type="gas,gas")).beside == ()


def test_types_without_particles_are_said_and_the_others_shown(path):
    for named in ("gas,bulge", "disk,gas"):
        table = io.read_table(path, part_type=named)
        assert len(table) == 70 and any("there are no particles of type" in one for one in table.conventions)
        assert any("no particles of type" in note for note in load(path, Source(part_type=named)).report.notes)
    with pytest.raises(DataError, match=r"no particles of type bulge; also holds type 0 \(gas\)"):
        load(path, Source(part_type="bulge"))
    with pytest.raises(DataError, match="no particles of type"):
        read_types(path, [("disk", None), ("bulge", None)])


def test_an_empty_type_of_gas_is_passed_over_where_none_is_named(path):
    with h5py.File(path, "r+") as file:
        file["Header"].attrs["NumPart_ThisFile"] = [0, 50, 0, 0, 40, 3]
        for name in list(file["PartType0"]):
            stored = file[f"PartType0/{name}"][:0]
            del file[f"PartType0/{name}"]
            file[f"PartType0/{name}"] = stored
    assert io.read_table(path).part_type == STARS


def test_a_support_that_is_asked_for_is_that_of_each_type(path):
    loaded = load(path, Source(part_type="gas,stars", support=0.5, where="x > 2"), joined=True)
    assert np.unique(loaded.shown.to_numpy()["support"]) == [0.5]
    one, other = (load(path, Source(part_type=kind, support=0.5, where="x > 2")).shown.to_numpy() for kind in ("gas", "stars"))
    volume = np.concatenate([one["volume"], other["volume"]])
    np.testing.assert_allclose(loaded.shown.to_numpy()["volume"], volume, rtol=1e-5)


def test_gas_and_dark_matter_of_a_binary_file_are_one_set(samples, tmp_path):
    samples.write_gadget_binary(tmp_path / "b.gadget", samples.particles(), dark=2)
    table = io.read_table(tmp_path / "b.gadget", part_type="gas,dm")
    count = len(samples.particles().position)
    assert len(table) == count + 2
    np.testing.assert_array_equal(table.columns[table.named("masses", "mass")], [2.0] * count + [4.0] * 2)
    assert dataclasses.replace(table).support.shape == (count + 2,)


def test_a_few_black_holes_are_seen_one_by_one(path):
    table = io.read_table(path, part_type="bh")
    support = io.particles_from_table(table, "x")[0].to_numpy()["support"]
    assert support.max() < 0.1 * np.ptp(table.position, axis=0).max()


def test_supports_in_a_box_reach_half_of_it_at_most():
    position = 4 * np.random.default_rng(0).random((40, 3)) ** 4
    particles, report = io.particles_from_table(ParticleTable(position, box_size=(4.0, 4.0, 4.0)), "x")
    assert particles.to_numpy()["support"].max() == 2.0 and report.support.endswith("at most half of the box")
