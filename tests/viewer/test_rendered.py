"""Pictures of a view as they are rendered: the last is that of `jaxsph.render`, and nothing is compiled for what moves."""

import numpy as np
import pytest
from derivatives import QUICKLY
from views import HEIGHT, SECONDS, SETTINGS, WIDTH, as_it_began, asked, camera, rested, same, scene, sequence

import jaxsph as js
from jaxsph.engine.runtime import programs
from jaxsph.viewer.session import Session
from jaxsph.viewer.stages import FULL
from jaxsph.viewer.state import frames_of


@pytest.fixture(scope="module")
def began(tmp_path_factory):
    """The first frame of a sequence, and its view; its threads work between tests, too, and compile alike there."""
    first, frames = frames_of(sequence(tmp_path_factory.mktemp("sequence"), wrong=()))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(programs, "OF_ALL", QUICKLY)
        with Session(first, camera(), SETTINGS, frames=frames) as made:
            yield first, made


@pytest.fixture
def first(began):
    return began[0]


@pytest.fixture
def session(began):
    yield began[1]
    as_it_began(began[1])


@pytest.mark.core
def test_the_last_picture_of_a_view_is_that_of_render_bit_for_bit(session, first):
    picture = session.wait(seconds=SECONDS)
    assert picture.final and picture.stage == FULL and picture.image.shape == (HEIGHT, WIDTH)
    assert same(picture.image, js.render(first, camera(), SETTINGS))
    for message in (
        {"do": "orbit", "right": 0.2, "down": -0.1},
        {"do": "zoom", "factor": 1.7, "right": 0.2},
        {"do": "roll", "degrees": 20},
    ):
        session.do(message)
    picture, state = session.wait(seconds=SECONDS), session.snapshot()
    assert picture.version == state.version and picture.camera.near is None
    assert same(picture.image, js.render(state.scene, state.camera, SETTINGS))
    assert not same(picture.image, js.render(first, camera(), SETTINGS))


def test_nothing_compiles_after_the_first_drag_and_the_first_edit(session, compiled):
    session.do({"do": "orbit", "right": 0.1, "down": 0})
    session.wait(seconds=SECONDS)
    rows = session.state()["look"]["points"]
    rows[1][1] *= 2
    session.do({"do": "points", "points": rows})
    rested(session)
    compiled.clear()
    for turn in range(4):
        session.do({"do": "orbit", "right": 0.3 * turn, "down": 0.1})
        session.do({"do": "points", "points": [*rows, [0.3, turn, 0.1, 0.2, 0.3]][turn % 2 :]})
        session.wait(seconds=SECONDS)
    assert not compiled


def test_a_colour_map_compiles_nothing(session, compiled):
    rested(session)
    compiled.clear()
    session.do({"do": "colormap", "name": "magma"})
    picture, state = session.wait(seconds=SECONDS), session.snapshot()
    assert not compiled
    assert same(picture.image, js.render(state.scene, state.camera, SETTINGS))


def test_a_cut_is_that_of_render_and_to_move_it_compiles_nothing(session, first, empty, compiled):
    session.do({"do": "cut", "kind": "plane"})
    session.do({"do": "orbit", "right": 0.1, "down": 0})
    picture, state = rested(session), session.snapshot()
    whole = js.render(first, state.camera, SETTINGS)
    assert same(picture.image, js.render(state.scene, state.camera, SETTINGS)) and not same(picture.image, whole)
    compiled.clear()
    for share in (-0.3, 0.2, -2.0, 2.0, 0.1):
        session.do({"do": "cut", "share": share})
        session.do({"do": "orbit", "right": 0.1, "down": 0})
        picture = session.wait(seconds=SECONDS)
        assert share < 2 or float(np.asarray(picture.image.transmittance).min()) == 1  # nothing is left
    session.do({"do": "cut", "follows": False})
    session.do({"do": "orbit", "right": 0.1, "down": 0})
    picture = session.wait(seconds=SECONDS)
    assert not compiled
    space = {"scene": first, "camera": None}
    exec(session.code()["python"], space)
    assert np.abs(np.asarray(space["image"].color) - np.asarray(picture.image.color)).max() < 1e-6


def test_a_frame_is_shown_with_the_look_the_camera_and_the_cut_and_compiles_nothing(session, compiled):
    session.do({"do": "orbit", "right": 0.1, "down": 0})
    session.do({"do": "exposure", "stops": 1})
    session.do({"do": "cut", "kind": "plane"})
    before, place = rested(session), session.snapshot()
    compiled.clear()
    picture, state = asked(session, 1), session.snapshot()
    assert not compiled
    assert state.pose is place.pose and np.array_equal(state.scene.transfer.extinction, place.scene.transfer.extinction)
    assert np.allclose(np.asarray(state.scene.particles.position)[:80], np.asarray(scene().particles.position) + 0.1, atol=1e-6)
    assert not np.array_equal(picture.image.color, before.image.color)
    expected = js.render(state.scene, state.camera, SETTINGS)
    assert np.array_equal(np.asarray(picture.image.color), np.asarray(expected.color))
