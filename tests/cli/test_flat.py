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
    there = np.isfinite(found) & (found != 0)
    assert there.any(0).mean() > 0.5 and there.any(1).mean() > 0.5
    assert ("as all particles lie in a plane" in out) == (across != (0, 0, 1))


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
    assert (found != 0).any(1).mean() < 0.5 and "as all particles lie" not in out


def inner(found):
    """Without what is near an edge of the sheet."""
    return found[5:-5, 7:-7]


@pytest.mark.parametrize("across", [(0, 1, 0), (1, 2, -2)])
@pytest.mark.parametrize("more", [{}, {"support": np.full(SIDE**2, 2.3 / SIDE), "density": np.ones(SIDE**2)}])
@pytest.mark.parametrize("how", [["slice", "--field", "sum"], ["project"], ["project", "--of", "density"]])
def test_a_surface_density_of_one_is_one(capsys, across, more, how):
    saved(sheet(across), **more)
    found, _ = values(capsys, *how, *["--color-by", "density"][: 2 * (how[0] == "slice")])
    np.testing.assert_allclose(inner(found), 1, atol=0.03)


def test_sums_in_a_plane_are_by_kernels_of_two_dimensions(capsys):
    rng = np.random.default_rng(2)
    position, support = np.stack([*rng.random((2, 400)), np.full(400, 0.5)], 1), rng.uniform(0.1, 0.3, 400)
    weight, density = rng.uniform(1, 2, (2, 400))
    np.savez("a.npz", position=position, support=support, mass=weight, density=density, heat=position[:, 0])
    place = ["--center", "0.5,0.5,0.5", "--width", "0.5", "--kernel", "cubic_spline"]
    found = [values(capsys, "slice", "--color-by", name, *place)[0] for name in ("density", "heat")]
    x, y = (axis.ravel() for axis in np.meshgrid((np.arange(18) - 8.5) / 36 + 0.5, (5.5 - np.arange(12)) / 36 + 0.5))
    q = np.hypot(*(one[:, None] - each for one, each in zip((x, y), position.T[:2], strict=True))) / support
    spline = np.where(q < 0.5, 1 - 6 * q**2 + 6 * q**3, 2 * np.clip(1 - q, 0, 1) ** 3) * 40 / (7 * np.pi) / support**2
    mean = (spline @ (weight / density * position[:, 0])) / (spline @ (weight / density))
    np.testing.assert_allclose(found[0].ravel(), spline @ weight, rtol=1e-4)
    np.testing.assert_allclose(found[1].ravel(), mean, rtol=1e-4)


def test_supports_and_densities_on_a_line_are_of_one_dimension():
    saved(np.stack([LINE, 0 * LINE, 0 * LINE], 1))
    particles = js.io.read_particles("a.npz", quantity="density")
    np.testing.assert_allclose(particles.to_numpy()["support"], 2 / SIDE, rtol=1e-5)
    np.testing.assert_allclose(particles.to_numpy()["quantity"][4:-4], 1, rtol=0.03)


def test_supports_in_a_plane_reach_as_far_as_in_space():
    position = np.random.default_rng(0).random((2000, 3)) * (1, 1, 0)
    saved(np.concatenate([position, position[:500] * 0.2]))
    support = js.io.read_particles("a.npz", quantity="heat").to_numpy()["support"]
    assert 1.7 < np.median(support) * 2000**0.5 < 2.3


def test_a_layer_of_a_solid_has_its_volumes(capsys):
    position = np.stack([axis.ravel() for axis in np.meshgrid(LINE[:12], LINE[:12], LINE[:12])], 1)
    saved(position, density=np.full(1728, 8.0), support=np.full(1728, 2.1 / SIDE))
    where = ["--where", f"abs(z - {LINE[5]}) < 0.01", "--along", "sum", "--of", "volume"]
    assert js.io.read_particles("a.npz", where=where[1]).to_numpy()["volume"] == pytest.approx(1 / SIDE**3, rel=1e-5)
    found, out = values(capsys, "project", *where)
    assert "two-dimensional" not in out and found[5:-5, 7:-7].mean() == pytest.approx(1 / SIDE, rel=0.1)


@pytest.mark.parametrize("asked", [["--view", "z"], ["--plane", "3,3.02,3,0,1,0"]])
def test_sums_beside_the_plane_are_refused_by_name(capsys, asked):
    saved(sheet((0, 1, 0)))
    told = commanded.refused(capsys, "slice", "a.npz", "-o", "out.npy", "--field", "sum", "--color-by", "density", *asked)
    assert "all particles lie in a plane" in told and "--field mean" in told
    values(capsys, "slice", "--field", "mean", "--color-by", "density", *asked)


def test_what_is_two_dimensional_is_said_to_be(capsys):
    saved(sheet((0, 1, 0)))
    assert "two-dimensional: all particles lie in a plane" in commanded.run(capsys, "info", "a.npz")[1]


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
