"""A medium of one's own is met where it is, by what it says of itself alone: its light, and its shadow."""

from __future__ import annotations

import dataclasses

import jax
import numpy as np
import pytest
from images import same_bits
from rows import Fog

import jaxsph as js
from jaxsph.reference.where import ray_coordinates

pytestmark = pytest.mark.usefixtures("quick_programs")


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
    image = drawn(frames, camera, None, Fog.of())
    left = np.exp(-0.7 * through(camera, float(camera.near), float(camera.far)))
    np.testing.assert_allclose(image.transmittance, left, rtol=1e-5)
    np.testing.assert_allclose(image.color, (1 - left)[..., None] * np.float32([0.2, 0.5, 0.9]), rtol=1e-5)
    assert image.stats["evaluations"] == 0


def test_media_that_share_samples_add_up(frames):
    """Three thin fogs of a colour are one, and so are those of several."""
    rng = np.random.default_rng(1)
    scene, camera = frames.scene(rng), frames.camera(rng)
    parts = Fog.of(0.1, (0.9, 0.0, 0.3)), Fog.of(0.2, (0.9, 0.9, 0.3)), Fog.of(0.4, (0.9, 0.3, 0.3))
    mixed = Fog.of(0.7, (0.9, (0.2 * 0.9 + 0.4 * 0.3) / 0.7, 0.3))
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
    ball = Fog.of(3.0, radius=0.4)
    anywhere = Anywhere(**{field.name: getattr(ball, field.name) for field in dataclasses.fields(ball)})
    found, wanted = (drawn(frames, camera, None, medium) for medium in (ball, anywhere))
    assert np.asarray(wanted.alpha).max() > 0.5 and (np.asarray(wanted.alpha) == 0).any()
    same_bits(found, wanted)
