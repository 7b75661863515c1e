"""Frames of any size are drawn, by every control: traced, as nothing else finds out whether shapes fit, and not compiled."""

from __future__ import annotations

import jax
import numpy as np
from examples import examples
from hypothesis import given, strategies as st

import jaxsph as js
from jaxsph.engine.runtime.tuning import ACCELERATOR, CPU

PILOT = {"tolerance": 0.01, "estimator": "pilot"}
CONTROLS = [
    PILOT,
    {},
    {"tolerance": 0.01},
    {"tolerance": 0.01, "super_pixels": False, "merge": False},
    {"tolerance": 0.1, "allocation": "greedy", "relax": 0.5},
    {"integrator": "segments"},
    {"integrator": "segments", "tolerance": 0.01},
    {"screen": "quadtree", "leaf_pixels": 32},
    {"screen": "quadtree", **PILOT},
    {"min_transmittance": 0.01},
]


@st.composite
def frames_of_any_size(draw):
    """One to 24 particles, supports from a hundredth of the view to ten times as much, and hardly any pixel or sample."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    count = draw(st.integers(1, 24))
    support = np.float32(10 ** rng.uniform(-2, 1.3, count if draw(st.booleans()) else 1)) * np.ones(count, np.float32)
    position, quantity = rng.uniform(-0.8, 0.8, (count, 3)).astype(np.float32), rng.uniform(0, 1, count).astype(np.float32)
    look = js.TransferFunction.from_points([0.0, 0.5, 1.0], np.eye(3), [3.0, 1.0, 2.0])
    scene = js.Scene(particles=js.Particles.from_arrays(position, support, quantity), transfer=look)
    size = {"width": draw(st.integers(1, 21)), "height": draw(st.integers(1, 18)), "near": 1.5, "far": 5.0}
    made = js.Camera.look_at if draw(st.booleans()) else js.Camera.orthographic
    settings = js.Settings(
        samples=draw(st.integers(1, 12) | st.integers(1, 64)), **draw(st.just(PILOT) | st.sampled_from(CONTROLS))
    )
    return scene, made((0, 0, 3.2), (0, 0, 0), **size), settings


@examples(10)
@given(frames_of_any_size(), st.sampled_from([CPU, ACCELERATOR]))
def test_every_control_draws_frames_of_any_size(frame, tuning):
    scene, camera, settings = frame
    plan = js.plan(scene, camera, settings, tuning=tuning)
    traced = jax.eval_shape(lambda *given: js.render(*given, settings, plan=plan), scene, camera)
    assert traced.color.shape == (camera.height, camera.width, 3)


def test_one_support_that_reaches_through_all_samples_is_drawn_by_the_pilot(quick_programs):
    """Eagerly: so few that a stencil of the lattice is longer."""
    particles = js.Particles.from_arrays(np.zeros((1, 3), np.float32), np.float32(2), np.float32([0.3]))
    look = js.TransferFunction.from_points([0.0, 1.0], [(1, 0, 0), (0, 0, 1)], [1.0, 2.0])
    camera = js.Camera.look_at((0, 0, 3), (0, 0, 0), width=7, height=5, near=1, far=5)
    scene = js.Scene(particles=particles, transfer=look)
    truth, image = (js.render(scene, camera, js.Settings(samples=7, **control)) for control in ({}, PILOT))
    assert abs(image.color - truth.color).max() <= PILOT["tolerance"]
