"""Cameras of scenes that were made by hand, and what cannot be seen."""

import numpy as np
import pytest

import jaxsph as js
from jaxsph.io.opening.options import View
from jaxsph.io.opening.views import framed
from jaxsph.model.clips import Box


def scene():
    position = np.random.default_rng(0).random((500, 3))
    look = js.TransferFunction.from_points([0, 1], np.ones((2, 3)), [3.0, 3.0])
    return js.Scene(particles=js.Particles.from_arrays(position, 0.2, position[:, 0], 1.0), transfer=look)


def test_a_scene_is_framed_by_what_is_lit():
    camera = js.Camera.fitted(scene(), width=32, height=24)
    assert (camera.width, camera.height) == (32, 24)
    alpha = np.asarray(js.reference.render(scene(), camera, js.Settings(samples=16)).alpha)
    rows, columns = np.nonzero(alpha > 0.1)
    assert max(np.ptp(rows) / 24, np.ptp(columns) / 32) > 0.7 and not alpha[0].any()


@pytest.mark.parametrize(("view", "told"), [
    ({"center": "mass"}, "needs the masses"), ({"view": "face-on"}, "needs velocities"),
    ({"acros": 3}, "no option 'acros'; .*did you mean across?"), ({"fov_degrees": 190}, "must lie in"),
    ({"up": (0, 0, 0)}, "`up` ="), ({"across": -1}, "`width` must be > 0"),
])  # fmt: skip
def test_what_a_scene_cannot_give_is_refused_by_name(view, told):
    with pytest.raises(ValueError, match=told):
        js.Camera.fitted(scene(), **view)


def test_points_alone_and_nothing_have_a_camera():
    points = js.Points.from_arrays(np.random.default_rng(0).random((9, 3)), 0.1, [[1, 1, 1]] * 9, 1.0)
    for shown in (js.Scene(points=points), js.Scene()):
        camera = js.Camera.fitted(shown, width=8, height=8)
        assert 0 < float(camera.near) < float(camera.far)


def test_particles_without_a_look_are_refused():
    with pytest.raises(ValueError, match="`transfer` must be given with `particles`"):
        js.Camera.fitted(js.Scene(particles=scene().particles))


def test_places_and_directions_may_be_arrays():
    given = {"view": (1.0, -2.0, 0.5), "center": (0.5, 0.25, 0.5), "across": 0.5}
    plain = js.Camera.fitted(scene(), width=32, height=24, **given)
    arrays = js.Camera.fitted(scene(), width=32, height=24, **{name: np.array(value) for name, value in given.items()})
    np.testing.assert_array_equal(arrays.axes, plain.axes)
    np.testing.assert_array_equal(arrays.exact_eye(), plain.exact_eye())


def test_a_few_particles_far_off_do_not_move_the_middle_of_columns_and_planes():
    position = np.random.default_rng(0).normal(size=(501, 3)) + (5, 6, 7)
    position[0] = 400, -300, 900
    shown, half = js.Scene(particles=js.Particles.from_arrays(position, 0.2, position[:, 0], 1.0)), np.median(position, axis=0)
    near = framed(shown, View(view="z", width=3.0), whole=True)
    np.testing.assert_allclose(near.center, half, atol=1e-5)
    whole = framed(shown, View(view="z"), whole=True)  # shows all, and a plane is where half of the particles are on either side
    np.testing.assert_allclose(whole.center, [*np.mean(shown.bounds(), 0)[:2], half[2]], atol=1e-3)
    assert 2 * float(whole.camera.half_height) >= 395
    cut = framed(shown, View(view="z", width=3.0, clips=(Box((4, 5, 6), (5.5, 7, 8)),)), whole=True)
    np.testing.assert_allclose(cut.center, [4.75, 6, 7])
