"""A view of a surface of particles: draft and full pictures of it, colours alone to edit, and numbers of where it lies."""

import dataclasses

import numpy as np
import pytest
from by_reference import DEPTHS, pictures_by_reference
from commanded import run
from surfaced import crossing
from views import HEIGHT, SETTINGS, WIDTH, camera, scene

import jaxsph as js
from jaxsph.cli.commands import view as cli_view
from jaxsph.io.opening.looks import SHOWN
from jaxsph.model.transfer.maps import Scale
from jaxsph.viewer import stages
from jaxsph.viewer.inputs import InputError
from jaxsph.viewer.session import Session
from jaxsph.viewer.stages import DEFAULT, DRAFT, FULL, histogram_of, stages_of
from jaxsph.viewer.state import Source, State

SECONDS = 240
LEVEL, LIT = 5.0, {"light": (-0.5, 0.8, 0.7), "occlusion": 0.8}


def surfaced(split=False):
    """The scene of other views by its surface; its opacity by a second quantity, which is of no meaning then."""
    shown = dataclasses.replace(scene(), surface=js.Surface(LEVEL, smoothing=1.1, **LIT))
    if not split:
        return shown
    particles = dataclasses.replace(shown.particles, extinction_quantity=shown.particles.quantity)
    look = shown.transfer
    transfer = js.TransferFunction.from_points(look.values, look.colors, [1.0, 2.0], extinction_values=[0.0, 1.0])
    return dataclasses.replace(shown, particles=particles, transfer=transfer)


@pytest.fixture(scope="module")
def session():
    with pictures_by_reference(), Session(surfaced(), camera(), SETTINGS, Source("# a file")) as made:
        yield made


def test_pictures_are_those_of_render_and_say_what_they_are(session):
    pictures = []
    undo = session.listen(pictures.append)
    session.do({"do": "home"})
    picture = session.wait(seconds=SECONDS)
    undo()
    image = js.render(surfaced(), camera(), SETTINGS)
    assert picture.stage == FULL and picture.final and np.isfinite(np.asarray(image.depth)).sum() > 40
    for name in ("color", "transmittance", "depth"):
        np.testing.assert_array_equal(np.asarray(getattr(picture.image, name)), np.asarray(getattr(image, name)))
    draft = next(one for one in pictures if not isinstance(one, dict))
    assert draft.stage == DRAFT and "surface to rounding" in picture.words and "thin parts are missed" in draft.words


def test_drafts_are_lit_and_settled_pictures_occluded_as_well():
    draft, full = (stage.shown(surfaced()).surface for stage in stages_of(SETTINGS, camera()))
    assert draft == dataclasses.replace(full, exact=False, occlusion=None) and full == surfaced().surface


def test_its_level_and_smoothing_are_changed_for_all_frames_and_told(monkeypatch):
    state = State.of(surfaced(), camera()).done({"do": "surface", "level": 4}).done({"do": "surface", "smoothing": 2.0})
    there = dataclasses.replace(surfaced().surface, level=4.0, smoothing=2.0)
    for shown in (state, state.to(base=surfaced())):
        assert shown.scene.surface == there and shown.told()["surface"] == {"level": [LEVEL, 4.0], "smoothing": [1.1, 2.0]}
    assert "surface=dataclasses.replace(scene.surface, level=4.0, smoothing=2.0))" in state.code(Source(), SETTINGS)
    monkeypatch.setattr(stages, "MOST_OF_SURFACE", 20)
    draft = stages_of(SETTINGS, camera())[0]
    longest = [float(draft.shown(one).particles.support.max()) for one in (surfaced(), state.scene)]
    assert longest[0] > longest[1] == stages.fewer(surfaced().particles, 20, 2.0).support.max()
    for wrong, of in (({"level": 0}, surfaced()), ({"smoothing": 99}, surfaced()), ({"level": 1}, scene())):
        with pytest.raises(InputError, match=r"must be a number from|no surface of particles"):
            State.of(of, camera()).done({"do": "surface", **wrong})


def test_a_pixel_has_its_depth_and_normal_and_where_there_is_no_surface_says_so(session):
    session.do({"do": "home"})
    session.wait(seconds=SECONDS)
    told, seen = session.do({"do": "pick", "right": 0.0, "down": 0.0}), crossing(surfaced(), camera(), samples=DEPTHS)
    at, (right, up, ahead) = (HEIGHT // 2, WIDTH // 2), np.asarray(camera().axes, np.float64)
    depth, (u, v) = seen.depth[at], float(camera().half_height) / HEIGHT * np.float64([1, -1])
    np.testing.assert_allclose(told["place"], camera().exact_eye() + depth * (ahead + u * right + v * up), atol=1e-5)
    np.testing.assert_allclose(told["normal"], seen.normal[at] @ [right, up, ahead], atol=1e-3)
    assert told["depth"] == pytest.approx(depth) and told["quantity"] == pytest.approx(seen.quantity[at], abs=1e-4)
    nothing = session.do({"do": "pick", "right": 0.7, "down": -0.45})
    assert nothing["surface"] and "place" not in nothing and "normal" not in nothing


def test_colours_are_edited_and_there_is_nothing_to_make_thinner(session):
    look = session.state()["look"]
    assert look["flat"] and not look["split"]
    with pytest.raises(InputError, match="a surface of particles is opaque"):
        session.do({"do": "exposure", "stops": 1})
    session.do({"do": "points", "points": [[0.0, 1, 1, 0, 0], [1.0, 1, 1, 0, 0]]})
    color = np.asarray(session.wait(seconds=SECONDS).image.color)
    assert color[..., 0].max() > 0.5 and color[..., 1:].max() == 0
    session.do({"do": "reset_look"})


def test_the_bars_of_a_surface_are_where_rays_met_it(session):
    session.do({"do": "home"})
    picture = session.wait(seconds=SECONDS)
    shown = picture.scene
    found = histogram_of(shown, picture.camera, Scale.of(np.asarray(shown.transfer.values)), picture)
    assert len(found["edges"]) == len(found["there"]) + 1 and max(found["there"]) == 1 and found["there"] == found["absorbed"]
    assert histogram_of(shown, picture.camera, Scale.of(np.asarray(shown.transfer.values))) is None


def test_opacity_by_another_quantity_is_no_matter():
    look = Session(surfaced(split=True), camera(), SETTINGS).state()["look"]
    assert look["flat"] and not look["split"] and len(look["points"]) == 4


def test_settings_are_without_a_tolerance_which_is_refused():
    assert Session(surfaced(), camera()).settings == js.Settings() and Session(scene(), camera()).settings == DEFAULT
    with pytest.raises(ValueError, match="`tolerance` does not cover"):
        Session(surfaced(), camera(), DEFAULT)


@pytest.mark.parametrize(
    ("words", "surface", "tolerance"),
    [([], None, 0.01), (["--surface", "0.3"], js.Surface(0.3, **SHOWN), None), (["--surface", "none"], None, 0.01)],
)
def test_the_command_shows_surfaces_as_pictures_do(words, surface, tolerance, empty, monkeypatch, capsys):
    np.savez("drop.npz", position=np.random.default_rng(0).normal(size=(60, 3)), support=np.full(60, 0.8))
    made = []
    monkeypatch.setattr(cli_view, "run", lambda server, ready: made.append(server))
    monkeypatch.setattr(cli_view, "Server", lambda session, port: session)
    assert run(capsys, "view", "drop.npz", *words, "--size", "16x12", "--no-browser")[0] == 0
    (session,) = made
    assert session.snapshot().scene.surface == surface and session.settings.tolerance == tolerance
    assert ("surface=0.3" in session.code()["python"]) == (surface is not None)
