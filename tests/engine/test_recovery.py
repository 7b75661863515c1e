"""The words on gradients lead back to the scene: its own example with an optimiser, and a camera."""

import re
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import jaxsph as js

PAGE = (Path(__file__).parents[2] / "docs" / "gradients.md").read_text(encoding="utf-8")
STARTS = [(0.25, 0.0, 0.2), (-0.2, 0.15, 0.0), (0.1, -0.25, -0.2), (-0.1, -0.1, 0.3)]


def descended(of, unknown, steps, rate):
    """The loss and the unknown after some steps of Adam, none of which met a fault."""
    optimiser = optax.adam(optax.cosine_decay_schedule(rate, steps, alpha=0.01))

    @jax.jit
    def step(unknown, state):
        (value, image), slope = jax.value_and_grad(of, has_aux=True)(unknown)
        moves, state = optimiser.update(slope, state)
        return optax.apply_updates(unknown, moves), state, value, image.faults

    state, word = optimiser.init(unknown), 0
    for _ in range(steps):
        unknown, state, value, faults = step(unknown, state)
        word |= int(faults)
    assert not word
    return float(value), unknown


def losses_of_the_page(tmp_path, monkeypatch):
    """Of its example, smaller: the last loss."""
    monkeypatch.chdir(tmp_path)
    (block,) = re.findall(r"```python\n((?:(?!```).)*jax\.nn\.sigmoid.*?)```", PAGE, re.DOTALL)
    for many, few in (("20_000", "200"), ("256", "16"), ("128", "16")):
        block = block.replace(many, few)
    names = {}
    exec(compile(block, "gradients.md", "exec"), names)
    return descended(lambda unknown: names["loss"](*unknown), names["start"], 200, 0.2)[0]


def cameras_found():
    """From four starts, an eye: the last losses, and how far it is from where the picture was taken."""
    position = np.random.default_rng(0).uniform(-1, 1, (60, 3))
    look = js.TransferFunction.from_points([-1.0, 1.0], [(1.0, 0.2, 0.0), (0.0, 0.4, 1.0)], [0.3, 2.0])
    scene = js.Scene(particles=js.Particles.from_arrays(position, 0.4, position[:, 0]), transfer=look)
    settings, true = js.Settings(samples=16, integrator="segments"), np.array([0.3, 0.2, 5.0], np.float32)

    def seen_from(eye):
        return js.Camera.look_at(eye, (0.0, 0.0, 0.0), width=16, height=16, near=2.5, far=8.0)

    plan = js.plan(scene, seen_from(true), settings, headroom=2)
    target = js.render(scene, seen_from(true), settings, plan=plan).color

    def loss(eye):
        image = js.render(scene, seen_from(eye), settings, plan=plan)
        return ((image.color - target) ** 2).mean(), image

    found = [descended(loss, jnp.asarray(true + np.array(start, np.float32)), 150, 0.03) for start in STARTS]
    return [(value, float(np.linalg.norm(eye - true))) for value, eye in found]


@pytest.mark.slow
def test_the_example_of_the_readme_ends_where_it_is_told_to(tmp_path, monkeypatch):
    assert losses_of_the_page(tmp_path, monkeypatch) < 1e-4


@pytest.mark.slow
def test_a_camera_is_found_from_four_starts():
    found = cameras_found()
    assert all(value < 1e-5 and off < 0.02 for value, off in found), found
