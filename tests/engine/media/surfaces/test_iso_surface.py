"""An iso-surface is where the field crosses its level, shaded by the gradient, in order among other media."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

import jaxsph as js
from jaxsph.reference.where import ray_coordinates, to_view

pytestmark = pytest.mark.usefixtures("quick_programs")

POINTS, RADIUS, COLOR, AMBIENT = 25, 0.7, (0.9, 0.5, 0.2), 0.25
SETTINGS = js.Settings(samples=48)


def ball(points=POINTS):
    """The distance from the origin, which is trilinear but for some 1e-3."""
    x = np.linspace(-1, 1, points)
    distance = np.sqrt(x[:, None, None] ** 2 + x[:, None] ** 2 + x**2).astype(np.float32)
    return js.Volume.from_array(distance, (-1, -1, -1), 2 / (points - 1))


def surface(level=RADIUS, **kwargs):
    return js.IsoSurface.from_volume(ball(), level, COLOR, AMBIENT, **kwargs)


def camera(projection, width=24, height=20):
    where = {"eye": (0.5, 0.8, -3.0), "target": (0.0, 0.0, 0.0), "width": width, "height": height, "near": 1.5, "far": 5.0}
    if projection == "orthographic":
        return js.Camera.orthographic(**where, view_height=2.2)
    return js.Camera.look_at(**where, fov_degrees=42.0)


def first_hit(view):
    """Of all pixels' rays with the ball, in float64: closest approach, depth, and the cosine towards the eye."""
    u, v = np.meshgrid(*ray_coordinates(view, np.arange(view.width) + 0.5, np.arange(view.height) + 0.5))
    centre = to_view(np.zeros(3), view)
    zero, one = np.zeros_like(u), np.ones_like(u)
    origin, way = (zero, (u, v, one)) if view.is_perspective else ((u, v, zero), (zero, zero, one))
    origin, way = np.stack(np.broadcast_arrays(*(origin if isinstance(origin, tuple) else (zero,) * 3)), -1), np.stack(way, -1)
    square, off = (way**2).sum(-1), origin - centre
    nearest = -(off * way).sum(-1) / square
    miss = np.linalg.norm(off + nearest[..., None] * way, axis=-1)
    half = np.sqrt(np.maximum(RADIUS**2 - miss**2, 0) / square)
    depth = nearest - half
    normal = (off + depth[..., None] * way) / RADIUS
    return miss, depth, np.abs((normal * way).sum(-1)) / np.sqrt(square)


@pytest.mark.parametrize("projection", ["perspective", pytest.param("orthographic", marks=pytest.mark.slow)])
def test_a_ball_is_opaque_in_its_place_and_shaded(projection):
    view = camera(projection)
    image = js.render(js.Scene(media=(surface(),)), view, SETTINGS)
    miss, depth, facing = first_hit(view)
    inside, outside = miss < 0.97 * RADIUS, miss > 1.01 * RADIUS
    assert inside.sum() > 100 < outside.sum()
    np.testing.assert_array_equal(np.asarray(image.transmittance)[inside], 0)
    np.testing.assert_array_equal(np.asarray(image.transmittance)[outside], 1)
    step = np.diff(js.reference.sample_depths(view, 48)).max()
    assert (np.abs(np.asarray(image.depth)[inside] - depth[inside]) <= step).all()
    wanted = np.asarray(COLOR) * (AMBIENT + (1 - AMBIENT) * facing)[..., None]
    np.testing.assert_allclose(np.asarray(image.color)[inside], wanted[inside], atol=0.02)


@pytest.mark.parametrize("within", [None, js.Sphere((0.0, 0.0, 0.0), 5.0)], ids=["everywhere", "within a clip"])
def test_a_ball_that_lies_between_samples_is_within_what_is_told(within):
    """Neither picture is certified, as the coarser one misses it."""
    scene, view = js.Scene(media=(surface(0.12),), within=within), camera("perspective")
    images = [js.render(scene, view, dataclasses.replace(SETTINGS, samples=samples)) for samples in (4, 48)]
    few, many = (np.asarray(image.alpha, np.float64) for image in images)
    assert (np.abs(few - many) <= sum(np.asarray(image.error_bound) for image in images)).all()
    assert many.max() == 1 > few.max() and not any(image.certified for image in images)


@pytest.mark.slow
def test_what_lies_in_front_is_seen_and_what_lies_behind_is_not():
    """A fog in front of the surface, and one behind it."""
    view, volume = (
        camera("perspective"),
        js.Volume.from_array(np.ones((2, 2, 2), np.float32), (-1.0, -1.0, -1.0), (2.0, 2.0, 0.2)),
    )
    fog = js.TransferFunction.from_points([0.0, 1.0], np.ones((2, 3)), [0.0, 3.0])
    alone = js.render(js.Scene(media=(surface(),)), view, SETTINGS)
    front = js.render(js.Scene(volume=volume, volume_transfer=fog, media=(surface(),)), view, SETTINGS)
    behind = dataclasses.replace(volume, lower=jnp.asarray((-1.0, -1.0, 0.8), jnp.float32))
    behind = js.render(js.Scene(volume=behind, volume_transfer=fog, media=(surface(),)), view, SETTINGS)
    middle = slice(8, 12), slice(10, 14)
    np.testing.assert_allclose(behind.color[middle], alone.color[middle], atol=1e-6)
    assert (np.abs(np.asarray(front.color - alone.color)[middle]) > 0.02).all()
    assert (np.asarray(front.alpha)[middle] == 1).all()


@pytest.mark.parametrize(
    ("changed", "match"),
    [
        ({"level": np.nan}, "`level`"),
        ({"color": (2, 0, 0)}, "color"),
        ({"color": 1.0}, "`color`"),
        ({"ambient": -1}, "`ambient`"),
    ],
)
def test_what_makes_no_surface_is_refused_by_name(changed, match):
    with pytest.raises(ValueError, match=match):
        js.IsoSurface.from_volume(ball(3), **{"level": 0.5} | changed)
