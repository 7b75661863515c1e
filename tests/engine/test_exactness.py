"""What holds to the bit, or to a stated multiple of eps: the same input twice, order and halves of particles, constants."""

import dataclasses
import itertools

import numpy as np
import pytest
from extreme import EPS, Extreme
from images import layers

import jaxsph as js
from jaxsph.numerics.checks import array_of


def test_the_same_input_gives_the_same_bits_eager_and_jitted(frames, traced):
    scene, camera = Extreme(decades=4).scene(frames), Extreme().camera(frames)
    for render in (traced, lambda *frame, plan: js.render(*frame, frames.settings, plan=plan)):
        first, second = (render(scene, camera, plan=frames.plan()) for _ in range(2))
        assert all(np.array_equal(getattr(first, name), getattr(second, name)) for name in ("color", "transmittance", "depth"))


@pytest.mark.core
def test_the_order_of_particles_changes_a_pixel_by_rounding_alone(frames):
    scene, camera = Extreme(decades=4).scene(frames), Extreme().camera(frames)
    image = js.render(scene, camera, frames.settings, plan=frames.plan())
    for seed in range(4):
        order = np.random.default_rng(seed).permutation(frames.capacity)
        shuffled = dataclasses.replace(scene, particles=scene.particles.at(order))
        other = js.render(shuffled, camera, frames.settings, plan=frames.plan())
        assert np.abs(layers(other) - layers(image)).max() <= 4 * EPS


@pytest.mark.parametrize("length", [1e-6, 1.0, 1e8])
def test_a_constant_quantity_gives_the_bits_of_a_constant_transfer_function(frames, length):
    """At a control point: nothing of the CSPH quotient is left, whatever the supports."""
    extreme = Extreme(length=length, decades=4.3, volume="equal")
    scene, camera = extreme.scene(frames), extreme.camera(frames)
    transfer = scene.transfer
    values, colors, extinction = map(np.asarray, (transfer.values, transfer.colors, transfer.extinction))
    for i in (0, 2, 4):
        quantity = np.full_like(scene.particles.quantity, values[i])
        constant = dataclasses.replace(scene, particles=dataclasses.replace(scene.particles, quantity=quantity))
        flat = dataclasses.replace(
            transfer, colors=np.broadcast_to(colors[i], (5, 3)), extinction=np.broadcast_to(extinction[i], (5,))
        )
        image, same = (
            js.render(s, camera, frames.settings, plan=frames.plan())
            for s in (constant, dataclasses.replace(scene, transfer=flat))
        )
        assert np.array_equal(image.color, same.color) and np.array_equal(image.transmittance, same.transmittance)
        alpha, color = 1 - np.asarray(image.transmittance, np.float64), colors[i].astype(np.float64)
        assert np.abs(np.asarray(image.color, np.float64) - alpha[..., None] * color).max() <= 2 * EPS


ROUNDING = (
    1e-4  # of pictures in float32, what a sample that is moved by some eps changes; a side of a jump changes a hundred times that
)


def jumping(scene, nth):
    """With a jump at a control point; its value, and the numbers beside it."""
    values = np.array(scene.transfer.values)
    values[nth - 1] = values[nth]
    transfer = dataclasses.replace(scene.transfer, values=array_of(values))
    value = values[nth]
    return dataclasses.replace(scene, transfer=transfer), np.array([value, np.nextafter(value, 0), np.nextafter(value, 1)])


@pytest.mark.parametrize("settings", [{}, {"tolerance": 0.01}], ids=["full rate", "bounds"])
def test_quantities_at_a_jump_are_right_or_uncertified(frames, settings):
    scene, camera = Extreme().scene(frames), Extreme().camera(frames)
    asked, doubted = dataclasses.replace(frames.settings, **settings), []
    for seed, nth in enumerate((1, 2, 4)):
        rng, (jumps, beside) = np.random.default_rng(seed), jumping(scene, nth)
        alike, mixed = np.full(frames.capacity, beside[seed]), rng.choice([*beside, 0.9], frames.capacity)
        for quantity in (alike, mixed):
            particles = dataclasses.replace(scene.particles, quantity=array_of(quantity.astype(np.float32)))
            labelled = dataclasses.replace(jumps, particles=particles)
            image, truth = js.render(labelled, camera, asked), js.reference.render(labelled, camera, frames.settings)
            off = np.abs(layers(image) - layers(truth)).max(-1)
            assert (off <= np.asarray(image.error_bound) + ROUNDING).all()
            assert bool(image.certified) == bool(np.isfinite(image.error_bound).all())
            doubted.append(not image.certified)
    assert doubted == [False, True] * 3


@pytest.mark.core
def test_a_uniform_medium_obeys_beer_lambert(frames):
    """One support far larger than the view; and many of equal quantity that fill it. Optical depths from 1e-3 to 1e3."""
    rng = np.random.default_rng(0)
    one = js.Particles.from_arrays(np.zeros((1, 3)), 1e4, 0.5, capacity=frames.capacity)
    many = js.Particles.from_arrays(rng.uniform(-1, 1, (frames.capacity, 3)), rng.uniform(9, 20, frames.capacity), 0.5)
    for particles, depth in itertools.product((one, many), 10 ** rng.uniform(-3, 3, 12)):
        near, length = rng.uniform(0.1, 2), rng.uniform(0.1, 5)
        transfer = js.TransferFunction.from_points(np.linspace(0, 1, 5), np.ones((5, 3)), np.full(5, depth / length))
        size = {"width": frames.width, "height": frames.height, "view_height": 2.5, "near": near, "far": near + length}
        camera = js.Camera.orthographic((0, 0, 3), (0, 0, 0), **size)
        image = js.render(js.Scene(particles=particles, transfer=transfer), camera, frames.settings, plan=frames.plan())
        exact = np.exp(-float(transfer.extinction[0]) * (float(camera.far) - float(camera.near)))
        assert np.abs(np.asarray(image.transmittance, np.float64) - exact).max() <= 4 * EPS
        assert np.abs(np.asarray(image.color, np.float64) - (1 - exact)).max() <= 4 * EPS
        half = near + np.log(2) * length / depth if exact < 0.5 else np.inf
        np.testing.assert_allclose(image.depth, half, rtol=1e-5)


def test_a_particle_split_in_two_of_half_the_volume_changes_rounding_alone(frames):
    scene, camera = Extreme(decades=4).scene(frames), Extreme().camera(frames)
    parts = {name: np.asarray(getattr(scene.particles, name))[:12] for name in ("position", "support", "quantity", "volume")}
    whole = js.Particles.from_arrays(**parts, capacity=frames.capacity)
    halves = js.Particles.from_arrays(
        **{name: np.repeat(value, 2, 0) for name, value in parts.items()} | {"volume": parts["volume"].repeat(2) / 2}
    )
    one, two = (
        layers(js.render(dataclasses.replace(scene, particles=particles), camera, frames.settings, plan=frames.plan()))
        for particles in (whole, halves)
    )
    assert np.abs(one - two).max() <= 4 * EPS
