"""Runs in two dimensions and in one: from where they are seen, and sums by kernels of as many dimensions."""

import commanded
import numpy as np
import pytest

import jaxsph as js
from jaxsph.model.particles.flat import dimensions_of

pytestmark = pytest.mark.usefixtures("quick_programs", "empty")
SIDE = 24
LINE = (np.arange(SIDE) + 0.5) / SIDE


def sheet(across, noise=0.0):
    """A square lattice around (3, 3, 3), in the plane across a direction."""
    normal = np.asarray(across, float) / np.linalg.norm(across)
    first = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
    first /= np.linalg.norm(first)
    u, v = (axis.ravel() - 0.5 for axis in np.meshgrid(LINE, LINE))
    rough = noise * np.random.default_rng(0).normal(size=len(u))
    return 3 + u[:, None] * first + v[:, None] * np.cross(normal, first) + rough[:, None] * normal


def saved(position, **columns):
    count = len(position)
    np.savez("a.npz", position=position, mass=np.full(count, 1 / count), heat=1 + position[:, 0], **columns)


def values(capsys, command, *arguments):
    """What a command writes, and says."""
    code, out, err = commanded.run(capsys, command, "a.npz", "--size", "18x12", "-o", "out.npy", *arguments)
    assert (code, err) == (0, []), err
    return np.load("out.npy"), out


@pytest.mark.parametrize("command", ["project", "slice"])
@pytest.mark.parametrize("across", [(0, 1, 0), (1, 0, 0), (0, 0, 1), (1, 2, -2)])
def test_what_lies_in_a_plane_is_seen_flat_on(capsys, command, across):
    saved(sheet(across, 1e-7))
    found, out = values(capsys, command)
    assert np.mean(np.isfinite(found) & (found != 0)) > 0.5
    assert ("all particles lie in a plane" in out) == (across != (0, 0, 1))


@pytest.mark.parametrize("more", [{}, {"width": 0.5}])
def test_a_picture_of_a_plane_is_flat_on(more):
    saved(sheet((0, 1, 0)), support=np.full(SIDE**2, 0.1))
    _, camera = js.io.read_scene("a.npz", size=(18, 12), **more)
    assert not camera.is_perspective
    np.testing.assert_allclose(np.abs(camera.axes[2]), (0, 1, 0), atol=1e-6)
    _, asked = js.io.read_scene("a.npz", size=(18, 12), view="iso", **more)
    assert asked.is_perspective


def test_a_view_that_is_asked_for_is_kept(capsys):
    saved(sheet((0, 1, 0)))
    found, out = values(capsys, "project", "--view", "z")
    assert np.mean(found != 0) < 0.5 and "lie in a plane" not in out


@pytest.mark.parametrize(
    ("position", "box", "dimensions"),
    [
        (sheet((1, 2, -2)).astype(np.float32), None, 2),
        (np.mod(sheet((0, 0, 1), 1e-9) - 3, 1), (1, 1, 1), 2),
        (sheet((0, 1, 0), 1e-3), None, 3),
        (np.stack([LINE, 0 * LINE, 0 * LINE], 1), None, 1),
        (np.stack([LINE, LINE, 2 * LINE], 1), None, 1),
        (np.ones((50, 3)), None, 3),
        (np.eye(3), None, 3),
        (np.random.default_rng(0).normal(size=(50, 3)), None, 3),
    ],
)
def test_dimensions_are_those_that_particles_span(position, box, dimensions):
    assert dimensions_of(position, box)[0] == dimensions
