"""Units of ChaNGa and Gasoline are those of the file of parameters that belongs to a snapshot, and no others."""

import math
import os

import pytest

from jaxsph.io.table import FileUnits
from jaxsph.io.units import MAX_BYTES, units_beside

COLUMNS = "mass", "rho", "temp", "hsmooth", "metals", "phi", "velocity", "GasDensity", "smoothlength"
GRAVITY, MASS_OF_SUN, KPC = 6.6743e-8, 1.98841e33, 3.0856776e21  # CGS, as textbooks have them


def write(folder, text="dKpcUnit = 2.0  # length\n# a comment = 3\ndMsolUnit=1e10\n", name="run.param"):
    (folder / name).write_text(text)


def units(folder, name="run.00010", time=0.5):
    return units_beside(folder / name, COLUMNS, time)


def cgs(unit):
    return unit.cgs, unit.powers


def test_lengths_and_masses_are_as_stated_and_the_rest_follows_with_a_gravitational_constant_of_one(tmp_path):
    write(tmp_path)
    found, said = units(tmp_path)
    assert said == ["units of run.param: dKpcUnit = 2, dMsolUnit = 1e+10"]
    length, mass = 2 * KPC, 1e10 * MASS_OF_SUN
    second = math.sqrt(length**3 / (GRAVITY * mass))
    wanted = {
        "mass": (mass, (0, 1, 0, 0)),
        "rho": (mass / length**3, (-3, 1, 0, 0)),
        "GasDensity": (mass / length**3, (-3, 1, 0, 0)),
        "temp": (1.0, (0, 0, 0, 1)),
        "hsmooth": (length, (1, 0, 0, 0)),
        "smoothlength": (length, (1, 0, 0, 0)),
        "velocity": (length / second, (1, 0, -1, 0)),
        "phi": ((length / second) ** 2, (2, 0, -2, 0)),
    }
    assert set(found.columns) == set(wanted)
    for name, (value, powers) in wanted.items():
        assert cgs(found.columns[name]) == (pytest.approx(value, rel=1e-5), powers), name
    assert cgs(found.length) == (pytest.approx(length), (1, 0, 0, 0))
    assert (found.time, cgs(found.time_unit)) == (0.5, (pytest.approx(second, rel=1e-5), (0, 0, 1, 0)))
    assert found.redshift is None


def test_the_velocity_of_a_kpc_and_a_solar_mass_is_that_of_textbooks(tmp_path):
    write(tmp_path, "dKpcUnit = 1\ndMsolUnit = 1\n")
    assert units(tmp_path)[0].columns["velocity"].cgs == pytest.approx(1e5 * math.sqrt(4.30091e-6), rel=1e-5)


def test_of_comoving_runs_numbers_keep_their_scale_factor_and_the_time_is_one(tmp_path):
    write(tmp_path, "dKpcUnit = 25000\ndMsolUnit = 2e15\nbComove = 1\n")
    found, said = units(tmp_path, time=0.25)
    assert (found.redshift, found.time, found.time_unit) == (3.0, None, None) and "comoving" in said[0]
    assert (found.length.a, found.columns["rho"].a, found.columns["velocity"].a, found.columns["mass"].a) == (1, -3, 1, 0)
    assert "phi" not in found.columns
    assert units(tmp_path, time=0.0)[0].redshift is None


@pytest.mark.parametrize("value", ["0", "-1", "nan", "inf", "1" + "0" * 400, "1e400", "1e-300", "ten", "", "1 2"])
@pytest.mark.parametrize("name", ["dKpcUnit", "dMsolUnit"])
def test_values_that_are_no_units_are_said_and_not_used(tmp_path, name, value):
    write(tmp_path, f"dKpcUnit = 1\ndMsolUnit = 1\n{name} = {value}\n")
    found, said = units(tmp_path)
    assert found == FileUnits() and len(said) == 1 and f"{name} of run.param is {value[:40]!r}" in said[0]


def test_units_that_are_missing_are_said(tmp_path):
    write(tmp_path, "dKpcUnit = 1\n")
    assert units(tmp_path) == (
        FileUnits(),
        ["units are not known: dMsolUnit of run.param is missing, and must be a number in 1e-40 .. 1e+40"],
    )


def test_without_a_file_of_parameters_nothing_is_said(tmp_path):
    assert units(tmp_path) == (FileUnits(), [])


def test_of_several_files_it_is_the_one_that_names_the_snapshot(tmp_path):
    write(tmp_path, 'dKpcUnit = 1\ndMsolUnit = 1\nachOutName = "out/run"\n', "a.param")
    write(tmp_path, "dKpcUnit = 2\ndMsolUnit = 1\nachOutName = runaway\n", "b.param")
    assert units(tmp_path)[1] == ["units of a.param: dKpcUnit = 1, dMsolUnit = 1"]
    assert units(tmp_path, "runaway.00010")[1] == ["units of b.param: dKpcUnit = 2, dMsolUnit = 1"]
    assert "there are 2 .param files beside it, and none of them" in units(tmp_path, "other.00010")[1][0]
    write(tmp_path, "dKpcUnit = 3\ndMsolUnit = 1\nachOutName = run\n", "c.param")
    assert "there are 3 .param files beside it, and 2 of them" in units(tmp_path)[1][0] and units(tmp_path)[0] == FileUnits()


def test_the_only_file_is_it_whatever_its_name(tmp_path):
    write(tmp_path, "dKpcUnit = 1\ndMsolUnit = 1\nachOutName = other\n", "other.param")
    assert units(tmp_path)[0].length is not None


def test_a_period_is_said_and_not_used(tmp_path):
    write(tmp_path, "dKpcUnit = 1\ndMsolUnit = 1\nbPeriodic = 1\ndPeriod = 2.5\n")
    assert "with a period of 2.5: it is not used; pass `box=`" in units(tmp_path)[1][1]


def test_files_that_are_none_of_parameters_are_harmless(tmp_path):
    (tmp_path / "a.param").write_bytes(bytes(range(256)) * 10)
    assert units(tmp_path)[0] == FileUnits()
    (tmp_path / "a.param").write_bytes(b"#" * (MAX_BYTES + 1))
    assert units(tmp_path)[1] == ["units are not known: a.param cannot be read"]
    (tmp_path / "a.param").unlink()
    (tmp_path / "b.param").mkdir()
    os.mkfifo(tmp_path / "c.param")  # would wait for ever if it were opened
    assert units(tmp_path) == (FileUnits(), [])
