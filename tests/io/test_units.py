"""Units: what files state and nothing that they do not, what people may write, and the names that are told."""

import math
import os
import sys

import numpy as np
import pytest
from refusals import refused

from jaxsph import io
from jaxsph.io.file_units import MAX_BYTES, of_gadget, of_phantom, units_beside
from jaxsph.io.table import LENGTH, MASS, TEMPERATURE, TIME, VELOCITY, CodeUnit, FileUnits, ParticleTable
from jaxsph.io.units import (
    Labels,
    checked_unit,
    labels_of,
    moment_of,
    named,
    read_unit,
    stated_length,
    unit_of,
    written,
)  # fmt: skip
from jaxsph.sequence import Snapshots

h5py = pytest.importorskip("h5py")

KPC, MYR = 3.0857e21, 3.15576e13
SWIFT_NAMES = "U_L exponent", "U_M exponent", "U_t exponent", "U_T exponent", "U_I exponent"
CGS = "Conversion factor to CGS (not including cosmological corrections)"


def gadget(path, header=(), parameters=(), density=None):
    """A small snapshot; `density` are the attributes of its data set."""
    with h5py.File(path, "w") as file:
        file.create_group("Header").attrs.update({"MassTable": np.ones(6), **dict(header)})
        file.create_group("Parameters").attrs.update(dict(parameters))
        group = file.create_group("PartType0")
        group["Coordinates"], group["SmoothingLength"] = np.eye(3), np.ones(3)
        group["Density"], group["Velocities"] = np.arange(1.0, 4), np.ones((3, 3))
        group["Density"].attrs.update(density or {})
        if density:
            scalings = {"length_scaling": 1.0, "mass_scaling": 0.0, "velocity_scaling": 0.0, "a_scaling": 1.0, "h_scaling": -1.0}
            group["Coordinates"].attrs.update(scalings | {"to_cgs": KPC})
    return path


STATED = {
    "length_scaling": -3.0, "mass_scaling": 1.0, "velocity_scaling": 0.0, "to_cgs": 6.77e-22, "a_scaling": -3.0, "h_scaling": 2.0,
}  # fmt: skip


def test_a_temperature_of_gadget_is_in_kelvin_as_its_attributes_have_no_power_of_one(tmp_path):
    path = gadget(tmp_path / "x.hdf5", density=STATED)
    with h5py.File(path, "a") as file:
        file["PartType0/Temperature"] = np.arange(1.0, 4)
        file["PartType0/Temperature"].attrs.update(dict.fromkeys(STATED, 0.0) | {"to_cgs": 1.0})
    assert io.read_table(path).units.columns["Temperature"] == CodeUnit(1.0, TEMPERATURE)


def test_gadget_attributes_give_units_with_their_powers_of_a_and_h(tmp_path):
    units = io.read_table(gadget(tmp_path / "x.hdf5", {"Time": 0.5, "Redshift": 1.0}, density=STATED)).units
    assert units.columns == {"Density": CodeUnit(6.77e-22, (-3, 1, 0, 0), -3, 2)}
    assert units.length == CodeUnit(KPC, LENGTH, 1, -1)
    assert units.time is None and units.redshift == 1  # GADGET's time is the scale factor there


def test_a_file_that_states_no_units_has_none(tmp_path):
    table = io.read_table(gadget(tmp_path / "x.hdf5"))
    assert table.units == FileUnits()
    assert labels_of(table, "Density") == Labels("Density") and unit_of(table, "density") is None


def test_a_zero_or_broken_factor_is_no_unit(tmp_path):
    for cgs in (0.0, -1.0, np.nan):
        table = io.read_table(gadget(tmp_path / "x.hdf5", density=STATED | {"to_cgs": cgs}))
        assert "Density" not in table.units.columns


@pytest.mark.parametrize(("hubble", "known"), [(None, True), (1.0, True), (0.7, False)])
def test_gadget_time_has_a_unit_where_no_hubble_parameter_can_be_in_it(tmp_path, hubble, known):
    parameters = {"UnitLength_in_cm": KPC, "UnitVelocity_in_cm_per_s": 1e5, "ComovingIntegrationOn": 0}
    parameters |= {} if hubble is None else {"HubbleParam": hubble}
    units = io.read_table(gadget(tmp_path / "x.hdf5", {"Time": 0.25, "Redshift": 0.0}, parameters)).units
    assert units.time == 0.25 and units.redshift is None
    assert units.time_unit == (CodeUnit(KPC / 1e5, TIME) if known else None)


@pytest.mark.parametrize("names", [("_in_cm", "_in_g", "_in_cm_per_s"), ("_In_CGS",) * 3], ids=["GADGET", "GIZMO"])
def test_columns_have_the_units_that_follow_from_base_units_where_they_state_none(tmp_path, names):
    bases = {
        f"Unit{what}{end}": value
        for what, end, value in zip(("Length", "Mass", "Velocity"), names, (KPC, 2e43, 1e5), strict=True)
    }
    units = io.read_table(gadget(tmp_path / "x.hdf5", {"Time": 0.5, "Redshift": 1.0}, bases | {"HubbleParam": 0.7})).units
    assert units.columns["Masses"] == CodeUnit(2e43, MASS, 0, -1)
    assert units.columns["Density"] == units.columns["Masses"].over(CodeUnit(KPC, LENGTH, 1, -1), 3)
    still = io.read_table(gadget(tmp_path / "y.hdf5", {"Redshift": 0.0}, bases)).units
    assert still.length == CodeUnit(KPC, LENGTH) and still.columns["Masses"] == CodeUnit(2e43, MASS)
    begun = gadget(tmp_path / "b.hdf5", {"Redshift": 0.0, "ComovingIntegrationOn": 1, "HubbleParam": 0.7}, bases)
    assert io.read_table(begun).units.columns["Masses"].h == -1 and io.read_table(begun).units.redshift == 0
    own = io.read_table(gadget(tmp_path / "z.hdf5", {"Redshift": 1.0}, bases, density=STATED)).units
    assert own.columns["Density"].cgs == 6.77e-22  # what a column states itself is taken


def test_swift_attributes_give_units(tmp_path):
    with h5py.File(tmp_path / "x.hdf5", "w") as file:
        file.create_group("Header").attrs.update({"Code": "SWIFT", "Time": [0.125], "Redshift": [0.0]})
        file.create_group("HydroScheme").attrs["Kernel function"] = "Cubic spline (M4)"
        file.create_group("Units").attrs["Unit time in cgs (U_t)"] = [MYR]
        group = file.create_group("PartType0")
        group["Coordinates"], group["SmoothingLengths"], group["Temperatures"] = np.eye(3), np.ones(3), np.ones(3)
        group["Temperatures"].attrs.update({key: [0.0] for key in SWIFT_NAMES} | {"U_T exponent": [1.0], CGS: [2.0]})
        group["Coordinates"].attrs.update(
            {key: [0.0] for key in SWIFT_NAMES} | {"U_L exponent": [1.0], CGS: [KPC], "a-scale exponent": [1.0]}
        )
    units = io.read_table(tmp_path / "x.hdf5").units
    assert units.columns == {"Temperatures": CodeUnit(2.0, (0, 0, 0, 1))}
    assert units.length == CodeUnit(KPC, LENGTH, 1.0)
    assert (units.time, units.time_unit) == (0.125, CodeUnit(MYR, TIME))


def test_phantom_units_are_those_of_its_header(samples, tmp_path):
    units = {"udist": 1e16, "umass": 2e33, "utime": 1e10}
    for name, stated in (("x", units), ("y", {"udist": 1e16})):
        header = {"f0": {"time": [3.0], "hfact": [1.2], "massoftype": [1.0]}, "f8": {key: [one] for key, one in stated.items()}}
        samples.write_phantom_native(tmp_path / name, samples.particles(), header=header)
    table = io.read_table(tmp_path / "x")
    assert unit_of(table, "density") == CodeUnit(2e33 / 1e16**3, (-3, 1, 0, 0))
    assert unit_of(table, "speed") == unit_of(table, "vxyz.x") == CodeUnit(1e6, VELOCITY)
    assert unit_of(table, "log10:density") == unit_of(table, "density") and unit_of(table, "x") == CodeUnit(1e16, LENGTH)
    assert unit_of(table, "itype") is None and table.units.time == 3
    assert io.read_table(tmp_path / "y").units == FileUnits(time=3.0)


def test_a_summed_density_has_the_unit_of_masses_over_volumes():
    units = FileUnits(CodeUnit(10.0, LENGTH, a=1), {"Masses": CodeUnit(5.0, (0, 1, 0, 0), h=-1)})
    table = ParticleTable(np.eye(3), {"Masses": np.ones(3)}, units=units)
    assert unit_of(table, "density") == CodeUnit(5e-3, (-3, 1, 0, 0), -3, -1)
    assert unit_of(ParticleTable(np.eye(3), {"Masses": np.ones(3)}, units=FileUnits(units.length)), "density") is None


@pytest.mark.parametrize(
    ("unit", "magnitude", "wanted", "factor", "name"),
    [
        (CodeUnit(KPC, LENGTH), 20.0, None, 1, "kpc"),  # the largest of which there is at least one
        (CodeUnit(KPC, LENGTH), 3000.0, None, 1e-3, "Mpc"),
        (CodeUnit(KPC, LENGTH), 1e-30, None, KPC, "cm"),
        (CodeUnit(MYR, TIME), 0.5, None, 1000, "kyr"),
        (CodeUnit(1e5, VELOCITY), 3.0, None, 1, "km/s"),
        (CodeUnit(0.018, (-0.5, 0.5, -1, 0)), 1.0, None, 0.018, "G"),
        (CodeUnit(1.0, (0, 0, 0, 0)), 1.0, None, 1, ""),
        (CodeUnit(KPC, LENGTH, 1, -1), 5.0, None, 1, "kpc a h^-1"),  # powers of a and h are left in
        (CodeUnit(6.77e-22, (-3, 1, 0, 0), -3, 2), 5.0, None, 6.77e-22, "g cm^-3 h^2 a^-3"),
        (CodeUnit(6.77e-22, (-3, 1, 0, 0)), 1.0, "Msun/kpc**3", 1e10, "Msun/kpc^3"),
    ],
)
def test_names_are_of_a_readable_size_or_those_asked_for(unit, magnitude, wanted, factor, name):
    pytest.importorskip("unyt")
    assert named(unit, magnitude, wanted) == (pytest.approx(factor, rel=1e-2), name)


def test_a_unit_that_does_not_agree_or_exist_is_refused_by_name():
    pytest.importorskip("unyt")
    refused(r"'s' does not agree .* cm", named, CodeUnit(KPC, LENGTH), 1.0, "s")
    refused("'parsnip' is no unit", named, CodeUnit(KPC, LENGTH), 1.0, "parsnip")


def test_labels_have_units_where_the_file_states_them(tmp_path):
    pytest.importorskip("unyt")
    table = io.read_table(gadget(tmp_path / "x.hdf5", {"Time": 0.5, "Redshift": 1.0}, density=STATED))
    made = labels_of(table, "log10:Density", 1e-7)
    assert (made.quantity, made.unit, made.factor, made.moment) == ("log10:Density", "g cm^-3 h^2 a^-3", 6.77e-22, "z = 1")
    assert made.length_as(2000.0)[1] == "Mpc a h^-1" and labels_of(table, "Velocities.x").unit == "code units"
    refused(r"does not state that of `Velocities.x`", labels_of, table, "Velocities.x", unit="kpc")
    refused("does not agree", labels_of, table, "x", length_unit="s")


def test_times_are_told_in_words():
    pytest.importorskip("unyt")
    assert moment_of(FileUnits(time=2.5, time_unit=CodeUnit(MYR, TIME))) == "t = 2.5 Myr"
    assert moment_of(FileUnits(time=2.5)) == "t = 2.5 (code units)"
    assert moment_of(FileUnits(redshift=2.02)) == "z = 2.02" and moment_of(FileUnits()) == ""


def test_without_unyt_labels_are_in_code_units_and_a_unit_asked_for_says_how_to_install_it(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "unyt", None)
    monkeypatch.setattr("jaxsph.io.units.can_name", lambda: False)
    table = io.read_table(gadget(tmp_path / "x.hdf5", density=STATED))
    assert labels_of(table, "Density") == Labels("Density")
    with pytest.raises(ImportError, match=r"jaxsph\[units\]"):
        labels_of(table, "Density", unit="g/cm**3")


@pytest.mark.parametrize(
    ("unit", "text"),
    [
        (CodeUnit(3.08568e21, LENGTH), "kpc"), (CodeUnit(1.496e13, LENGTH), "AU"), (CodeUnit(1e16, LENGTH), "1e+16*cm"),
        (CodeUnit(KPC, LENGTH, 1, -1), "kpc a h^-1"), (CodeUnit(2.5e-10, (-2, 1, 0, 0)), "2.5e-10*g*cm**-2"),
        (CodeUnit(1.0, (0, 0, 0, 0)), ""),
    ],
)  # fmt: skip
def test_units_are_written_as_other_libraries_read_them(unit, text):
    assert written(unit) == text


def test_units_of_lengths_reach_particles(tmp_path):
    assert io.read_particles(gadget(tmp_path / "x.hdf5", density=STATED), "x", 1.0).length_unit == "kpc a h^-1"
    for names, unit in (("x [kpc],y [kpc],z [kpc]", "kpc"), ("Pos.x (m),Pos.y (m),Pos.z (m)", "m"), ("x,y,z", None),
                        ("x [furlong],y [furlong],z [furlong]", None), ("x [m],y [km],z [m]", None)):  # fmt: skip
        (tmp_path / "a.csv").write_text(f"{names},rho [m]\n1,2,3,4\n5,6,7,8\n")
        assert io.read_particles(tmp_path / "a.csv", "rho", 1.0).length_unit == unit, names


def test_a_length_has_the_unit_that_it_is_said_to_have():
    assert stated_length("kpc").cgs == pytest.approx(3.0857e21, rel=1e-4) and stated_length("kpc").powers == LENGTH
    for name in ("s", "kpc**2", "furlongs and more"):
        refused("unit", stated_length, name)


LET_THROUGH = {
    "kpc": "kpc",
    "Msun/kpc**3": "Msun/kpc**(3)",
    " g * cm ^ -3 ": "g*cm**(-3)",
    "1/s": "1/s",
    "g**(1/2)*cm**(-1/2)/s": "g**(1/2)*cm**(-1/2)/s",
    "cm**0.5": "cm**(0.5)",
    "m_p/cm**3": "m_p/cm**(3)",
}
REFUSED = (
    "", "*", "kpc*", "/s", "1", "kpc kpc", "kpc**", "kpc**s", "s**(9**9**9)", "s**999", "s**13", "s**(1/0)", "s**99**99", "2*kpc",
    "f'{1}'", "kpc.real", "__import__", "a__b", "exit()", "lambda", "sqrt", "kpc[0]", "'kpc'", "kpc;s", "kpc\n\nkpc", "k" * 101,
    "*".join(["kpc"] * 40), "a   *" * 19,
)  # fmt: skip


@pytest.mark.parametrize("text", LET_THROUGH)
def test_names_with_powers_are_let_through(text):
    assert checked_unit(text) == LET_THROUGH[text]


@pytest.mark.parametrize(("text", "like"), [("MSUN/pc2", "Msun"), ("g/cm**3*kps", "kpc"), ("Msum", "Msun")])
def test_the_name_that_is_most_like_an_unknown_one_is_told(text, like):
    pytest.importorskip("unyt")
    with pytest.raises(ValueError, match=rf"there is no .*; did you mean {like}\?"):
        named(CodeUnit(1.0, (-2, 1, 0, 0)), 1.0, text)


@pytest.mark.parametrize(
    "text",
    ["Msun/pc**2", "Msun pc^-2", "solMass/pc2", "pc**-2*Msun", "M_sun pc-2", "M⊙·pc⁻²", "Msun / pc ** 2", "1e0 Msun/pc^2"],
)
def test_units_are_read_as_people_write_them(text):
    pytest.importorskip("unyt")
    factor, name = named(CodeUnit(3.0, (-2, 1, 0, 0)), 1.0, text)
    assert factor == pytest.approx(3 / 1.98841e33 * 3.0857e18**2, rel=1e-3)
    assert read_unit(name).cgs == read_unit(text).cgs == pytest.approx(3 / factor)


def test_a_number_before_a_unit_counts():
    pytest.importorskip("unyt")
    for text in ("1e10 Msun", "10**10 solMass", "10^10*Msun"):
        factor, name = named(CodeUnit(1.98841e43, MASS), 1.0, text)
        assert (
            factor == pytest.approx(1, rel=1e-4)
            and name == "1e+10 Msun"
            and read_unit(name).cgs == pytest.approx(1.98841e43, rel=1e-4)
        )


@pytest.mark.parametrize("text", REFUSED, ids=lambda text: text[:20])
def test_all_else_is_refused_in_one_line(text):
    with pytest.raises(ValueError, match=r"a unit may have 100|is no unit") as error:
        checked_unit(text)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("text", ['f\'{open("ran", "w")}\'', "g/cm**3*s**(9**9**9)", "Symbol", "None", "S", "oo"])
def test_no_unit_runs_code_or_goes_on_for_ever(text, empty, tmp_path):
    pytest.importorskip("unyt")
    refused(r"is no unit|does not agree", named, CodeUnit(1.0, LENGTH), 1.0, text)
    assert not list(tmp_path.iterdir())


COLUMNS = "mass", "rho", "temp", "hsmooth", "metals", "phi", "velocity", "GasDensity", "smoothlength"
GRAVITY, MASS_OF_SUN = 6.6743e-8, 1.98841e33  # CGS, as textbooks have them


def write_param(folder, text="dKpcUnit = 2.0  # length\n# a comment = 3\ndMsolUnit=1e10\n", name="run.param"):
    (folder / name).write_text(text)


def beside(folder, name="run.00010", time=0.5):
    return units_beside(folder / name, COLUMNS, time)


def cgs(unit):
    return unit.cgs, unit.powers


def test_lengths_and_masses_are_as_stated_and_the_rest_follows_with_a_gravitational_constant_of_one(tmp_path):
    write_param(tmp_path)
    found, said = beside(tmp_path)
    assert said == ["units of run.param: dKpcUnit = 2, dMsolUnit = 1e+10"]
    length, mass = 2 * 3.0856776e21, 1e10 * MASS_OF_SUN
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
    write_param(tmp_path, "dKpcUnit = 1\ndMsolUnit = 1\n")
    assert beside(tmp_path)[0].columns["velocity"].cgs == pytest.approx(1e5 * math.sqrt(4.30091e-6), rel=1e-5)


def test_of_comoving_runs_numbers_keep_their_scale_factor_and_the_time_is_one(tmp_path):
    write_param(tmp_path, "dKpcUnit = 25000\ndMsolUnit = 2e15\nbComove = 1\n")
    found, said = beside(tmp_path, time=0.25)
    assert (found.redshift, found.time, found.time_unit) == (3.0, None, None) and "comoving" in said[0]
    assert (found.length.a, found.columns["rho"].a, found.columns["velocity"].a, found.columns["mass"].a) == (1, -3, 1, 0)
    assert "phi" not in found.columns
    assert beside(tmp_path, time=0.0)[0].redshift is None


@pytest.mark.parametrize("value", ["0", "-1", "nan", "inf", "1" + "0" * 400, "1e400", "1e-300", "ten", "", "1 2"])
@pytest.mark.parametrize("name", ["dKpcUnit", "dMsolUnit"])
def test_values_that_are_no_units_are_said_and_not_used(tmp_path, name, value):
    write_param(tmp_path, f"dKpcUnit = 1\ndMsolUnit = 1\n{name} = {value}\n")
    found, said = beside(tmp_path)
    assert found == FileUnits() and len(said) == 1 and f"{name} of run.param is {value[:40]!r}" in said[0]


def test_units_that_are_missing_are_said_and_without_a_file_of_parameters_nothing_is(tmp_path):
    assert beside(tmp_path) == (FileUnits(), [])
    write_param(tmp_path, "dKpcUnit = 1\n")
    said = "units are not known: dMsolUnit of run.param is missing, and must be a number in 1e-40 .. 1e+40"
    assert beside(tmp_path) == (FileUnits(), [said])


def test_of_several_files_it_is_the_one_that_names_the_snapshot(tmp_path):
    write_param(tmp_path, 'dKpcUnit = 1\ndMsolUnit = 1\nachOutName = "out/run"\n', "a.param")
    write_param(tmp_path, "dKpcUnit = 2\ndMsolUnit = 1\nachOutName = runaway\n", "b.param")
    assert beside(tmp_path)[1] == ["units of a.param: dKpcUnit = 1, dMsolUnit = 1"]
    assert beside(tmp_path, "runaway.00010")[1] == ["units of b.param: dKpcUnit = 2, dMsolUnit = 1"]
    assert "there are 2 .param files beside it, and none of them" in beside(tmp_path, "other.00010")[1][0]
    write_param(tmp_path, "dKpcUnit = 3\ndMsolUnit = 1\nachOutName = run\n", "c.param")
    assert "there are 3 .param files beside it, and 2 of them" in beside(tmp_path)[1][0] and beside(tmp_path)[0] == FileUnits()


def test_the_only_file_is_it_whatever_its_name(tmp_path):
    write_param(tmp_path, "dKpcUnit = 1\ndMsolUnit = 1\nachOutName = other\n", "other.param")
    assert beside(tmp_path)[0].length is not None


def test_a_period_is_said_and_not_used(tmp_path):
    write_param(tmp_path, "dKpcUnit = 1\ndMsolUnit = 1\nbPeriodic = 1\ndPeriod = 2.5\n")
    assert "with a period of 2.5: it is not used; pass `box=`" in beside(tmp_path)[1][1]


def test_files_that_are_none_of_parameters_are_harmless(tmp_path):
    (tmp_path / "a.param").write_bytes(bytes(range(256)) * 10)
    assert beside(tmp_path)[0] == FileUnits()
    (tmp_path / "a.param").write_bytes(b"#" * (MAX_BYTES + 1))
    assert beside(tmp_path)[1] == ["units are not known: a.param cannot be read"]
    (tmp_path / "a.param").unlink()
    (tmp_path / "b.param").mkdir()
    os.mkfifo(tmp_path / "c.param")  # would wait for ever if it were opened
    assert beside(tmp_path) == (FileUnits(), [])


@pytest.mark.parametrize("stated", [STATED, None], ids=["by its attributes", "by Gadget's convention"])
def test_physical_numbers_have_no_scale_factor_and_no_hubble_parameter(tmp_path, stated):
    a, h = 0.25, 0.7
    path = gadget(tmp_path / "x.hdf5", {"Redshift": 3.0, "HubbleParam": h, "BoxSize": 4.0}, density=stated)
    stored, found = io.read_table(path), io.read_table(path, physical=True)
    factors = {"Density": h**2 / a**3, "SmoothingLength": a / h, "Velocities": math.sqrt(a), "Masses": 1 / h}
    for name, factor in factors.items():
        np.testing.assert_allclose(found.columns[name], stored.columns[name] * factor, rtol=1e-6)
    np.testing.assert_allclose(found.position, stored.position * a / h)
    np.testing.assert_allclose(found.support, stored.support * a / h)
    np.testing.assert_allclose(found.box_size, np.full(3, 4.0 * a / h))
    assert "a = 0.25 and h = 0.7 taken out of positions (a h^-1), Density (h^2 a^-3)" in found.conventions[-1]
    assert unit_of(found, "Density") == (None if stated is None else CodeUnit(6.77e-22, (-3.0, 1.0, 0.0, 0.0)))
    later = gadget(tmp_path / "y.hdf5", {"Redshift": 1.0, "HubbleParam": h, "BoxSize": 4.0}, density=stated)
    survey = Snapshots.from_files([path, later], "Density", physical=True).survey
    assert survey.box is None and any("periods of the files differ" in said for said in survey.told())
    again = io.read_particles(path, "Density", physical=True)
    np.testing.assert_allclose(again.to_numpy()["quantity"], found.columns["Density"], rtol=1e-6)


def test_a_cosmological_run_of_today_is_known_by_its_matter_where_nothing_else_says_so(tmp_path):
    today = {"Redshift": 0.0, "Time": 1.0, "HubbleParam": 0.7, "Omega0": 0.3}
    found = io.read_table(gadget(tmp_path / "x.hdf5", today), physical=True)
    np.testing.assert_allclose(found.position, np.eye(3) / 0.7)
    assert found.units.redshift == 0 and found.units.hubble == 0.7
    for other in ({"Time": 0.25}, {"Omega0": 0.0}, {"HubbleParam": 1.0}, {"ComovingIntegrationOn": 0}):
        assert io.read_table(gadget(tmp_path / "y.hdf5", today | other)).units.redshift is None


def test_what_is_not_cosmological_stays_and_powers_of_an_unknown_parameter_are_refused(tmp_path):
    path = gadget(tmp_path / "x.hdf5", {"HubbleParam": 1.0})
    found = io.read_table(path, physical=True)
    np.testing.assert_array_equal(found.position, io.read_table(path).position)
    assert "nothing changes, as the file states no redshift" in found.conventions[-1]
    refused(
        "does not state it; leave out `physical`", io.read_table, gadget(tmp_path / "y.hdf5", {"Redshift": 1.0}), physical=True
    )


def swift(path, physical=(), h=0.4, cosmological=1):
    """A snapshot of SWIFT at a = 0.5, of which some data sets are stored as physical."""
    position = np.random.default_rng(3).uniform(0, 1, (400, 3))
    columns = {"Coordinates": (position, 0, 1), "Masses": (np.full(400, 1 / 400), 1, 0), "Densities": (np.ones(400), 1, -3)}
    columns |= {"SmoothingLengths": (np.full(400, h / 1.825742), 0, 1), "Gas": (np.full(400, 5.0), 1, -3)}
    with h5py.File(path, "w") as file:
        file.create_group("Header").attrs.update({"Code": "SWIFT", "Redshift": [1.0], "BoxSize": np.ones(3)})
        file.create_group("Cosmology").attrs.update({"Cosmological run": [cosmological], "h": [0.7]})
        file.create_group("HydroScheme").attrs.update({"Kernel function": "Cubic spline (M4)", "Dimension": [3]})
        for name, (values, mass, length) in columns.items():
            stated = {key: [0.0] for key in SWIFT_NAMES} | {"U_M exponent": [mass], "U_L exponent": [length], CGS: [1.0]}
            stated |= {"a-scale exponent": [float(length)], "Value stored as physical": [int(name in physical)]}
            factor = 0.5**length if name in physical else 1
            file.create_dataset(f"PartType0/{name}", data=values * factor).attrs.update(stated)
    return path


def test_numbers_stored_as_physical_have_no_scale_factor(tmp_path):
    path = swift(tmp_path / "x.hdf5", physical=["Gas"])
    assert io.read_table(path).units.columns["Gas"] == CodeUnit(1.0, (-3, 1, 0, 0))
    table = io.read_table(path, physical=True)
    np.testing.assert_array_equal(table.columns["Gas"], 40.0)  # 5 comoving
    np.testing.assert_array_equal(table.columns["Densities"], 8.0)
    assert unit_of(table, "Gas / Densities") == CodeUnit(1.0, (0, 0, 0, 0))
    assert unit_of(io.read_table(path), "Gas / Densities").a == 3


def test_physical_supports_and_densities_suit_comoving_positions(tmp_path):
    stored = io.read_particles(swift(tmp_path / "x.hdf5"), "x")
    path = swift(tmp_path / "y.hdf5", physical=["SmoothingLengths", "Densities"])
    found = io.read_particles(path, "x").to_numpy()
    np.testing.assert_allclose(found["support"], stored.to_numpy()["support"], rtol=1e-6)
    np.testing.assert_allclose(found["volume"], stored.to_numpy()["volume"], rtol=1e-6)
    again = io.read_particles(path, "x", support="1.825742 * SmoothingLengths").to_numpy()
    np.testing.assert_allclose(again["support"], 0.4, rtol=1e-6)
    physical = io.read_particles(path, "x", physical=True).to_numpy()
    np.testing.assert_allclose(physical["support"], 0.2, rtol=1e-6)


def test_runs_that_are_not_comoving_have_no_scale_factor(tmp_path):
    path = swift(tmp_path / "x.hdf5", cosmological=0)
    with h5py.File(path, "a") as file:
        file["Header"].attrs["Redshift"] = [0.0]
    assert io.read_table(path).units.length == CodeUnit(1.0, LENGTH)


def test_constants_of_gas_are_those_that_files_state(tmp_path):
    with h5py.File(tmp_path / "a.hdf5", "w") as file:
        file.create_group("Header").attrs["Time"] = 0.0
        file.create_group("HydroScheme").attrs.update({"Adiabatic index": [1.4], "Hydrogen mass fraction": 0.7})
        file.create_group("PartType0")
        assert of_gadget(file, file["PartType0"], True).gas == {"gamma": 1.4, "hydrogen": 0.7}
        header = file.create_group("header")
        header.attrs.update({"gamma": 5 / 3, "gmw": 2.381})
        assert of_phantom(header.attrs, {}).gas == {"gamma": 5 / 3, "mu": 2.381}
