"""A command that is asked to end (SIGTERM) ends as if interrupted: nothing half-written is left, and nothing runs on."""

import os
import signal
import subprocess
import sys
import threading
import time

import pytest
from snapshots_made import particles, write

from jaxsph.cli import console, main as cli

MOMENTS = 10
TINY = ["--size", "24x32", "--samples", "16"]
COMMANDS = {
    "render": ["render", "snap.0.hdf5", *TINY, "-o", "out.png"],
    "movie": ["movie", "snap.0.hdf5", "--orbit", "90", "--frames", "3", *TINY, "-o", "out.mp4"],
}
posix = pytest.mark.skipif(os.name != "posix", reason="signals are POSIX's")


@pytest.fixture
def folder(empty, tmp_path):
    write(tmp_path, particles(200, ordered=False))
    yield tmp_path
    signal.signal(signal.SIGTERM, signal.SIG_DFL)


class Moment:
    """Counts calls of functions while a command runs, and asks the process to end at one of them, if it would hear."""

    def __init__(self, at=None):
        self.calls, self.at = 0, at

    def begin(self, **_):
        sys.setprofile(self)

    def __call__(self, *_):
        self.calls += 1
        if self.at is not None and self.calls >= self.at and signal.getsignal(signal.SIGTERM) is not signal.SIG_DFL:
            self.at = None
            sys.setprofile(None)
            os.kill(os.getpid(), signal.SIGTERM)


def run(moment, arguments, monkeypatch):
    """The exit code of a command of this process."""
    monkeypatch.setattr(sys, "argv", ["jaxsph", *arguments])
    monkeypatch.setattr(console, "tell_of_compiling", moment.begin)
    try:
        return cli.main()
    finally:
        sys.setprofile(None)


def left(folder):
    """Files that are there besides the source and frames that are whole."""
    files = [path for path in folder.rglob("*") if path.is_file()]
    return [path.name for path in files if not path.name.startswith("snap.") and path.parent.name != "out_frames"], files


@posix
@pytest.mark.parametrize("command", COMMANDS)
def test_a_command_that_is_asked_to_end_at_any_moment_leaves_nothing(command, folder, by_reference, capsys, monkeypatch):
    arguments = COMMANDS[command]
    for _ in range(2):  # the first imports
        whole = Moment()
        assert run(whole, arguments, monkeypatch) == 0
        content = (folder / arguments[-1]).read_bytes()
        (folder / arguments[-1]).unlink()
        for frame in folder.glob("out_frames/*"):
            frame.unlink()
    codes = []
    for moment in range(MOMENTS):
        capsys.readouterr()
        codes.append(run(Moment((moment * whole.calls) // MOMENTS + 1), arguments, monkeypatch))
        outputs, files = left(folder)
        assert not [path for path in files if path.name.startswith(".")], (moment, files)
        assert outputs == [arguments[-1]] * (not codes[-1] or len(outputs)), (moment, codes)
        assert all((folder / name).read_bytes() == content for name in outputs), (moment, codes)  # it was whole by then
        if codes[-1]:
            assert capsys.readouterr().err.splitlines()[-1] == f"jaxsph {command}: terminated"
        for name in outputs:
            (folder / name).unlink()
        for frame in folder.glob("out_frames/*"):
            frame.unlink()
    assert set(codes) <= {0, 143} and codes.count(143) >= MOMENTS - 2, codes
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL


@posix
def test_asking_is_heard_while_an_object_is_thrown_away(folder, capsys, monkeypatch):
    class Asking:
        def __del__(self):
            os.kill(os.getpid(), signal.SIGTERM)

    def work(**_):
        Asking()
        time.sleep(60)

    monkeypatch.setattr(sys, "argv", ["jaxsph", "doctor"])
    monkeypatch.setattr(console, "tell_of_compiling", work)
    started, hook = time.monotonic(), sys.unraisablehook
    assert cli.main() == 143 and time.monotonic() - started < 50
    assert capsys.readouterr().err.splitlines() == ["jaxsph doctor: terminated"] and sys.unraisablehook is hook


def test_an_interrupt_that_a_library_makes_an_error_of_is_one(folder, capsys, monkeypatch):
    def work(**_):
        raise SystemError("a result with an exception set") from KeyboardInterrupt()

    monkeypatch.setattr(sys, "argv", ["jaxsph", "doctor"])
    monkeypatch.setattr(console, "tell_of_compiling", work)
    assert cli.main() == 130 and capsys.readouterr().err.splitlines() == ["jaxsph doctor: interrupted"]


@posix
def test_a_command_that_is_done_is_not_asked_again(folder, monkeypatch):
    class Asking:
        def __del__(self):
            os.kill(os.getpid(), signal.SIGTERM)

    def work(**_):
        Asking()

    late = []
    monkeypatch.setattr(sys, "argv", ["jaxsph", "doctor"])
    monkeypatch.setattr(console, "tell_of_compiling", work)
    monkeypatch.setattr(cli, "AGAIN_SECONDS", 5)
    assert cli.main() == 0
    signal.signal(signal.SIGTERM, lambda *_: late.append(True))
    until = time.monotonic() + 6
    while time.monotonic() < until and any(type(thread) is threading.Timer for thread in threading.enumerate()):
        time.sleep(0.05)
    assert not late


@posix
@pytest.mark.parametrize("handler", [signal.SIG_IGN, signal.default_int_handler])
def test_signals_that_are_ignored_or_somebody_elses_are_left_alone(handler, folder, capsys, monkeypatch):
    seen = []
    monkeypatch.setattr(sys, "argv", ["jaxsph", "doctor"])
    monkeypatch.setattr(console, "tell_of_compiling", lambda **_: seen.append(signal.getsignal(signal.SIGTERM)))
    signal.signal(signal.SIGTERM, handler)
    assert cli.main() == 0 and seen == [handler] and signal.getsignal(signal.SIGTERM) is handler
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    assert cli.main(["doctor"]) == 0 and len(seen) == 1


def ends(group):
    """Whether all processes of a group end soon."""
    until = time.monotonic() + 30
    while time.monotonic() < until:
        try:
            os.killpg(group, 0)
        except ProcessLookupError:
            return True
        time.sleep(0.05)
    return False


@posix
@pytest.mark.slow
@pytest.mark.parametrize("command", [*COMMANDS, "workers"])
def test_a_process_that_is_asked_to_end_at_any_moment_leaves_nothing(command, folder):
    more = ["--workers", "2"] if command == "workers" else []
    arguments = [*COMMANDS[{"workers": "movie"}.get(command, command)], *more]
    output = folder / arguments[arguments.index("-o") + 1]
    program = [sys.executable, "-m", "jaxsph", *arguments]
    for _ in range(2):
        started = time.monotonic()
        subprocess.run(program, check=True, capture_output=True)
        seconds, content = time.monotonic() - started, output.read_bytes()
        output.unlink()
        for frame in folder.glob("out_frames/*"):
            frame.unlink()
    codes = []
    for moment in range(MOMENTS):
        process = subprocess.Popen(program, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True)
        time.sleep(seconds * (moment + 1) / (MOMENTS + 1))
        process.terminate()
        _, err = process.communicate(timeout=120)
        codes.append(process.returncode)
        outputs, files = left(folder)
        assert not [path for path in files if path.name.startswith(".")], (moment, files)
        assert outputs == [output.name] * (not codes[-1] or len(outputs)), (moment, codes)
        assert all((folder / name).read_bytes() == content for name in outputs), (moment, codes)  # it was whole by then
        assert "resource_tracker" not in err and "atexit" not in err, err
        assert more or "Traceback" not in err, err  # Dask tells of connections that its workers had
        last = f"jaxsph {arguments[0]}: terminated"  # what was read and chosen may be said before it
        said = err.splitlines() if more else err.splitlines()[-1:]
        assert codes[-1] != 143 or last in said, err
        assert ends(process.pid), moment
        output.unlink(missing_ok=True)
        for frame in folder.glob("out_frames/*"):
            frame.unlink()
    print(command, f"{seconds:.1f} s", codes)
    assert set(codes) <= {0, 143, -signal.SIGTERM} and codes.count(143) >= 2, codes  # early ones come before Python has begun
