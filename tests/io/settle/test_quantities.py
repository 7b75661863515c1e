import dataclasses

import numpy as np
import pytest
from refusals import refused

from jaxsph.io.settle.quantities import available_quantities, choose_quantity, passed_over, unit_of
from jaxsph.io.table import LENGTH, MASS, CodeUnit, FileUnits, ParticleTable

position = np.array([[0.0, 0, 0], [1, 0, 5], [2, 1, 10]])
velocity = np.array([[3.0, 4, 0], [0, 0, 1], [0, 2, 0]])
one_to_three = np.array([1.0, 2.0, 3.0])
BALL = np.array([30.0, 1000.0, 1000.0])


def table(**columns):
    return ParticleTable(position, columns)


@pytest.mark.parametrize(
    ("columns", "asked", "name", "expected"),
    [
        *(({"Internal_Energy": one_to_three}, one, "Internal_Energy", one_to_three)
          for one in ("Internal_Energy", "internal_energy", "InternalEnergy")),
        ({"A": one_to_three, "a": -one_to_three}, "a", "a", -one_to_three),  # the exact name wins
        *(({"velocity": velocity}, one, "velocity.y", velocity[:, 1])
          for one in ("velocity.y", "velocity_y", "velocity:1", "vy", "Velocity.Y")),
        ({"stress": np.arange(18.0).reshape(3, 6)}, "stress.5", "stress.5", [5, 11, 17]),
        ({"Velocities": velocity}, "speed", "speed", [5, 1, 2]),
        ({}, "z", "z", [0, 5, 10]),
        ({"rho": one_to_three}, "density", "rho", one_to_three),
        ({"u": one_to_three}, "internal_energy", "u", one_to_three),
        ({"a": np.array([0.0, 10.0, 1000.0])}, "log10:A", "log10:a", [1, 1, 3]),
    ],
)  # fmt: skip
def test_a_quantity_is_found_by_its_name_whatever_its_case_and_punctuation(columns, asked, name, expected):
    values, found = choose_quantity(table(**columns), asked)
    assert found == name
    np.testing.assert_allclose(values, expected)


def test_a_density_that_is_not_stored_is_summed():
    values, name = choose_quantity(table(), "density", density=lambda: one_to_three)
    assert name == "density" and values is one_to_three


def test_a_missing_quantity_is_answered_with_those_there_are():
    refused(r"`log10:a` needs positive values, but the largest is -1", choose_quantity, table(a=-one_to_three), "log10:a")
    refused(r"velocity\.x, velocity\.y, velocity\.z, speed", choose_quantity, table(velocity=velocity), "velocity")
    for name in ("a", "velocity.x", "speed", "density", "x, y, z", "log10:"):
        refused(rf"no quantity 'spin'.*{name}", choose_quantity, table(a=one_to_three, velocity=velocity), "spin")


def test_every_available_quantity_can_be_chosen():
    for name in available_quantities(table(a=one_to_three, velocity=velocity)):
        values, chosen = choose_quantity(table(a=one_to_three, velocity=velocity), name, density=lambda: one_to_three)
        assert chosen == name and values.shape == (3,) and np.isfinite(values).all()


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_values_that_are_not_finite_are_refused_by_name(bad):
    with pytest.raises(ValueError, match="'a' must be finite, but 1 of 3 values are not, the first at index 1"):
        choose_quantity(table(a=np.array([1.0, bad, 2.0])), "a")
    refused("'a' must be finite", choose_quantity, table(a=np.array([1.0, bad, 2.0])), "log10:a")


@pytest.mark.parametrize(
    ("columns", "expected"),
    [
        ({"density": one_to_three, "my_dye": one_to_three, "Temperature": one_to_three}, "my_dye"),
        ({"density": one_to_three, "concentration_a": one_to_three}, "concentration_a"),
        ({"density": one_to_three, "Temperature": one_to_three}, "Temperature"),
        ({"density": one_to_three, "InternalEnergy": 10.0 ** (2 * one_to_three)}, "density"),  # every gas has both
        ({"InternalEnergy": 10.0 ** (2 * one_to_three)}, "log10:InternalEnergy"),
        ({"density": BALL, "u": one_to_three, "velocity": velocity}, "u"),
        ({"density": one_to_three, "velocity": velocity}, "density"),
        ({"density": 1000 + one_to_three, "velocity": velocity}, "speed"), ({"density": 1000 + one_to_three}, "density"),
        ({"density": 10.0**one_to_three}, "log10:density"),  # as opacity, over more than a decade
        ({"density": BALL, "velocity": velocity}, "speed"),  # of a ball of even density in a thin medium, which is hardly seen
        ({"density": BALL, "u": 1e3 / BALL, "velocity": velocity}, "speed"),
        ({"density": 1000 + one_to_three, "DustFraction": one_to_three, "velocity": velocity}, "DustFraction"),
        ({"density": np.ones(3), "velocity": velocity}, "speed"),
        ({"Rhop": 1000 + one_to_three, "Vel": velocity}, "speed"), ({"Rhop": 1000 + one_to_three, "Vel": 0 * velocity}, "speed"),
        ({"density": 1000 - 900 * (one_to_three == 1), "velocity": np.ones((3, 3))}, "density"),
        ({"velocity": np.ones((3, 3))}, "speed"), ({"velocity": velocity}, "speed"),
        ({"Temperature": 1e4 * (1 + 1e-7 * one_to_three), "density": one_to_three}, "density"),  # the same but for rounding
        ({"velocity": np.array([[0.5, 0, 0], [-0.5, 0.01, 0], [0.5, 0, 0]])}, "velocity.x"), ({"id": one_to_three}, "z"),
    ],
)  # fmt: skip
def test_without_a_name_the_most_telling_quantity_is_picked(columns, expected):
    assert choose_quantity(table(**columns))[1] == expected


def test_massless_particles_that_have_velocities_are_not_shown_by_a_sum_of_kernels():
    still = {"velocity": np.ones((3, 3))}
    assert choose_quantity(table(**still), density=lambda: one_to_three)[1] == "speed"
    assert choose_quantity(table(mass=one_to_three, **still), density=lambda: one_to_three)[1] == "density"


def test_particles_that_cluster_are_shown_by_density_before_speed_and_constants_are_told():
    stars = table(velocity=velocity, temperature=np.full(3, 10.0))
    assert choose_quantity(stars, density=lambda: 10.0 ** (2 * one_to_three))[1] == "log10:density"
    assert passed_over(stars, "log10:density") == ["temperature is 10 for all particles, so log10:density is shown"]
    assert not passed_over(stars, "temperature")
    assert passed_over(table(density=BALL, velocity=velocity), "speed")[0].endswith("that are not thin, so speed is shown")


def test_bare_points_are_shown_by_density_its_logarithm_where_they_cluster_and_height_where_they_lie_evenly():
    assert choose_quantity(table(), density=lambda: 1000 + one_to_three)[1] == "y"
    assert choose_quantity(table(density=BALL), density=lambda: BALL)[1] == "log10:density"  # of a thin medium around it
    assert choose_quantity(table(), density=lambda: one_to_three)[1] == "density"
    assert choose_quantity(table(), density=lambda: 10.0 ** (2 * one_to_three))[1] == "log10:density"


def test_an_empty_set_has_an_empty_quantity():
    empty = ParticleTable(np.zeros((0, 3)), {"density": np.zeros(0)})
    assert choose_quantity(empty)[0].shape == choose_quantity(empty, "log10:density")[0].shape == (0,)


NUMBER = CodeUnit(1.0, (0, 0, 0, 0))
MASS_UNIT, LENGTH_UNIT = CodeUnit(2e33, MASS, h=-1), CodeUnit(3e21, LENGTH, 1, -1)
DENSITY_UNIT = MASS_UNIT.over(LENGTH_UNIT, 3)
IN_UNITS = ParticleTable(
    position,
    {"Masses": one_to_three, "Density": one_to_three[::-1], "h": one_to_three, "vel": velocity, "rho (kg/m3)": -one_to_three},
    units=FileUnits(LENGTH_UNIT, {"Masses": MASS_UNIT, "Density": DENSITY_UNIT, "h": LENGTH_UNIT}),
)
M, RHO, H, VX = one_to_three, one_to_three[::-1], one_to_three, velocity[:, 0]


@pytest.mark.parametrize(
    ("asked", "expected", "unit"),
    [
        ("Masses*Density", M * RHO, MASS_UNIT.over(DENSITY_UNIT, -1)), ("Masses / h**3", M / H**3, DENSITY_UNIT),
        ("density**2", RHO**2, DENSITY_UNIT.over(DENSITY_UNIT, -1)), ("sqrt(h * h)", H, LENGTH_UNIT),
        ("x + 2*h", position[:, 0] + 2 * H, LENGTH_UNIT), ("hypot(x, y)", np.hypot(position[:, 0], position[:, 1]), LENGTH_UNIT),
        ("max(h, x) - 1", np.maximum(H, position[:, 0]) - 1, None), ("h + Masses", H + M, None),
        ("log10(Density / (Masses / h**3))", np.log10(RHO / M * H**3), NUMBER), ("log10(Density)", np.log10(RHO), None),
        ("vel.x*h", VX * H, None), ("h**x", H ** position[:, 0], None), ("h + vx", H + VX, None),
        ("log10: Masses * 10", np.log10(10 * M), MASS_UNIT), ("rho (kg/m3)", -M, None), ("RHO (KG/M3)", -M, None),
        ("`rho (kg/m3)` * 2", -2 * M, None), ("Density**200", RHO**200.0, None), ("2 * 3", np.full(3, 6.0), NUMBER),
    ],
)  # fmt: skip
def test_an_expression_is_what_numpy_makes_of_it_in_the_unit_that_follows(asked, expected, unit):
    values, name = choose_quantity(IN_UNITS, asked)
    np.testing.assert_array_equal(values, expected)
    assert name == ("log10:" * (":" in asked) + asked.removeprefix("log10: ") if "KG" not in asked else "rho (kg/m3)")
    np.testing.assert_array_equal(choose_quantity(IN_UNITS, name)[0], values)
    found = unit_of(IN_UNITS, name)
    numbers = [None if one is None else (*one.powers, one.a, one.h, np.log(one.cgs)) for one in (found, unit)]
    assert (found is None) == (unit is None) and (unit is None or numbers[0] == pytest.approx(numbers[1]))


def test_an_expression_that_is_wrong_is_refused_where_it_is():
    refused("at character 1, 'Denstiy': .*did you mean Density", choose_quantity, IN_UNITS, "Denstiy * 2")
    refused("'h / x' in 'h / x' is no finite number for 1 of 3 particles.* 0, h = 1, x = 0;", choose_quantity, IN_UNITS, "h / x")
    refused("'log\\(1 - h\\)' .* 3 of 3 particles.* 0, 1 - h = 0; 1, 1 - h = -1; 2,", choose_quantity, IN_UNITS, "2 + log(1 - h)")
    refused("expression 'h > 1' is not understood", choose_quantity, IN_UNITS, "h > 1")
    refused("'vel' has 3 components", choose_quantity, IN_UNITS, "vel * 2")  # it is not vel.z
    for wrong in ("Density *", "x +", "vel * x"):
        refused("is not understood at", choose_quantity, IN_UNITS, wrong)


def test_a_component_along_the_line_of_sight_is_positive_away_from_the_eye():
    refused("and there is none; name x, y or z", choose_quantity, IN_UNITS, "velocity.los")
    eye = np.array([0.0, 0.0, -3.0])
    rays = (position - eye) / np.linalg.norm(position - eye, axis=1)[:, None]
    for sight, expected in (((eye, True), (velocity * rays).sum(1)), (((0.0, 2.0, 0.0), False), velocity[:, 1])):
        seen = dataclasses.replace(IN_UNITS, sight=sight)
        values, name = choose_quantity(seen, "velocity.los")
        np.testing.assert_allclose(values, expected)
        assert name == "vel.los" and name in available_quantities(seen)
        np.testing.assert_allclose(choose_quantity(seen, "Masses * velocity.los**2")[0], M * expected**2)
