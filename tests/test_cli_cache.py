"""Commands keep what they compiled, and the next one really loads it."""

import os
import subprocess
import sys

import pytest

from jaxsph import cli_cache

RENDER = ["render", "scene:radial", "--particles", "200", "--size", "24x16", "--samples", "8", "-o", "out.png"]
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
    assert said == "", "nothing was missing from the cache"
    assert (tmp_path / "out.png").read_bytes() == first
    assert sorted((tmp_path / "cache").rglob("*-cache")) == kept
    told, _ = command("info", "--cache")
    assert str(tmp_path / "cache") in told and f"{len(kept)} compiled programs" in told and "268 MB" in told


def test_without_the_cache_nothing_is_written(command, tmp_path):
    _, said = command(*RENDER, "--no-cache")
    assert said.count(COMPILING) == 1 and "--no-cache" in said
    assert not list(tmp_path.rglob("*-cache"))


@pytest.mark.slow
def test_a_folder_that_the_user_names_is_taken(command, tmp_path):
    folder = tmp_path / "mine"
    told, _ = command("info", "--cache", JAX_COMPILATION_CACHE_DIR=str(folder))
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
