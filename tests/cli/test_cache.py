"""Commands keep what they compiled, and the next one really loads it."""

import os
import subprocess
import sys
import warnings

import jax
import pytest

from jaxsph.cli import cache as cli_cache
from jaxsph.cli.console import warnings_in_lines

RENDER = ["render", "scene:radial:particles=200", "--size", "24x16", "--samples", "8", "-o", "out.png"]
COMPILING = "compiling for frames of this kind"


@pytest.fixture
def command(tmp_path):
    """Runs a command in a process of its own, whose home is empty; stdout and stderr."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith(("JAX_COMPILATION", "JAX_PERSISTENT"))}
    home = {"HOME": str(tmp_path), "XDG_CACHE_HOME": str(tmp_path / "cache")}

    def run(*arguments, **environment):
        done = subprocess.run(
            [sys.executable, "-m", "jaxsph", *arguments],
            cwd=tmp_path,
            env=kept | home | environment,
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
    kept = sorted((tmp_path / "cache").rglob("*-cache"))
    assert len(kept) >= 5
    _, said = command(*RENDER)
    assert COMPILING not in said, "nothing was missing from the cache"
    assert (tmp_path / "out.png").read_bytes() == first
    assert sorted((tmp_path / "cache").rglob("*-cache")) == kept
    told, _ = command("doctor")
    assert str(tmp_path / "cache") in told and f"{len(kept)} compiled programs" in told and "268 MB" in told


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


def test_the_folder_is_of_this_user_and_this_program(monkeypatch):
    monkeypatch.delenv(cli_cache.CHOSEN_BY_USER, raising=False)
    assert cli_cache.folder().name == "compiled" and "jaxsph" in str(cli_cache.folder())


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
            cli_cache._make_own(place)
    finally:
        assert os.umask(before) == umask
    assert {path.stat().st_mode & 0o777 for place in (there, new) for path in (place, place.parent)} == {0o700}
    assert new.parent.parent.stat().st_mode & 0o777 == 0o700 and (there / "jit_cast-ab-cache").exists()


@pytest.mark.skipif(os.name != "posix", reason="of POSIX")
def test_programs_of_another_user_are_not_run(tmp_path, monkeypatch, capsys):
    place = tmp_path / "jaxsph" / "compiled"
    place.mkdir(parents=True)
    monkeypatch.setattr(cli_cache, "folder", lambda: place)
    monkeypatch.delenv(cli_cache.CHOSEN_BY_USER, raising=False)
    monkeypatch.setattr(cli_cache.PROGRAMS, "on_compile", lambda told: None)
    kept = jax.config.jax_compilation_cache_dir
    with monkeypatch.context() as other:
        other.setattr(os, "geteuid", lambda: place.stat().st_uid + 1)
        cli_cache.begin(keep=True)
    assert jax.config.jax_compilation_cache_dir == kept
    assert "not kept" in (said := capsys.readouterr().err) and "belongs to another user; remove it" in said
    if os.geteuid() == 0:  # who else can give files away
        (place / "jit_cast-ab-cache").write_bytes(b"theirs")
        os.chown(place / "jit_cast-ab-cache", 65534, 65534)
        place.chmod(0o777)
        cli_cache._make_own(place)
        assert not list(place.iterdir())


def test_entries_that_cannot_be_read_are_removed_and_no_warning_is_shown(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv(cli_cache.CHOSEN_BY_USER, str(tmp_path))
    for name in ("jit_cast-ab-cache", "jit_cast-cd-cache", "jit_other-ab-cache"):
        (tmp_path / name).write_bytes(b"garbage")
    (tmp_path / "jit_cast-ef-cache").mkdir()
    with warnings_in_lines("render", cli_cache.mended):
        warnings.warn("Error reading persistent compilation cache entry for 'jit_cast': ValueError: no", stacklevel=1)
    assert [path.name for path in tmp_path.iterdir()] == ["jit_other-ab-cache"]
    assert capsys.readouterr().err == ""


def test_jax_still_says_of_a_broken_entry_what_is_looked_for(tmp_path, monkeypatch, capsys):
    """In a process of its own, as JAX opens its cache once."""
    script = """if True:
        import sys, pathlib, jax, jax.numpy as jnp
        from jaxsph.cli import cache as cli_cache
        from jaxsph.cli.console import warnings_in_lines
        folder = pathlib.Path(sys.argv[1])
        jax.config.update("jax_compilation_cache_dir", str(folder))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
        jax.config.update("jax_persistent_cache_min_entry_size_bytes", 0)
        with warnings_in_lines("render", cli_cache.mended):
            jax.jit(lambda x: x * 3 + 1)(jnp.ones(7))
            print(sum(path.stat().st_size > 7 for path in folder.glob("*-cache")))
            for path in folder.glob("*-cache"):
                path.write_bytes(b"garbage")
            jax.clear_caches()
            jax.jit(lambda x: x * 3 + 1)(jnp.ones(7))
            print(sum(path.stat().st_size > 7 for path in folder.glob("*-cache")))
    """
    told = {**os.environ, cli_cache.CHOSEN_BY_USER: str(tmp_path)}
    done = subprocess.run([sys.executable, "-c", script, str(tmp_path)], env=told, capture_output=True, text=True)
    assert done.returncode == 0 and done.stderr == "", done.stderr
    kept, again = (int(count) for count in done.stdout.split())
    assert kept == again > 0, "what was broken is written anew"
