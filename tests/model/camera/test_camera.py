"""Promises of the camera: the contract's axes, rays and sample depths; framing shows everything; bad views are refused."""

import jax
import numpy as np
import pytest
from hypothesis import given, strategies as st

import jaxsph as js
from jaxsph.reference import where

to_view = jax.jit(js.Camera.to_view)
depth = jax.jit(js.Camera.depth, static_argnums=2)
view = {"eye": (1.0, 2.0, 5.0), "target": (0.5, 0.0, -1.0), "near": 0.5, "far": 8.0}


def test_axes_are_right_up_forward_as_the_contract_says():
    camera = js.Camera.look_at(**view)
    forward = np.array(view["target"]) - view["eye"]
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, (0, 1, 0))
    right /= np.linalg.norm(right)
    np.testing.assert_allclose(camera.axes, [right, np.cross(right, forward), forward], atol=1e-6)
    np.testing.assert_allclose(
        to_view(camera, np.float32(view["target"])), [0, 0, np.linalg.norm(np.subtract(view["target"], view["eye"]))], atol=1e-6
    )


def test_up_in_the_world_is_up_in_the_image_and_right_is_right():
    camera = js.Camera.look_at((0, 0, 5), (0, 0, 0), near=1, far=9)
    (right, _, _), (_, up, _) = (np.asarray(to_view(camera, axis)) for axis in np.eye(3, dtype=np.float32)[:2])
    assert right > 0 and up > 0
    camera = jax.tree.map(np.asarray, camera)
    assert camera.row(0.5) > camera.row(1.5)
    assert camera.column(0.5) < camera.column(1.5)


@pytest.mark.parametrize(("width", "height"), [(1, 1), (7, 5), (640, 480)])
def test_rays_are_those_of_the_contract(width, height):
    camera = js.Camera.look_at(**view, fov_degrees=60, width=width, height=height)
    camera, c, r = jax.tree.map(np.asarray, camera), np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32)
    half = np.tan(np.radians(30))
    np.testing.assert_allclose(camera.column(c + 0.5), half * width / height * (2 * (c + 0.5) / width - 1), rtol=1e-5, atol=1e-7)
    np.testing.assert_allclose(camera.row(r + 0.5), half * (1 - 2 * (r + 0.5) / height), rtol=1e-5, atol=1e-7)


@given(u=st.floats(0, 1), near=st.floats(1e-3, 10), ratio=st.floats(1.001, 1e6))
def test_depth_is_geometric_in_perspective_and_linear_in_orthographic(u, near, ratio):
    far = near * ratio
    size = {"eye": (0, 0, 0), "target": (0, 0, 1), "near": near, "far": far}
    geometric, linear = (depth(make(**size), np.float32(u * 64), 64) for make in (js.Camera.look_at, js.Camera.orthographic))
    assert float(geometric) == pytest.approx(near * ratio**u, rel=1e-5)
    assert float(linear) == pytest.approx(near + (far - near) * u, rel=1e-5)


def seen(camera, particles):
    """Positions in the view, in NumPy."""
    return (particles.exact_position() - camera.exact_eye()) @ np.asarray(camera.axes, np.float64).T


@pytest.mark.parametrize("size", [(512, 512), (200, 600), (601, 100)])
@pytest.mark.parametrize("direction", [(0, 0, -1), (1, 1, 1), (-0.3, -2, 0.4)])
def test_framing_shows_every_support_between_near_and_far(size, direction):
    rng = np.random.default_rng(0)
    particles = js.Particles.from_arrays(rng.normal(size=(50, 3)) * (3, 1, 0.5) + 7, rng.uniform(0.1, 0.5, 50), 0.0)
    camera = js.Camera.framing(particles, direction=direction, width=size[0], height=size[1])
    x, y, z = seen(camera, particles).T
    h = np.asarray(particles.support)
    assert np.all(z - h >= float(camera.near) * (1 - 1e-5))
    assert np.all(z + h <= float(camera.far) * (1 + 1e-5))
    half = float(camera.half_height)
    assert np.all(np.abs(y) + h <= half * (z + h) * 1.0001)
    assert np.all(np.abs(x) + h <= half * size[0] / size[1] * (z + h) * 1.0001)


def test_framing_of_nothing_and_of_one_particle_works():
    for position, support in (([], 1.0), ([[5, 5, 5]], 1e-3)):
        particles = js.Particles.from_arrays(position, support, 0.0)
        camera = js.Camera.framing(particles)
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(camera)) and 0 < camera.near < camera.far
        depth, near, far = seen(camera, particles)[: len(position), 2], float(camera.near), float(camera.far)
        assert (near <= depth - support).all() and (depth + support <= far * (1 + 1e-5)).all()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"near": 8.0, "far": 0.5}, "`near` must be less than `far`"),
        ({"near": 1.0, "far": 1.0}, "`near` must be less than `far`"),
        ({"near": 1.0, "far": 1.0 + 1e-9}, "same number in float32"),
        ({"near": 0.0}, "`near` must be > 0 for a perspective camera"),
        ({"far": np.inf}, "both finite"),
        ({"target": (1.0, 2.0, 5.0)}, "`target` must differ from `eye`"),
        ({"up": (0.5, 2.0, 6.0)}, "parallel to the line of sight"),
        ({"up": (0.0, 0.0, 0.0)}, "zero or parallel"),
        ({"eye": (np.nan, 0, 0)}, "`eye` must be finite"),
        ({"eye": (1, 2)}, r"`eye` must have shape \(3,\)"),
        ({"fov_degrees": 180}, r"`fov_degrees` must lie in \(0, 180\)"),
        ({"width": 0}, "`width` must be an integer from 1"),
        ({"height": 2.5}, "`height` must be an integer from 1"),
    ],
)
def test_a_view_that_cannot_be_is_refused(change, message):
    if "up" in change and any(change["up"]):
        change = {"up": tuple(np.subtract(view["target"], view["eye"]))}
    with pytest.raises(ValueError, match=message):
        js.Camera.look_at(**{**view, **change})


def test_orthographic_refuses_a_height_of_nothing_and_allows_negative_depths():
    with pytest.raises(ValueError, match="`view_height` must be > 0"):
        js.Camera.orthographic(**view, view_height=0.0)
    js.Camera.orthographic(**{**view, "near": -3.0})


@pytest.mark.parametrize("up", np.eye(3))
def test_an_upward_direction_that_is_proposed_is_one_that_can_be(up):
    with pytest.raises(ValueError, match="choose another, such as") as refused:
        js.Camera.look_at(9 * up, (0, 0, 0), up=up, near=1, far=20)
    other = [float(part) for part in str(refused.value).rpartition("(")[2].strip(")").split(",")]
    js.Camera.look_at(9 * up, (0, 0, 0), up=other, near=1, far=20)


@pytest.mark.parametrize("camera", [js.Camera.look_at, js.Camera.orthographic])
def test_exact_rays_and_places_are_the_oracles(camera):
    camera = camera((1.0, 2.0, -3.0), (0.25, 0.0, 1.0), (0.1, 1.0, 0.3), 1.5, 7, 5, near=1.0, far=2.0)
    rays = where.ray_coordinates(camera, np.arange(7) + 0.5, np.arange(5) + 0.5)
    for own, wanted in zip(camera.exact_rays(), rays, strict=True):
        np.testing.assert_allclose(own, wanted, rtol=0, atol=4e-16)
    place = np.random.default_rng(1).normal(size=(9, 3))
    np.testing.assert_allclose(camera.exact_world(place), where.to_world(place, camera), rtol=0, atol=4e-15)
    np.testing.assert_allclose(camera.exact_view(place), where.to_view(place, camera), rtol=0, atol=4e-15)
