"""What pixels of an image can see is never missed: spheres that a ray of theirs meets, and boxes of such."""

import numpy as np
from examples import examples
from hypothesis import given
from hypothesis import strategies as st

import jaxsph as js
from jaxsph.reference.where import ray_coordinates
from jaxsph.scale.on_disk import between_depths, seen_by


def camera_of(perspective, height):
    place = {"eye": (0.3, -0.2, 3.0), "target": (0, 0, 0), "near": 1.5, "far": 4.5, "width": 21, "height": height}
    if perspective:
        return js.Camera.look_at(fov_degrees=50.0, **place)
    return js.Camera.orthographic(view_height=2.0, **place)


@examples(40)
@given(st.booleans(), st.integers(0, 2**32 - 1), st.floats(-4, 0))
def test_spheres_that_a_ray_of_a_pane_meets_are_met_and_so_are_boxes_around_them(perspective, seed, decade):
    rng, camera = np.random.default_rng(seed), camera_of(perspective, 32)
    (top, left), size = rng.integers(0, (31, 20)), (33, 22)
    bottom, right = (int(rng.integers(first + 1, end)) for first, end in zip((top, left), size, strict=True))
    rows, columns = rng.integers(top, bottom, 50), rng.integers(left, right, 50)
    depth = rng.uniform(1.5, 4.5, 50)
    u, v = ray_coordinates(camera, columns + 0.5, rows + 0.5)
    spread = depth if perspective else np.ones(50)
    on_rays = camera.exact_eye() + np.stack([u * spread, v * spread, depth], 1) @ np.asarray(camera.axes, float)
    reach = 10**decade * rng.uniform(0.1, 1, 50)
    way = rng.normal(size=(50, 3))
    middle = on_rays + 0.999 * reach[:, None] * way / np.linalg.norm(way, axis=1)[:, None]
    planes = seen_by(camera, top, bottom, left, right)
    assert planes.meet(middle, reach).all() and between_depths(camera).meet(middle, reach).all()
    around = rng.uniform(0, 0.3, (2, 50, 3))
    assert planes.meet_boxes(middle - around[0], middle + around[1], reach).all()


def test_what_lies_far_outside_is_not_met():
    camera = camera_of(True, 32)
    behind, above, beside = np.array([[0.3, -0.2, 9.0]]), np.array([[0.0, 8.0, 0.0]]), np.array([[5.0, 0.0, 0.0]])
    for place in (behind, above, beside):
        assert not seen_by(camera, 0, 32, 0, 21).meet(place, np.array([0.5])).any()
        assert not seen_by(camera, 0, 32, 0, 21).meet_boxes(place - 0.1, place + 0.1, np.array([0.5])).any()
    left_half, right_half = seen_by(camera, 0, 32, 0, 10), seen_by(camera, 0, 32, 10, 21)
    on_the_right = np.array([[0.9, 0.0, 0.0]]), np.array([0.5])
    assert right_half.meet(*on_the_right).all() and not left_half.meet(*on_the_right).any()
