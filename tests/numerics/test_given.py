"""Numbers with units, masks and foreign byte orders: converted, kept in their own unit, or refused by name; never stripped."""

import numpy as np
import pytest

import jaxsph as js
from jaxsph.model.particles.columns import emission_measure, held_by, unit_held
from jaxsph.numerics.checks import in_unit, own, plain, unit_of, with_unit

unyt = pytest.importorskip("unyt")
KPC, PC = 1.0, 1e-3
POSITION = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])


class Unit:
    """A unit as astropy has it: an object that knows powers of itself, and how to write itself."""

    def __init__(self, size, power=1, name="kpc"):
        self.size, self.power, self.name = size, power, name

    def __pow__(self, power):
        return Unit(self.size, self.power * power, self.name)

    def __str__(self):
        return self.name if self.power == 1 else f"{self.name}{self.power}"


class Quantity:
    """Numbers as astropy has them: `unit` and `to_value`, no subclass of an array, and NumPy drops the unit without a word."""

    def __init__(self, value, unit):
        self.value, self.unit = np.asarray(value, float), unit

    def to_value(self, unit):
        if unit.power != self.unit.power:
            raise TypeError("not convertible")
        return self.value * (self.unit.size / unit.size) ** unit.power

    def __array__(self, dtype=None, copy=None):
        return np.array(self.value, dtype)

    ndim = property(lambda self: self.value.ndim)


def stand_in(value, name, power=1):
    return Quantity(value, Unit({"kpc": KPC, "pc": PC}[name], power, name))


def of_unyt(value, name, power=1):
    return unyt.unyt_array(value, f"{name}**{power}")


LIBRARIES = pytest.mark.parametrize("made", [of_unyt, stand_in])


def particles(position, support=0.5, quantity=1.0, **more):
    return js.Particles.from_arrays(position, support, quantity, **more)


@LIBRARIES
def test_lengths_and_volumes_become_those_of_positions(made):
    found = particles(made(POSITION, "kpc"), made([400, 300, 200], "pc"), volume=made([1e9, 2e9, 3e9], "pc", 3),
                      box=made([4e3, 5e3, 6e3], "pc"))  # fmt: skip
    columns = found.to_numpy()
    np.testing.assert_allclose(columns["support"], [0.4, 0.3, 0.2], rtol=1e-6)
    np.testing.assert_allclose(columns["volume"], [1, 2, 3], rtol=1e-6)
    np.testing.assert_allclose(columns["position"], POSITION)
    np.testing.assert_allclose(found.box.sides, [4, 5, 6], rtol=1e-6)
    assert found.length_unit == "kpc"
    np.testing.assert_allclose(particles(made(POSITION, "kpc"), 0.4).to_numpy()["support"], 0.4, rtol=1e-6)


@LIBRARIES
def test_extinctions_of_points_are_a_unit_of_their_positions(made):
    ages = {"age": unyt.unyt_array([1.0, 2, 3], "Myr")}
    lengths = {"radius": made(100, "pc"), "extinction": made(0.002, "pc", -1), "splats_beyond": made(3000, "pc")}
    found = js.Points.from_arrays(made(POSITION, "kpc"), **lengths, attributes=ages)
    np.testing.assert_allclose(found.radius[:3], 0.1, rtol=1e-6)
    np.testing.assert_allclose(found.extinction[:3], 2, rtol=1e-6)
    np.testing.assert_allclose(found.splats_beyond, 3, rtol=1e-6)
    np.testing.assert_array_equal(found.attributes["age"][:3], [1, 2, 3])


@LIBRARIES
def test_a_grid_is_in_the_unit_of_its_place_or_of_its_spacing_at_the_origin(made):
    values = unyt.unyt_array(np.arange(8.0).reshape(2, 2, 2), "K")
    placed = js.Volume.from_array(values, made([1, 2, 3], "kpc"), made(500, "pc"))
    np.testing.assert_allclose(placed.spacing, 0.5)
    np.testing.assert_array_equal(placed.values, np.arange(8.0).reshape(2, 2, 2))
    at_origin = js.Volume.from_array(values, spacing=made(500, "pc"))
    assert float(at_origin.spacing[0]) == 500 and (placed.length_unit, at_origin.length_unit) == ("kpc", "pc")
    with pytest.raises(ValueError, match=r"`spacing` is in pc, but `lower` has no unit.*spacing\.to_value\(\"pc\"\)"):
        js.Volume.from_array(values, [1.0, 2, 3], made(500, "pc"))


@LIBRARIES
@pytest.mark.parametrize(
    ("call", "name"),
    [
        (lambda x: particles(POSITION, x(0.4)), "support"),
        (lambda x: particles(POSITION, box=x([4, 4, 4])), "box"),
        (lambda x: js.Points.from_arrays(POSITION, x(1), extinction=1), "radius"),
        (lambda x: js.Camera.look_at(x([0, 0, 5]), (0, 0, 0), near=1, far=9), "eye"),
        (lambda x: js.Camera.look_at((0, 0, 5), (0, 0, 0), near=1, far=x(9)), "far"),
        (lambda x: js.Camera.orthographic((0, 0, 5), (0, 0, 0), view_height=x(1), near=1, far=9), "view_height"),
        (lambda x: js.Plane(x([0, 0, 0]), (0, 0, 1)), "point"),
        (lambda x: js.Box(x([0, 0, 0]), (1, 1, 1)), "lower"),
        (lambda x: js.Sphere((0, 0, 0), x(1)), "radius"),
        (lambda x: js.CameraPath.orbit(center=(0, 0, 0), radius=x(2)), "radius"),
        (lambda x: js.TransferFunction.from_points(x([0, 1]), np.ones((2, 3)), [1, 1]), "values"),
        (lambda x: js.TransferFunction.from_points([0, 1], np.ones((2, 3)), x([1, 1])), "extinction"),
        (lambda x: js.TransferFunction.from_colormap("viridis", x([0, 1]), 1.0), "values"),
        (lambda x: js.resample(particles(POSITION), x([0, 0, 0]), 0.5, (2, 2, 2)), "lower"),
        (lambda x: emission_measure(x([1, 1, 1]), 1.0), "mass"),
    ],
)  # fmt: skip
def test_a_unit_that_nothing_can_be_held_against_is_refused_by_name(made, call, name):
    with pytest.raises(ValueError, match=rf"`{name}` is in kpc, but .*pass {name}\.to_value\(\"kpc\"\)"):
        call(lambda value: made(value, "kpc"))


@LIBRARIES
def test_units_of_another_kind_are_refused_by_name(made):
    with pytest.raises(
        ValueError, match=r"`support` is in pc2?(\*\*2)?, which cannot be converted to kpc, as `position` is in kpc"
    ):
        particles(made(POSITION, "kpc"), made(0.4, "pc", 2))


def test_the_parts_of_a_scene_have_one_unit_of_length():
    gas = particles(of_unyt(POSITION, "kpc"))
    stars = js.Points.from_arrays(of_unyt(POSITION, "pc"), 1.0, extinction=1.0)
    look = js.TransferFunction.from_points([0, 1], np.ones((2, 3)), [1, 1])
    with pytest.raises(ValueError, match=r"one unit of length, got `particles` in kpc and `points` in pc"):
        js.Scene(particles=gas, transfer=look, points=stars)
    js.Scene(particles=gas, transfer=look, points=js.Points.from_arrays(POSITION, 1.0, extinction=1.0))


def test_places_are_converted_where_particles_know_their_unit():
    gas = particles(of_unyt(POSITION, "kpc"), box=of_unyt([4.0, 4, 4], "kpc"))
    np.testing.assert_allclose(gas.centered(of_unyt([1e3, 2e3, 3e3], "pc")).box.lower, [-1, 0, 1], atol=1e-6)
    volume = js.resample(gas, of_unyt([0.0, 0, 0], "pc"), of_unyt(500, "pc"), (2, 2, 2))
    np.testing.assert_allclose(volume.spacing, 0.5)
    assert volume.length_unit == "kpc"


def test_carried_quantities_are_numbers_in_their_own_unit():
    kelvin = unyt.unyt_array([10.0, 20, 30], "K")
    np.testing.assert_array_equal(particles(POSITION, quantity=kelvin).to_numpy()["quantity"], [10, 20, 30])
    pair = particles(POSITION, quantity=(kelvin, stand_in([1, 2, 3], "pc")))
    np.testing.assert_array_equal(pair.to_numpy()["extinction_quantity"], [1, 2, 3])


def test_what_has_no_dimension_is_a_number():
    assert plain("x", unyt.unyt_quantity(50, "percent")) == 0.5
    assert plain("x", unyt.unyt_array([1.0, 2], "dimensionless")).tolist() == [1, 2]
    position, unit = with_unit("position", unyt.unyt_array(POSITION, "dimensionless"))
    assert unit is None and type(position) is np.ndarray
    assert in_unit("x", Quantity([1.0], ""), None) == [1]


def test_plain_numbers_pass_as_they_are():
    for value in (POSITION, [1, 2.0], (1, 2), 3, 2.5, None, np.float32(1), "name"):
        assert unit_of(value) is None and plain("x", value) is value and own("x", value) is value


def test_a_list_of_numbers_with_units_is_refused():
    one = unyt.unyt_quantity(1, "kpc")
    with pytest.raises(ValueError, match=r"`eye` is a list of numbers that carry units \(kpc\); make it one array"):
        js.Camera.look_at((one, one, one), (0, 0, 0), near=1, far=9)
    with pytest.raises(ValueError, match=r"`position` is a list of numbers that carry units"):
        particles([[one, one, one]])


@pytest.mark.parametrize("name", ["position", "support", "quantity", "volume"])
def test_masked_arrays_are_refused_by_name_with_what_to_do(name):
    given = {"position": POSITION, "support": np.ones(3), "quantity": np.ones(3), "volume": np.ones(3)}
    hidden = np.zeros(given[name].shape, bool)
    hidden.flat[1] = True
    given[name] = np.ma.masked_array(given[name], hidden)
    with pytest.raises(ValueError, match=rf"`{name}` is masked in 1 of {hidden.size} entries.*~mask.*{name}\.filled"):
        js.Particles.from_arrays(**given)
    given[name] = np.ma.masked_array(given[name].data, False)  # nothing is hidden
    assert js.Particles.from_arrays(**given).num_particles == 3


def test_masked_grids_rows_and_control_points_are_refused():
    with pytest.raises(ValueError, match="`values` is masked in 1 of 8"):
        js.Volume.from_array(np.ma.masked_array(np.ones((2, 2, 2)), np.arange(8).reshape(2, 2, 2) == 3))
    with pytest.raises(ValueError, match="`position` is masked in 1 of 3"):
        particles([np.ma.masked_array([0.0, 0, 0], [0, 1, 0])])
    with pytest.raises(ValueError, match="`extinction` is masked"):
        js.TransferFunction.from_points([0, 1], np.ones((2, 3)), np.ma.masked_array([1, 1], [0, 1]))
    with pytest.raises(ValueError, match="`quantity` is masked"):
        js.TransferFunction.control_values("linear", np.ma.masked_array([1.0, 2], [0, 1]))


@pytest.mark.parametrize("dtype", [">f4", ">f8", "<f4", "<f8", ">i4", np.longdouble])
def test_numbers_of_other_machines_are_taken(dtype):
    found = particles(POSITION.astype(dtype), np.full(3, 2, dtype), np.arange(3).astype(dtype), volume=np.ones(3, dtype))
    np.testing.assert_array_equal(found.to_numpy()["position"], POSITION)
    np.testing.assert_array_equal(found.to_numpy()["quantity"], np.arange(3))
    volume = js.Volume.from_array(np.arange(8).reshape(2, 2, 2).astype(dtype), np.zeros(3, dtype), np.ones(3, dtype))
    np.testing.assert_array_equal(volume.values, np.arange(8).reshape(2, 2, 2))
    points = js.Points.from_arrays(POSITION.astype(dtype), np.ones(3, dtype), extinction=np.ones(3, dtype))
    np.testing.assert_array_equal(points.position[:3], POSITION)
    look = js.TransferFunction.from_points(np.array([0, 1], dtype), np.ones((2, 3), dtype), np.ones(2, dtype))
    np.testing.assert_array_equal(look.values, [0, 1])
    camera = js.Camera.look_at(np.array([0, 0, 5], dtype), np.zeros(3, dtype), near=np.array(1, dtype), far=np.array(9, dtype))
    np.testing.assert_array_equal(camera.eye, [0, 0, 5])
    np.testing.assert_array_equal(js.Sphere(np.ones(3, dtype), np.array(2, dtype)).center, [1, 1, 1])
    np.testing.assert_array_equal(js.Box(np.zeros(3, dtype), np.ones(3, dtype)).upper, [1, 1, 1])


def test_amounts_are_numbers_in_their_own_unit():
    held = held_by(particles(POSITION), unyt.unyt_array([1.0, 2, 4], "Msun"), None)
    np.testing.assert_array_equal(np.ldexp(held.amounts[:3, 0], held.exponents[0]), [1, 2, 4])


@pytest.mark.parametrize(
    ("unit", "weight", "called"),
    [(None, None, "Msun a unit of area"), ("kpc", None, "Msun / (kpc)**2"), ("kpc", "volume", "Msun"), (None, "volume", "Msun")],
)
def test_integrals_are_called_by_the_unit_of_what_is_summed_up(unit, weight, called):
    gas = particles(POSITION if unit is None else of_unyt(POSITION, unit))
    assert unit_held(gas, unyt.unyt_array([1.0, 2, 4], "Msun"), weight) == called
    assert unit_held(gas, np.ones(3), weight) == "" == unit_held(gas, "volume", weight)


def test_masked_amounts_and_weights_are_refused():
    hidden = np.ma.masked_array(np.ones(3), [0, 1, 0])
    for name, of, weight in (("of", hidden, None), ("weight", "quantity", hidden)):
        with pytest.raises(ValueError, match=f"`{name}` is masked in 1 of 3"):
            held_by(particles(POSITION), of, weight)
