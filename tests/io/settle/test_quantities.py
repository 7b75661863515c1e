import numpy as np
import pytest
from refusals import refused

from jaxsph.io.settle.quantities import available_quantities, choose_quantity
from jaxsph.io.table import ParticleTable

position = np.array([[0.0, 0, 0], [1, 0, 5], [2, 1, 10]])
velocity = np.array([[3.0, 4, 0], [0, 0, 1], [0, 2, 0]])
one_to_three = np.array([1.0, 2.0, 3.0])


def table(**columns):
    return ParticleTable(position, columns)


def test_a_column_is_found_by_name_whatever_its_case_and_punctuation():
    for asked in ("Internal_Energy", "internal_energy", "InternalEnergy"):
        values, name = choose_quantity(table(Internal_Energy=one_to_three), asked)
        assert name == "Internal_Energy"
        np.testing.assert_array_equal(values, one_to_three)


def test_the_exact_name_wins_over_one_of_other_case():
    values, name = choose_quantity(table(A=one_to_three, a=-one_to_three), "a")
    assert name == "a" and values[0] == -1


@pytest.mark.parametrize("asked", ["velocity.y", "velocity_y", "velocity:1", "vy", "Velocity.Y"])
def test_a_component_of_a_vector_is_found(asked):
    values, name = choose_quantity(table(velocity=velocity), asked)
    assert name == "velocity.y"
    np.testing.assert_array_equal(values, velocity[:, 1])


def test_components_of_wide_columns_are_numbered():
    values, name = choose_quantity(table(stress=np.arange(18.0).reshape(3, 6)), "stress.5")
    assert name == "stress.5" and values[0] == 5


def test_speed_is_the_norm_of_the_velocity():
    np.testing.assert_array_equal(choose_quantity(table(Velocities=velocity), "speed")[0], [5, 1, 2])


def test_coordinates_are_quantities():
    np.testing.assert_array_equal(choose_quantity(table(), "z")[0], [0, 5, 10])


def test_a_role_is_found_under_the_name_the_code_uses():
    assert choose_quantity(table(rho=one_to_three), "density")[1] == "rho"
    assert choose_quantity(table(u=one_to_three), "internal_energy")[1] == "u"


def test_a_density_that_is_not_stored_is_summed():
    values, name = choose_quantity(table(), "density", density=lambda: one_to_three)
    assert name == "density" and values is one_to_three


def test_the_logarithm_lifts_what_is_not_positive_to_the_smallest_positive():
    values, name = choose_quantity(table(a=np.array([0.0, 10.0, 1000.0])), "log10:A")
    assert name == "log10:a"
    np.testing.assert_allclose(values, [1, 1, 3])


def test_the_logarithm_of_nothing_positive_is_refused():
    refused(r"`log10:a` needs positive values, but the largest is -1", choose_quantity, table(a=-one_to_three), "log10:a")


def test_a_missing_quantity_is_answered_with_those_there_are():
    with pytest.raises(ValueError, match="no quantity 'spin'") as caught:
        choose_quantity(table(a=one_to_three, velocity=velocity), "spin")
    for name in ("a", "velocity.x", "speed", "density", "x", "y", "z", "log10:"):
        assert name in str(caught.value)


def test_every_available_quantity_can_be_chosen():
    for name in available_quantities(table(a=one_to_three, velocity=velocity)):
        values, chosen = choose_quantity(table(a=one_to_three, velocity=velocity), name, density=lambda: one_to_three)
        assert chosen == name and values.shape == (3,) and np.isfinite(values).all()


def test_a_vector_without_component_is_answered_with_its_components():
    refused(r"velocity\.x, velocity\.y, velocity\.z, speed", choose_quantity, table(velocity=velocity), "velocity")


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
        ({"density": one_to_three, "InternalEnergy": 10.0 ** (2 * one_to_three)}, "log10:InternalEnergy"),
        ({"density": one_to_three, "velocity": velocity}, "density"),
        ({"density": 1000 + one_to_three, "velocity": velocity}, "speed"),
        ({"density": 1000 + one_to_three}, "density"),
        ({"density": 10.0 ** (2 * one_to_three)}, "log10:density"),
        ({"density": np.ones(3), "velocity": velocity}, "speed"),
        ({"Rhop": 1000 + one_to_three, "Vel": velocity}, "speed"),
        ({"Rhop": 1000 + one_to_three, "Vel": 0 * velocity}, "speed"),
        ({"density": 1000 - 900 * (one_to_three == 1), "velocity": np.ones((3, 3))}, "density"),
        ({"velocity": np.ones((3, 3))}, "speed"),
        ({"velocity": velocity}, "speed"),
        ({"id": one_to_three}, "z"),
    ],
)
def test_without_a_name_the_most_telling_quantity_is_picked(columns, expected):
    assert choose_quantity(table(**columns))[1] == expected


def test_massless_particles_that_have_velocities_are_not_shown_by_a_sum_of_kernels():
    still = {"velocity": np.ones((3, 3))}
    assert choose_quantity(table(**still), density=lambda: one_to_three)[1] == "speed"
    assert choose_quantity(table(mass=one_to_three, **still), density=lambda: one_to_three)[1] == "density"


def test_bare_points_are_shown_by_density_and_its_logarithm_where_they_cluster():
    assert choose_quantity(table(), density=lambda: one_to_three)[1] == "density"
    assert choose_quantity(table(), density=lambda: 10.0 ** (2 * one_to_three))[1] == "log10:density"


def test_an_empty_set_has_an_empty_quantity():
    empty = ParticleTable(np.zeros((0, 3)), {"density": np.zeros(0)})
    assert choose_quantity(empty)[0].shape == choose_quantity(empty, "log10:density")[0].shape == (0,)
