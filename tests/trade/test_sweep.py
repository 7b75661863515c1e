"""The sweep: errors are those of the images, the table is kept, the figures are drawn."""

import csv
import dataclasses
import importlib
import types
from unittest import mock

import numpy as np
import pytest
from derivatives import QUICKLY

import jaxsph as js
from jaxsph.engine.runtime import programs
from jaxsph.plot import sweep_figures as figures
from jaxsph.trade.sweep import (
    BASELINES,
    COLUMNS,
    ESTIMATORS,
    TABLE,
    baseline,
    contenders,
    integral_at,
    of_frame,
    scaled_up,
    suitable,
    write_table,
)

pytestmark = pytest.mark.usefixtures("quick_programs")

PARTICLES, WIDTH, HEIGHT, SAMPLES = 2000, 40, 33, 16
CHOSEN = {"tolerances": (0.02, 0.3), "estimators": ("interval", "interval relaxed"), "baselines": ("samples/2",)}
ONCE = {"repeats": 1, "converged": 1, "integral": 0}
SETTINGS, POINTS_8, POINTS_4 = (js.Settings(samples=samples, integrator="samples") for samples in (SAMPLES, 8, 4))


@pytest.fixture(scope="module")
def view():
    return js.scenes.load("radial", PARTICLES, width=WIDTH, height=HEIGHT)


@pytest.fixture(scope="module")
def tiny():
    return js.scenes.load("radial", 20, width=8, height=8)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("sweep")


@pytest.fixture(scope="module")
def rows(view, folder):
    with mock.patch.object(programs, "OF_ALL", QUICKLY):  # as tests have them
        return js.sweep(*view, SETTINGS, **CHOSEN, **ONCE, name="radial", folder=folder)


def layers(image):
    return np.concatenate([np.asarray(image.color, np.float64), np.asarray(image.alpha, np.float64)[..., None]], -1)


def test_there_is_a_row_for_every_setting_full_rate_first(rows):
    expected = [("full rate", None), ("samples/2", None)]
    expected += [(name, tolerance) for name in CHOSEN["estimators"] for tolerance in CHOSEN["tolerances"]]
    assert [(row["method"], row["tolerance"]) for row in rows] == expected
    size = (PARTICLES, WIDTH, HEIGHT, SAMPLES)
    assert {(row["particles"], row["width"], row["height"], row["samples"]) for row in rows} == {size}
    assert all(row["repeats"] == 1 and row["dtype"] == "float32" and row["jaxsph"] == js.__version__ for row in rows)


def test_errors_are_the_differences_of_the_images(view, rows):
    scene, camera = view
    settings = SETTINGS
    asked = settings, dataclasses.replace(settings, samples=SAMPLES // 2), dataclasses.replace(settings, tolerance=0.3, relax=1.0)
    full, coarse, relaxed = (js.render(scene, camera, one, plan=js.plan(scene, camera, one)) for one in asked)
    error = np.abs(layers(coarse) - layers(full)).max(-1)
    row = rows[1]
    assert row["max_error"] == pytest.approx(error.max(), abs=1e-7) and row["mean_error"] == pytest.approx(error.mean(), abs=1e-7)
    assert (row["evaluations"], row["evaluations_full"]) == (coarse.stats["evaluations"], full.stats["evaluations"])
    assert rows[0]["max_error"] == 0 and rows[0]["evaluations"] == rows[0]["evaluations_full"]
    away, row = np.abs(layers(relaxed) - layers(full)).max(-1), rows[-1]
    assert row["max_error"] == pytest.approx(away.max(), abs=1e-7) and row["over_tolerance"] == (away > 0.3).mean()
    assert row["max_bound"] == np.asarray(relaxed.error_bound).max() and row["evaluations"] == relaxed.stats["evaluations"]


def test_certified_settings_keep_their_word(rows):
    certified = [row for row in rows if row["certified"]]
    assert [row["method"] for row in certified] == ["interval"] * 2
    for row in certified:
        assert row["max_error"] <= row["max_bound"] <= row["tolerance"] and row["over_tolerance"] == row["over_bound"] == 0


def test_the_converged_image_has_that_many_times_the_samples(view, rows):
    """Half the samples against twice as many is what `samples/2` is against full rate."""
    few = dataclasses.replace(SETTINGS, samples=SAMPLES // 2)
    (half,) = js.sweep(*view, few, estimators=(), baselines=(), **ONCE | {"converged": 2})
    assert half["max_error"] == 0 and half["max_error_converged"] == pytest.approx(rows[1]["max_error"], abs=1e-7)
    assert half["mean_error_converged"] == pytest.approx(rows[1]["mean_error"], abs=1e-7)


def test_stages_add_up_and_compiling_is_apart(rows):
    for row in rows:
        stages = row["grid"] + row["adapt"] + row["cast"] + row["image"]
        assert row["total"] == pytest.approx(stages)  # of one turn the median is the turn
        assert row["deviation"] == 0 and row["bytes"] > 0


def test_estimators_are_those_that_suit_full_rate():
    assert suitable(SETTINGS) == tuple(ESTIMATORS)
    assert suitable(js.Settings(integrator="segments")) == ("segments",)
    groups = contenders(SETTINGS, (0.1,), None, ())
    kept = {group[0].method: group[0].is_against_integral for group in groups}
    assert kept == {"full rate": False, "interval": False, "interval relaxed": False, "pilot": False, "segments": True}


@pytest.fixture
def by_reference(monkeypatch):
    """The reference renderer in place of the fast one: nothing is compiled. Gives the settings and sizes it was asked for."""
    module, calls = importlib.import_module("jaxsph.trade.sweep"), []

    def render(scene, camera, settings, *, plan=None):
        calls.append((settings.tolerance, camera.width))
        image = js.reference.render(scene, camera, settings)
        seconds = dict.fromkeys(("plan", "compile", "grid", "adapt", "cast", "image"), 1.0)
        return dataclasses.replace(image, stats=image.stats | {"seconds": seconds})

    monkeypatch.setattr(module, "render", render)
    monkeypatch.setattr(module, "make_plan", lambda *_: types.SimpleNamespace(bytes=1))
    return calls


def test_smaller_images_are_scaled_up_before_they_are_compared(by_reference):
    scene, camera = js.scenes.load("radial", 50, width=24, height=16)
    settings = POINTS_8
    full, half = js.sweep(scene, camera, settings, estimators=(), baselines=("size/2",), **ONCE)
    small = js.reference.render(scene, dataclasses.replace(camera, width=12, height=8), settings)
    expected = np.abs(scaled_up(layers(small), camera) - layers(js.reference.render(scene, camera, settings))).max(-1)
    assert half["max_error"] == expected.max() > 0 and half["mean_error"] == expected.mean()
    assert half["evaluations"] < full["evaluations"] == half["evaluations_full"]
    assert half["image"] > full["image"] and half["certified"] is False and half["max_bound"] is None


def test_each_group_takes_turns_with_full_rate(tiny, by_reference):
    chosen = {"tolerances": (0.1, 0.2), "estimators": ("pilot",), "baselines": ("size/2",), "repeats": 2, "integral": 0}
    rows = js.sweep(*tiny, POINTS_4, **chosen)
    truths, turns = [(None, 8)] * 2, [(None, 8), (0.1, 8), (0.2, 8)]
    assert by_reference == [*truths, (None, 4), *[(None, 8), (None, 4)] * 2, (0.1, 8), (0.2, 8), *turns * 2]
    assert all(row["full_total"] == 4 and row["repeats"] == 2 for row in rows)


def test_errors_to_the_integral_are_of_every_row_and_tolerances_of_segments_are_held_against_it(tiny, by_reference):
    chosen = {"tolerances": (0.01,), "estimators": ("pilot", "segments"), "baselines": ("samples/2",), **ONCE}
    steps = []
    more = {"integral": 64, "progress": lambda done, total: steps.append((done, total))}
    rows = js.sweep(*tiny, POINTS_8, **chosen | more)
    truth = layers(js.reference.integral(*tiny))
    images = [layers(js.reference.render(*tiny, one)) for one in (POINTS_8, POINTS_4)]
    full, half = (np.abs(image - truth).max(-1) for image in images)
    for row, error in zip(rows, (full, half, full, full), strict=True):  # here all but the second are full rate
        expected = (error.mean(), np.quantile(error, 0.999), error.max())
        assert (row["integral_mean"], row["integral_p999"], row["integral_max"]) == pytest.approx(expected, abs=2e-6)
    _, _, pilot, segments = rows
    assert pilot["over_tolerance"] == pilot["over_bound"] == 0
    assert segments["over_tolerance"] == (full > 0.01).mean() > 0 and segments["over_bound"] == (full > 0).mean()
    assert steps[-1][0] == steps[-1][1] == len(steps)
    without = js.sweep(*tiny, POINTS_8, **chosen)[-1]
    assert without["integral_max"] is without["over_tolerance"] is without["over_bound"] is None


def test_errors_to_the_integral_are_differences_of_each_pixel(tiny):
    truth, image = js.reference.integral(*tiny, tolerance=1e-8), js.reference.render(*tiny, POINTS_8)
    expected = np.abs(layers(image) - layers(truth)).max(-1)
    pixels, light = integral_at(*tiny, 20)
    errors = np.abs(layers(image)[pixels] - light).max(-1)
    assert errors == pytest.approx(expected[pixels], abs=2e-6) and errors.max() > 1e-3


def test_pixels_are_different_ones_all_over_the_image_and_always_the_same(tiny):
    (pixels, light), (again, once_more) = integral_at(*tiny, 20), integral_at(*tiny, 20)
    assert len(set(zip(*pixels, strict=True))) == 20
    assert (np.array(pixels) == np.array(again)).all() and (light == once_more).all()
    everywhere, _ = integral_at(*tiny, 10 * 64)
    assert len(set(zip(*everywhere, strict=True))) == 64


def test_of_no_pixels_and_of_media_that_are_unknown_there_is_none(tiny):
    scene, camera = tiny
    assert integral_at(scene, camera, 0) is None
    x = np.linspace(-1, 1, 4)
    surface = js.IsoSurface.from_volume(
        js.Volume.from_array(x[:, None, None] + np.zeros((4, 4, 4)), (-1, -1, -1), 0.5), level=0.1
    )
    assert integral_at(dataclasses.replace(scene, media=(surface,)), camera, 5) is None


def test_frames_share_a_plan_until_one_outgrows_it(by_reference, monkeypatch):
    module = importlib.import_module("jaxsph.trade.sweep")
    views = [js.scenes.load("letters", 20, frame, width=8, height=8) for frame in range(3)]
    made, fits = [], module.render

    def render(scene, camera, settings, *, plan):
        if scene is views[2][0] and plan.bytes <= 2:
            raise js.CapacityError("too small")
        return fits(scene, camera, settings, plan=plan)

    monkeypatch.setattr(module, "render", render)
    monkeypatch.setattr(module, "make_plan", lambda *_: made.append(None) or types.SimpleNamespace(bytes=len(made)))
    rows = js.sweep(*zip(*views, strict=True), POINTS_4, estimators=(), baselines=(), **ONCE | {"converged": 2})
    assert [(row["frame"], row["bytes"]) for row in rows] == [(0, 2), (1, 2), (2, 4)]  # 1 and 3 are the converged image's


def test_rows_of_groups_that_were_done_outlive_an_interruption(tiny, by_reference, tmp_path, monkeypatch):
    chosen = {"tolerances": (0.1,), "estimators": ("pilot",), "baselines": (), "repeats": 1, "integral": 0, "folder": tmp_path}

    def stop(done, total):
        if done == total:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        js.sweep(*tiny, POINTS_4, **chosen, progress=stop)
    assert [row["method"] for row in csv.DictReader((tmp_path / TABLE).open())] == ["full rate"]


def test_other_data_is_another_measurement(view):
    scene, camera = view
    settings = SETTINGS
    moved = dataclasses.replace(scene.particles, quantity=scene.particles.quantity + 1e-3)
    nearer = dataclasses.replace(camera, near=camera.near * 0.9)
    wider = dataclasses.replace(camera, width=WIDTH + 1)
    variants = [(scene, camera, settings, 8), (dataclasses.replace(scene, particles=moved), camera, settings, 8)]
    variants += [(scene, nearer, settings, 8), (scene, wider, settings, 8), (scene, camera, settings, 4)]
    variants += [(scene, camera, dataclasses.replace(SETTINGS, merge=False), 8)]
    digests = [of_frame(*variant)["fingerprint"] for variant in variants]
    assert len(set(digests)) == len(variants) and digests[0] == of_frame(*view, settings, 8)["fingerprint"]


def test_the_csv_is_the_same_table(rows, tmp_path):
    write_table(tmp_path / TABLE, rows)
    with open(tmp_path / TABLE, newline="") as file:
        found = list(csv.DictReader(file))
    assert tuple(found[0]) == COLUMNS and len(found) == len(rows)
    for got, row in zip(found, rows, strict=True):
        assert got["method"] == row["method"] and float(got["max_error"]) == row["max_error"]
        assert got["tolerance"] == ("" if row["tolerance"] is None else str(row["tolerance"]))


def test_a_smaller_image_is_read_where_its_rays_pass():
    """A ramp over the view is reproduced by fewer pixels of another aspect, but for the border that they do not reach."""
    camera = js.Camera.look_at((0, 0, 5), (0, 0, 0), width=40, height=33, near=1, far=2)
    small = baseline(js.Settings(), "size/2").camera(camera)
    assert (small.width, small.height) == (20, 17)

    def ramp(view):
        across = (2 * (np.arange(view.width) + 0.5) / view.width - 1) * view.width / view.height
        down = 2 * (np.arange(view.height) + 0.5) / view.height - 1
        return np.stack(np.broadcast_arrays(across[None], down[:, None], 0.0, 1.0), -1)

    inner = np.s_[2:-2, 2:-2]
    assert scaled_up(ramp(small), camera)[inner] == pytest.approx(ramp(camera)[inner], abs=1e-12)
    assert scaled_up(ramp(camera), camera) is not None and (scaled_up(ramp(camera), camera) == ramp(camera)).all()
    made = [baseline(js.Settings(), name) for name in BASELINES]
    assert [one.shrink for one in made] == [1, 1, 1, 1, 2, 4]
    assert [one.settings.samples for one in made] == [128, 64, 256, 64, 256, 256]
    assert [one.settings.integrator_used for one in made[:4]] == ["samples"] * 2 + ["segments"] * 2
    assert baseline(js.Settings(), "segments") == made[2]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"estimators": ("exact",)}, "'interval', 'interval relaxed', 'pilot', 'segments', got 'exact'"),
        (
            {"estimators": ("pilot",), "settings": js.Settings(integrator="segments")},
            "'pilot'.*full rate of point samples.*integrator='segments'",
        ),
        ({"baselines": ("pixels/2",)}, "'samples/2', 'segments', 'segments/2' or 'size/4', got 'pixels/2'"),
        ({"integral": -1}, "`integral` must be an integer of at least 0, got -1"),
        ({"baselines": ("size/0",)}, "got 'size/0'"),
        ({"tolerances": (-1.0,)}, "`tolerance` must be >= 0"),
        ({"repeats": 0}, "`repeats` must be an integer of at least 1, got 0"),
        ({"converged": 0}, "`converged` must be"),
        ({"settings": js.Settings(tolerance=0.1)}, "give `tolerances` instead"),
        ({"frames": (1, 2)}, "1 different numbers"),
    ],
)
def test_bad_arguments_are_named(view, arguments, message):
    with pytest.raises(ValueError, match=message):
        js.sweep(*view, **arguments)
    with pytest.raises(ValueError, match="must pair, got 2 and 1"):
        js.sweep([view[0]] * 2, view[1])
    with pytest.raises(TypeError, match="`sweep` has no argument `turns`; others that it has are repeats, converged, integral"):
        js.sweep(*view, turns=2)


def test_the_front_holds_what_nothing_beats():
    errors, seconds = [0.1, 0.01, 0.1, 0.001, 0.0, 0.5], [1.0, 2.0, 0.5, 3.0, 9.0, 0.5]
    assert figures.pareto_front(errors, seconds) == [4, 3, 1, 2]
    assert figures.pareto_front([], []) == []


def test_scenes_are_not_drawn_over_each_other(rows, tmp_path):
    pytest.importorskip("matplotlib")
    with pytest.raises(ValueError, match="one scene, got mixer, radial; draw each on its own"):
        figures.draw([*rows, dict(rows[0], scene="mixer")], tmp_path)
    with pytest.raises(ValueError, match="got nothing"):
        figures.draw([], tmp_path)
    assert not list(tmp_path.iterdir())


def test_a_figure_of_a_sequence_sums_its_frames_up(rows):
    pytest.importorskip("matplotlib")
    later = [dict(row, frame=1.0, max_error=row["max_error"] + 1, total=2.0, full_total=4.0) for row in rows]
    points = figures.summary([*rows, *later])
    assert [point["error"] for point in points] == [row["max_error"] + 1 for row in rows]
    assert [point["time"] for point in points] == pytest.approx([(row["total"] + 2) / (row["full_total"] + 4) for row in rows])


@pytest.mark.parametrize("least", [0.0, 0.0003])
def test_the_figure_of_errors_shows_each_where_it_can_be_told_from_others(rows, least):
    """Whether or not some are zero: from the least to the tolerance they take up a good part of the axis."""
    pytest.importorskip("matplotlib")
    wrong = [row if row["tolerance"] is None else dict(row, max_error=least, max_bound=0.001) for row in rows]
    (axis,) = figures._error(figures.summary(wrong), "a title").axes
    bottom, top = axis.get_ylim()
    lowest = max(least, figures.MIN_SHOWN)
    assert lowest / 10 < bottom < lowest < max(CHOSEN["tolerances"]) < top


def test_errors_of_segments_are_drawn_against_the_integral_where_it_was_taken(rows, tmp_path):
    pytest.importorskip("matplotlib")
    taken = {"integral_mean": 0.001, "integral_p999": 0.01, "integral_max": 0.02}
    more = [dict(row, method="segments", **taken) for row in rows if row["method"] == "interval"]
    points = figures.summary([*rows, *more])
    assert [point["kept"] for point in points[-2:]] == [0.02] * 2 and points[2]["kept"] == rows[2]["max_error"]
    (axis,) = figures._error(points, "a title").axes
    assert "segments: the light integral" in axis.get_ylabel()
    shown = figures._time_over_error(points, "a title", figures.AGAINST_INTEGRAL).axes[1]
    assert shown.get_xlabel() == "largest error, against the light integral"
    assert "segments" in shown.get_legend_handles_labels()[1]
    unknown = figures.summary([*rows, *(dict(row, integral_max=None) for row in more)])
    assert "segments" not in str(figures._error(unknown, "a title").axes[0].get_legend_handles_labels())
    far_off = [dict(point, kept=5.0) for point in points]
    assert figures._error(far_off, "a title").axes[0].get_ylim()[1] > 5
    assert [path.name for path in figures.draw(rows, tmp_path)] == ["error.png", "pareto.png"]
