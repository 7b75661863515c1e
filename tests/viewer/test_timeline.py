"""A view of a sequence: frames are read when they are asked for, neighbours before; what cannot be is told."""

import threading

import numpy as np
import pytest
from by_reference import pictures_by_reference
from views import NUMBER, SECONDS, SETTINGS, asked, camera, scene, sequence, until

from jaxsph.viewer.inputs import InputError
from jaxsph.viewer.session import Session
from jaxsph.viewer.state import Frame, Source, frames_of


@pytest.fixture(scope="module")
def sequenced(tmp_path_factory):
    """A view of a sequence, and its folder."""
    folder = tmp_path_factory.mktemp("sequence")
    first, frames = frames_of(sequence(folder))
    with pictures_by_reference(), Session(first, camera(), SETTINGS, frames=frames) as session:
        session.wait(seconds=SECONDS)
        yield session, folder


def test_a_file_that_cannot_be_read_is_told_and_the_view_goes_on(sequenced):
    session, folder = sequenced
    asked(session, 2)
    told, version = [], session.version
    undo = session.listen(lambda what: told.append(what) if isinstance(what, dict) else None)
    session.do({"do": "frame", "number": 3})
    until(lambda: session.state()["frames"]["why"])
    frames = session.state()["frames"]
    assert "s_3.npz" in frames["why"] and (frames["number"], frames["asked"], frames["of"]) == (2, 3, NUMBER)
    until(lambda: any(one["is"] == "state" and one["frames"]["why"] for one in told))
    undo()
    assert session.version == version and session.told == ""
    asked(session, 0)
    until(lambda: session._read.keys() == {0, 1})
    (folder / "s_4.npz").rename(folder / "away.npz")
    session.do({"do": "frame", "number": 4})
    until(lambda: "s_4.npz" in session.state()["frames"]["why"])
    (folder / "away.npz").rename(folder / "s_4.npz")
    assert asked(session, 4).version == session.version and not session.state()["frames"]["why"]


@pytest.mark.parametrize("number", [-1, NUMBER, "1", None, True, float("nan")], ids=str)
def test_a_frame_that_there_is_not_is_refused(sequenced, number):
    session, _ = sequenced
    with pytest.raises(InputError):
        session.do({"do": "frame", "number": number})
    with pytest.raises(InputError, match="no sequence"):
        Session(scene(), camera(), SETTINGS).do({"do": "frame", "number": 0})


def test_neighbours_are_read_before_they_are_asked_for_and_what_is_asked_last_comes_first():
    begun, go, read = threading.Semaphore(0), threading.Semaphore(0), []

    def reads(number):
        read.append(number)
        begun.release()
        assert go.acquire(timeout=60)
        return scene()

    frames = [Frame(str(k), float(k), lambda k=k: reads(k), Source()) for k in range(9)]
    with pictures_by_reference(), Session(scene(), camera(), SETTINGS, frames=frames) as session:
        assert begun.acquire(timeout=60)  # of the first neighbour
        for number in (3, 7, 5):
            session.do({"do": "frame", "number": number})
        go.release(20)
        until(lambda: session._read.keys() == {4, 5, 6})
        assert read == [1, 5, 6, 4] and (session.number, session.version) == (5, 2)
        session.do({"do": "frame", "number": 6})
        until(lambda: session._read.keys() == {5, 6, 7})
        assert read == [1, 5, 6, 4, 7] and (session.number, session.version) == (6, 3)


def test_the_code_of_a_frame_makes_it_again(tmp_path):
    snapshots = sequence(tmp_path, wrong=())
    files = [str(file.path) for file in snapshots.survey.files]
    python = f"snapshots = js.sequence.Snapshots.from_files({files}, 'heat')\nscene = snapshots.at(0.5)"
    first, frames = frames_of(snapshots, lambda time: Source(python, whole=True))
    session = Session(first, camera(), SETTINGS, frames=frames)
    session._read[1] = frames[1].scene()
    session.do({"do": "frame", "number": 1})
    space = {}
    exec(session.code()["python"].partition("image = ")[0], space)
    state = session.snapshot()
    assert np.array_equal(space["scene"].particles.position, state.scene.particles.position)
    assert np.allclose(space["scene"].transfer.values, state.scene.transfer.values)
