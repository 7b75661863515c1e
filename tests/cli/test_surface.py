"""`--surface [LEVEL]`: particles by their surface, as `jaxsph.io.read_scene(..., surface=)` has them."""

from __future__ import annotations

import dataclasses

import jax
import numpy as np
import pytest
from commanded import run

import jaxsph as js
from jaxsph import io

TINY = ["--size", "8x8", "--samples", "8", "-o", "out.png"]


@pytest.fixture
def asked(tmp_path, monkeypatch):
    """A small file in an otherwise empty working directory; the scenes that commands ask pictures of, which show fog instead."""
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(0)
    columns = {"temperature": rng.uniform(1, 2, 60), "density": np.full(60, 8.0), "mass": np.full(60, 1.0)}
    np.savez("drop.npz", position=rng.normal(size=(60, 3)), support=np.full(60, 0.8), **columns)
    scenes = []

    def render(scene, camera, settings, **_):
        scenes.append((scene, camera))
        image = js.reference.render(dataclasses.replace(scene, surface=None), camera, settings)
        return dataclasses.replace(
            image, stats=image.stats | {"seconds": {"compile": 0.0, "grid": 0.0, "adapt": 0.0, "cast": 0.0}}
        )

    monkeypatch.setattr(js, "render", render)
    return scenes


@pytest.mark.parametrize(
    ("words", "level"),
    [
        (["drop.npz", "--surface"], 0.5),
        (["--surface", "drop.npz"], 0.5),
        (["drop.npz", "--surface", "0.3"], 0.3),
        (["drop.npz", "--surface=0.25"], 0.25),
    ],
)
def test_the_surface_is_that_of_read_scene_with_any_level_or_none(words, level, asked, capsys):
    code, out, err = run(capsys, "render", *words, *TINY)
    assert (code, err) == (0, []) and f"surface   where the coverage by particles is {level:g}" in out
    assert "surfaces of particles are in their place to rounding" in " ".join(out.split())
    ((scene, camera),) = asked
    own, own_camera = io.read_scene("drop.npz", surface=level, size=(8, 8))
    assert scene.surface == js.Surface(level) == own.surface and camera.describe() == own_camera.describe()
    jax.tree.map(np.testing.assert_array_equal, scene.transfer, own.transfer)


def test_a_surface_of_read_scene_may_be_smoothed_and_that_of_a_built_in_scene_is_shown(asked, capsys):
    smooth = js.Surface(0.4, smoothing=1.5)
    assert io.read_scene("drop.npz", surface=smooth)[0].surface is smooth
    assert run(capsys, "render", "scene:letters:particles=200", "--surface", *TINY)[0] == 0
    assert asked[-1][0].surface == js.Surface(0.5) and asked[-1][0].transfer is not None


@pytest.mark.parametrize(
    ("words", "code", "match"),
    [
        (["drop.npz", "--surface", "-1"], 2, "must be > 0"),
        (["drop.npz", "--surface", "--from-disk", "1"], 2, "--surface is for particles that are in memory"),
        (["drop.npy", "--surface"], 2, "is for particles, and this is a volume"),
        (["--points", "drop.npz:radius=0.1", "--surface"], 2, "--surface is for FILE or scene:NAME"),
    ],
)
def test_a_surface_of_nothing_is_wrong_usage(words, code, match, asked, capsys):
    np.save("drop.npy", np.zeros((4, 4, 4), np.float32))
    got, _, err = run(capsys, "render", *words, *TINY)
    assert got == code and match in err[-1]
