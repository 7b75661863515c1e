"""A view without anybody who shows it: inputs coalesce, and what is old is abandoned; its pictures are of the reference."""

import dataclasses
import threading

import jax
import numpy as np
import pytest
from by_reference import pictures_by_reference
from views import HEIGHT, SETTINGS, WIDTH, as_it_began, camera, scene

import jaxsph as js
from jaxsph.model.transfer.maps import Scale
from jaxsph.viewer import session as views
from jaxsph.viewer.inputs import MAX_PIXELS, InputError, size_of
from jaxsph.viewer.session import Session
from jaxsph.viewer.stages import DRAFT, FULL, TOLERANCE, Abandoned, histogram_of, stages_of

pytestmark = pytest.mark.usefixtures("quick_programs")

SECONDS = 240


@pytest.fixture(scope="module")
def session():
    with pictures_by_reference(), Session(scene(), camera(), SETTINGS) as made:
        yield made


@pytest.fixture
def home(session):
    yield session
    as_it_began(session)


def test_every_frame_says_what_it_is_and_how_wrong(home):
    pictures = []
    undo = home.listen(pictures.append)
    home.do({"do": "orbit", "right": 0.01, "down": 0})
    home.wait(seconds=SECONDS)
    undo()
    told = [picture for picture in pictures if not isinstance(picture, dict) and picture.version == home.version]
    assert [picture.stage for picture in told] == [DRAFT, FULL]
    draft, full = told
    height, width = draft.image.shape
    assert width * height < WIDTH * HEIGHT / 3
    assert (
        draft.words
        == f"draft: {width} x {height}, 4 samples a ray; error not estimated; {WIDTH * HEIGHT - width * height:,} rays left"
    )
    assert full.words == f"full: {WIDTH} x {HEIGHT}, 16 samples a ray; error not estimated"
    assert (draft.format, full.format, full.header()["rays_left"]) == ("jpeg", "png", 0)
    assert draft.encoded[:2] == b"\xff\xd8" and full.encoded[:4] == b"\x89PNG"


def test_the_code_of_a_cut_has_all_clips():
    held = dataclasses.replace(scene(), within=js.Sphere((0, 0, 0), 0.75))
    made = Session(held, camera(), SETTINGS)
    made.do({"do": "cut", "kind": "plane", "outside": True})
    places = tuple(np.float32(np.random.default_rng(0).uniform(-1, 1, (3, 99))))
    line = next(line for line in made.code()["python"].splitlines() if "within" in line)
    space = {"js": js, "dataclasses": dataclasses, "scene": scene()}
    exec(line, space)
    told, kept = (jax.tree.map(np.asarray, shown.within).contains(places) for shown in (space["scene"], made.snapshot().scene))
    assert np.array_equal(told, kept)


def test_a_look_is_edited_and_taken_back(home):
    before = np.asarray(home.snapshot().transfer.extinction)
    assert len(before) == 8  # four points, and room
    home.do({"do": "exposure", "stops": 1})
    assert np.array_equal(np.asarray(home.snapshot().transfer.extinction), 2 * before)
    home.do({"do": "undo"})
    assert np.array_equal(np.asarray(home.snapshot().transfer.extinction), before)
    home.do({"do": "redo"})
    assert np.array_equal(np.asarray(home.snapshot().transfer.extinction), 2 * before)
    home.do({"do": "colormap", "name": "viridis"})
    assert np.allclose(np.asarray(home.snapshot().transfer.colors)[0], (0.267, 0.005, 0.329), atol=0.01)
    home.do({"do": "points", "points": [[0.5, 2, 1, 0, 0], [0.25, 1, 0, 1, 0]]})
    values = np.asarray(home.snapshot().transfer.values)
    assert np.allclose(values[:2], (-0.3, 0.0), atol=1e-6) and (values[2:] == values[1]).all()


def test_a_drag_of_points_is_one_step_back(home):
    first = home.state()["look"]["points"]
    for opaque in (1.0, 2.0, 3.0):
        rows = [[*row] for row in first]
        rows[0][1] = opaque
        home.do({"do": "points", "points": rows, "done": opaque == 3.0})
    home.do({"do": "undo"})
    assert home.state()["look"]["points"] == first


def test_a_pixel_is_told_in_numbers_and_what_is_seen_there_becomes_the_middle(home):
    picture = home.wait(seconds=SECONDS)
    told = home.do({"do": "pick", "right": 0.0, "down": 0.0})
    assert (told["row"], told["column"]) == (HEIGHT // 2, WIDTH // 2)
    assert np.allclose(told["color"], np.asarray(picture.image.color)[HEIGHT // 2, WIDTH // 2])
    assert np.isclose(told["depth"], 4, atol=1.2) and -0.7 < told["quantity"] < 0.7 and told["neighbours"] > 3
    home.do({"do": "center", "right": 0.0, "down": 0.0})
    assert np.allclose(home.snapshot().pose.target, told["place"])
    with pytest.raises(InputError, match="nothing is seen there"):
        home.wait(seconds=SECONDS)
        home.do({"do": "center", "right": 0.7, "down": -0.45})


def test_the_code_that_is_told_makes_the_picture(home, empty, tmp_path):
    home.do({"do": "orbit", "right": 0.2, "down": 0.1})
    home.do({"do": "exposure", "stops": 0.5})
    space = {"scene": scene(), "camera": None}
    exec(home.code()["python"], space)
    assert np.abs(np.asarray(space["image"].color) - np.asarray(home.wait(seconds=SECONDS).image.color)).max() < 1e-6
    assert (tmp_path / "view.png").exists()


@pytest.mark.parametrize(
    "message",
    [None, 3, [], {}, {"do": 3}, {"do": "explode"}, {"do": "orbit"}, {"do": "orbit", "right": "a", "down": 0}, {"do": "points"},
     {"do": "orbit", "right": float("nan"), "down": 0}, {"do": "zoom", "factor": -1}, {"do": "axis", "name": ["x"]},
     {"do": "points", "points": []}, {"do": "points", "points": [[0, -1, 0, 0, 0]]}, {"do": "points", "points": [[0] * 5] * 1000},
     {"do": "points", "points": [[0, 1, 2, 0, 0]]}, {"do": "colormap", "name": "nothing of the kind"}, {"do": "colormap"},
     {"do": "restore"}, {"do": "restore", "pose": {"target": [0, 0]}}, {"do": "pick"}, {"do": "exposure", "stops": True},
     {"do": "restore", "pose": {"target": [0, 0, 0], "pole": [0, 0, 0], "forward": [0, 0, 1], "up": [0, 1, 0], "distance": 4,
                                "tangent": 0.3, "perspective": True}},
     {"do": "size"}, {"do": "size", "width": 40}, {"do": "size", "width": "wide", "height": 30},
     {"do": "size", "width": -4, "height": 30}, {"do": "size", "width": 40, "height": 0},
     {"do": "size", "width": 40, "height": float("nan")}, {"do": "size", "width": 1e9, "height": 3}],
    ids=str,
)  # fmt: skip
def test_what_makes_no_sense_is_refused_and_changes_nothing(session, message):
    version = session.version
    with pytest.raises(InputError):
        session.do(message)
    assert session.version == version


def test_a_view_has_as_many_pixels_as_its_page_has_room_for_and_so_has_its_code():
    with pictures_by_reference(), Session(scene(), camera(), SETTINGS, fits=True) as made:
        made.do({"do": "key"})
        made.do({"do": "size", "width": 40, "height": 36})
        made.do({"do": "key"})
        whole = made.wait(seconds=SECONDS)
        assert made.state()["size"] == whole.header()["size"] == [40, 36] and whole.image.shape == (36, 40)
        assert {(one.width, one.height) for one in made.snapshot().path.legs[0].cameras} == {(40, 36)}
        first = camera()
        for message in ({"do": "size", "width": 40, "height": 36}, {"do": "orbit", "right": 0.1, "down": 0}, {"do": "home"}):
            version = made.version
            made.do(message)
            assert (made.version == version) == (message["do"] == "size")
            space = {"js": js, "dataclasses": dataclasses, "scene": scene(), "camera": first}
            exec(made.code()["python"].partition("image = ")[0], space)
            for one, other in zip(jax.tree.leaves(space["camera"]), jax.tree.leaves(made.snapshot().camera), strict=True):
                np.testing.assert_allclose(one, other, rtol=1e-6, atol=1e-6)
            assert (space["camera"].width, space["camera"].height) == (40, 36)


@pytest.mark.parametrize("size", [(40, 36), (30, 90), (60, 32), (200, 20)], ids=str)
@pytest.mark.parametrize("perspective", [True, False])
def test_what_a_camera_framed_is_in_a_picture_of_any_shape_and_as_large_as_it_can_be(size, perspective):
    made = Session(scene(), camera(), SETTINGS, fits=True)
    for message in [] if perspective else [{"do": "projection", "name": "parallel"}]:
        made.do(message)
    first = made.snapshot()
    for width, height in ((17, 90), size):
        made.do({"do": "size", "width": width, "height": height})
    last = made.snapshot()
    shares = [float(last.camera.half_height / first.camera.half_height)]
    shares.append(shares[0] * (size[0] / size[1]) / (WIDTH / HEIGHT))
    assert min(shares) == pytest.approx(1, rel=1e-6) and last.pose.height / first.pose.height == pytest.approx(shares[0])
    made.do({"do": "size", "width": WIDTH, "height": HEIGHT})
    assert float(made.snapshot().camera.half_height) == pytest.approx(float(first.camera.half_height))


def test_a_size_that_was_given_stays(home):
    version = home.version
    home.do({"do": "size", "width": 40, "height": 36})
    assert home.version == version and home.state()["size"] == [WIDTH, HEIGHT]


@pytest.mark.parametrize("asked", [(1, 1), (1, 9000), (3000, 2000), (9000, 4000), (16384, 16384)], ids=str)
def test_a_picture_is_as_large_as_there_is_room_within_limits(asked):
    width, height = size_of({"do": "size", "width": asked[0], "height": asked[1]})
    assert min(width, height) >= 16 and width * height <= MAX_PIXELS
    if min(asked) >= 16:
        assert width / height == pytest.approx(asked[0] / asked[1], rel=1e-3)
    if min(asked) >= 16 and asked[0] * asked[1] <= MAX_PIXELS:
        assert (width, height) == asked


@pytest.mark.parametrize("within", [None, js.Sphere((0, 0, 0), 0.5)], ids=["everywhere", "in a clip"])
def test_a_histogram_says_what_rays_meet_and_what_takes_their_light(within):
    shown = dataclasses.replace(scene(), within=within)
    found = histogram_of(shown, camera(), Scale.of(np.asarray(shown.transfer.values)))
    assert len(found["edges"]) == len(found["there"]) + 1 and max(found["there"]) == 1
    assert max(found["absorbed"]) == 1 and found["rays"] > 0


class Slow:
    """A stage that is held up between bands, for as long as a test likes."""

    def __init__(self, name):
        self.name, self.settings = name, SETTINGS
        self.begun, self.go, self.seen, self.left = threading.Semaphore(0), threading.Semaphore(0), [], []
        self.sizes = set()

    def camera(self, camera):
        return camera

    def shown(self, scene):
        return scene

    def image(self, state, stop):
        self.seen.append(float(state.camera.eye[0]))
        self.sizes.add((state.camera.width, state.camera.height))
        self.begun.release()
        assert self.go.acquire(timeout=60)
        if stop():
            self.left.append(self.seen[-1])
            raise Abandoned
        layer = np.zeros((2, 3), np.float32)
        return js.Image(np.zeros((2, 3, 3), np.float32), layer, layer, layer, layer, True, 0, {})


@pytest.fixture
def slow():
    """A session whose stages are held up."""
    made = Session(scene(), camera(), SETTINGS)
    made.stages = (Slow(DRAFT), Slow(FULL))
    yield made.start()
    for stage in made.stages:
        stage.go.release(100)
    assert made.close(60)


def test_inputs_coalesce_and_the_newest_wins(slow):
    draft, _ = slow.stages
    assert draft.begun.acquire(timeout=60)
    for _ in range(50):
        slow.do({"do": "pan", "right": 0.01, "down": 0})
    draft.go.release()
    assert draft.begun.acquire(timeout=60)
    draft.go.release()
    assert slow.wait(DRAFT, 60).version == slow.version == 51
    assert len(draft.seen) == 2 and draft.seen[-1] == pytest.approx(float(slow.snapshot().camera.eye[0]))


def test_a_picture_that_is_old_is_left_at_its_next_stage_and_drafts_go_on_beside_it(slow):
    draft, full = slow.stages
    draft.go.release(100)
    slow.wait(DRAFT, 60)
    assert full.begun.acquire(timeout=60)  # which is now held up
    slow.do({"do": "pan", "right": 0.1, "down": 0})
    assert slow.wait(DRAFT, 60).version == 2
    full.go.release()
    assert full.begun.acquire(timeout=60)
    full.go.release()
    assert slow.wait(FULL, 60).version == 2
    assert len(full.left) == 1 and full.left[0] == full.seen[0]


def test_a_colour_map_is_drafted_at_once_beside_what_is_under_way(slow):
    draft, full = slow.stages
    draft.go.release(100)
    slow.wait(DRAFT, 60)
    assert full.begun.acquire(timeout=60)  # which is now held up
    slow.do({"do": "colormap", "name": "viridis"})
    assert slow.wait(DRAFT, 60).version == 2 and not full.left


@pytest.mark.parametrize("says", [True, False], ids=["says its size", "says none"])
def test_a_view_that_fits_begins_with_the_size_of_its_page(monkeypatch, says):
    """No stage sees another size than its own; where no page says one, the view begins after a while."""
    made = []

    def stages(*_):
        made.append((Slow(DRAFT), Slow(FULL)))
        return made[-1]

    monkeypatch.setattr(views, "stages_of", stages)
    monkeypatch.setattr(views, "FIRST_SECONDS", 60.0 if says else 0.05)
    with Session(scene(), camera(), SETTINGS, fits=True) as session:
        if says:
            assert not made[0][0].begun.acquire(timeout=0.1)
            session.do({"do": "size", "width": WIDTH, "height": HEIGHT})  # which it has
        assert made[0][0].begun.acquire(timeout=30)
        session.do({"do": "size", "width": 40, "height": 36})
        for stage in (*made[0], *made[1]):
            stage.go.release(100)
        assert session.wait(FULL, 30).version == 2
    assert made[0][0].sizes == {(WIDTH, HEIGHT)} and made[1][0].sizes == made[1][1].sizes == {(40, 36)} and len(made) == 2


def test_a_stage_that_fails_is_told_and_the_view_goes_on(slow, monkeypatch):
    draft, full = slow.stages
    draft.go.release(100)
    full.go.release(100)
    told = []
    slow.listen(lambda what: told.append(what) if isinstance(what, dict) else None)
    slow.wait(seconds=60)
    monkeypatch.setattr(full, "image", lambda *_: 1 / 0)
    monkeypatch.setattr(views, "histogram_of", lambda *_: {}["nothing"])
    slow.do({"do": "pan", "right": 0.1, "down": 0})
    with pytest.raises(RuntimeError, match="full: ZeroDivisionError"):
        slow.wait(FULL, 60)
    monkeypatch.undo()
    slow.do({"do": "pan", "right": 0.1, "down": 0})
    assert slow.wait(FULL, 60).version == 3 and slow.told == ""
    assert {"is": "error", "text": "full: ZeroDivisionError: division by zero"} in told


def test_stages_lead_to_what_was_asked_for():
    asked = js.Settings(integrator="segments", tolerance=0.01)
    draft, full, last = stages_of(asked, camera(1024, 768))
    assert [stage.name for stage in (draft, full, last)] == [DRAFT, FULL, TOLERANCE]
    assert draft.shrink == 4 and (draft.settings.samples, draft.settings.tolerance) == (64, None)
    assert (full.settings.samples, full.settings.integrator_used, full.settings.tolerance) == (256, "samples", None)
    assert last.settings == asked
    quadtree = dataclasses.replace(SETTINGS, screen="quadtree")
    assert [stage.settings.screen for stage in stages_of(quadtree, camera())] == ["pixels", "pixels", "quadtree"]


def test_a_full_picture_is_planned_in_bands_between_which_it_can_be_left():
    assert js.plan(scene(), camera(), SETTINGS).bands == 1
    assert js.plan(scene(), camera(), SETTINGS, bands=9).bands == 2  # of 16 rows each
    with pytest.raises(ValueError, match="`bands` must be at least 1, got 0"):
        js.plan(scene(), camera(), SETTINGS, bands=0)


def test_what_is_no_scene_is_refused():
    with pytest.raises(ValueError, match="scene"):
        Session(camera(), scene())
