"""Surfaces as points: depths of the picture, places on the level, normals along the gradient; in PLY whole or not at all."""

import dataclasses

import numpy as np
import pytest
from surfaced import crossing

import jaxsph as js

SIZE, SPACING = {"width": 16, "height": 14}, 0.1
SETTINGS = js.Settings(samples=40)
LEVEL, SMOOTHING = 0.45, 1.2
DEGREE = np.pi / 180


def scene(**more):
    """Jittered particles in a ball, with supports that vary."""
    rng = np.random.default_rng(3)
    steps = (np.arange(9) - 4) * SPACING
    position = np.stack(np.meshgrid(steps, steps, steps), -1).reshape(-1, 3)
    position = position[np.linalg.norm(position, axis=1) < 0.4]
    position = position + rng.uniform(-0.01, 0.01, position.shape)
    support = 0.2 * rng.uniform(0.8, 1.2, len(position))
    columns = (one.astype(np.float32) for one in (position, support, position[:, 0], np.full(len(position), SPACING**3)))
    return js.Scene(particles=js.Particles.from_arrays(*columns, "cubic_spline"), **more)


def camera():
    return js.Camera.look_at((0.35, 0.45, -2.1), (0, 0, 0), fov_degrees=35, near=1.2, far=3.2, **SIZE)


@pytest.fixture(scope="module")
def made():
    return js.surface_depth(scene(surface=js.Surface(LEVEL, smoothing=SMOOTHING)), camera(), SETTINGS)


def test_depths_are_those_of_the_picture_and_normals_those_of_the_field(made):
    shown, view = scene(surface=js.Surface(LEVEL, smoothing=SMOOTHING)), camera()
    image, truth = js.render(shown, view, SETTINGS), crossing(shown, view)
    np.testing.assert_array_equal(made.depth, image.depth)
    np.testing.assert_array_equal(made.color, image.color)
    both = made.met & np.isfinite(truth.depth) & (truth.facing > 0.02)
    assert both.sum() > 40
    world = truth.normal @ np.asarray(view.axes, np.float64)
    assert np.degrees(np.arccos(np.clip((made.normal * world).sum(-1)[both], -1, 1))).max() < 0.1
    np.testing.assert_allclose(made.quantity[both], truth.quantity[both], atol=1e-5)
    away = (made.position - view.exact_eye()) @ np.asarray(view.axes, np.float64)[2]
    np.testing.assert_allclose(away[made.met], made.depth[made.met], rtol=1e-6)
    nowhere = ~made.met
    assert np.isinf(made.depth[nowhere]).all()
    assert np.isnan(made.position[nowhere]).all() and np.isnan(made.quantity[nowhere]).all()
    assert not made.normal[nowhere].any() and "rays meet it" in repr(made)


def test_what_else_is_in_the_scene_hides_nothing(made):
    stars = js.Points.from_arrays(np.zeros((1, 3), np.float32), radius=1.0, color=(1, 1, 1), opacity=0.99)
    shown = scene(surface=js.Surface(LEVEL, smoothing=SMOOTHING), points=stars)
    np.testing.assert_array_equal(js.surface_depth(shown, camera(), SETTINGS).depth, made.depth)


def test_points_are_written_as_ply_which_is_read_again(made, tmp_path):
    path = tmp_path / "points.ply"
    made.save(path)
    table = js.io.read_table(path)
    met = made.met
    assert len(table) == met.sum()
    np.testing.assert_array_equal(table.position, made.position[met])
    content = path.read_bytes()
    header, _, rows = content.partition(b"end_header\n")
    assert b"property float nx" in header and b"comment jaxsph.version" in header
    kinds = [(name, "<f8") for name in "xyz"] + [(name, "<f4") for name in ("nx", "ny", "nz")]
    kinds += [(name, "u1") for name in ("red", "green", "blue")] + [("quantity", "<f4")]
    vertices = np.frombuffer(rows, kinds)
    np.testing.assert_allclose(vertices["ny"], made.normal[met][:, 1], atol=1e-6)
    np.testing.assert_allclose(vertices["green"] / 255, made.color[met][:, 1], atol=0.5 / 255 + 1e-6)
    np.testing.assert_allclose(vertices["quantity"], made.quantity[met], atol=1e-6)


def test_a_file_is_whole_or_not_there(made, tmp_path, monkeypatch):
    with pytest.raises(ValueError, match=r"written as \.ply"):
        made.save(tmp_path / "points.exr")
    (tmp_path / "points.ply").write_text("what was there")
    broken = dataclasses.replace(made, color=made.color[:, :-1])
    with pytest.raises(IndexError):
        broken.save(tmp_path / "points.ply")
    with pytest.raises(ValueError, match="does not exist"):
        made.save(tmp_path / "nowhere" / "points.ply")
    assert [path.read_text() for path in tmp_path.iterdir()] == ["what was there"]


def test_without_a_surface_it_is_refused_and_nothing_is_met_beyond_the_level():
    with pytest.raises(ValueError, match="must have particles and a `surface`"):
        js.surface_depth(scene(), camera(), SETTINGS)
    with pytest.warns(UserWarning, match="no ray meets the surface"):
        nothing = js.surface_depth(scene(surface=js.Surface(5.0, smoothing=SMOOTHING)), camera(), SETTINGS)
    assert not nothing.met.any() and not nothing.normal.any()
