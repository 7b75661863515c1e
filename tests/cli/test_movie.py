"""The command `movie`: what it writes, that it goes on where it was stopped, and how it refuses."""

import json
import os
import signal
import subprocess
import sys
import time
import types
from pathlib import Path

import commanded
import numpy as np
import pytest
from exec_after import HEARS_INTERRUPTS, exec_after

import jaxsph as js
from jaxsph.cli.commands import movie as cli_movie
from jaxsph.io.opening.looks import look_of
from jaxsph.io.opening.opened import exposed
from jaxsph.io.opening.options import Look, View
from jaxsph.io.opening.views import framed
from jaxsph.model.preview.glimpse import glimpse

pytestmark = pytest.mark.usefixtures("quick_programs")

TINY = ["--size", "24x16", "--samples", "16"]


@pytest.fixture
def sequence(empty):
    """Three snapshots in an otherwise empty working directory; the command line sorts them."""
    position = np.random.default_rng(0).normal(size=(90, 3)).astype(np.float32)
    for number in range(3):
        columns = {"temperature": position[:, 0] + number, "support": np.full(90, 0.8, np.float32), "id": np.arange(90)}
        columns["velocity"] = np.zeros((90, 3))
        np.savez(f"s_{number}.npz", position=position + (0.1 * number, 0, 0), time=2.0 * number, **columns)
    return ["s_2.npz", "s_0.npz", "s_1.npz"]


def run(capsys, *arguments):
    return commanded.run(capsys, "movie", *arguments)


def test_a_sequence_becomes_a_movie_with_its_frames_beside_and_says_how(sequence, tmp_path, by_reference, capsys):
    code, out, err = run(capsys, *sequence, "--frames", 5, "--fps", 10, "--orbit", 360, "-o", "m.mp4", *TINY)
    assert (code, err) == (0, [])
    for said in (
        "3 snapshots",
        "0 to 4, as the files say",
        "180 matched",
        "temperature",
        "all 3 snapshots",
        "y; --up 0,0,1 has z",
    ):
        assert said in out
    assert all(said in out for said in ("s_1.npz", "m_frames", "0.5 s"))
    found = js.io.movie_info(tmp_path / "m.mp4")
    assert (found.frames, found.width, found.height, found.fps) == (5, 24, 16, 10) and found.seconds == pytest.approx(0.5)
    frames = sorted((tmp_path / "m_frames").iterdir())
    assert [path.name for path in frames] == [f"0000{number}.png" for number in range(1, 6)]
    images = [np.asarray(js.io.read_image(path).color) for path in frames]
    assert all(image.max() > 0.1 for image in images)


def test_a_frame_is_the_picture_of_its_time_and_camera(sequence, tmp_path, by_reference, capsys):
    key = {"eye": [0, 0, 9], "target": [0, 0, 0], "near": 4, "far": 14}
    keys = {"keys": [{"time": 1} | key, {"time": 1.3} | key | {"eye": [1, 0, 9]}], "width": 20, "height": 12}
    (tmp_path / "keys.json").write_text(json.dumps(keys))
    more = ["--fps", 10, "--samples", 16, "--frame-format", "exr", "--range", "-1,2"]
    code, out, _ = run(capsys, *sequence, "--camera", "keys.json", *more)
    assert code == 0 and "s_2.mp4, 4 frames" in out and "20 x 12" in out
    snapshots = js.sequence.Snapshots.from_files(sequence)
    typical, _ = look_of(snapshots.survey.middle, "temperature", Look(range=(-1, 2)))
    seen = framed(snapshots.survey.bulk() or snapshots, View(size=(512, 512)))
    transfer = exposed(js.Scene(particles=snapshots.survey.middle, transfer=typical), seen.camera, Look()).transfer
    path = js.CameraPath.load("keys.json")
    for frame in (1, 2, 4):
        scene = js.Scene(particles=snapshots.at(4 * (frame - 1) / 3).particles, transfer=transfer)
        expected = js.reference.render(scene, path.at(1 + (frame - 1) / 10), js.Settings(samples=16))
        image = js.io.read_image(tmp_path / "s_2_frames" / f"0000{frame}.exr")
        differs = np.abs(np.asarray(image.color) - expected.color).max(-1) > 1e-4
        assert differs.sum() <= 1


def test_a_sequence_has_a_frame_a_file_and_each_is_a_figure_of_its_time_where_there_is_a_key(sequence, by_reference, capsys):
    pytest.importorskip("matplotlib")
    code, out, err = run(capsys, *sequence, *TINY, "-o", "m.mp4")
    assert (code, err) == (0, []) and "3, one a file, 1 a second; --frames N" in out and "m.mp4, 3 frames, 3 s" in out
    code, _, err = run(capsys, *sequence, *TINY, "--annotate", "--background", "white", "-o", "k.mp4")
    assert (code, err) == (0, []) and sorted(path.suffix for path in Path("k_frames").iterdir()) == [".exr"] * 3
    plain, key = js.io.movie_info("m.mp4"), js.io.movie_info("k.mp4")
    assert (plain.width, plain.height) == (24, 16) and key.width > 300 and key.frames == 3  # of one size, else none is written


def test_the_middle_of_a_sequence_is_lit_as_its_file_alone(sequence, cameras, capsys):
    """However its extinction is fitted: by the picture."""
    assert run(capsys, *sequence, *TINY, "--range", "-1,2", "--exposure", "1", "-o", "m.mp4")[0] == 0
    scene, camera = js.io.read_scene("s_1.npz", range=(-1, 2), exposure=1, size=(24, 16))
    light = [glimpse(one, camera).weights().sum(-1).mean() for one in (scene, cameras.source[1]())]
    assert light[1] == pytest.approx(light[0], rel=0.1)


def test_figures_of_physical_snapshots_have_lengths_without_scale_factor(sequence, monkeypatch, by_reference, capsys):
    h5py, figures = pytest.importorskip("h5py"), pytest.importorskip("jaxsph.plot.image_figure")
    for number in range(2):
        with h5py.File(f"c_{number}.hdf5", "w") as file:
            file.create_group("Header").attrs.update({"Redshift": 1.0 + number, "HubbleParam": 0.7, "MassTable": np.ones(6)})
            file.create_group("Parameters").attrs.update({"UnitLength_in_cm": 3e21, "UnitMass_in_g": 2e43})
            file["Parameters"].attrs["UnitVelocity_in_cm_per_s"] = 1e5
            group = file.create_group("PartType0")
            group["Coordinates"], group["SmoothingLength"] = np.random.default_rng(0).normal(size=(90, 3)), np.full(90, 0.8)
            group["Density"] = np.linspace(1, 2, 90)
    told = []

    def recorded(*given, labels, **more):
        told.append(labels.length)
        return figures.image_figure(*given, labels=labels, **more)

    monkeypatch.setattr("jaxsph.cli.commands.movie.image_figure", recorded)
    assert run(capsys, "c_0.hdf5", "c_1.hdf5", *TINY, "--annotate", "--physical", "-o", "m.mp4")[0] == 0
    assert {(length.a, length.h) for length in told} == {(0, 0)}


def test_a_first_frame_that_shows_nothing_is_told_before_the_others_are_made(sequence, by_reference, capsys):
    code, _, err = run(capsys, *sequence, "--exposure", "-20", *TINY, "-o", "m.mp4")
    assert code == 0 and len(err) == 1 and "m_frames/00001.png: all of the pixels are nearly black" in err[0]


@pytest.mark.slow
def test_one_source_is_seen_from_a_camera_that_goes_around(empty, capsys):
    code, _, err = run(capsys, "scene:radial:particles=300", "--orbit", 360, "--frames", 3, *TINY, "-o", "m.mp4")
    assert (code, err) == (0, []) and js.io.movie_info("m.mp4").frames == 3
    images = [np.asarray(js.io.read_image(f"m_frames/0000{number}.png").color) for number in (1, 2, 3)]
    assert all(image.max() > 0.1 and image[0].max() == 0 and image[:, 0].max() == 0 for image in images)  # nothing is cut off
    assert not np.array_equal(images[0], images[2])


@pytest.fixture
def cameras(monkeypatch):
    """Those that frames would be rendered by, and their scene or snapshots."""
    found = types.SimpleNamespace()

    def render(sources, cameras, settings, client=None, output=None):
        found.cameras, found.source = [*cameras], sources
        return commanded.frames_made(found.cameras)

    monkeypatch.setattr(cli_movie, "render_frames", render)
    return found


def looked_at(camera, place):
    """How wide the picture is at the depth of a place, and how far that lies from its middle."""
    right, up, depth = np.asarray(camera.axes, np.float64) @ (np.asarray(place) - camera.exact_eye())
    wide = 2 * float(camera.half_height) * camera.width / camera.height
    return wide * (depth if camera.is_perspective else 1), max(abs(right), abs(up)), depth


@pytest.mark.parametrize("view", [[], ["--view", "x"], ["--center", "0.5,0,0.25"]], ids=["iso", "x", "center"])
def test_a_camera_that_goes_around_a_sequence_keeps_its_middle_and_width(sequence, cameras, capsys, view):
    assert run(capsys, *sequence, "--width", "0.75", *view, "--orbit", 90, "--frames", 3, *TINY, "-o", "m.mp4")[0] == 0
    place = (0.5, 0, 0.25) if "--center" in view else np.mean(cameras.source[0].snapshots.bounds(), 0)
    for camera in cameras.cameras:
        wide, off, depth = looked_at(camera, place)
        assert wide == pytest.approx(0.75, rel=1e-4) and off < 1e-4 and float(camera.near) < depth < float(camera.far)
    assert cameras.cameras[0].exact_eye() @ cameras.cameras[-1].exact_eye() != pytest.approx(1)


def test_a_camera_that_goes_around_a_clip_has_depths_of_it(sequence, cameras, capsys):
    corners = np.array([[-0.5, -0.25, -0.5], [0.5, 0.25, 0.25]])
    clip = "box:" + ",".join(map(str, corners.ravel()))
    assert run(capsys, sequence[0], "--clip", clip, "--orbit", 360, "--frames", 5, *TINY, "-o", "m.mp4")[0] == 0
    reach = np.linalg.norm(corners[1] - corners[0]) / 2
    for camera in cameras.cameras:
        wide, off, depth = looked_at(camera, corners.mean(0))
        assert float(camera.near) > depth - 1.01 * reach and float(camera.far) < depth + 1.01 * reach and off < 1e-4
        assert 1 < wide < 6


@pytest.mark.parametrize("number", [1, 3])
def test_matter_across_the_faces_of_a_box_is_in_the_middle_of_a_movie(sequence, cameras, capsys, number):
    for name in sequence:
        columns = dict(np.load(name))
        columns["position"] = np.mod(0.02 * columns["position"], 10).astype(np.float32)
        np.savez(name, **columns | {"support": np.full(90, 0.05, np.float32)})
    more = ["--box-size", "10,10,10", "--orbit", 90, "--frames", 3, *TINY, "-o", "m.mp4"]
    code, out, _ = run(capsys, *sequence[:number], *more)
    assert code == 0 and "lies across its faces" in out
    for camera in cameras.cameras:
        wide, off, _ = looked_at(camera, np.round(camera.exact_eye() / 10) * 10)
        assert 0.1 < wide < 0.6 and off < 0.05
    shown = cameras.source if number == 1 else cameras.source[1]()
    assert np.ptp(shown.particles.to_numpy()["position"], 0).max() < 0.3


def test_a_sequence_in_a_period_is_framed_by_what_spreads_later_too(sequence, cameras, capsys):
    for name, size in zip(sorted(sequence), (0.02, 0.05, 0.3), strict=True):
        columns = dict(np.load(name))
        columns["position"] = (5 + size * columns["position"]).astype(np.float32)
        np.savez(name, **columns | {"support": np.full(90, 0.05, np.float32)})
    code, out, _ = run(capsys, *sequence, "--box-size", "10,10,10", *TINY, "-o", "m.mp4")
    assert code == 0 and "nearly all of the first, middle and last snapshot" in out
    camera, place = cameras.cameras[0], np.load("s_2.npz")["position"].astype(np.float64)
    right, up, depth = np.asarray(camera.axes, np.float64) @ (place - camera.exact_eye()).T
    assert (np.abs([right / 1.5, up]).max(0) < float(camera.half_height) * depth).mean() > 0.95


@pytest.mark.slow
def test_options_of_which_particles_and_where_hold_for_all_frames(sequence, tmp_path, capsys):
    chosen = ["--where", "temperature > 0 and x < 2", "--share", 0.9, "--clip", "box:-2,-2,-2,2,2,2"]
    code, out, err = run(capsys, *sequence, "--frames", 2, *chosen, "--box-size", "9,9,9", *TINY, "-o", "a.mp4")
    assert (code, err) == (0, []) and "left out by temperature > 0" in out and "for a quick look" in out
    orbit = ["--orbit", 90, "--frames", 2, "--clip", "sphere:0,0,0,1", *TINY, "-o", "c.mp4"]
    assert run(capsys, "s_0.npz", "--where", "temperature > 0", *orbit)[0] == 0


@pytest.mark.slow
def test_a_command_that_was_killed_goes_on_and_ends_with_the_same_bits(sequence, tmp_path):
    command = [sys.executable, "-m", "jaxsph", "movie", *sequence, "--frames", "24", "--orbit", "90", *TINY, "--no-cache"]
    killed = subprocess.Popen([*command, "-o", "m.mp4"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    until = time.monotonic() + 300
    while time.monotonic() < until and killed.poll() is None and not (tmp_path / "m_frames" / "00003.png").exists():
        time.sleep(0.005)
    killed.send_signal(signal.SIGKILL)
    killed.wait(timeout=60)
    done = {path.name: path.stat().st_mtime_ns for path in (tmp_path / "m_frames").glob("0*.png")}
    assert 3 <= len(done) < 24 and not (tmp_path / "m.mp4").exists()
    again = subprocess.run([*command, "-o", "m.mp4"], capture_output=True, text=True, check=True)
    assert f"24 files, {len(done)} of which were there already" in again.stderr
    assert {name: (tmp_path / "m_frames" / name).stat().st_mtime_ns for name in done} == done
    subprocess.run([*command, "-o", "whole.mp4"], check=True, capture_output=True)
    for number in range(1, 25):
        name = f"{number:05d}.png"
        assert (tmp_path / "m_frames" / name).read_bytes() == (tmp_path / "whole_frames" / name).read_bytes()
    assert (tmp_path / "m.mp4").read_bytes() == (tmp_path / "whole.mp4").read_bytes()


def test_what_is_there_is_not_rendered_again_and_other_settings_are(sequence, by_reference, capsys):
    arguments = [*sequence, "--frames", 3, "-o", "m.mp4", *TINY]
    assert "3 files;" in run(capsys, *arguments)[1]
    assert "3 of which were there already" in run(capsys, *arguments)[1]
    assert "3 files;" in run(capsys, *arguments, "--colormap", "heat")[1]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["s_0.npz"], "needs a camera that moves"),
        (["s_0.npz", "--orbit", 0], "--orbit must be"),
        (["s_0.npz", "--orbit", 1e308], "--orbit must be"),
        (["s_0.npz", "--orbit", 9, "--camera", "keys.json"], "--orbit and --camera exclude each other"),
        (["s_0.npz", "--camera", "keys.json", "--eye", 0, 0, 9], "exclude each other"),
        (["s_0.npz", "s_1.npz", "-o", "m.avi"], ".mp4"),
        (["s_0.npz", "s_1.npz", "--fps", 0], "--fps"),
        (["s_0.npz", "s_1.npz", "--frames", 0], "--frames"),
        (["s_0.npz", "s_1.npz", "--progressive"], "--progressive"),
        (["s_0.npz", "s_1.npz", "--iso", 1], "--iso"),
        (["s_0.npz", "s_1.npz", "--workers", 0], "--workers must be a whole number of at least 1, got '0'"),
        (["s_0.npz", "s_1.npz", "--workers", 2, "--client", "tcp://x:1"], "--workers and --client exclude each other"),
        (["s_0.npz", "s_1.npz", "--client", "nonsense"], "no address of a scheduler"),
        (["s_0.npz", "s_1.npz", "--share", 0], "--share must be above 0"),
        (["s_0.npz", "s_1.npz", "--center", "mass"], "--center mass is for one file"),
        (["s_0.npz", "scene:mixer"], "scene:mixer"),
        (["s_0.npz", "--orbit", 9, "--color-by", "2*velocity.los"], "along the line of sight of the picture of one file"),
        ([], "is needed as FILE"),
    ],
)
def test_wrong_usage_is_told_in_one_line(sequence, capsys, arguments, said):
    assert said in commanded.refused(capsys, "movie", *arguments)


def test_bad_files_are_told_in_one_line_before_anything_is_rendered(sequence, tmp_path, capsys):
    (tmp_path / "s_1.npz").rename(tmp_path / "s_4.npz")
    (tmp_path / "s_3.npz").write_bytes((tmp_path / "s_2.npz").read_bytes())
    code, _, err = run(capsys, "s_0.npz", "s_2.npz", "s_3.npz", "s_4.npz", *TINY)
    assert code == 1 and "number 1 is missing" in err[0] and "--gaps" in err[0]
    code, _, err = run(capsys, "s_0.npz", "s_2.npz", "s_3.npz", "s_4.npz", "--gaps", *TINY)
    assert code == 1 and "s_2.npz and s_3.npz are both of time 4" in err[0]
    (tmp_path / "s_3.npz").write_bytes((tmp_path / "s_2.npz").read_bytes()[:700])
    code, _, err = run(capsys, "s_2.npz", "s_3.npz", "s_4.npz", "--strict", *TINY)
    assert code == 1 and len(err) == 1 and "1 of 3 snapshots cannot be read" in err[0] and "s_3.npz" in err[0]
    assert not list(tmp_path.glob("*_frames"))


@pytest.mark.parametrize("where", [[], pytest.param(["--workers", 2], marks=pytest.mark.slow)], ids=["here", "workers"])
def test_a_file_that_cannot_be_read_costs_its_frames_alone(sequence, tmp_path, by_reference, capsys, where):
    (tmp_path / "s_1.npz").write_bytes((tmp_path / "s_1.npz").read_bytes()[:700])
    code, out, err = run(capsys, *sequence, "--frames", 5, "-o", "m.mp4", *TINY, *where)
    assert code == 1 and len(err) == 1
    assert (
        "3 of 5 frames could not be made: frames 2 to 4: there is no scene between times 0 and 4" in err[0]
        and "s_1.npz" in err[0]
    )
    assert "unread    s_1.npz" in out and "m.mp4, 2 of 5 frames" in out
    assert sorted(path.name for path in (tmp_path / "m_frames").iterdir()) == ["00001.png", "00005.png"]
    assert js.io.movie_info("m.mp4").frames == 2


def test_a_file_at_an_end_that_cannot_be_read_is_named_though_no_frame_needs_it(sequence, tmp_path, capsys):
    (tmp_path / "s_2.npz").write_bytes((tmp_path / "s_2.npz").read_bytes()[:700])
    code, out, err = run(capsys, *sequence, "--frames", 2, "-o", "m.mp4", *TINY)
    assert code == 1 and len(err) == 1 and "1 of the snapshots cannot be read: s_2.npz" in err[0]
    assert "m.mp4, 2 frames" in out


def test_a_scheduler_that_does_not_answer_is_told_of_before_files_are_read(sequence, capsys, monkeypatch):
    monkeypatch.setattr(cli_movie, "ANSWER", 0.3)
    code, out, err = run(capsys, *sequence, "--client", "tcp://127.0.0.1:9", *TINY)
    assert (code, out.strip(), len(err)) == (1, "", 1) and "no scheduler answers there within 0.3 s" in err[0]


@pytest.mark.slow
def test_an_interrupt_leaves_frames_and_no_processes(sequence, tmp_path):
    command = exec_after(HEARS_INTERRUPTS, "movie", *sequence, "--frames", "400", *TINY, "--workers", "2", "-o", "m.mp4")
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True)
    until = time.monotonic() + 300
    while time.monotonic() < until and process.poll() is None and not (tmp_path / "m_frames" / "00003.png").exists():
        time.sleep(0.005)
    os.killpg(process.pid, signal.SIGINT)  # as a terminal does, to all of them
    _, err = process.communicate(timeout=60)
    assert process.returncode == 130 and err.splitlines()[-1] == "jaxsph movie: interrupted", err
    assert "stopped" in err and not (tmp_path / "m.mp4").exists()
    assert not list((tmp_path / "m_frames").glob(".*"))
    until = time.monotonic() + 30
    while time.monotonic() < until and is_there(process.pid):
        time.sleep(0.05)
    assert not is_there(process.pid)


def is_there(group):
    """Whether any process of a group is."""
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return False
    return True


@pytest.mark.parametrize(
    ("keys", "said"),
    [
        ([{"time": 0, "eye": [0, 0, 9], "target": [0, 0, 0], "zoom": 2}], "key 1 has 'zoom', which is not known"),
        ([{"time": t, "eye": [0, 0, 9], "target": [0, 0, 0]} for t in (1, 0)], "must ascend, but 0 follows 1"),
    ],
)
def test_key_frames_that_make_no_path_are_told_with_their_file(sequence, tmp_path, capsys, keys, said):
    (tmp_path / "keys.json").write_text(json.dumps({"keys": keys}))
    code, _, err = run(capsys, *sequence, "--camera", "keys.json", *TINY)
    assert code == 1 and len(err) == 1 and said in err[0] and "keys.json" in err[0]


def test_a_movie_without_end_is_refused_with_the_time_that_was_meant(sequence, tmp_path, capsys):
    key = {"time": 0, "eye": [0, 0, 9], "target": [0, 0, 0]}
    (tmp_path / "k.json").write_text(json.dumps({"keys": [key, key | {"time": 1e12, "eye": [0, 9, 1]}]}))
    code, _, err = run(capsys, "s_0.npz", "--camera", "k.json", *TINY)
    assert code == 1 and len(err) == 1 and "k.json" in err[0] and "lasts 1e+12 s" in err[0] and "--frames" in err[0]
    code, _, err = run(capsys, "s_0.npz", "--orbit", 360, "--frames", 1_000_000_000, *TINY)
    assert code == 2 and len(err) == 1 and "--frames must be at most 1,000,000" in err[0] and "hours" in err[0]


def test_a_sequence_is_seen_face_on_from_one_direction(empty, tmp_path, by_reference, capsys):
    rng, tilt = np.random.default_rng(0), np.radians(50)
    axis = np.array([0, np.sin(tilt), np.cos(tilt)])
    for nth in range(2):
        place = rng.normal(size=(90, 3))
        place -= np.outer(place @ axis, axis)
        columns = {"velocity": np.cross((-1) ** nth * axis, place), "support": np.full(90, 0.8), "mass": np.ones(90)}
        np.savez(f"d_{nth}.npz", position=place, time=float(nth), **columns)  # the second turns the other way
    for view, cosine in (("face-on", 1.0), ("edge-on", 0.0)):
        code, out, err = run(capsys, "d_0.npz", "d_1.npz", "--view", view, "-o", f"{view}.mp4", *TINY)
        assert (code, err) == (0, []), err
        told = next(line for line in out.splitlines() if f"{view} in d_0.npz, from" in line)
        toward = np.array(told.partition("from ")[2].partition(" in all")[0].split(), float)
        assert toward @ axis == pytest.approx(cosine, abs=1e-4)
