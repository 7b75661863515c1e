"""Gradients of images by segments: borders of supports move between samples and over them, and what is seen moves with them."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from adversary import cameras, scenes
from derivatives import AGREE, CLOSE, QUICKLY, along, anyhow, differ, looked, pulled, still, total, towards, weights
from hypothesis import assume, given, settings
from hypothesis import strategies as st

import jaxsph as js
from jaxsph.access.lists import ListPlan
from jaxsph.cast.batches import CastPlan

CAPACITY = 6
RTOL = 1e-4
SETTINGS = js.Settings(samples=12, integrator="segments")
PLAN = js.Plan(8, 6, 12, CAPACITY, 3, 1, ListPlan(1, 1, 64, 256), CastPlan(8, 4, 16), 0, integrator="segments")


def of_segments(frames):
    """Settings and plan of the frames that other gradients are tested with."""
    plan = dataclasses.replace(frames.plan(), integrator="segments")
    return dataclasses.replace(frames.settings, integrator="segments"), plan


def turns(inputs, rng):
    """About all three axes: a tangent of rotations."""
    x, y, z = rng.normal(size=3)
    return {"axes": jnp.asarray([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ inputs[1].axes}


def moves(inputs, rng):
    """By name, what a scene and its camera are differentiated by."""
    names = "position", "support", "quantity", "volume", "values", "colors", "extinction", "eye"
    found = {name: anyhow(name)(inputs, rng) for name in names}
    return found | {"axes": turns(inputs, rng), "half_height": {"half_height": jnp.ones(())}}


def apart(inputs):
    """Whether no ray of the image only grazes a support: where its chord comes and goes there is no slope worth the name."""
    scene, camera = inputs
    view = np.asarray(camera.to_view(scene.particles.position))
    columns, rows = np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5
    u, v = np.meshgrid(np.asarray(camera.column(columns)), np.asarray(camera.row(rows)))
    ray = np.stack([u, v, np.ones_like(u)], -1).reshape(-1, 1, 3)
    foot = (ray * view).sum(-1, keepdims=True) / (ray**2).sum(-1, keepdims=True)
    away = np.linalg.norm(view - foot * ray, axis=-1)
    return (np.abs(away / np.asarray(scene.particles.support) - 1) > 1e-4).all()


def small(frames, rng):
    """Six particles with borders all over the image."""
    few = dataclasses.replace(frames, width=8, height=6, samples=12, capacity=CAPACITY)
    return few.scene(rng, decades=0.6, dtype=np.float64), few.camera(rng, dtype=np.float64)


def check(inputs, named, cotangent, asked, plan):
    """That both modes give the slope of differences in a direction."""
    move = towards(inputs, named)
    difference, pushed, gradient = differ(inputs, move, cotangent, asked, plan)
    slope, size = along(gradient, move)
    assert slope == pytest.approx(difference, rel=RTOL, abs=CLOSE * (1 + size)), list(named)
    assert pushed == pytest.approx(slope, abs=AGREE * (1 + size)), list(named)


@settings(max_examples=6)
@given(seed=st.integers(0, 2**32 - 1))
def test_gradients_are_those_of_differences_wherever_borders_are(frames, seed):
    """In directions in which all moves, and what a camera is made of."""
    with jax.enable_x64(True):
        rng = np.random.default_rng(seed)
        inputs, cotangent = small(frames, rng), jnp.asarray(rng.normal(size=(6, 8, 4)))
        assume(apart(inputs))
        parts = moves(inputs, rng)
        for names in (("position", "support", "quantity", "volume", "values", "colors", "extinction"), ("eye", "axes", "half_height")):
            check(inputs, {name: way for part in names for name, way in parts[part].items()}, cotangent, SETTINGS, PLAN)


@pytest.mark.slow
@pytest.mark.parametrize("projection", ["perspective", "orthographic"])
@pytest.mark.parametrize("kernel", ["poly6", "cubic_spline", "wendland_c2"])
def test_gradients_are_those_of_differences_for(frames, kernel, projection, x64):
    """By one after the other of all that there is."""
    rng = np.random.default_rng(len(kernel))
    inputs = frames.scene(rng, kernel, dtype=np.float64), frames.camera(rng, projection, dtype=np.float64)
    cotangent, asked = weights(rng, frames), of_segments(frames)
    for named in moves(inputs, rng).values():
        check(inputs, named, cotangent, *asked)
