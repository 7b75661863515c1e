"""Two fluids that orbit a centre: dense as they were, at the distance they had."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from jaxsph import scenes
from jaxsph.scenes.analytic import BALL, ball, orbited


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
