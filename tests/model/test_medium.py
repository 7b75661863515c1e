"""A medium of one's own is met where it is, by what it says of itself alone: its light, its shadow, and its derivatives."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from derivatives import QUICKLY

import jaxsph as js
from jaxsph.model.medium import Medium
from jaxsph.numerics.checks import array_of
from jaxsph.reference.where import ray_coordinates

STEP, CLOSE = 1e-6, 1e-6


@dataclasses.dataclass(frozen=True)
class Fog(Medium):
    """Everywhere the same, or what lies within a radius of a place in the world."""

    extinction_here: jax.Array
    color: jax.Array
    place: jax.Array
    radius: float = np.inf

    def seen_by(self, camera):
        return dataclasses.replace(self, place=camera.to_view(self.place))

    def occupied(self, slabs):
        return slabs.distance_to(*self.place) <= self.radius

    def extinction(self, gathered, task):
        square = sum((at - middle) ** 2 for at, middle in zip(task.positions(), self.place, strict=True))
        return jnp.where(square <= self.radius**2, self.extinction_here, 0), ()

    def colors(self, samples, task, channels):
        return [jnp.broadcast_to(color, task.shape) for color in list(self.color)[channels]]


jax.tree_util.register_dataclass(Fog, data_fields=["extinction_here", "color", "place"], meta_fields=["radius"])


def fog(extinction=0.7, color=(0.2, 0.5, 0.9), radius=np.inf, dtype=np.float32):
    return Fog(*(array_of(number, dtype) for number in (extinction, color, np.zeros(3))), radius)


def drawn(frames, camera, scene, *media):
    return js.render(with_media(frames, scene, *media), camera, frames.settings, plan=frames.plan())


def with_media(frames, scene, *media):
    """Without particles that could be seen, if there is no scene."""
    if scene is None:
        far_away = js.Particles.from_arrays([[0, 1e3, 0]], 0.5, 0.0, capacity=frames.capacity)
        scene = js.Scene(far_away, js.TransferFunction.from_points(np.linspace(0, 1, 5), np.ones((5, 3)), np.ones(5)))
    return dataclasses.replace(scene, media=media)


def through(camera, near, far):
    """Path lengths of all rays from one depth to another."""
    u, v = ray_coordinates(camera, np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    return (far - near) * (np.sqrt(1 + u**2 + v[:, None] ** 2) if camera.is_perspective else np.ones((len(v), len(u))))


@pytest.mark.parametrize("projection", ["perspective", "orthographic"])
def test_fog_everywhere_is_what_beer_and_lambert_say(frames, projection):
    camera = frames.camera(np.random.default_rng(0), projection)
    image = drawn(frames, camera, None, fog())
    left = np.exp(-0.7 * through(camera, float(camera.near), float(camera.far)))
    np.testing.assert_allclose(image.transmittance, left, rtol=1e-5)
    np.testing.assert_allclose(image.color, (1 - left)[..., None] * np.float32([0.2, 0.5, 0.9]), rtol=1e-5)
    assert image.stats["evaluations"] == 0


def test_media_that_share_samples_add_up(frames):
    """Three thin fogs of a colour are one, and so are those of several."""
    rng = np.random.default_rng(1)
    scene, camera = frames.scene(rng), frames.camera(rng)
    parts = fog(0.1, (0.9, 0.0, 0.3)), fog(0.2, (0.9, 0.9, 0.3)), fog(0.4, (0.9, 0.3, 0.3))
    mixed = fog(0.7, (0.9, (0.2 * 0.9 + 0.4 * 0.3) / 0.7, 0.3))
    several, one, none = (drawn(frames, camera, scene, *media) for media in (parts, (mixed,), ()))
    for layer in ("color", "transmittance"):
        np.testing.assert_allclose(getattr(several, layer), getattr(one, layer), atol=1e-6)
    assert np.abs(np.asarray(one.color) - np.asarray(none.color)).max() > 0.1
    assert several.stats["evaluations"] == none.stats["evaluations"]


@pytest.mark.parametrize("projection", ["perspective", "orthographic"])
def test_a_medium_that_is_somewhere_is_marched_only_there_and_missed_nowhere(frames, projection):
    """A ball that says so, and one that says it may be anywhere, are the same to the last bit."""
    camera = frames.camera(np.random.default_rng(2), projection)

    class Anywhere(Fog):
        def occupied(self, slabs):
            return slabs.z_lower <= slabs.z_upper

    jax.tree_util.register_dataclass(Anywhere, data_fields=["extinction_here", "color", "place"], meta_fields=["radius"])
    ball = fog(3.0, radius=0.4)
    anywhere = Anywhere(**{field.name: getattr(ball, field.name) for field in dataclasses.fields(ball)})
    found, wanted = (drawn(frames, camera, None, medium) for medium in (ball, anywhere))
    assert np.asarray(wanted.alpha).max() > 0.5 and (np.asarray(wanted.alpha) == 0).any()
    for layer in ("color", "transmittance", "depth"):
        np.testing.assert_array_equal(getattr(found, layer), getattr(wanted, layer))


@pytest.mark.slow
def test_a_medium_has_derivatives_in_both_modes(frames, x64):
    rng, plan = np.random.default_rng(3), frames.plan()
    scene, camera = frames.scene(rng, dtype=np.float64), frames.camera(rng, dtype=np.float64)
    cotangent = jnp.asarray(rng.normal(size=(frames.height, frames.width, 4)))

    def total(numbers):
        medium = fog(numbers["extinction"], numbers["color"], dtype=np.float64)
        view = dataclasses.replace(camera, half_height=numbers["half_height"])
        image = js.render(with_media(frames, scene, medium), view, frames.settings, plan=plan)
        return (jnp.concatenate([image.color, image.transmittance[..., None]], -1) * cotangent).sum()

    numbers = {"extinction": jnp.asarray(0.7), "color": jnp.asarray([0.2, 0.5, 0.9]), "half_height": camera.half_height}
    move = {name: jnp.asarray(rng.normal(size=value.shape)) for name, value in numbers.items()}
    move["half_height"] *= 0  # particles' supports meet other samples then, and colours jump

    def look(numbers, move):
        return *jax.jvp(total, (numbers,), (move,)), jax.grad(total)(numbers)

    look = jax.jit(look, compiler_options=QUICKLY)
    _, pushed, gradient = look(numbers, move)
    ahead, behind = (look(jax.tree.map(lambda x, d, by=by: x + by * d, numbers, move), move)[0] for by in (STEP, -STEP))
    slope = sum(float((gradient[name] * move[name]).sum()) for name in numbers)
    assert abs(slope) > 0.1
    assert slope == pytest.approx(float(pushed), rel=1e-10)
    assert slope == pytest.approx(float(ahead - behind) / (2 * STEP), rel=CLOSE)


@pytest.mark.slow
def test_fog_alone_has_derivatives_by_how_wide_the_view_is(frames, x64):
    """Rays are the longer the wider the view: a cotangent that a medium has by where its samples are, and by their paths."""
    rng, plan = np.random.default_rng(3), frames.plan()
    camera = frames.camera(rng, dtype=np.float64)
    scene, glow = with_media(frames, None), fog(dtype=np.float64)

    def total(half_height):
        view = dataclasses.replace(camera, half_height=half_height)
        return js.render(dataclasses.replace(scene, media=(glow,)), view, frames.settings, plan=plan).transmittance.sum()

    look = jax.jit(jax.value_and_grad(total), compiler_options=QUICKLY)
    slope = float(look(camera.half_height)[1])
    ahead, behind = (float(look(camera.half_height + by)[0]) for by in (STEP, -STEP))
    assert abs(slope) > 0.1 and slope == pytest.approx((ahead - behind) / (2 * STEP), rel=CLOSE)
