"""Options from files, pictures and the environment: what wins, what is refused, and that a picture can be made again."""

import json
import tomllib
from pathlib import Path

import numpy as np
import pytest
from commanded import run

import jaxsph as js
from jaxsph import io

TINY = ["--size", "24x16", "--samples", "16"]


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    position = np.random.default_rng(0).normal(size=(60, 3)).astype(np.float32)
    np.savez("a.npz", position=position, heat=position[:, 0], cold=position[:, 1] ** 2, support=np.full(60, 0.8, np.float32))


@pytest.fixture
def seen(monkeypatch):
    """What the renderer would be asked for; its picture is grey."""
    found = []

    def render(scene, camera, settings, progress=None, devices=None):
        found.append((scene, camera, settings))
        layer = np.zeros((camera.height, camera.width), np.float32)
        stats = {"evaluations": 0, "evaluations_full": 0, "cells": 0, "pairs": 0, "seconds": {"cast": 0.0}}
        return js.Image(np.full((*layer.shape, 3), 0.5, np.float32), layer + 0.5, layer, layer, layer, True, 0, stats, ())

    monkeypatch.setattr(js, "render", render)
    return found


def test_a_file_of_options_holds_where_nothing_else_is_said(seen, monkeypatch, capsys):
    text = 'samples = 32\n[camera]\nsize = "20x10"\neye = [0, 0, 9]\nfov = 30\n[movie]\norbit = 9\n[render]\ncolor-by = "cold"\n'
    Path("look.toml").write_text(text)
    code, out, err = run(capsys, "render", "a.npz", "--config", "look.toml", "--fov", 20)
    assert (code, err) == (0, []) and "quantity  cold" in out
    _, camera, settings = seen[-1]
    assert settings.samples == 32 and (camera.width, camera.height) == (20, 10)
    np.testing.assert_array_equal(camera.exact_eye(), (0, 0, 9))
    assert np.degrees(np.arctan(float(camera.half_height))) * 2 == pytest.approx(20)
    monkeypatch.setenv("JAXSPH_SAMPLES", "8")
    assert run(capsys, "render", "a.npz", "--config", "look.toml")[0] == 0 and seen[-1][2].samples == 8
    assert run(capsys, "render", "a.npz", "--samples", 64)[0] == 0 and seen[-1][2].samples == 64


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('colormpa = "heat"', "--config look.toml: 'colormpa' is no option of `jaxsph render`; did you mean colormap?"),
        ('[look]\nnrom = "log"', "--config look.toml, [look]: 'nrom' is no option of `jaxsph render`; did you mean norm?"),
        ("annotate = 3", "annotate must be true or false, got 3"),
        ("size = ", "--config look.toml: is no TOML"),
        ('size = "big"', "--size: 'big' is not a size"),
    ],
)
def test_a_file_that_cannot_be_is_named_with_its_place(seen, capsys, text, said):
    Path("look.toml").write_text(text)
    code, _, err = run(capsys, "render", "a.npz", "--config", "look.toml")
    assert code == 2 and len(err) == 1 and said in err[0] and not seen
    code, _, err = run(capsys, "render", "a.npz", "--config", "gone.toml")
    assert code == 1 and len(err) == 1 and "gone.toml" in err[0]


def test_options_are_saved_and_give_the_same_command(seen, capsys):
    more = ["--clip", "box:-1,-1,-1,1,1,1", "--clip", "~sphere:0,0,0,0.2", "--where", "heat > -1 and cold < 3", "-q"]
    code, *_ = run(capsys, "render", "a.npz", *TINY, *more, "--save-config", "look.toml", "-o", "x.png")
    assert code == 0
    saved = tomllib.loads(Path("look.toml").read_text())
    assert saved["clip"] == ["box:-1,-1,-1,1,1,1", "~sphere:0,0,0,0.2"] and saved["samples"] == "16"
    assert not {"output", "quiet", "save-config"} & set(saved)
    assert run(capsys, "render", "a.npz", "--config", "look.toml")[0] == 0
    (_, one, first), (_, other, second) = seen
    assert one.describe() == other.describe() and first == second


@pytest.mark.parametrize("suffix", ["png", "exr"])
def test_a_picture_holds_its_command_and_is_made_again_by_it(seen, capsys, suffix):
    assert run(capsys, "render", "a.npz", *TINY, "--eye", 0, 0, 9, "--quantity", "cold", "-o", f"x.{suffix}")[0] == 0
    words = json.loads(dict(io.read_image(f"x.{suffix}").metadata)["jaxsph.command"])
    assert words[0] == "render" and "a.npz" in words and "--eye=0,0,9" in words and "--color-by=cold" in words
    code, out, _ = run(capsys, "render", "--like", f"x.{suffix}", "a.npz", "--samples", 8)
    assert code == 0 and out.splitlines()[0] == "a.png"
    (_, one, _), (_, other, settings) = seen
    assert one.describe() == other.describe() and settings.samples == 8


def test_a_picture_that_says_no_command_is_refused(seen, capsys):
    layer = np.zeros((4, 4), np.float32)
    io.write_image("bare.png", js.Image(np.zeros((4, 4, 3), np.float32), layer, layer, layer, layer, True, 0, {}))
    code, _, err = run(capsys, "render", "--like", "bare.png", "a.npz")
    assert code == 2 and len(err) == 1 and "--like bare.png: it does not say by which command it was made" in err[0]


def test_a_variable_of_the_environment_is_as_good_as_an_option(seen, monkeypatch, capsys):
    monkeypatch.setenv("JAXSPH_QUIET", "1")
    monkeypatch.setenv("JAXSPH_COLORMAP", "virdis")
    code, out, err = run(capsys, "render", "a.npz", *TINY)
    assert code == 2 and len(err) == 1 and "--colormap must be one of" in err[0]
    monkeypatch.setenv("JAXSPH_COLORMAP", "heat")
    code, out, err = run(capsys, "render", "a.npz", *TINY)
    assert (code, out, err) == (0, "a.png\n", []), "JAXSPH_QUIET"
