"""Two fluids that orbit a centre stay dense, at the distance they had; letters fall freely, splash, and stay in their basin."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from jaxsph import scenes
from jaxsph.scenes.analytic import BALL, BASIN, GLYPHS, GRAVITY, SECONDS_PER_FRAME, STROKE, area, ball, distance, orbited


def test_orbits_keep_distance_and_frame_zero_is_the_start():
    start = np.random.default_rng(0).normal(size=(300, 3))
    assert orbited(start, 0.0) == pytest.approx(start)
    for frame in (0.3, 8.0, 100.0):
        assert np.linalg.norm(orbited(start, frame), axis=1) == pytest.approx(np.linalg.norm(start, axis=1))


def test_the_flow_keeps_volume():
    place, step = np.random.default_rng(1).uniform(-1, 1, (200, 3)), 1e-5
    moved = [(orbited(place + d, 5.0) - orbited(place - d, 5.0)) / (2 * step) for d in step * np.eye(3)]
    assert np.linalg.det(np.stack(moved, -1)) == pytest.approx(1, abs=1e-6)


def test_each_fluid_is_a_ball_at_first_and_sheets_later():
    points = ball(2000, 0)
    assert np.linalg.norm(points, axis=1).max() == pytest.approx(BALL, rel=0.05)
    contact = []
    for frame in (0, 8):
        particles = scenes.load("flubber", 4000, frame)[0].particles
        position, fluid = (particles.to_numpy()[name] for name in ("position", "quantity"))
        assert (fluid == 0).sum() == (fluid == 1).sum() == 2000
        away, _ = cKDTree(position[fluid == 0]).query(position[fluid == 1])
        contact.append((away < 0.1).mean())
    assert contact[1] > 2 * contact[0]


def columns(frame, count=4000):
    columns = scenes.load("letters", count, frame)[0].particles.to_numpy()
    return columns["position"].astype(np.float64), columns["quantity"]


def test_dye_tells_the_letters_apart_and_shares_are_those_of_their_volumes():
    _, dye = columns(0)
    values, counts = np.unique(dye, return_counts=True)
    assert values == pytest.approx([0, 1 / 3, 2 / 3, 1])
    assert counts[1:] / counts[1] == pytest.approx([area(name) / area("S") for name in GLYPHS], rel=0.02)


def test_letters_fall_freely_until_they_meet_the_water():
    start, dye = columns(0)
    for frame in (0.5, 1.5, 2.0):
        place, _ = columns(frame)
        drop = GRAVITY / 2 * (frame * SECONDS_PER_FRAME) ** 2
        dry = (dye > 0) & (start[:, 1] - drop > BASIN[1][1] + 0.02)
        assert dry.sum() > 500 and place[dry] == pytest.approx(start[dry] - (0, drop, 0), abs=1e-5)


def test_what_has_met_the_water_is_thrown_up_or_sinks_and_stays_between_the_walls():
    start, dye = columns(0)
    surface = BASIN[1][1]
    for frame in (4.0, 7.0, 30.0):
        place, _ = columns(frame)
        for axis in (0, 2):
            assert (place[:, axis] >= BASIN[0][axis] - 1e-6).all() and (place[:, axis] <= BASIN[1][axis] + 1e-6).all()
        assert (place[:, 1] >= 0).all() and place[:, 1].max() < start[:, 1].max()
        rising = (place[:, 1] > 1.8 * surface) & (dye > 0)
        assert rising.any() == (frame < 30)
    assert place[:, 1].max() < 2 * surface  # at rest, in a basin that is fuller by what fell into it


def test_a_face_is_as_large_as_its_strokes():
    bar = np.array([[0.3, 0.5], [0.3, 0.5 + STROKE], [0.3, 1.0]])
    assert distance(bar, "H") == pytest.approx([0, STROKE, 0.3])
    assert area("H") == pytest.approx(2 * (2 * STROKE + np.pi * STROKE**2) + (0.6 - 2 * STROKE) * 2 * STROKE, rel=0.02)
