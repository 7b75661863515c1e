"""Options: whatever a command offers, it reads, be it to refuse it."""

import argparse

import numpy as np
import pytest

import jaxsph as js
from jaxsph.cli import look as cli_look
from jaxsph.cli import main as cli
from jaxsph.cli import movie as cli_movie
from jaxsph.cli import project as cli_project
from jaxsph.cli import sweep as cli_sweep

SMALL = ["--size", "8x8"]
RUNS = {
    "render": (["render", "FILE", *SMALL], ["render", "VOLUME", *SMALL], ["render", "scene:radial", "--particles", "50", *SMALL],
               ["render", "FILE", "--points", "FILE", "--volume", "VOLUME", *SMALL], ["render", "FILE", "--annotate", *SMALL],
               ["render", "FILE", "--from-disk", "1"]),
    "movie": (["movie", "FILE", "--orbit", "9", *SMALL], ["movie", "VOLUME", "--orbit", "9", *SMALL],
              ["movie", "FILE", "FILE", *SMALL], ["movie", "FILE", "--points", "FILE", "--volume", "VOLUME", "--orbit", "9"],
              ["movie", "scene:radial", "--particles", "50", "--orbit", "9"]),
    "transfer": (["transfer", "FILE", *SMALL], ["transfer", "VOLUME", *SMALL], ["transfer", "scene:radial", "--particles", "50"]),
    "info": (["info", "FILE"], ["info", "VOLUME"], ["info", "scene:radial", "--particles", "50"],
             ["info", "--points", "FILE", "--volume", "VOLUME"]),
    "project": (["project", "FILE", *SMALL], ["project", "FILE", "--of", "volume", *SMALL]),
    "sweep": (["sweep", "FILE", "-o", "out"], ["sweep", "VOLUME", "-o", "out"],
              ["sweep", "scene:radial", "--particles", "50", "-o", "out"]),
    "merge": (["merge", "FILE.exr", "-o", "a.png"],),
    "sort": (["sort", "FILE", "-o", "a.hdf5"],),
    "demo": (["demo", *SMALL],),
}  # fmt: skip
OF_ALL = {"help", "debug", "no_cache"}


class EnoughError(ValueError):
    """All that says what is to be made was read."""


@pytest.fixture
def asked(tmp_path, monkeypatch):
    """Names of the options that commands ask for; what takes its time is left out."""
    monkeypatch.chdir(tmp_path)
    position = np.random.default_rng(0).normal(size=(60, 3)).astype(np.float32)
    np.savez("FILE.npz", position=position, heat=position[:, 0], support=np.full(60, 0.8, np.float32))
    np.save("VOLUME.npy", np.random.default_rng(0).random((4, 4, 4), np.float32))
    names = set()

    class Recording(argparse.Namespace):
        def __getattribute__(self, name):
            names.add(name)
            return super().__getattribute__(name)

    def enough(*_, **__):
        raise EnoughError("enough")

    monkeypatch.setattr(argparse, "Namespace", Recording)
    begun = cli.warnings_in_lines
    monkeypatch.setattr(cli, "warnings_in_lines", lambda *given: names.clear() or begun(*given))  # the parser asks for all
    for module, name in ((js, "render"), (js, "project"), (cli_movie, "render_frames"), (cli_sweep, "sweep")):
        monkeypatch.setattr(module, name, enough)
    monkeypatch.setattr(cli_look, "transfer_figure", enough)
    if hasattr(cli_project, "project"):
        monkeypatch.setattr(cli_project, "project", enough)
    return names


def offered():
    """Of each command, the names under which its options are kept."""
    (commands,) = [action for action in cli._parser()._actions if isinstance(action, argparse._SubParsersAction)]
    return {name: {action.dest for action in parser._actions} - OF_ALL for name, parser in commands.choices.items()}


def test_every_command_is_tried():
    assert set(offered()) == set(RUNS)


@pytest.mark.parametrize("command", RUNS)
def test_every_option_of_a_command_is_read_or_refused_by_it(command, asked):
    read = set()
    for arguments in RUNS[command]:
        code = cli.main([{"FILE": "FILE.npz", "VOLUME": "VOLUME.npy"}.get(argument, argument) for argument in arguments])
        assert code in (cli.DONE, cli.FAILED, cli.WRONG_USAGE)
        read |= asked
    assert not offered()[command] - read, "offered, and never looked at"
