"""Promises of the reference image of point samples."""

import numpy as np

import jaxsph as js

CAMERA = js.Camera.orthographic((0, 0, 3), (0, 0, 0), view_height=2.0, width=16, height=8, near=2.0, far=4.0)
COLORS = [(0, 1, 0), (1, 0, 0), (0, 0, 1)]


def all_of_one_color(scene):
    """Whether what is shown has the colour of the later side of the jump."""
    image = js.reference.render(scene, CAMERA, js.Settings(samples=8))
    assert image.alpha.max() > 0
    return image.color[..., :2].max() == 0


def test_a_lone_quantity_keeps_its_side_of_jumps():
    for quantity in np.random.default_rng(3).uniform(0.1, 0.9, 8):
        particles = js.Particles.from_arrays([[-0.5, 0, 0], [0.5, 0, 0]], 0.45, np.float32([quantity, 0.95]))
        value = float(particles.quantity[0])
        transfer = js.TransferFunction.from_points([0, value, value], COLORS, np.full(3, 2.0))
        assert all_of_one_color(js.Scene(particles=particles, transfer=transfer))
        volume = js.Volume.from_array(np.full((3, 3, 3), value, np.float32), (-0.5, -0.5, -0.5), (0.4, 0.4, 0.4))
        assert all_of_one_color(js.Scene(volume=volume, volume_transfer=transfer))
