"""Built-in scenes: the promised number of particles, the same on every machine, and all of them in view."""

import numpy as np
import pytest

from jaxsph import Settings, reference, scenes
from jaxsph.scenes.analytic import CUBES, concentration
from jaxsph.scenes.sampling import refill, scatter, simulation

SCENES = ["mixer", "radial", "checker_board", "dam_break", "letters", "flubber"]
SIMULATED = {"mixer": 43_740, "dam_break": 59_582}


def in_view(scene, camera):
    """Depths with support, and lateral place over the edge of the image, of every particle."""
    particles = scene.particles
    view = (np.asarray(particles.position, np.float64) - np.asarray(camera.eye)) @ np.asarray(camera.axes, np.float64).T
    support = np.asarray(particles.support, np.float64)
    edge = float(camera.half_height) * view[:, 2] * np.array([[camera.width / camera.height], [1.0]])
    return view[:, 2] - support, view[:, 2] + support, np.abs(view[:, :2].T / edge).max(0)


def test_every_scene_is_listed_and_described():
    assert set(scenes.names()) == set(SCENES)
    assert all(f"`{name}`" in scenes.__doc__ for name in scenes.names())


@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("count", [1, 2, 777, 5000])
def test_the_number_of_particles_is_exact(name, count):
    particles = scenes.load(name, particles=count)[0].particles
    assert particles.num_particles == count
    assert np.isfinite(np.asarray(particles.position)).all()
    assert ((np.asarray(particles.quantity) >= 0) & (np.asarray(particles.quantity) <= 1)).all()


@pytest.mark.parametrize("name", SIMULATED)
def test_simulated_scenes_use_the_simulated_particles_by_default(name):
    particles = scenes.load(name, frame=2)[0].particles
    stored = simulation(name)
    assert particles.num_particles == SIMULATED[name]
    assert (particles.to_numpy()["position"] == stored["position"][2]).all()
    assert np.asarray(particles.support)[0] == pytest.approx(2 * stored["spacing"])


@pytest.mark.parametrize("name", SCENES)
def test_the_same_arguments_give_the_same_particles(name):
    first, again, other = (scenes.load(name, particles=500, seed=seed)[0].particles for seed in (3, 3, 4))
    for field in ("position", "support", "quantity", "volume"):
        assert (np.asarray(getattr(first, field)) == np.asarray(getattr(again, field))).all()
    assert (np.asarray(first.position) != np.asarray(other.position)).any()


@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("frame", [0, 1, 2])
@pytest.mark.parametrize("count", [None, 3000])
def test_the_camera_frames_the_particles(name, frame, count):
    scene, camera = scenes.load(name, count, frame, width=96, height=64)
    front, back, lateral = in_view(scene, camera)
    assert (camera.width, camera.height) == (96, 64)
    assert front.min() >= float(camera.near) and back.max() <= float(camera.far)
    assert float(camera.near) >= 0.99 * front.min() and float(camera.far) <= 1.01 * back.max()
    allowed_outside = 0.01 if name == "mixer" and frame == 2 else 0.0  # what splashes out of the tank
    assert (lateral > 1).mean() <= allowed_outside
    assert np.quantile(lateral, 0.99) > 0.5


@pytest.mark.parametrize("name", SIMULATED)
def test_all_frames_share_the_eye(name):
    cameras = [scenes.load(name, 1000, frame)[1] for frame in (0, 1, 2)]
    assert all((np.asarray(c.eye) == np.asarray(cameras[0].eye)).all() for c in cameras)


@pytest.mark.parametrize("name", SCENES)
def test_the_picture_is_neither_empty_nor_opaque(name):
    scene, camera = scenes.load(name, particles=4000, width=32, height=32)
    image = reference.render(scene, camera, Settings(samples=48))
    alpha = np.asarray(image.alpha)
    assert alpha.max() > 0.7 and (alpha > 0.02).mean() > 0.15
    assert (alpha[alpha > 0.02] < 0.98).mean() > 0.1
    assert np.asarray(image.color).std(axis=(0, 1)).min() > 0.02  # all three channels tell something


def test_points_are_evenly_spread():
    points = scatter(np.zeros(3), np.array([1.0, 2.0, 0.5]), 4000, seed=1)
    eighths = (points >= np.array([0.5, 1.0, 0.25])) @ np.array([1, 2, 4])
    assert (abs(np.bincount(eighths) / 500 - 1) < 0.1).all()
    assert (points >= 0).all() and (points <= [1.0, 2.0, 0.5]).all()


def test_refilled_fluid_keeps_its_place_volume_and_dye():
    position = scatter(np.zeros(3), np.ones(3), 2000)
    left = (position[:, 0] < 0.5).astype(float)
    for count in (300, 2000, 9000):
        place, dye, spacing = refill(position, left, (1 / 2000) ** (1 / 3), count)
        assert len(place) == count and count * spacing**3 == pytest.approx(1)
        reach = max(spacing, 2000 ** (-1 / 3))
        assert (place > -reach).all() and (place < 1 + reach).all()
        assert (dye[place[:, 0] < 0.4] > 0.9).all() and (dye[place[:, 0] > 0.6] < 0.1).all()


def test_checker_board_begins_in_cubes_and_conserves_its_dye():
    corner = np.array([[0.1, 0.1, 0.9], [0.3, 0.1, 0.9], [0.9, 0.1, 0.1]])
    assert concentration(corner, 0.0) == pytest.approx([0.1, 0.0, 1.0], abs=1e-6)
    grid = np.stack(np.meshgrid(*[(np.arange(40) + 0.5) / 40] * 3, indexing="ij"), -1).reshape(-1, 3)
    means = [concentration(grid, frame).mean() for frame in (0.0, 1.0, 30.0)]
    spreads = [concentration(grid, frame).std() for frame in (0.0, 1.0, 30.0)]
    assert means == pytest.approx([means[0]] * 3, rel=5e-3)
    assert spreads[0] > spreads[1] > spreads[2] and CUBES == 5


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"name": "mixture"}, "mixer, radial, checker_board, dam_break"),
        ({"name": "mixer", "frame": 3}, r"one of \[0, 1, 2\], got 3"),
        ({"name": "mixer", "frame": 0.5}, "got 0.5"),
        ({"name": "dam_break", "frame": float("nan")}, "got nan"),
        ({"name": "checker_board", "frame": -1}, "got -1"),
        ({"name": "letters", "frame": -0.5}, "got -0.5"),
        ({"name": "flubber", "frame": float("inf")}, "got inf"),
        ({"name": "radial", "particles": 0}, "at least 1, got 0"),
        ({"name": "radial", "particles": 10.5}, "at least 1, got 10.5"),
    ],
)
def test_bad_arguments_are_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        scenes.load(**arguments)


def test_radial_is_static():
    first, later = (scenes.load("radial", 100, frame)[0].particles for frame in (0, 9))
    assert (np.asarray(first.position) == np.asarray(later.position)).all()
    assert (np.asarray(first.quantity) == np.asarray(later.quantity)).all()
