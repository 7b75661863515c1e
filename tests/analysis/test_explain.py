"""A pixel explained: sources add up to the error bound that the image tells, and the ray to the alpha that it shows."""

import dataclasses

import jax
import numpy as np
import pytest

import jaxsph as js
from jaxsph.analysis.explain import _filled_cells

pytestmark = pytest.mark.usefixtures("quick_programs")

SAMPLES = 96
ROUNDING = 1e-6
WAYS = {
    "full rate": ({}, set()),
    "bounds": ({"tolerance": 0.05, "estimator": "interval"}, {"super-pixels", "rounding"}),
    "levels": ({"tolerance": 0.2, "super_pixels": False}, {"coarse levels", "rounding"}),
    "pilot": ({"tolerance": 0.05, "estimator": "pilot"}, {"interpolation"}),
    "segments": ({"integrator": "segments", "tolerance": 0.02}, {"segments", "ended rays"}),
    "quadtree": ({"screen": "quadtree", "tolerance": 0.05, "estimator": "pilot"}, {"screen", "interpolation"}),
    "quadtree of segments": (
        {"screen": "quadtree", "tolerance": 0.05, "integrator": "segments"},
        {"screen", "segments", "ended rays"},
    ),
    "ended": ({"screen": "quadtree", "min_transmittance": 0.05}, {"screen", "ended rays"}),
}
SLOW = ("levels", "pilot", "quadtree", "quadtree of segments", "ended")
"""Ways whose programs take long to compile."""
MARKED = [pytest.param(name, marks=[pytest.mark.slow] * (name in SLOW)) for name in WAYS]


@pytest.fixture(scope="module")
def board():
    return js.scenes.load("checker_board", 400, width=64, height=48)


@pytest.fixture(scope="module")
def calm(board):
    """As the board, of wide supports and quantities that hardly differ: much of it is saved."""
    scene, camera = board
    particles = scene.particles
    quantity = 0.5 + 0.1 * (np.asarray(particles.quantity) - 0.5)
    particles = dataclasses.replace(particles, support=2 * np.asarray(particles.support), quantity=quantity)
    return dataclasses.replace(scene, particles=particles), camera


def explained(scene, camera, settings, number=3):
    """The image, and explanations of the pixel of the largest bound, of that of the least transmittance, and of others."""
    image = js.render(scene, camera, settings)
    bound, left = np.asarray(image.error_bound), np.asarray(image.transmittance)
    most = [np.unravel_index(place, bound.shape) for place in (np.nan_to_num(bound).argmax(), left.argmin())]
    more = np.random.default_rng(0).integers(0, bound.shape, (number, 2))
    return image, [js.explain(scene, camera, settings, pixel=(row, column)) for row, column in (*most, *more)]


@pytest.mark.parametrize("name", MARKED)
@pytest.mark.filterwarnings("ignore:.*too long for the tolerance")
def test_sources_add_up_to_the_bound_of_the_image_and_the_ray_to_its_alpha(board, calm, name):
    given, sources = WAYS[name]
    board = calm if name in ("bounds", "levels") else board
    image, made = explained(*board, js.Settings(samples=SAMPLES, **given))
    bound, left = np.asarray(image.error_bound, np.float64), np.asarray(image.transmittance, np.float64)
    full = js.render(*board, js.Settings(samples=SAMPLES))
    for one in made:
        assert one.total == bound[one.pixel] and one.certified == bool(image.certified)
        assert set(one.sources) == sources and min(one.sources.values(), default=0) >= 0
        assert sum(one.sources.values()) == pytest.approx(one.total, rel=1e-9, abs=1e-12)
        assert one.transmittance[-1] == pytest.approx(left[one.pixel], abs=bound[one.pixel] + ROUNDING)
        exact = np.append(np.asarray(full.color)[one.pixel], 1 - np.asarray(full.transmittance)[one.pixel])
        assert (one.lower <= exact).all() and (exact <= one.upper).all() and "alpha" in str(one)
        assert one.alpha == 1 - left[one.pixel] and np.array_equal(one.color, np.asarray(image.color)[one.pixel])
        lengths = {len(one.depth), len(one.quantity), len(one.extinction), len(one.transmittance)}
        assert len(lengths) == 1 and (np.diff(one.depth) >= 0).all()
    assert (max(one.total for one in made) > 0) == bool(sources)


def test_slabs_along_the_pixel_are_counted_by_what_they_were_given(calm):
    settings = js.Settings(samples=SAMPLES, **WAYS["bounds"][0])
    image, plan = js.render(*calm, settings), js.plan(*calm, settings)
    row, column = np.unravel_index(np.asarray(image.error_bound).argmax(), image.error_bound.shape)
    one = js.explain(*calm, settings, pixel=(row, column))
    np.testing.assert_array_equal(one.levels, np.asarray(image.levels)[:, row // 8, column // 8])
    assert len(one.levels) == -(-SAMPLES // plan.cast.slab_samples)
    (line,) = (line.split(maxsplit=1)[1] for line in str(one).split("\n") if line.startswith("slabs "))
    names = {0: "at full rate", 5: "of one colour", -1: "empty"}
    told = {name: int(number) for number, name in (part.split(" ", 1) for part in line.split(", "))}
    assert told == {names[level]: number for level, number in zip(*np.unique(one.levels, return_counts=True), strict=True)}
    assert "of one colour" in told


@pytest.mark.parametrize(("slab_samples", "cells"), [(4, 3), (8, 3), (16, 4)])
def test_cells_are_filled_where_a_slab_is(slab_samples, cells):
    levels = np.array([-1, 0, -1, -1, 5, 5, -1, -1, -1, -1, -1, -1, 0])
    assert _filled_cells(levels, slab_samples) == cells


@pytest.mark.slow
def test_what_is_interpolated_between_rays_is_the_share_of_the_screen(board):
    scene, camera = board
    thin = dataclasses.replace(scene.transfer, extinction=0.02 * scene.transfer.extinction)
    thin = dataclasses.replace(scene, transfer=thin)
    image, made = explained(thin, camera, js.Settings(samples=SAMPLES, screen="quadtree", tolerance=0.1), number=1)
    assert made[0].sources == {"screen": made[0].total} and made[0].total == np.asarray(image.error_bound).max() > 0


@pytest.mark.slow
def test_light_that_rays_let_through_where_they_ended_is_a_source(board):
    """Of small batches, as those of large images are."""
    scene, camera = board
    dark = dataclasses.replace(scene.transfer, extinction=30 * scene.transfer.extinction)
    scene, settings = dataclasses.replace(scene, transfer=dark), js.Settings(samples=SAMPLES, min_transmittance=0.2)
    plan = js.plan(scene, camera, settings)
    plan = dataclasses.replace(plan, cast=dataclasses.replace(plan.cast, chunk=8, batch_slabs=32))
    bound = np.asarray(js.render(scene, camera, settings, plan=plan).error_bound)
    row, column = np.unravel_index(bound.argmax(), bound.shape)
    one = js.explain(scene, camera, settings, pixel=(row, column), plan=plan)
    assert one.sources == {"ended rays": one.total} and one.total == bound.max() > 0
    assert one.total == pytest.approx(1 - one.alpha)


def test_of_several_bands_the_own_one_is_drawn_and_tells_the_same(board):
    scene, camera = board
    settings = js.Settings(samples=16, memory_limit=3 * js.plan(scene, camera, js.Settings(samples=16)).bytes // 4)
    assert js.plan(scene, camera, settings).bands > 1
    image = js.render(scene, camera, settings)
    for pixel in ((47, 20), (24, 20), (0, 0)):
        one = js.explain(scene, camera, settings, pixel=pixel)
        assert one.alpha == 1 - np.asarray(image.transmittance)[pixel] and one.half_depth == np.asarray(image.depth)[pixel]


def test_where_nothing_is_estimated_the_note_says_why(board):
    scene, camera = board
    one = js.explain(scene, camera, js.Settings(samples=SAMPLES, integrator="segments"), pixel=(20, 30))
    assert np.isinf(one.total) and np.isinf(list(one.sources.values())).all() and set(one.sources) == {"segments"}
    assert "give tolerance=" in one.note and one.note in str(one)
    full = js.explain(scene, camera, js.Settings(samples=SAMPLES), pixel=(20, 30))
    assert (full.total, full.sources) == (0, {}) and "full rate" in full.note


def test_what_samples_lose_against_the_light_integral_is_told_beside_the_budget(board):
    scene, camera = board
    truth = js.reference.integral(scene, camera, pixels=(np.array([20]), np.array([30])))
    coarse, fine = (js.explain(scene, camera, js.Settings(samples=samples), pixel=(20, 30)) for samples in (16, SAMPLES))
    for one in (coarse, fine):
        np.testing.assert_allclose(one.integral_color, truth.color[0], atol=2e-6)
        assert one.integral_alpha == pytest.approx(1 - truth.transmittance[0], abs=2e-6)
        off = [*(one.color - truth.color[0]), one.alpha - one.integral_alpha]
        assert one.off_integral == pytest.approx(np.abs(off).max(), abs=1e-5)
    assert coarse.off_integral > fine.off_integral > 1e-5 and f"{fine.off_integral:.2g} off" in str(fine)


def test_the_table_says_the_budget_the_ray_and_the_particles_that_add_most(board):
    scene, camera = board
    one = js.explain(scene, camera, js.Settings(samples=SAMPLES), pixel=(20, 30))
    text, most = str(one), one.particles[one.added.argmax()]
    assert text.startswith("pixel 20 30: colour") and f"\n  {most} " in text and f"{len(one.particles)} met" in text
    assert max(map(len, text.split("\n"))) <= 130 and len(repr(one).split("\n")) == 1
    assert one.extinction_quantity is None and one.levels is None


def test_a_figure_is_drawn_and_saved(board, tmp_path):
    pytest.importorskip("matplotlib")
    scene, camera = board
    for pixel in ((20, 30), (0, 0)):
        made = js.explain(scene, camera, js.Settings(samples=SAMPLES), pixel=pixel)
        labels = [axes.get_ylabel() for axes in made.figure("heat").get_axes()]
        assert labels[:3] == ["heat", "extinction", "transmittance"]
        made.save(tmp_path / f"{pixel[0]}.png", title="board")
        assert (tmp_path / f"{pixel[0]}.png").stat().st_size > 5000


def test_of_two_quantities_both_are_told_and_drawn(board):
    pytest.importorskip("matplotlib")
    scene, camera = board
    particles = dataclasses.replace(scene.particles, extinction_quantity=10 * np.asarray(scene.particles.quantity))
    values = 10 * np.asarray(scene.transfer.values)
    look = js.TransferFunction.from_points(scene.transfer.values, scene.transfer.colors, scene.transfer.extinction, values)
    two = js.explain(js.Scene(particles=particles, transfer=look), camera, js.Settings(samples=SAMPLES), pixel=(20, 30))
    one = js.explain(scene, camera, js.Settings(samples=SAMPLES), pixel=(20, 30))
    np.testing.assert_allclose(two.extinction_quantity, 10 * one.quantity, rtol=1e-5, atol=1e-6)
    assert two.transmittance[-1] == pytest.approx(one.transmittance[-1], abs=1e-5) and "of extinction" in str(two)
    assert len(two.figure().get_axes()[0].get_legend().get_texts()) == 2


@pytest.mark.parametrize("pixel", [(48, 0), (0, 64), (-1, 0), (0, -1)])
def test_pixels_that_the_image_does_not_have_are_refused_with_those_that_it_has(board, pixel):
    with pytest.raises(ValueError, match="`pixel` must have a row from 0 to 47 and a column from 0 to 63"):
        js.explain(*board, js.Settings(samples=SAMPLES), pixel=pixel)


@pytest.mark.parametrize("pixel", [(0.5, 1), 3, "12", (1, 2, 3), (None, 1)])
def test_what_is_no_pixel_is_refused(board, pixel):
    with pytest.raises(ValueError, match="`pixel` must be two integers"):
        js.explain(*board, js.Settings(samples=SAMPLES), pixel=pixel)


def test_what_is_traced_and_media_that_the_reference_does_not_know_are_refused(board):
    scene, camera = board
    with pytest.raises(ValueError, match="concrete"):
        jax.jit(lambda scene: js.explain(scene, camera, pixel=(0, 0)).total)(scene)
    volume = js.Volume.from_array(np.random.default_rng(0).random((3, 3, 3), np.float32), (0, 0, 0), 0.4)
    surface = js.IsoSurface.from_volume(volume, 0.5)
    with pytest.raises(ValueError, match="media"):
        js.explain(dataclasses.replace(scene, media=(surface,)), camera, pixel=(0, 0))
