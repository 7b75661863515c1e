"""Transfer functions of colour maps and norms; domains, where control points sit; scales, on which they are spread evenly."""

import builtins
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import assume, given, strategies as st
from lookups import look_up

import jaxsph as js
from jaxsph.model.transfer.maps import DOMAINS, Scale, colormap

colors = pytest.importorskip("matplotlib.colors")
matplotlib = pytest.importorskip("matplotlib")

NORMS = [
    colors.Normalize(-2, 7),
    colors.LogNorm(1e-3, 1e4),
    colors.SymLogNorm(1.0, vmin=-50, vmax=100),
    colors.PowerNorm(0.5, 0, 9),
    colors.AsinhNorm(0.1, -3, 3),
]


@pytest.mark.parametrize("norm", NORMS, ids=lambda norm: type(norm).__name__)
def test_control_points_have_the_colours_that_a_figure_would_show_there(norm):
    made = js.TransferFunction.from_matplotlib("magma", norm, extinction=2.0)
    values = np.asarray(made.values, np.float64)
    assert values[[0, -1]] == pytest.approx([norm.vmin, norm.vmax])
    place = np.linspace(0, 1, 16)
    np.testing.assert_allclose(made.colors, matplotlib.colormaps["magma"](place)[:, :3], atol=1e-7)
    np.testing.assert_allclose(np.ma.filled(norm(values)), place, atol=1e-5)
    assert np.asarray(made.extinction).tolist() == [2.0] * 16


def test_between_control_points_a_log_norm_is_met_and_better_with_more():
    norm, fine = colors.LogNorm(1e-4, 1e4), np.geomspace(1e-4, 1e4, 3000)
    rows = np.array(matplotlib.colormaps["viridis"].colors)  # matplotlib shows the nearest of these; a picture shows all between
    place = norm(fine) * len(rows) - 0.5
    truth = np.stack([np.interp(place, np.arange(len(rows)), channel) for channel in rows.T], 1)
    for points, worst in ((16, 0.04), (64, 0.007)):
        made = js.TransferFunction.from_matplotlib("viridis", norm, points=points)
        assert np.abs(np.asarray(look_up(made, fine)[0]) - truth).max() < worst


def test_a_map_is_taken_as_an_object_and_its_alpha_multiplies_extinction():
    chosen = colors.ListedColormap([(0, 0, 0, 0), (1, 1, 1, 1)])
    made = js.TransferFunction.from_matplotlib(chosen, low=0, high=1, extinction=[1, 3], points=4)
    np.testing.assert_allclose(made.extinction, [0, 0, 1 + 4 / 3, 3], rtol=1e-6)


def test_colours_jump_at_boundaries():
    norm = colors.BoundaryNorm([0, 1, 4, 5], 256)
    made = js.TransferFunction.from_matplotlib("viridis", norm)
    middles = np.array([0.5, 1.01, 3.99, 4.5])
    np.testing.assert_allclose(look_up(made, middles)[0], matplotlib.colormaps["viridis"](norm(middles))[:, :3], atol=1e-6)


def test_the_norm_that_was_given_is_left_as_it_was():
    norm = colors.LogNorm()
    js.TransferFunction.from_matplotlib("viridis", norm, low=1, high=10)
    assert norm.vmin is None and norm.vmax is None


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"cmap": "virids", "low": 0, "high": 1}, "viridis"),
        ({"cmap": 3, "low": 0, "high": 1}, "Colormap"),
        ({"cmap": "viridis"}, "`low`"),
        ({"cmap": "viridis", "norm": colors.LogNorm(1, 2), "low": 3}, "agree"),
        ({"cmap": "viridis", "norm": colors.LogNorm(), "low": 0, "high": 1}, "> 0"),
        ({"cmap": "viridis", "low": 1, "high": 1}, "ascend"),
    ],
)
def test_what_makes_no_function_is_refused_with_a_remedy(given, said):
    with pytest.raises((ValueError, TypeError), match=said):
        js.TransferFunction.from_matplotlib(**given)


def test_without_matplotlib_a_name_says_how_to_install_it(monkeypatch):
    real = builtins.__import__

    def refuse(name, *rest, **more):
        if name.split(".")[0] == "matplotlib":
            raise ImportError(name)
        return real(name, *rest, **more)

    monkeypatch.setattr(builtins, "__import__", refuse)
    with pytest.raises(ImportError, match=r"jaxsph\[color\]"):
        js.TransferFunction.from_matplotlib("magma", low=0, high=1)


@pytest.mark.parametrize("name", ["viridis", "coolwarm", "plasma", "magma", "cividis", "turbo", "RdBu", "hot", "Spectral_r"])
def test_names_of_matplotlib_have_its_colours_without_it(name):
    np.testing.assert_allclose(colormap(name), matplotlib.colormaps[name](np.linspace(0, 1, 16))[:, :3], atol=2e-3)


@pytest.mark.parametrize("name", ["cmocean:thermal", "thermal", "crameri:batlow", "batlow_r", "cmasher:rainforest", "Viridis"])
def test_names_of_other_collections_work_with_any_number_of_points(name, caplog):
    for points in (2, 16, 33):
        rows = colormap(name, points)
        assert rows.shape == (points, 3) and rows.min() >= 0 and rows.max() <= 1
    assert not caplog.records


def test_maps_of_this_package_hide_others_of_their_names_and_say_nothing(caplog):
    for name, low in (("gray", 32 / 255), ("heat", 42 / 255), ("ice", 11 / 255), ("coolwarm", 59 / 255)):
        assert colormap(name)[0, 0] == pytest.approx(low, abs=2e-3)
    assert colormap("cmocean:ice")[0, 0] < 0.02 and not caplog.records


def test_a_map_that_was_registered_with_matplotlib_is_known_by_its_name():
    made = colors.LinearSegmentedColormap.from_list("of_the_house", [(0, 0, 0), (1, 0.5, 0)])
    matplotlib.colormaps.register(made)
    try:
        np.testing.assert_allclose(colormap("of_the_house", 3)[:, 1], [0, 0.25, 0.5], atol=1e-2)
    finally:
        matplotlib.colormaps.unregister("of_the_house")


@pytest.mark.parametrize(
    ("given", "meant"), [("virdis", "viridis"), ("coolwram_r", "coolwarm"), ("haet", "heat"), ("batlo", "batlow")]
)
def test_an_unknown_name_is_answered_with_those_like_it(given, meant):
    with pytest.raises(ValueError, match=rf"did you mean .*\b{meant}\b"):
        colormap(given)


def test_maps_are_loaded_only_when_one_is_asked_for():
    program = (
        "import sys, jaxsph; assert 'cmap' not in sys.modules; jaxsph.scenes.colormap('viridis'); assert 'cmap' in sys.modules"
    )
    subprocess.run([sys.executable, "-c", program], check=True)


def test_a_map_over_more_control_values_is_finer():
    made = js.TransferFunction.from_colormap("viridis", np.linspace(0, 1, 65))
    np.testing.assert_allclose(made.colors, matplotlib.colormaps["viridis"](np.linspace(0, 1, 65))[:, :3], atol=2e-3)


def test_rows_of_colours_are_spread_over_control_values_of_a_domain():
    values = js.TransferFunction.control_values("log", low=1, high=100, points=5)
    made = js.TransferFunction.from_colormap([(0, 0, 0), (1, 0.5, 0)], values, extinction=[0, 4])
    np.testing.assert_allclose(made.values, np.geomspace(1, 100, 5), rtol=1e-6)
    np.testing.assert_allclose(made.colors[:, 0], np.linspace(0, 1, 5))
    np.testing.assert_allclose(made.extinction, np.linspace(0, 4, 5))


def test_two_ends_are_spread_over():
    made = js.TransferFunction.from_colormap("heat", (2, 4))
    np.testing.assert_allclose(made.values, np.linspace(2, 4, 16), rtol=1e-6)


QUANTITY = np.random.default_rng(3).lognormal(0, 2, 4000)
exponents = st.floats(-12, 12)


@pytest.mark.parametrize("domain", DOMAINS)
@pytest.mark.parametrize("points", [2, 16, 33])
def test_control_values_ascend_and_are_as_many_as_asked(domain, points):
    values = js.TransferFunction.control_values(domain, QUANTITY, points=points)
    assert values.shape == (points,) and (np.diff(values) > 0).all()


@pytest.mark.parametrize("domain", ["linear", "log", "symlog", "equalised"])
def test_ends_that_are_given_are_kept_exactly(domain):
    values = js.TransferFunction.control_values(domain, np.concatenate([QUANTITY, [0.1, 30.0]]), low=0.1, high=30.0)
    assert values[[0, -1]].tolist() == [0.1, 30.0]


@given(exponents, exponents)
def test_control_values_of_a_log_domain_have_even_logarithms(low, high):
    assume(high - low > 0.1)
    values = js.TransferFunction.control_values("log", low=10.0**low, high=10.0**high)
    np.testing.assert_allclose(np.log10(values), np.linspace(low, high, 16), rtol=0, atol=1e-12)


@given(st.floats(1e-3, 1e6))
def test_a_symlog_domain_is_odd_about_zero_linear_within_its_width_and_logarithmic_far_beyond(high):
    values = js.TransferFunction.control_values("symlog", low=-high, high=high, points=33)
    np.testing.assert_allclose(values, -values[::-1], rtol=0, atol=1e-12 * high)
    np.testing.assert_allclose(values[-1] / values[-2], values[-2] / values[-3], rtol=1e-2)


def test_an_equalised_domain_gives_every_colour_to_as_many_particles():
    values = js.TransferFunction.control_values("equalised", QUANTITY, points=11)
    counts = np.histogram(QUANTITY, values)[0]
    assert np.abs(counts - len(QUANTITY) / 10).max() <= 1


def test_an_equalised_domain_counts_by_weight():
    weights = np.where(QUANTITY > 1, 9.0, 1.0)
    values = js.TransferFunction.control_values("equalised", QUANTITY, weights=weights, points=11)
    share = np.histogram(QUANTITY, values, weights=weights)[0] / weights.sum()
    np.testing.assert_allclose(share, 0.1, atol=2 * 9 / weights.sum())


def test_values_that_many_share_take_no_more_than_one_colour():
    values = js.TransferFunction.control_values("equalised", [*np.zeros(1000), 1.0, 2.0, 3.0], points=4)
    np.testing.assert_allclose(values, [0, 1, 2, 3])


def test_percentages_are_of_the_quantity():
    values = js.TransferFunction.control_values("percentile", QUANTITY, low=10, high=90)
    np.testing.assert_allclose(values[[0, -1]], np.percentile(QUANTITY, [10, 90]))
    np.testing.assert_allclose(np.diff(values, 2), 0, atol=1e-12)


@pytest.mark.parametrize("domain", ["linear", "symlog", "percentile", "equalised"])
def test_a_constant_quantity_has_a_range_around_it(domain):
    values = js.TransferFunction.control_values(domain, np.full(20, -4.0))
    assert values[0] < -4 < values[-1]


def test_what_is_not_finite_is_not_counted():
    odd = np.concatenate([QUANTITY, [np.nan, np.inf, -np.inf]])
    for domain in DOMAINS:
        np.testing.assert_array_equal(
            js.TransferFunction.control_values(domain, odd), js.TransferFunction.control_values(domain, QUANTITY)
        )


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"norm": "loglog"}, "linear, log, symlog, percentile, equalised"),
        ({"norm": "log", "low": 0.0, "high": 1.0}, "symlog"),
        ({"norm": "log", "quantity": QUANTITY, "low": -1.0}, f"{QUANTITY.min():.4g}"),
        ({"norm": "log", "quantity": -QUANTITY}, "has none"),
        ({"norm": "log", "quantity": [0.0, 0.0, 1.0, -2.0]}, "only positive value .* 3 of 4 are not positive.* 'symlog'"),
        ({"norm": "linear", "low": 1.0}, "`high`"),
        ({"norm": "linear", "low": 2.0, "high": 1.0}, "ascend"),
        ({"norm": "percentile", "quantity": QUANTITY, "high": 101.0}, "percentages"),
        ({"norm": "equalised"}, "`quantity`"),
        ({"norm": "equalised", "quantity": QUANTITY, "low": -2.0, "high": -1.0}, "widen"),
        ({"norm": "symlog", "low": -1.0, "high": 1.0, "width": 0.0}, "`width`"),
        ({"norm": "linear", "low": 0.0, "high": 1.0, "width": 1.0}, "leave it out"),
        ({"norm": "linear", "low": 0.0, "high": 1.0, "points": 1}, "two ends"),
        ({"norm": "equalised", "quantity": QUANTITY, "weights": [1.0]}, "`weights`"),
    ],
)
def test_what_makes_no_domain_is_refused_with_a_remedy(given, said):
    with pytest.raises(ValueError, match=said):
        js.TransferFunction.control_values(**given)


@pytest.mark.parametrize(
    ("domain", "name"),
    [("linear", "linear"), ("percentile", "linear"), ("log", "log"), ("symlog", "even"), ("equalised", "even")],
)
@pytest.mark.parametrize("points", [16, 64])
def test_control_values_of_every_domain_are_even_on_their_scale_also_in_float32(domain, name, points):
    values = js.TransferFunction.control_values(domain, QUANTITY, points=points).astype(np.float32)
    scale = Scale.of(values)
    assert scale.name == name
    np.testing.assert_allclose(scale.place(values), np.linspace(0, 1, points), atol=2e-5)


@pytest.mark.parametrize("values", [[-3.0, 1.0, 5.0], [1e-4, 1e-2, 1.0], np.cumsum(np.arange(1.0, 12))])
def test_places_and_values_are_inverse(values):
    scale, place = Scale.of(np.array(values)), np.linspace(0, 1, 77)
    np.testing.assert_allclose(scale.place(scale.value(place)), place, atol=1e-12)


def test_points_laid_by_hand_and_jumps_have_a_linear_axis():
    assert Scale.of(np.array([0.0, 0.1, 0.9, 1.0])).name == "linear"
    assert Scale.of(np.array([0.0, 1, 1, 2, 4, 8, 16, 32, 64])).name == "linear"


@pytest.mark.parametrize("values", [[3.0], [0.0, 0.0], [-1e9]])
def test_a_single_value_has_an_axis_around_it(values):
    scale = Scale.of(np.array(values))
    assert scale.name == "linear" and 0 < scale.place(values[0]) < 1


def test_what_is_not_positive_is_below_a_logarithmic_axis():
    assert Scale.of(np.geomspace(1, 100, 16)).place(np.array([0.0, -1.0])).tolist() == [-np.inf, -np.inf]
