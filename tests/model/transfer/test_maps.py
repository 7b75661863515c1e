"""Transfer functions of colour maps: matplotlib's maps and norms, and rows of colours over a domain."""

import builtins
import subprocess
import sys

import numpy as np
import pytest
from lookups import look_up

import jaxsph as js
from jaxsph.model.transfer.maps import colormap

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
