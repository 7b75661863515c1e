"""Commands and Python keep what they compiled, and the next process really loads it."""

import os
import subprocess
import sys
import warnings

import jax
import pytest

from jaxsph.cli.console import warnings_in_lines
from jaxsph.engine.runtime import kept

RENDER = ["render", "scene:radial:particles=200", "--size", "24x16", "--samples", "8", "-o", "out.png"]
COMPILING = "compiling for frames of this kind"
IN_PYTHON = """
import jax, jax.monitoring
missed = []
jax.monitoring.register_event_listener(lambda event, **_: missed.append(event) if event.endswith("cache_misses") else None)
import jaxsph as js
from jaxsph.engine.runtime import programs
scene, camera = js.scenes.load("radial", particles=200, width=24, height=16)
assert jax.config.jax_compilation_cache_dir is None, "importing sets up nothing"
begun = []
programs.PROGRAMS.on_compile = lambda: begun.append(1)
js.render(scene, camera, js.Settings(samples=8))
print(len(missed), len(begun))
"""


@pytest.fixture
def command(tmp_path):
    """Runs a command in a process of its own, whose home is empty; stdout and stderr."""
    left = {name: value for name, value in os.environ.items() if not name.startswith(("JAX_COMPILATION", "JAX_PERSISTENT"))}
    home = {"HOME": str(tmp_path), "XDG_CACHE_HOME": str(tmp_path / "cache")}

    def run(*arguments, **environment):
        done = subprocess.run(
            [sys.executable, *(arguments if arguments[0] == "-c" else ("-m", "jaxsph", *arguments))],
            cwd=tmp_path,
            env=left | home | environment,
            capture_output=True,
            text=True,
        )
        assert done.returncode == 0, done.stderr
        return done.stdout, done.stderr

    return run


@pytest.mark.slow
def test_a_second_process_loads_what_the_first_compiled(command, tmp_path):
    _, said = command(*RENDER)
    assert said.count(COMPILING) == 1 and "once" in said
    first = (tmp_path / "out.png").read_bytes()
    files = sorted((tmp_path / "cache").rglob("*-cache")) + sorted((tmp_path / "cache").rglob("*.program"))
    assert len(files) >= 10
    _, said = command(*RENDER)
    assert COMPILING not in said, "nothing was missing from the cache"
    assert (tmp_path / "out.png").read_bytes() == first
    assert command("-c", IN_PYTHON)[0] == "0 0\n", "nor for Python, and nothing is traced"
    for file in files[-3:]:
        file.write_bytes(file.read_bytes()[:-1])
    assert command("-c", IN_PYTHON)[0] == "0 3\n", "what is broken is traced"
    assert sorted((tmp_path / "cache").rglob("*-cache")) == files[: -len(list((tmp_path / "cache").rglob("*.program"))) - 3]
    told, _ = command("doctor")
    assert str(tmp_path / "cache") in told and "compiled programs" in told and "268 MB" in told


def test_without_the_cache_nothing_is_written(command, tmp_path):
    _, said = command(*RENDER, "--no-cache")
    assert said.count(COMPILING) == 1 and "--no-cache" in said
    assert not list(tmp_path.rglob("*-cache"))


@pytest.mark.slow
def test_a_folder_that_the_user_names_is_taken(command, tmp_path):
    folder = tmp_path / "mine"
    told, _ = command("doctor", JAX_COMPILATION_CACHE_DIR=str(folder))
    assert str(folder) in told and "0 compiled programs" in told
    command(*RENDER, JAX_COMPILATION_CACHE_DIR=str(folder), JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS="0")
    assert list(folder.iterdir()) and not (tmp_path / "cache").exists()


@pytest.mark.slow
def test_a_folder_that_cannot_be_made_is_said_and_does_no_harm(command, tmp_path):
    (tmp_path / "cache").write_text("a file where a folder should be")
    _, said = command(*RENDER)
    assert "not kept" in said and COMPILING in said
    _, said = command("-c", IN_PYTHON)
    assert said.count("not kept") == 1 and "name another by JAX_COMPILATION_CACHE_DIR" in said
    _, said = command("-c", IN_PYTHON, JAX_ENABLE_COMPILATION_CACHE="0")
    assert said == "", "asked for nothing, nothing is tried"


def test_the_folder_is_of_this_user_and_this_program():
    assert kept._own().name == "compiled" and "jaxsph" in str(kept._own())


@pytest.mark.skipif(os.name != "posix", reason="of POSIX")
@pytest.mark.parametrize("umask", [0o000, 0o022, 0o277])
def test_the_folder_is_open_to_its_user_alone_whatever_the_umask(umask, tmp_path):
    there = tmp_path / "there" / "jaxsph" / "compiled"
    there.mkdir(parents=True)
    for path in (there, there.parent):
        path.chmod(0o777)
    (there / "jit_cast-ab-cache").write_bytes(b"mine")
    new = tmp_path / "new" / "cache" / "jaxsph" / "compiled"
    before = os.umask(umask)
    try:
        for place in (there, new):
            kept._make_own(place)
    finally:
        assert os.umask(before) == umask
    assert {path.stat().st_mode & 0o777 for place in (there, new) for path in (place, place.parent)} == {0o700}
    assert new.parent.parent.stat().st_mode & 0o777 == 0o700 and (there / "jit_cast-ab-cache").exists()


@pytest.fixture
def kept_in(tmp_path, monkeypatch):
    """A folder that is to be used, before anything was kept."""
    place, before = tmp_path / "jaxsph" / "compiled", jax.config.jax_compilation_cache_dir
    place.mkdir(parents=True)
    monkeypatch.setattr(kept, "_own", lambda: place)
    monkeypatch.delenv(kept.CHOSEN_BY_USER, raising=False)
    jax.config.update("jax_compilation_cache_dir", None)
    yield place
    jax.config.update("jax_compilation_cache_dir", before)


@pytest.mark.skipif(os.name != "posix", reason="of POSIX")
def test_programs_of_another_user_are_not_run(kept_in, monkeypatch):
    with monkeypatch.context() as other, pytest.warns(UserWarning, match=r"not kept.*belongs to another user; remove it"):
        other.setattr(os, "geteuid", lambda: os.getuid() + 1)
        assert not kept.keep.__wrapped__()
    assert jax.config.jax_compilation_cache_dir is None
    if os.geteuid() == 0:  # who else can give files away
        (kept_in / "jit_cast-ab-cache").write_bytes(b"theirs")
        os.chown(kept_in / "jit_cast-ab-cache", 65534, 65534)
        kept_in.chmod(0o777)
        kept._make_own(kept_in)
        assert not list(kept_in.iterdir())


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="a disk that is always full")
def test_a_full_disk_is_said_once(kept_in, monkeypatch):
    monkeypatch.setattr(kept.tempfile, "TemporaryFile", lambda **_: open("/dev/full", "wb", 0))  # noqa: SIM115
    with pytest.warns(UserWarning, match="not kept.*No space left"):
        assert not kept.keep.__wrapped__()


def test_entries_that_cannot_be_read_are_removed_and_no_warning_is_shown(kept_in, capsys):
    for name in ("jit_cast-ab-cache", "jit_cast-cd-cache", "jit_other-ab-cache"):
        (kept_in / name).write_bytes(b"garbage")
    (kept_in / "jit_cast-ef-cache").mkdir()
    with warnings_in_lines("render", kept.mended):
        warnings.warn("Error reading persistent compilation cache entry for 'jit_cast': ValueError: no", stacklevel=1)
    assert [path.name for path in kept_in.iterdir()] == ["jit_other-ab-cache"]
    assert capsys.readouterr().err == ""


def test_jax_still_says_of_a_broken_entry_what_is_looked_for(tmp_path, monkeypatch, capsys):
    """In a process of its own, as JAX opens its cache once."""
    script = """if True:
        import sys, pathlib, jax, jax.numpy as jnp
        from jaxsph.engine.runtime import kept
        from jaxsph.cli.console import warnings_in_lines
        folder = pathlib.Path(sys.argv[1])
        jax.config.update("jax_compilation_cache_dir", str(folder))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
        jax.config.update("jax_persistent_cache_min_entry_size_bytes", 0)
        with warnings_in_lines("render", kept.mended):
            jax.jit(lambda x: x * 3 + 1)(jnp.ones(7))
            print(sum(path.stat().st_size > 7 for path in folder.glob("*-cache")))
            for path in folder.glob("*-cache"):
                path.write_bytes(b"garbage")
            jax.clear_caches()
            jax.jit(lambda x: x * 3 + 1)(jnp.ones(7))
            print(sum(path.stat().st_size > 7 for path in folder.glob("*-cache")))
    """
    told = {**os.environ, kept.CHOSEN_BY_USER: str(tmp_path)}
    done = subprocess.run([sys.executable, "-c", script, str(tmp_path)], env=told, capture_output=True, text=True)
    assert done.returncode == 0 and done.stderr == "", done.stderr
    written, again = (int(count) for count in done.stdout.split())
    assert written == again > 0, "what was broken is written anew"
