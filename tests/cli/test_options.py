"""Options: whatever a command offers, it reads, and it offers no more than a person can take in."""

import ast
import dataclasses
import sys
from pathlib import Path

import numpy as np
import pytest
from commanded import refused, run

import jaxsph as js
from jaxsph.cli import groups, main as cli
from jaxsph.cli.commands import checks, columns, data, movie, planes, sweep, view
from jaxsph.cli.table import COMMANDS
from jaxsph.io.opening import options as opening

SMALL = ["--size", "8x8"]
SCENE = "scene:radial:particles=50"
RUNS = {
    "render": (["render", "FILE", *SMALL], ["render", "VOLUME", *SMALL], ["render", SCENE, *SMALL],
               ["render", "FILE", "--points", "FILE", "--volume", "VOLUME", *SMALL], ["render", "FILE", "--annotate", *SMALL],
               ["render", "VOLUME", "--iso", "0.5", *SMALL]),
    "movie": (["movie", "FILE", "--orbit", "9", *SMALL], ["movie", "VOLUME", "--orbit", "9", *SMALL],
              ["movie", "FILE", "FILE", *SMALL], ["movie", "FILE", "--points", "FILE", "--volume", "VOLUME", "--orbit", "9"],
              ["movie", SCENE, "--orbit", "9"], ["movie", "VOLUME", "--iso", "0.5", "--orbit", "9", *SMALL]),
    "transfer": (["transfer", "FILE", *SMALL], ["transfer", "VOLUME", *SMALL], ["transfer", SCENE]),
    "view": (["view", "FILE", *SMALL], ["view", "VOLUME", *SMALL], ["view", SCENE, *SMALL]),
    "info": (["info", "FILE"], ["info", "VOLUME"], ["info", SCENE], ["info", "--points", "FILE", "--volume", "VOLUME"]),
    "project": (["project", "FILE", *SMALL], ["project", "FILE", "--of", "volume", *SMALL],
                ["project", "FILE", "--eye", "0,0,9", *SMALL], ["project", "FILE", "--center", "mass", *SMALL]),
    "explain": (["explain", "FILE", "--pixel", "1", "1", *SMALL], ["explain", "VOLUME", "--pixel", "1,1", *SMALL],
                ["explain", SCENE, "--pixel", "1,1", "-o", "a.png", *SMALL],
                ["explain", "FILE", "--points", "FILE", "--volume", "VOLUME", "--pixel", "1,1", *SMALL]),
    "slice": (["slice", "FILE", *SMALL], ["slice", SCENE, *SMALL], ["slice", "FILE", "--eye", "0,0,9", *SMALL]),
    "sweep": (["sweep", "FILE", "-o", "out"], ["sweep", "VOLUME", "-o", "out"], ["sweep", SCENE, "-o", "out"]),
    "merge": (["merge", "FILE.exr", "-o", "a.png"],),
    "demo": (["demo", *SMALL],),
    "doctor": (["doctor"], ["doctor", "--completion", "bash"]),
}  # fmt: skip
OF_ALL = {"quiet", "verbose", "json", "config", "no_cache"}
"""What is read before a command is, see `test_words.py` and `test_voice.py`."""


class EnoughError(ValueError):
    """All that says what is to be made was read."""


@pytest.fixture
def asked(empty, monkeypatch):
    """Names of the options that commands ask for; what takes its time is left out."""
    position = np.random.default_rng(0).normal(size=(60, 3)).astype(np.float32)
    np.savez("FILE.npz", position=position, heat=position[:, 0], support=np.full(60, 0.8, np.float32))
    np.save("VOLUME.npy", np.random.default_rng(0).random((4, 4, 4), np.float32))
    names = set()

    def recording(self, name):
        code = sys._getframe(1).f_code  # who copies or checks the options does not use them
        if not (code.co_filename.endswith("dataclasses.py") or code.co_name == "__post_init__"):
            names.add(name)
        return object.__getattribute__(self, name)

    def enough(*_, **__):
        raise EnoughError("enough")

    monkeypatch.setattr(groups.Options, "__getattribute__", recording)
    for module, name in (
        (js, "render"), (columns, "projected"), (movie, "render_frames"), (sweep, "measured"), (data, "transfer_figure"),
        (planes, "slice_of"), (checks, "explained"), (view, "run"),
    ):  # fmt: skip
        monkeypatch.setattr(module, name, enough)
    return names


def offered(command):
    """Names under which the options of a command are kept."""
    return {one.field_info.name for one in cli.arguments_of(command) if one.name.startswith("--") and one.parse} - OF_ALL


def test_every_command_is_tried_and_a_function_of_its_name():
    assert set(COMMANDS) == set(RUNS) == {cli.function_of(command).__name__ for command in COMMANDS}


@pytest.mark.parametrize("command", RUNS)
def test_every_option_of_a_command_is_read_by_it(command, asked, capsys):
    for arguments in RUNS[command]:
        code = cli.main([{"FILE": "FILE.npz", "VOLUME": "VOLUME.npy"}.get(argument, argument) for argument in arguments])
        assert code in (cli.DONE, cli.FAILED, cli.WRONG_USAGE)
    assert not offered(command) - asked, "offered, and never looked at"


def test_render_shows_no_more_options_than_a_person_can_take_in(capsys):
    shown = [one.name for one in cli.arguments_of("render") if one.show and one.name.startswith("--")]
    assert len(shown) <= 46
    code, out, _ = run(capsys, "render", "--help")
    assert code == 0 and all(f"  {name}" in out for name in shown)
    said = (word.rstrip(":,") for word in out.split() if word.startswith("--"))
    assert {word for word in said if word[2:].isidentifier()} <= {*shown, "--quantity"}


@pytest.mark.parametrize("command", COMMANDS)
def test_help_begins_with_examples_and_names_exit_codes_and_json(command, capsys):
    code, out, err = run(capsys, command, "--help")
    assert (code, err) == (0, []) and out.startswith("Examples:\n  ") and "jaxsph" in out.splitlines()[1]
    assert "Exit codes: 0 done, 1 the work failed, 2 wrong usage, 130 interrupted, 143" in " ".join(out.split())
    assert "--json" in out and max(map(len, out.splitlines())) <= 130
    code, short, err = run(capsys, command, "-h")
    assert (code, err) == (0, []) and "Examples:\n  " in short and len(short) < len(out) and "--help" in short


def test_the_groups_of_the_command_line_are_those_of_python():
    shared = {field.name for group in (opening.Source, opening.Look, opening.View) for field in dataclasses.fields(group)}
    assert shared - {"frame_all"} <= offered("render")  # which is said by `--width all`


@pytest.mark.parametrize(
    ("arguments", "meant"),
    [
        (["rendr", "FILE"], "render"), (["render", "FILE", "--colr-by", "heat"], "--color-by"),
        (["render", "scene:mixre"], "mixer"), (["render", "scene:mixer:particels=3"], "particles"),
        (["render", "none.npz", "--colormap", "viridsi"], "viridis"),  # before the file is looked for
        (["render", "none.npz", "--norm", "logg"], "log"), (["render", "none.npz", "--integrator", "segment"], "segments"),
        (["render", "FILE", "--color-by", "haet"], "heat"), (["project", "FILE", "--of", "haet"], "heat"),
        (["render", "none.npz", "--background", "whiet"], "white"),
    ],
    ids=lambda value: value if isinstance(value, str) else None,
)  # fmt: skip
def test_typing_errors_are_answered_with_what_was_meant(arguments, meant, asked, capsys):
    code, _, err = run(capsys, *("FILE.npz" if word == "FILE" else word for word in arguments))
    assert code in (1, 2) and len(err) == 1 and f"did you mean {meant}" in err[0].replace("Did", "did")


def test_options_are_not_abbreviated(asked, capsys):
    assert "--tol" in refused(capsys, "render", "FILE.npz", "--tol", "0.1")


def test_help_imports_nothing_that_takes_time():
    """What `jaxsph.cli.main` imports at its top, and what that imports, is of this package's lightest modules."""
    light, ahead = set(), ["jaxsph.cli.main"]
    root = Path(js.__file__).parent.parent
    while ahead:
        name = ahead.pop()
        light.add(name)
        for node in ast.parse((root / (name.replace(".", "/") + ".py")).read_text(encoding="utf-8")).body:
            names = [node.module] if isinstance(node, ast.ImportFrom) else []
            names += [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            for found in names:
                assert found.split(".")[0] not in ("jax", "numpy", "scipy"), (name, found)
                if found.startswith("jaxsph."):
                    inside = [f"{found}.{alias.name}" for alias in node.names]
                    files = [one for one in (*inside, found) if (root / (one.replace(".", "/") + ".py")).exists()]
                    ahead += [one for one in files if one not in light]
    assert len(light) < 10
