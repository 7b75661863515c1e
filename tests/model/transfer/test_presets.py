"""Presets: pictures that can be seen into, whatever kind of data, its units and its sign."""

import numpy as np
import pytest

from jaxsph import Camera, Particles, Scene, Settings, TransferFunction, Volume, reference
from jaxsph.model.transfer.looks import PRESETS
from jaxsph.scenes import domain_transfer, fitted, preset
from jaxsph.scenes.sampling import scatter

DECADES = 10 ** np.linspace(-6, 2, 1200)


def block(values, size=1.0):
    """Particles of a cube whose values, in their order, change from one side to the other."""
    position = size * scatter(np.zeros(3), np.ones(3), len(values))
    position = position[np.argsort(position[:, 0])]
    return Particles.from_arrays(position.astype(np.float32), 2 * size * len(values) ** (-1 / 3), values)


@pytest.mark.parametrize("name", PRESETS)
@pytest.mark.parametrize("size", [1e-2, 1e5])
def test_every_preset_shows_a_block_neither_empty_nor_as_a_wall(name, size):
    particles = block(DECADES if PRESETS[name].domain == "log" else np.linspace(0, 3, 1200), size)
    camera = Camera.framing(particles, width=9, height=9, direction=(0.1, 0.1, -1))
    scene = Scene(particles=particles, transfer=preset(name, particles))
    image = reference.render(scene, camera, Settings(samples=32))
    alpha = np.asarray(image.alpha)[2:7, 2:7]
    assert 0.6 < alpha.max() < 0.9999 and 0.1 < alpha.mean() < 0.95
    assert np.asarray(image.color).max() > 0.3


def test_values_over_decades_get_even_logarithms_and_others_do_not():
    for values, even in ((DECADES, np.log10), (np.linspace(5, 6, 1200), np.asarray), (np.linspace(-1, 1, 1200), np.asarray)):
        control = even(np.asarray(TransferFunction.preset("density", block(values)).values, np.float64))
        np.testing.assert_allclose(np.diff(control), np.diff(control)[0], rtol=1e-3)


def test_what_changes_its_sign_has_zero_in_the_middle_where_it_is_not_seen():
    made = preset("velocity", block(np.linspace(-1, 3, 1200)))
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
    particles = block(np.ones(1200))
    made = TransferFunction.from_points([0, 1], [(0, 0, 0), (1, 1, 1)], [0, 1e-7])
    thin, thick = (float(fitted(made, particles, depth).extinction[1]) for depth in (1.0, 5.0))
    assert thick == pytest.approx(5 * thin) and 0.5 < thin < 3


def test_a_domain_changes_places_and_keeps_the_depth_of_columns():
    particles = block(DECADES)
    for domain in ("linear", "log", "symlog", "percentile", "equalised"):
        made = domain_transfer(particles, domain)
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
        preset(shown=block(DECADES), **given)
