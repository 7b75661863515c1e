"""Many frames: few programs for all of them, the same bits in any order, files that are there left alone."""

import dataclasses
import itertools
import pickle
from collections.abc import Sequence

import numpy as np
import pytest
from png_chunks import with_check_sum_apart

import jaxsph as js
from jaxsph.engine.runtime.programs import PROGRAMS
from jaxsph.sequence.frames import AHEAD, _some
from jaxsph.sequence.task import FINGERPRINT, FrameTask, fingerprint_of

pytestmark = pytest.mark.usefixtures("quick_programs")

SETTINGS = js.Settings(samples=16)
CAMERA = js.Camera.look_at((0, 0, 4), (0, 0, 0), width=24, height=16, near=2, far=6)
LOOK = js.TransferFunction.from_points([-1, 1], [(1, 0, 0), (0, 0, 1)], [1.0, 4.0])


def cloud(count=100, shown=0):
    """Particles of one place, so that most tests share what is compiled, whatever is shown of them."""
    position = np.random.default_rng(0).normal(size=(count, 3)) * 0.4
    quantity = np.sin(position[:, 0] + shown)
    return js.Scene(particles=js.Particles.from_arrays(position, 2.0 * count ** (-1 / 3), quantity), transfer=LOOK)


@pytest.fixture
def snapshots(tmp_path):
    """Six files, each larger than the one before, of particles that fall and appear."""
    rng = np.random.default_rng(1)
    start = rng.normal(size=(1800, 3)) * 0.4
    for number, count in enumerate((700, 800, 1000, 1200, 1500, 1800)):
        when = 0.25 * number
        position = start[:count] - (0, 0.3 * when, 0)
        ids = rng.permutation(count)
        columns = {"id": ids, "support": np.full(count, 2.0 * count ** (-1 / 3)), "temperature": start[ids, 0]}
        np.savez(tmp_path / f"s_{number:03d}.npz", position=position[ids], time=when, **columns)
    return js.sequence.Snapshots.from_files(sorted(tmp_path.glob("s_*.npz")))


@pytest.mark.slow
def test_48_frames_over_6_snapshots_of_different_size_compile_at_most_three_times(snapshots, compiles):
    PROGRAMS.clear()
    cameras = js.CameraPath.orbit(CAMERA, 360, center=(0, 0, 0)).cameras(48)
    frames, before = 0, 0
    for image in js.render_frames(snapshots.moments(np.linspace(0, 1.25, 48)), cameras, SETTINGS):
        frames, before = frames + (len(compiles) > before), len(compiles)
        assert np.asarray(image.alpha).max() > 0.5
    assert 1 <= frames <= 3


@pytest.mark.slow
def test_an_image_is_the_same_bits_as_alone_whatever_was_rendered_before():
    scenes = [cloud(count) for count in (400, 1500, 500)]
    together = list(js.render_frames(scenes, CAMERA, SETTINGS))
    again = list(js.render_frames([scenes[0], scenes[2]], CAMERA, SETTINGS))
    for one, other in ((together[0], again[0]), (together[2], again[1])):
        np.testing.assert_array_equal(one.color, other.color)
    expected = js.reference.render(scenes[2], CAMERA, SETTINGS)
    np.testing.assert_allclose(together[2].color, expected.color, atol=2e-5)


@pytest.mark.slow
def test_sources_are_made_one_at_a_time_when_it_is_their_turn():
    made = []

    def source(number):
        made.append(number)
        return cloud(shown=number)

    frames = js.render_frames((lambda n=n: source(n) for n in range(3)), CAMERA, SETTINGS)
    assert made == []
    next(frames)
    assert made == [0]
    assert len(list(frames)) == 2 and made == [0, 1, 2]


def test_files_that_are_there_are_left_alone_and_others_are_made(tmp_path, by_reference):
    scenes = [cloud(shown=number) for number in range(4)]
    render = lambda settings=SETTINGS: list(js.render_frames(scenes, CAMERA, settings, output=tmp_path / "frames"))  # noqa: E731
    first = render()
    assert [frame.rendered for frame in first] == [True] * 4 and first[2].path.name == "00003.png"
    bytes_of = {frame.path: frame.path.read_bytes() for frame in first}
    first[1].path.unlink()
    first[2].path.write_bytes(bytes_of[first[2].path][:200])  # as a disk that was full leaves it
    again = render()
    assert [frame.rendered for frame in again] == [False, True, True, False]
    assert {frame.path: frame.path.read_bytes() for frame in again} == bytes_of
    assert not any(frame.rendered for frame in render(js.Settings(samples=16, memory_limit=1 << 30)))
    assert all(frame.rendered for frame in render(js.Settings(samples=16, min_transmittance=1e-9)))


@pytest.mark.slow
def test_frames_may_be_exr_by_a_pattern(tmp_path):
    pattern = str(tmp_path / "f_{:03d}.exr")
    (frame,) = js.render_frames(cloud(), CAMERA, SETTINGS, output=pattern)
    assert frame.path.name == "f_001.exr" and frame.stats["pairs"] > 0
    alone = js.render(cloud(), CAMERA, SETTINGS)
    np.testing.assert_allclose(js.io.read_image(frame.path).color, alone.color, atol=1e-6)
    assert [frame.rendered for frame in js.render_frames(cloud(), CAMERA, SETTINGS, output=pattern)] == [False]


def test_anything_that_a_picture_depends_on_makes_another_frame(tmp_path, by_reference):
    scene = cloud()
    hotter = dataclasses.replace(scene, transfer=js.TransferFunction.from_points([-1, 1], [(1, 0, 0), (0, 1, 1)], [1.0, 4.0]))
    kernel = dataclasses.replace(scene, particles=dataclasses.replace(scene.particles, kernel="wendland_c2"))
    moved = js.Camera.look_at((0, 0, 4.001), (0, 0, 0), width=24, height=16, near=2, far=6)
    for source, camera in ((scene, CAMERA), (hotter, CAMERA), (kernel, CAMERA), (scene, moved)):
        (frame,) = js.render_frames([source], [camera], SETTINGS, output=tmp_path / "frames")
        assert frame.rendered


def test_frames_whose_files_hold_other_colours_are_made_anew(monkeypatch):
    task = FrameTask(1, cloud(), CAMERA, SETTINGS)
    before = task.fingerprint()
    assert task.fingerprint() == before
    monkeypatch.setattr("jaxsph.sequence.task.LIGHT", "as displayed")
    assert task.fingerprint() != before


def test_files_are_shown_with_one_look(snapshots, by_reference):
    paths = [file.path for file in snapshots.survey.files[:3]]
    images = list(js.render_frames(paths, CAMERA, SETTINGS))
    assert len(images) == 3
    expected = js.reference.render(js.sequence.Snapshots.from_files(paths).at(0.25), CAMERA, SETTINGS)
    np.testing.assert_allclose(images[1].color, expected.color, atol=2e-5)


def test_a_moment_can_be_sent_elsewhere(snapshots):
    moment = snapshots.moments([0.3])[0]
    moment()
    sent = pickle.loads(pickle.dumps(moment))
    assert sent.fingerprint == moment.fingerprint
    np.testing.assert_array_equal(sent().particles.position, moment().particles.position)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"sources": [cloud()], "cameras": [CAMERA] * 2}, "1 `sources` and 2 `cameras`"),
        ({"sources": 3, "cameras": [CAMERA]}, "`sources` must be"),
        ({"sources": cloud(), "cameras": js.CameraPath.orbit(CAMERA)}, "path.cameras"),
        ({"sources": cloud(), "cameras": CAMERA, "client": object()}, "`client`"),
        ({"sources": cloud(), "cameras": CAMERA, "output": "frame.png"}, "pattern"),
    ],
)
def test_calls_that_make_no_sense_are_refused_at_once(given, said):
    with pytest.raises(ValueError, match=said):
        js.render_frames(settings=SETTINGS, **given)


def test_an_iterable_that_ends_too_early_is_told_of_after_its_frames(by_reference):
    frames = js.render_frames((cloud() for _ in range(2)), itertools.repeat(CAMERA), SETTINGS)
    next(frames), next(frames)
    with pytest.raises(ValueError, match="more `cameras` than the 2 `sources`"):
        next(frames)


def test_a_camera_that_flies_close_is_foreseen_and_compiled_for_once(compiles):
    closer = js.Camera.look_at((0, 0, 0.9), (0, 0, 0), width=24, height=16, near=0.1, far=2)
    cameras = js.CameraPath.from_keys([(0, CAMERA)]).fly_to(closer, 1).cameras(9)
    frames, before = 0, 0
    for _ in js.render_frames(cloud(300), cameras, SETTINGS):
        frames, before = frames + (len(compiles) > before), len(compiles)
    assert frames <= 1


def test_in_double_precision_all_is(tmp_path):
    import jax

    with jax.enable_x64(True):
        path = js.CameraPath.orbit(center=(0, 0, 0), radius=2.0, degrees=30, width=8, height=8)
        assert path.at(2.0).dtype == np.float64


def test_a_frame_of_which_a_bit_is_damaged_is_made_again(tmp_path):
    """Whatever bit it is: decoding alone lets some through."""
    pixels, layer = np.random.default_rng(0).random((16, 24, 3)).astype(np.float32), np.zeros((16, 24), np.float32)
    path = tmp_path / "00001.png"
    js.io.write_image(path, js.Image(pixels, layer, layer, layer, layer, True, 0, {}, ((FINGERPRINT, "mark"),)))
    whole = with_check_sum_apart(path.read_bytes())
    path.write_bytes(whole)
    assert fingerprint_of(path) == "mark"
    start = whole.index(b"IDAT") + 4
    for bit in range(8 * start, 8 * (len(whole) - 16), 29):
        damaged = bytearray(whole)
        damaged[bit // 8] ^= 1 << bit % 8
        path.write_bytes(damaged)
        assert fingerprint_of(path) is None


def test_cameras_that_are_made_when_asked_for_are_looked_at_ahead():
    path = js.CameraPath.orbit(center=(0, 0, 0), radius=1, seconds=1)

    class Lazy(Sequence):
        asked = 0

        def __len__(self):
            return 1_000_000

        def __getitem__(self, frame):
            Lazy.asked += 1
            return path.at(frame / 1_000_000)

    assert len(_some(Lazy())) == AHEAD == Lazy.asked
