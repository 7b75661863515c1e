"""Quantities that files do not hold, against formulas written out here."""

import dataclasses

import numpy as np
import pytest
from refusals import refused

import jaxsph.io as io
from jaxsph.io.file_units import without_cosmology
from jaxsph.io.settle.quantities import choose_quantity, formulas_said, unit_of
from jaxsph.io.table import MASS, TEMPERATURE, VELOCITY, CodeUnit, FileUnits, ParticleTable

RNG = np.random.default_rng(0)
COUNT = 50
KMS2 = CodeUnit(1e10, (2, 0, -2, 0))
LENGTH = CodeUnit(3.086e21, (1, 0, 0, 0))
POSITION, SPEED = RNG.uniform(0, 1, (COUNT, 3)), RNG.normal(size=(COUNT, 3))
U, XE, RHO = RNG.uniform(500, 2000, COUNT), RNG.uniform(0, 1.2, COUNT), RNG.uniform(1, 2, COUNT)
PER_K = 1.67262192e-24 / 1.380649e-16  # m_p / k_B


def gas(unit=KMS2, constants=None, more=None, **columns):
    units = {"InternalEnergy": unit, "Density": CodeUnit(6.8e-22, (-3, 1, 0, 0)), "Masses": CodeUnit(2e43, MASS)}
    held = {"InternalEnergy": U, "Density": RHO, "Masses": np.ones(COUNT), "Velocities": SPEED, **columns}
    stated = FileUnits(LENGTH, {key: one for key, one in units.items() if one is not None}, gas=constants or {}, **(more or {}))
    return ParticleTable(POSITION, held, units=stated)


def kelvin(mu, gamma=5 / 3, u=U * 1e10):
    return (gamma - 1) * u * mu * PER_K


def ionised(u=U * 1e10, x=0.76):
    neutral, hot = (kelvin(mu, u=u) for mu in (4 / (1 + 3 * x), 4 / (3 + 5 * x)))
    return np.where(hot > 1e4, hot, np.where(neutral < 1e4, neutral, 1e4))


@pytest.mark.parametrize(
    ("table", "expected"),
    [
        (gas(ElectronAbundance=XE), kelvin(4 / (1 + 3 * 0.76 + 4 * 0.76 * XE))),
        (gas(), ionised()), (gas(InternalEnergy=U / 10), ionised(U * 1e9)), (gas(InternalEnergy=U / 5), ionised(U * 2e9)),
        (gas(CodeUnit(1e10, (2, 0, -2, 0), -2), more={"redshift": 1.0}), ionised(U * 4e10)),
        (gas(constants={"gamma": 1.4, "mu": 2.381}), kelvin(2.381, 1.4)), (gas(mu=XE + 1), kelvin(XE + 1)),
        (gas(constants={"hydrogen": 0.7}, ElectronAbundance=XE), kelvin(4 / (1 + 3 * 0.7 + 4 * 0.7 * XE))),
        (gas(GFM_Metals=np.tile([0.5, 0.4, 0.1, 0], (COUNT, 1)), ElectronAbundance=XE), kelvin(4 / (2.5 + 2 * XE))),
        (gas(Metallicity=np.tile([0.1, 0.4, 0.0], (COUNT, 1)), ElectronAbundance=XE), kelvin(4 / (2.5 + 2 * XE))),
        (gas(Temperature=XE), XE), (gas(temp=XE), XE),
    ],
)  # fmt: skip
def test_temperatures_are_those_of_the_formula(table, expected):
    for asked in ("temperature", "Temperature", "temp"):
        values, name = choose_quantity(table, asked)
        np.testing.assert_allclose(values, expected, rtol=1e-6)
    if "emp" not in "".join(table.columns):
        found = unit_of(table, name)
        assert name == "temperature" and (found.cgs, found.powers, found.a) == (1.0, TEMPERATURE, 0.0)
        np.testing.assert_allclose(choose_quantity(table, "log10:temperature / 10")[0], np.log10(expected / 10), rtol=1e-6)


def test_a_temperature_is_the_same_without_scale_factors():
    table = gas(CodeUnit(1e10, (2, 0, -2, 0), -2), more={"redshift": 1.0}, ElectronAbundance=XE)
    both = [choose_quantity(one, "temperature")[0] for one in (table, without_cosmology(table))]
    np.testing.assert_allclose(*both, rtol=1e-6)


@pytest.mark.parametrize(
    ("asked", "expected", "unit"),
    [
        ("pressure", 2 / 3 * RHO * U, (-1, 1, -2, 0)), ("entropy", 2 / 3 * U / RHO ** (2 / 3), (4, -2 / 3, -2, 0)),
        ("SoundSpeed", np.sqrt(10 / 9 * U), VELOCITY), ("volume", 1 / RHO, (3, 0, 0, 0)), ("n_H", 0.76 * RHO, (-3, 0, 0, 0)),
        ("radius", np.linalg.norm(POSITION - POSITION.mean(0), axis=1), (1, 0, 0, 0)),
    ],
)  # fmt: skip
def test_names_that_are_computed_have_the_unit_that_follows(asked, expected, unit):
    values, name = choose_quantity(gas(), asked)
    np.testing.assert_allclose(values, expected, rtol=1e-6)
    assert unit_of(gas(), name).powers == pytest.approx(unit, abs=1e-5)
    assert name in io.available_quantities(gas()) or name == "radius"
    assert (name in " ".join(formulas_said(gas(), name))) and not formulas_said(gas(**{name: XE}), name)
    np.testing.assert_array_equal(choose_quantity(gas(**{name: XE}), asked)[0], XE)  # what is stored is that


@pytest.mark.parametrize("name", ["Z", "GFM_Metallicity", "MetalMassFractions", "Metallicity"])
def test_metallicity_is_that_of_whatever_the_file_calls_it(name):
    column = np.stack([XE, 0 * XE], 1) if name == "Metallicity" else XE
    np.testing.assert_array_equal(choose_quantity(gas(**{name: column}), "metallicity")[0], XE)


def test_components_about_a_centre_are_those_of_spheres():
    for center, box in ((None, None), ((0.2, 0.3, 0.9), None), ((0.05, 0.5, 0.95), (1.0, 1.0, 1.0))):
        table = dataclasses.replace(gas(), center=center, box_size=box)
        away = POSITION - (POSITION.mean(0) if center is None else center)
        away = away if box is None else away - np.round(away)
        radial = away / np.linalg.norm(away, axis=1)[:, None]
        phi = np.cross((0, 0, 1), away)
        phi /= np.linalg.norm(phi, axis=1)[:, None]
        for name, axis in (("radial", radial), ("phi", phi), ("theta", np.cross(phi, radial))):
            values, full = choose_quantity(table, f"velocity.{name}")
            np.testing.assert_allclose(values, (SPEED * axis).sum(1), atol=1e-12)
            assert full == f"Velocities.{name}" and formulas_said(table, full)
        np.testing.assert_allclose(choose_quantity(table, "radius")[0], np.linalg.norm(away, axis=1))
    np.testing.assert_array_equal(choose_quantity(gas(), "vr")[0], choose_quantity(gas(), "velocity.radial")[0])


def test_particles_without_weight_have_a_middle():
    table = gas(Masses=np.zeros(COUNT))
    np.testing.assert_allclose(choose_quantity(table, "radius")[0], choose_quantity(gas(), "radius")[0])


def test_volumes_that_a_file_has_are_its_own():
    table = dataclasses.replace(gas(), volume=XE + 1)
    for asked in ("volume", "log10:Volume"):
        expected = XE + 1 if asked == "volume" else np.log10(XE + 1)
        np.testing.assert_array_equal(choose_quantity(table, asked)[0], expected)
    assert formulas_said(table, "volume") == [] and unit_of(table, "volume").powers == (3, 0, 0, 0)
    unweighed = ParticleTable(POSITION, volume=XE + 1)
    assert "volume" in io.available_quantities(unweighed) and choose_quantity(unweighed, "volume")[1] == "volume"


def test_a_name_that_cannot_be_computed_says_what_it_needs():
    refused(
        r"unit of `InternalEnergy`.*\(km/s\)\^2.*0.76.*ElectronAbundance",
        choose_quantity,
        gas(None, ElectronAbundance=XE),
        "temperature",
    )
    refused("without internal energy", choose_quantity, ParticleTable(POSITION, {"mass": XE}), "temperature")
    refused("isothermal gas, with gamma = 1", choose_quantity, gas(constants={"gamma": 1.0}), "pressure")
    with pytest.raises(ValueError, match="write the expression") as error:
        choose_quantity(gas(None), "temperature")
    text = str(error.value).partition("the expression '")[2].partition("'")[0]
    np.testing.assert_allclose(choose_quantity(gas(None), text)[0], ionised(), rtol=1e-6)  # which may be copied


def test_radii_are_from_the_middle_of_all_whoever_is_left_out():
    particles, report = io.particles_from_table(gas(), "radius", 0.3, where="x > 0.5 and temperature > 0")
    shown = POSITION[POSITION[:, 0] > 0.5]
    expected = np.linalg.norm(shown - POSITION.mean(0), axis=1)
    np.testing.assert_allclose(particles.to_numpy()["quantity"], expected, rtol=1e-5)
    told = " ".join(report.notes)
    assert ",," not in told and "the centre of mass of all" in told and "gamma = 5/3" in told and "X = 0.76" in told
