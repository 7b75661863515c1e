"""Where a ray meets a surface, its normal and its light have the derivatives of an implicit function, in both modes."""

from __future__ import annotations

import copy
import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from derivatives import AGREE, QUICKLY, along, stepped, still
from surfaced import ball, view_of_ball

import jaxsph as js

STEP = 1e-6  # of a difference: so small that no other ray meets the surface
CLOSE = 1e-6  # of the sum of a slope's terms
OF_PARTICLES, OF_CAMERA = ("position", "support", "quantity", "volume"), ("eye", "axes", "half_height")
MOVED = (*OF_PARTICLES, "level", "smoothing", "color", "ambient", "opacity", *OF_CAMERA)


def interior(depth):
    """Rays whose neighbours meet the surface as well: silhouettes do not move in derivatives."""
    met = np.isfinite(np.asarray(depth))
    inner = met.copy()
    for shift in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        inner &= np.roll(met, shift, (0, 1))
    return inner


def fog():
    """A sheet of points in front of the ball."""
    grid = np.stack(np.meshgrid(np.linspace(-0.4, 0.4, 4), np.linspace(-0.4, 0.4, 4)), -1).reshape(-1, 2)
    position = np.concatenate([grid, np.full((16, 1), -0.7)], 1)
    return js.Points.from_arrays(position, np.full(16, 0.2), np.full((16, 3), 0.6), np.full(16, 1.0))


def directions(inputs, rng):
    """Named directions: each moves one part of the particles, the surface or the camera, as a share of it."""
    for name in MOVED:
        zero = list(still(inputs))
        for k, part in enumerate(inputs):
            if getattr(part, name, None) is not None:
                value = getattr(part, name)
                size = 1 if name in ("position", "quantity", "eye", "axes") else value
                move = size * jnp.asarray(rng.normal(size=np.shape(value)))
                zero[k] = copy.copy(zero[k])
                object.__setattr__(zero[k], name, move)  # a direction is not checked as a level is
        yield name, tuple(zero)


@pytest.mark.parametrize(
    ("kernel", "projection", "integrator", "coloured", "fogged", "opacity"),
    [
        ("poly6", "perspective", "samples", True, False, None),
        ("poly6", "perspective", "samples", False, False, 0.6),
        pytest.param("cubic_spline", "orthographic", "segments", False, False, None, marks=pytest.mark.slow),
        pytest.param("wendland_c2", "perspective", "samples", False, True, None, marks=pytest.mark.slow),
        pytest.param("cubic_spline", "orthographic", "segments", True, True, 0.55, marks=pytest.mark.slow),
    ],
)
def test_both_modes_are_central_differences_and_backward_another_program_finds_depths_again(
    kernel, projection, integrator, coloured, fogged, opacity, x64
):
    """As without an outer `jit`, where what goes backward is compiled by itself, and rounds otherwise."""
    look = js.TransferFunction.from_points(np.array([-0.5, 0.5]), np.array([[0.1, 0.5, 0.9], [0.9, 0.5, 0.1]]), np.ones(2))
    camera = view_of_ball(projection, dtype=np.float64)
    numbers = {"level": 0.45, "smoothing": 1.1, "color": np.array([0.4, 0.6, 0.8]), "ambient": 0.3}
    numbers |= {} if opacity is None else {"opacity": opacity}
    surface = js.Surface(**{name: jnp.asarray(value, jnp.float64) for name, value in numbers.items()})
    scene = js.Scene(
        particles=ball(kernel, np.float64),
        surface=surface,
        transfer=look if coloured else None,
        points=fog() if fogged else None,
    )
    settings = js.Settings(samples=40, integrator=integrator)
    plan = js.plan(scene, camera, settings)
    inputs, rng, checked = (scene.particles, surface, camera), np.random.default_rng(5), 0

    def seen(inputs, weights):
        particles, surface, camera = inputs
        image = js.render(dataclasses.replace(scene, particles=particles, surface=surface), camera, settings, plan=plan)
        depth = jnp.where(jnp.isfinite(image.depth), image.depth, 0)[..., None]
        return (jnp.concatenate([image.color, image.normal, depth], -1) * weights).sum(), image.depth

    @functools.partial(jax.jit, compiler_options=QUICKLY)
    def forward(inputs, move, weights):
        return jax.jvp(lambda inputs: seen(inputs, weights), (inputs,), (move,), has_aux=True)

    @functools.partial(jax.jit, compiler_options=QUICKLY)
    def linear(inputs, weights):
        return jax.vjp(lambda inputs: seen(inputs, weights)[0], inputs)[1]

    depth = forward(inputs, still(inputs), np.zeros((camera.height, camera.width, 7)))[2]
    inner = interior(depth)
    weights = rng.normal(size=(*inner.shape, 7)) * inner[..., None]
    backward = jax.jit(lambda pull, one: pull(one)[0], compiler_options=QUICKLY)
    gradient = backward(linear(inputs, weights), np.float64(1))
    for name, move in directions(inputs, rng):
        pushed = float(forward(inputs, move, weights)[1])
        ahead, behind = (forward(stepped(inputs, move, by), move, weights)[0] for by in (STEP, -STEP))
        pulled, size = along(gradient, move)
        assert abs(float(ahead - behind) / (2 * STEP) - pushed) <= CLOSE * max(size, 1), name
        assert abs(pulled - pushed) <= 1e3 * AGREE * max(size, 1), name
        checked += size > 1e-3
    assert checked >= 9 - coloured  # what a transfer function colours has no colour of its own


def test_on_control_points_both_modes_paint_with_the_slope_that_begins_there(x64):
    """Though backward the root is found again, a rounding away, and so is the quantity there."""
    rng, particles, camera = np.random.default_rng(2), ball("poly6", np.float64), view_of_ball(dtype=np.float64)
    halves = np.where(np.asarray(particles.position)[:, 0] > 0, 2 / 3, 1 / 3)
    look = js.TransferFunction.from_points(np.linspace(0, 1, 4), rng.uniform(0, 1, (4, 3)), np.ones(4))
    surface, settings = js.Surface(np.float64(0.45)), js.Settings(samples=40)
    scene = js.Scene(particles=dataclasses.replace(particles, quantity=halves), surface=surface, transfer=look)
    plan, weights = js.plan(scene, camera, settings), rng.normal(size=(camera.height, camera.width, 3))

    def seen(quantity):
        painted = dataclasses.replace(scene, particles=dataclasses.replace(particles, quantity=quantity))
        return (js.render(painted, camera, settings, plan=plan).color * weights).sum()

    @functools.partial(jax.jit, compiler_options=QUICKLY)
    def both(quantity, move):
        return jax.jvp(seen, (quantity,), (move,))[1], jax.grad(seen)(quantity)

    move = rng.normal(size=halves.shape)
    pushed, gradient = (np.asarray(one) for one in both(halves, move))
    assert abs(pushed - (gradient * move).sum()) <= 1e3 * AGREE * abs(gradient * move).sum()
