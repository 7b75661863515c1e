"""Looks, by default or by preset: readable opacity whatever the kind of data, its units and its sign."""

import numpy as np
import pytest
from examples import examples
from hypothesis import given, strategies as st
from lookups import look_up

import jaxsph as js
from jaxsph import Camera, Particles, Scene, Settings, TransferFunction, Volume, reference
from jaxsph.model.transfer.looks import COLORMAPS, default_transfer, opacity_by_second, value_range
from jaxsph.model.transfer.maps import colormap
from jaxsph.model.transfer.presets import FAINTEST, PRESETS
from jaxsph.scenes import fitted, preset
from jaxsph.scenes.sampling import scatter


def block(count=1500, size=1.0, shift=0.0, values=None):
    position = size * scatter(np.zeros(3), np.ones(3), count) + shift
    quantity = np.linspace(0, 1, count) if values is None else values
    return Particles.from_arrays(position.astype(np.float32), 2 * size * count ** (-1 / 3), quantity)


@examples(10)
@given(st.floats(-3, 6))
def test_a_block_of_any_size_is_readable(decades):
    particles = block(size=10.0**decades, shift=10.0**decades)
    camera = Camera.framing(particles, width=9, height=9, direction=(0.1, 0.1, -1))
    scene = Scene(particles=particles, transfer=default_transfer(particles))
    image = reference.render(scene, camera, Settings(samples=32))
    assert 0.8 < np.asarray(image.alpha)[4, 4] < 0.995


def test_extinction_rises_with_the_quantity_over_the_range():
    transfer = default_transfer(block(), "gray", range=(-2.0, 5.0))
    extinction = np.asarray(transfer.extinction)
    assert np.asarray(transfer.values)[[0, -1]].tolist() == [-2.0, 5.0]
    assert (np.diff(extinction) > 0).all() and extinction[0] == pytest.approx(FAINTEST * extinction[-1])


@pytest.mark.parametrize("values", [np.zeros(50), np.full(50, -3.0), np.full(50, 1e7) + np.arange(50) * 1e-3])
def test_a_constant_quantity_has_a_range(values):
    low, high = value_range(values)
    assert low < values.min() and high > values.max() and np.float32(low) < np.float32(high)


@pytest.mark.parametrize("name", ["speed", "density", "temperature", "magnetic"])
@pytest.mark.parametrize("value", [0.0, 2.5])
def test_what_is_never_negative_has_colours_from_0_up_where_it_is_constant(name, value):
    shown = js.Particles.from_arrays(np.random.default_rng(0).random((20, 3)), 0.3, np.full(20, value))
    values = np.asarray(js.TransferFunction.preset(name, shown).values)
    assert 0 <= values[0] <= value <= values[-1] and values[0] < values[-1]


@pytest.mark.parametrize("name", ["speed", "density", "temperature", "magnetic", "fluid", "velocity", "scan"])
@pytest.mark.parametrize("value", [0.0, 2.5])
@pytest.mark.parametrize("colormap_name", [None, "ice"])
def test_a_constant_quantity_has_the_colour_in_the_middle_of_its_map(name, value, colormap_name):
    """Which is seen on black, where those of the ends may not be: a liquid at rest is no shadow."""
    shown = js.Particles.from_arrays(np.random.default_rng(0).random((20, 3)), 0.3, np.full(20, value))
    made = js.TransferFunction.preset(name, shown, colormap=colormap_name)
    rows = colormap(colormap_name or PRESETS[name].colormap)
    middle = (1 + (0.0 if colormap_name else PRESETS[name].lift)) / 2 * (len(rows) - 1)
    wanted = [np.interp(middle, np.arange(len(rows)), channel) for channel in rows.T]
    np.testing.assert_allclose(look_up(made, np.array([value]))[0][0], wanted, atol=0.03)


def test_a_quantity_that_is_0_has_the_colour_of_0_in_a_range_that_is_asked_for():
    shown = js.Particles.from_arrays(np.random.default_rng(0).random((20, 3)), 0.3, np.zeros(20))
    made = js.TransferFunction.preset("speed", shown, range=(0.0, 5.0))  # as in other pictures of that range
    np.testing.assert_allclose(look_up(made, np.array([0.0]))[0][0], colormap("ice")[0], atol=1e-6)


def test_a_few_odd_values_do_not_take_the_colours():
    values = np.append(np.linspace(0, 1, 10_000), 1e6)
    assert value_range(values)[1] < 1.01
    assert value_range(np.append(np.zeros(10_000), 1.0)) == (0.0, 1.0)  # unless they are all there is to see


def test_an_empty_or_single_set_has_a_transfer_function():
    for count in (0, 1):
        particles = Particles.from_arrays(np.zeros((count, 3)), 1.0, np.zeros(count))
        assert np.isfinite(np.asarray(default_transfer(particles).extinction)).all()


@pytest.mark.parametrize("name", [*COLORMAPS, "viridis_r"])
def test_built_in_colour_maps(name):
    colors = colormap(name)
    assert colors.ndim == 2 and colors.shape[1] == 3 and colors.min() >= 0 and colors.max() <= 1
    assert (colormap(name.removesuffix("_r")) == colormap(name.removesuffix("_r") + "_r")[::-1]).all()


def test_bad_arguments_are_named():
    with pytest.raises(ValueError, match=r"viridis, heat, ice, coolwarm, gray.*'nope'"):
        colormap("nope")
    with pytest.raises(ValueError, match=r"ascend, got \(1\.0, 0\.0\)"):
        default_transfer(block(10), range=(1, 0))
    with pytest.raises(ValueError, match="`optical_depth` must be > 0"):
        default_transfer(block(10), optical_depth=0)


def pair(count=200):
    density = np.geomspace(1e-3, 10, count)
    position = scatter(np.zeros(3), np.ones(3), count).astype(np.float32)
    return Particles.from_arrays(position, 2 * count ** (-1 / 3), (np.linspace(-1, 1, count), np.log10(density)))


def test_of_two_quantities_colours_span_the_first_and_extinction_rises_from_nothing_over_the_second():
    transfer = default_transfer(pair(), range=(-1.0, 1.0))
    own, extinction = np.asarray(transfer.extinction_values), np.asarray(transfer.extinction)
    assert np.asarray(transfer.values)[[0, -1]].tolist() == [-1.0, 1.0]
    assert -3 <= own[0] < -2.9 and 0.9 < own[-1] <= 1 and extinction[0] == 0 and (np.diff(extinction) > 0).all()


def test_colours_of_any_function_are_kept_where_extinction_is_by_the_second():
    colored = TransferFunction.from_points([0, 1, 5], [(1, 0, 0), (0, 1, 0), (0, 0, 1)], np.full(3, 3.0))
    made = opacity_by_second(colored, pair())
    assert (made.values == colored.values).all() and (made.colors == colored.colors).all()
    with pytest.raises(ValueError, match="two quantities"):
        opacity_by_second(colored, block())


def test_ramps_are_even_rising_or_steep_and_nothing_else():
    low, high = (float(look_up(default_transfer(block(), ramp="even"), np.array([end]))[1][0]) for end in (0.1, 0.9))
    assert low == pytest.approx(high) and low > 0
    steep = default_transfer(block(), ramp="steep")
    assert float(look_up(steep, np.array([0.0]))[1][0]) == 0
    with pytest.raises(ValueError, match="even, rising, steep"):
        default_transfer(block(), ramp="falling")


DECADES = 10 ** np.linspace(-6, 2, 1200)


def cube(values, size=1.0):
    """Particles of a cube whose values, in their order, change from one side to the other."""
    position = size * scatter(np.zeros(3), np.ones(3), len(values))
    position = position[np.argsort(position[:, 0])]
    return Particles.from_arrays(position.astype(np.float32), 2 * size * len(values) ** (-1 / 3), values)


@pytest.mark.parametrize("name", PRESETS)
@pytest.mark.parametrize("size", [1e-2, 1e5])
def test_every_preset_shows_a_block_neither_empty_nor_as_a_wall(name, size):
    particles = cube(DECADES if PRESETS[name].domain == "log" else np.linspace(0, 3, 1200), size)
    camera = Camera.framing(particles, width=9, height=9, direction=(0.1, 0.1, -1))
    scene = Scene(particles=particles, transfer=preset(name, particles))
    image = reference.render(scene, camera, Settings(samples=32))
    alpha = np.asarray(image.alpha)[2:7, 2:7]
    assert 0.6 < alpha.max() < 0.9999 and 0.1 < alpha.mean() < 0.95
    assert np.asarray(image.color).max() > 0.3


def test_values_over_decades_get_even_logarithms_and_others_do_not():
    for values, even in ((DECADES, np.log10), (np.linspace(5, 6, 1200), np.asarray), (np.linspace(-1, 1, 1200), np.asarray)):
        control = even(np.asarray(TransferFunction.preset("density", cube(values)).values, np.float64))
        np.testing.assert_allclose(np.diff(control), np.diff(control)[0], rtol=1e-3)


def test_what_changes_its_sign_has_zero_in_the_middle_where_it_is_not_seen():
    made = preset("velocity", cube(np.linspace(-1, 3, 1200)))
    values, extinction = np.asarray(made.values), np.asarray(made.extinction)
    np.testing.assert_allclose(values, -values[::-1], atol=1e-6)
    assert extinction[7:9].max() < 0.02 * extinction.max() and extinction[0] == extinction[-1]


def test_a_volume_and_two_ends_have_presets_too():
    volume = Volume.from_array(np.linspace(0, 1, 8**3, dtype=np.float32).reshape(8, 8, 8), (0, 0, 0), 1.0)
    assert float(preset("scan", volume).extinction.max()) > 0
    made = preset("temperature", (10.0, 1e4), colormap="heat", points=5)
    np.testing.assert_allclose(made.values, np.geomspace(10, 1e4, 5), rtol=1e-6)
    assert float(made.extinction.max()) == 1


def test_any_function_can_be_fitted_to_an_optical_depth():
    particles = cube(np.ones(1200))
    made = TransferFunction.from_points([0, 1], [(0, 0, 0), (1, 1, 1)], [0, 1e-7])
    thin, thick = (float(fitted(made, particles, depth).extinction[1]) for depth in (1.0, 5.0))
    assert thick == pytest.approx(5 * thin) and 0.5 < thin < 3


def test_a_domain_changes_places_and_keeps_the_depth_of_columns():
    particles = cube(DECADES)
    for domain in ("linear", "log", "symlog", "percentile", "equalised"):
        made = default_transfer(particles, norm=domain)
        again = fitted(made, particles)
        np.testing.assert_allclose(again.extinction, made.extinction, rtol=1e-5)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"name": "liquid"}, "fluid, density"),
        ({"name": "fluid", "norm": "lin"}, "linear, log"),
        ({"name": "fluid", "colormap": "nope"}, "viridis"),
        ({"name": "fluid", "range": (1.0, 2.0, 3.0)}, "two numbers"),
        ({"name": "density", "norm": "log", "range": (-1.0, 2.0)}, "> 0"),
        ({"name": "fluid", "optical_depth": 0.0}, "`optical_depth`"),
    ],
)
def test_what_makes_no_preset_is_refused_with_those_there_are(given, said):
    with pytest.raises(ValueError, match=said):
        preset(shown=cube(DECADES), **given)
