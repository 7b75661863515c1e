"""Frames on a cluster: the same bits as without one, whatever dies or is damaged on the way."""

import argparse
import os
import signal
import time
from concurrent.futures import Future

import jax
import numpy as np
import pytest
from images import same_bits

import jaxsph as js
from jaxsph.sequence import cluster as workers
from jaxsph.sequence.cluster import Share, local_client, share_of
from jaxsph.sequence.task import GrowingPlan

distributed = pytest.importorskip("distributed")

pytestmark = pytest.mark.usefixtures("quick_programs")

SETTINGS = js.Settings(samples=16)
CAMERA = js.Camera.look_at((0, 0, 4), (0, 0, 0), width=24, height=16, near=2, far=6)
LOOK = js.TransferFunction.from_points([-1, 1], [(1, 0, 0), (0, 0, 1)], [1.0, 4.0])
NO_PAGES = {"scheduler_kwargs": {"dashboard": False, "dashboard_address": "127.0.0.1:0"}, "dashboard_address": None}
IN_THIS_PROCESS = {"n_workers": 1, "threads_per_worker": 1, "processes": False, **NO_PAGES}
LAYERS = ("color", "transmittance", "depth", "error_bound", "evaluations")


def cloud(count=100, shown=0):
    position = np.random.default_rng(0).normal(size=(count, 3)) * 0.4
    quantity = np.sin(position[:, 0] + shown)
    return js.Scene(particles=js.Particles.from_arrays(position, 2.0 * count ** (-1 / 3), quantity), transfer=LOOK)


def sources(number, bad=()):
    """Functions that make scenes where they are called, but for some."""

    def source(n):
        if n in bad:
            raise ValueError("cut short")
        return cloud(shown=n)

    return [lambda n=n: source(n) for n in range(number)]


def test_frames_that_end_at_any_moment_are_seen_to_and_their_plans_kept(monkeypatch):
    class Ends(Future):  # between one look and the next
        def done(self):
            before = super().done()
            if not before:
                self.set_result((b"", frames, None))
            return before

    class Grown(int):
        grown = int.__add__

    frames, there = Grown(2), object.__new__(workers._Workers)
    there._plan = GrowingPlan([])
    found = Ends()
    there.wait([found])
    there.wait([found])
    assert there._plan.made == 4 and found.result()[1] is frames


@pytest.fixture(scope="module")
def client():
    """Of a worker that is a thread of this process, so that what is compiled serves both."""
    with distributed.LocalCluster(**IN_THIS_PROCESS) as cluster, distributed.Client(cluster) as made:
        yield made


@pytest.fixture
def snapshots(tmp_path):
    position = cloud().particles.to_numpy()["position"]
    for number in range(3):
        columns = {"support": np.full(100, 2.0 * 100 ** (-1 / 3)), "temperature": position[:, 0], "id": np.arange(100)}
        np.savez(tmp_path / f"s_{number}.npz", position=position + (0.1 * number, 0, 0), time=float(number), **columns)
    return sorted(tmp_path.glob("s_*.npz"))


def test_images_are_the_same_bits_as_without_a_client_and_come_in_order(client):
    expected = list(js.render_frames(sources(5), CAMERA, SETTINGS))
    images = list(js.render_frames(sources(5), CAMERA, SETTINGS, client))
    for image, alone in zip(images, expected, strict=True):
        same_bits(image, alone, *LAYERS)
    assert not np.array_equal(images[0].color, images[1].color) and np.asarray(images[0].alpha).max() > 0.5


@pytest.mark.slow
def test_frames_that_outgrow_the_plan_are_the_same_bits_too(client):
    cameras = [CAMERA, js.Camera.look_at((0, 0, 1.2), (0, 0, 0), width=24, height=16, near=0.1, far=3)] * 2
    for settings in (SETTINGS, js.Settings(samples=16, tolerance=0.02, estimator="pilot")):
        scenes = [cloud(count) for count in (100, 900, 300, 2000)]
        alone = js.render_frames(scenes, iter(cameras), settings)
        for image, expected in zip(js.render_frames(scenes, iter(cameras), settings, client), alone, strict=True):
            same_bits(image, expected, *LAYERS)


def test_files_are_written_and_what_cannot_be_made_is_named_at_the_end(client, empty):
    results = []
    with pytest.raises(js.sequence.FramesError, match="2 of 6 frames could not be made: frames 3 to 4: cut short") as raised:
        for frame in js.render_frames(sources(6, bad=(2, 3)), CAMERA, SETTINGS, client, output="on/{:02d}.exr"):
            results.append(frame)
    assert [(frame.number, frame.rendered, frame.error) for frame in results] == [
        (number, number not in (3, 4), "cut short" if number in (3, 4) else None) for number in range(1, 7)
    ]
    assert [frame.number for frame in raised.value.failed] == [3, 4] and str(results[0].path) == "on/01.exr"
    assert results[0].stats["pairs"] > 0
    with pytest.raises(js.sequence.FramesError, match="frames 3 to 4: cut short"):
        list(js.render_frames(sources(6, bad=(2, 3)), CAMERA, SETTINGS, output="alone/{:02d}.exr"))
    for number in (1, 2, 5, 6):
        same_bits(js.io.read_image(f"on/{number:02d}.exr"), js.io.read_image(f"alone/{number:02d}.exr"), *LAYERS)


def test_what_is_there_is_left_alone_and_what_was_bad_is_made_again(client, tmp_path):
    with pytest.raises(js.sequence.FramesError):
        list(js.render_frames(sources(3, bad=(1,)), CAMERA, SETTINGS, client, output=tmp_path))
    again = list(js.render_frames(sources(3), CAMERA, SETTINGS, client, output=tmp_path))
    assert [frame.rendered for frame in again] == [False, True, False]
    alone = list(js.render_frames(sources(3), CAMERA, SETTINGS, output=tmp_path / "alone"))
    assert [frame.path.read_bytes() for frame in again] == [frame.path.read_bytes() for frame in alone]


def test_choices_are_those_of_the_first_frame_that_can_be_read(client, tmp_path):
    with pytest.raises(js.sequence.FramesError, match="frame 1: cut short"):
        list(js.render_frames(sources(3, bad=(0,)), CAMERA, SETTINGS, client, output=tmp_path))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["00002.png", "00003.png"]


def test_no_more_sources_are_held_than_keep_workers_busy(client):
    drawn = []

    def scenes():
        for number in range(12):
            drawn.append(number)
            yield cloud(shown=number)

    frames = js.render_frames(scenes(), CAMERA, SETTINGS, client)
    assert drawn == []
    for done, _ in enumerate(frames, 1):
        assert len(drawn) <= done + workers.AHEAD
    assert len(drawn) == 12


def test_a_scene_of_many_frames_is_sent_once(client, monkeypatch):
    sent, submit = [], client.submit
    monkeypatch.setattr(client, "submit", lambda does, *more, **how: sent.append(does) or submit(does, *more, **how))
    cameras = js.CameraPath.orbit(CAMERA, 30, center=(0, 0, 0)).cameras(4)
    images = list(js.render_frames(cloud(), cameras, SETTINGS, client))
    assert len(images) == 4 and sent.count(bytes) == 1 and sent.count(workers._do) == 5


def test_a_sequence_of_files_is_the_same_bits_and_a_truncated_file_is_one_frame(client, snapshots, tmp_path):
    alone = list(js.render_frames(snapshots, CAMERA, SETTINGS))
    for image, expected in zip(js.render_frames(snapshots, CAMERA, SETTINGS, client), alone, strict=True):
        same_bits(image, expected, *LAYERS)
    snapshots[1].write_bytes(snapshots[1].read_bytes()[:500])
    for given in (client, None):
        frames = []
        with pytest.raises(js.sequence.FramesError, match=r"1 of 3 frames could not be made: frame 2: .*s_1\.npz"):
            for frame in js.render_frames(snapshots, CAMERA, SETTINGS, given, output=tmp_path / str(given is None)):
                frames.append(frame)
        assert [frame.error is None for frame in frames] == [True, False, True]
    with pytest.raises(ValueError, match=r"1 of 3 snapshots cannot be read.*s_1\.npz"):
        js.render_frames(snapshots, CAMERA, SETTINGS, client)


@pytest.mark.slow
def test_in_double_precision_all_is(client):
    with jax.enable_x64(True):
        rng = np.random.default_rng(0)
        position = rng.normal(size=(50, 3)) * 0.4
        look = js.TransferFunction.from_points(np.array([-1.0, 1]), np.array([(1.0, 0, 0), (0, 0, 1)]), np.array([1.0, 4.0]))
        scene = js.Scene(particles=js.Particles.from_arrays(position, 0.5, position[:, 0]), transfer=look)
        (image,) = js.render_frames([scene], [CAMERA], SETTINGS, client)
        (alone,) = js.render_frames([scene], [CAMERA], SETTINGS)
        assert image.color.dtype == np.float64
        same_bits(image, alone, *LAYERS)
    assert not jax.config.jax_enable_x64


def test_what_no_frame_would_escape_ends_all_at_once(client, tmp_path, monkeypatch):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(ValueError, match="frame 1 cannot be written"):
        list(js.render_frames(sources(3), CAMERA, SETTINGS, client, output=tmp_path / "file" / "{:02d}.png"))
    monkeypatch.setattr(workers._Workers, "_submitted", lambda self, to, does, _, *more: to.submit(does, "none", *more))
    with pytest.raises(ImportError, match="but none is asked for"):
        list(js.render_frames(sources(3), CAMERA, SETTINGS, client))


def test_an_image_that_cannot_be_made_raises_when_it_is_its_turn(client):
    frames = js.render_frames(sources(3, bad=(1,)), CAMERA, SETTINGS, client)
    next(frames)
    with pytest.raises(ValueError, match="cut short"):
        next(frames)


def test_an_iterable_that_ends_too_early_is_told_of_after_its_frames(client):
    frames = js.render_frames(iter(sources(2)), iter([CAMERA] * 3), SETTINGS, client)
    next(frames), next(frames)
    with pytest.raises(ValueError, match="more `cameras` than the 2 `sources`"):
        next(frames)


@pytest.mark.parametrize("number", [0, -1, 1.5, True])
def test_numbers_of_workers_that_make_no_sense_are_refused(number):
    with pytest.raises(ValueError, match="`workers` must be an integer of at least 1"), local_client(number):
        pass


@pytest.mark.parametrize(("cores", "number"), [(8, 2), (7, 3), (2, 2), (2, 5), (1, 1)])
def test_every_worker_has_cores_and_every_core_a_worker(cores, number):
    shares = [share_of(range(cores), place, number) for place in range(number)]
    assert all(shares) and set().union(*shares) == set(range(cores))
    if number <= cores:
        assert sum(map(len, shares)) == cores


def test_a_worker_has_a_device_of_its_own_and_the_compiled_programs_of_who_started_it(monkeypatch, tmp_path):
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "3,5")
    before = jax.config.jax_compilation_cache_dir
    shares = Share(4, [], workers._accelerators(), {"jax_compilation_cache_dir": str(tmp_path)})
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        shares.setup(argparse.Namespace(name=3))
        assert os.environ["CUDA_VISIBLE_DEVICES"] == "5" and jax.config.jax_compilation_cache_dir == str(tmp_path)
    finally:
        jax.config.update("jax_compilation_cache_dir", before)
        for number, handler in handlers.items():
            assert signal.getsignal(number) is signal.SIG_IGN
            signal.signal(number, handler)


@pytest.fixture
def interrupts():
    """How interrupts are heard; where this process was begun to ignore them, as in the background of a shell, it hears them."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield signal.default_int_handler
    signal.signal(signal.SIGINT, before)


def test_an_interrupt_while_processes_are_started_comes_when_they_can_be_closed(monkeypatch, interrupts):
    class Cluster:
        def __init__(self, **_):
            signal.raise_signal(signal.SIGINT)
            signal.raise_signal(signal.SIGINT)
            self.started = True

        def close(self, timeout):
            closed.append(self.started)

    closed = []
    monkeypatch.setattr(workers.distributed, "LocalCluster", Cluster)
    with pytest.raises(KeyboardInterrupt), workers.local_client(1):
        pass
    assert closed == [True] and signal.getsignal(signal.SIGINT) is interrupts


@pytest.mark.slow
def test_a_scheduler_that_dies_ends_the_sequence_and_says_so(tmp_path):
    cluster = distributed.LocalCluster(**IN_THIS_PROCESS)
    with distributed.Client(cluster) as made:
        frames = js.render_frames(sources(30), CAMERA, SETTINGS, made, output=tmp_path)
        next(frames)
        cluster.close()
        with pytest.raises(RuntimeError, match="the scheduler of the cluster is gone"):
            list(frames)


@pytest.mark.slow
def test_a_worker_that_is_killed_is_replaced_and_its_frames_are_made(tmp_path):
    def slowly(n):
        def source():
            time.sleep(0.3)
            return cloud(shown=n)

        return source

    with local_client(2) as client:
        (victim, *_) = client.run(os.getpid).values()
        frames = []
        for frame in js.render_frames([slowly(n) for n in range(40)], CAMERA, SETTINGS, client, output=tmp_path / "on"):
            frames.append(frame)
            if len(frames) == 3:
                os.kill(victim, signal.SIGKILL)
        assert victim not in client.run(os.getpid).values()
    assert [frame.number for frame in frames] == list(range(1, 41)) and all(frame.rendered for frame in frames)
    for frame, alone in zip(frames, js.render_frames(sources(40), CAMERA, SETTINGS, output=tmp_path / "alone"), strict=True):
        assert frame.path.read_bytes() == alone.path.read_bytes()
