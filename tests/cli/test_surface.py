"""`--surface [LEVEL]`: particles by their surface, as `jaxsph.io.read_scene(..., surface=)` has them."""

from __future__ import annotations

import dataclasses
from pathlib import Path

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


def of_lattice():
    """Particles that lie evenly in a ball, and how fast they are."""
    places = np.stack(np.meshgrid(*[np.arange(-3.0, 4)] * 3, indexing="ij"), -1).reshape(-1, 3)
    places = places[(places**2).sum(1) < 10]
    return places, np.linspace(0, 1, len(places))


@pytest.fixture
def liquid():
    """A file of points and nothing more, as tools for liquids write them."""
    rows = [f"{x} {y} {z} {speed}" for (x, y, z), speed in zip(*of_lattice(), strict=True)]
    header = ["ply", "format ascii 1.0", f"element vertex {len(rows)}"]
    header += [f"property float {name}" for name in ("x", "y", "z", "speed")]
    return lambda: Path("liquid.ply").write_text("\n".join([*header, "end_header", *rows, ""]))


def test_liquids_are_shown_by_their_surface_unless_it_is_said_otherwise(asked, liquid, capsys):
    liquid()
    code, out, err = run(capsys, "render", "liquid.ply", *TINY)
    assert (code, err) == (0, []) and "where the coverage by particles is 0.5, as of a liquid" in " ".join(out.split())
    ((scene, camera),) = asked
    own, own_camera = io.read_scene("liquid.ply", size=(8, 8))
    assert scene.surface == js.Surface() == own.surface and camera.describe() == own_camera.describe()
    assert io.read_scene("liquid.ply", surface=False)[0].surface is None


@pytest.mark.parametrize(
    "words",
    [
        ("--surface", "none"),
        ("--surface=none",),
        ("--tolerance", "0.1"),
        ("--opacity-by", "speed"),
        ("--exposure", "1"),
        ("--support", "1.5"),
    ],
)
def test_what_only_a_medium_has_shows_a_liquid_as_one(words, asked, liquid, capsys):
    liquid()
    assert run(capsys, "render", "liquid.ply", *words, *TINY)[0] == 0
    assert asked[-1][0].surface is None


def test_even_particles_of_other_kinds_of_files_are_a_medium(asked, capsys):
    places, speed = of_lattice()
    np.savez("even.npz", position=places, speed=speed)
    assert run(capsys, "render", "even.npz", *TINY)[0] == 0
    assert asked[-1][0].surface is None
