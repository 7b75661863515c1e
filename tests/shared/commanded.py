"""A command of the command line, within this process."""

import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image as Picture

import jaxsph as js
from jaxsph.cli import main as cli
from jaxsph.sequence.task import FrameFile

PROSE = re.compile(r"(?=.{10}\S)[a-z0-9][a-z0-9 ]{8} \S| {10}\S")
"""Lines of stderr that say what was chosen and done: a word, and a sentence from the eleventh place on."""


def run(capsys, *arguments):
    """Exit code, what was said (results on stdout, then prose), and the lines of stderr that say what is wrong."""
    code, out, prose, wrong = apart(capsys, *arguments)
    return code, "\n".join([out, *prose]), wrong


def apart(capsys, *arguments):
    """Exit code, stdout, and the lines of stderr: prose, and what is wrong."""
    code = cli.main([str(argument) for argument in arguments])
    out, err = capsys.readouterr()
    lines = err.splitlines()
    prose = [line for line in lines if PROSE.match(line)]
    return code, out, prose, [line for line in lines if not PROSE.match(line)]


def refused(capsys, *arguments):
    """The one line that wrong usage is told in."""
    code, _, wrong = run(capsys, *arguments)
    assert code == 2 and len(wrong) == 1 and "--help" in wrong[0], wrong
    return wrong[0]


@pytest.fixture
def empty(tmp_path, monkeypatch):
    """An empty working directory."""
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def here(empty):
    """Particles, `a.npz`, in an otherwise empty working directory."""
    position = np.random.default_rng(0).normal(size=(60, 3)).astype(np.float32)
    columns = {"mass": np.ones(60), "heat": position[:, 0], "cold": position[:, 1] ** 2}
    np.savez("a.npz", position=position, support=np.full(60, 0.8, np.float32), **columns)


def frames_made(cameras):
    """A grey frame for each camera, as `render_frames` tells of them."""
    Picture.new("RGB", (2, 2), "grey").save("grey.png")
    return iter([FrameFile(number, Path("grey.png"), True, {}) for number, _ in enumerate(cameras, 1)])


class Seen(list):
    """What the renderer was asked for: scene, camera and settings of each picture."""

    scene = property(lambda self: self[-1][0])
    camera = property(lambda self: self[-1][1])


@pytest.fixture
def seen(monkeypatch):
    """What the renderer would have been asked for; its pictures are grey."""
    found = Seen()

    def render(scene, camera, settings, progress=None, devices=None):
        found.append((scene, camera, settings))
        layer = np.full((camera.height, camera.width), 0.5, np.float32)
        stats = {"evaluations": 0, "evaluations_full": 0, "cells": 0, "pairs": 0, "seconds": {"cast": 0.0}}
        return js.Image(np.full((*layer.shape, 3), 0.25, np.float32), layer, layer, layer, layer, True, 0, stats, ())

    monkeypatch.setattr(js, "render", render)
    return found
