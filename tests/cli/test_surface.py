"""`--surface [LEVEL]`: particles by their surface, as `jaxsph.io.read_scene(..., surface=)` has them."""

from __future__ import annotations

from pathlib import Path

import jax
import numpy as np
import pytest
from commanded import frames_made, run

import jaxsph as js
from jaxsph import io
from jaxsph.cli.commands import movie as cli_movie
from jaxsph.io.opening.looks import SHOWN
from jaxsph.io.replace import digest_of

TINY = ["--size", "8x8", "--samples", "8", "-o", "out.png"]

LIQUID = js.Surface(**SHOWN)


@pytest.fixture
def asked(empty, seen):
    """What the renderer is asked for; a small file is in an otherwise empty working directory."""
    rng = np.random.default_rng(0)
    columns = {"temperature": rng.uniform(1, 2, 60), "density": np.full(60, 8.0), "mass": np.full(60, 1.0)}
    np.savez("drop.npz", position=rng.normal(size=(60, 3)), support=np.full(60, 0.8), **columns)
    return seen


@pytest.mark.parametrize(("words", "level"), [
    (["drop.npz", "--surface"], 0.5), (["--surface", "drop.npz"], 0.5), (["drop.npz", "--surface", "0.3"], 0.3),
    (["drop.npz", "--surface=0.25"], 0.25),
])  # fmt: skip
def test_the_surface_is_that_of_read_scene_with_any_level_or_none(words, level, asked, capsys):
    code, out, err = run(capsys, "render", *words, *TINY)
    assert (code, err) == (0, []) and f"surface   where the coverage by particles is {level:g}" in out
    assert "surfaces of particles are in their place to rounding" in " ".join(out.split())
    ((scene, camera, _),) = asked
    own, own_camera = io.read_scene("drop.npz", surface=level, size=(8, 8))
    assert scene.surface == js.Surface(level, **SHOWN) == own.surface and camera.describe() == own_camera.describe()
    jax.tree.map(np.testing.assert_array_equal, scene.transfer, own.transfer)


def test_a_surface_of_read_scene_may_be_smoothed_and_that_of_a_built_in_scene_is_shown(asked, capsys):
    smooth = js.Surface(0.4, smoothing=1.5)
    assert io.read_scene("drop.npz", surface=smooth)[0].surface is smooth
    assert run(capsys, "render", "scene:letters:particles=200", "--surface", *TINY)[0] == 0
    assert asked[-1][0].surface == LIQUID and asked[-1][0].transfer is not None


def test_a_surface_of_a_quantity_is_coloured_by_another_and_framed_by_what_has_the_level(asked, capsys):
    code, out, _ = run(capsys, "render", "drop.npz", "--surface-of", "temperature", "--color-by", "density", *TINY)
    ((scene, camera, _),) = asked
    assert code == 0 and scene.surface.of == "extinction_quantity" and scene.transfer.extinction_values is None
    warm = np.asarray(scene.particles.extinction_quantity)[:60]
    level = float(scene.surface.level)
    assert (
        level == pytest.approx(np.median(warm)) and f"where temperature, smoothed by kernels, is {level:.6g}, which half" in out
    )
    own, own_camera = io.read_scene("drop.npz", surface_of="temperature", color_by="density", size=(8, 8))
    assert own.surface == scene.surface and own_camera.describe() == camera.describe()
    same, _ = io.read_scene("drop.npz", surface_of="temperature", surface=1.2, color_by="temperature", size=(8, 8))
    assert same.surface == js.Surface(1.2, "quantity", **SHOWN) and same.particles.extinction_quantity is None
    smooth = js.Surface(1e-3, smoothing=2)
    given, all_of_it = io.read_scene("drop.npz", surface_of="temperature", color_by="density", surface=smooth, size=(8, 8))
    assert given.surface == js.Surface(1e-3, "extinction_quantity", 2)
    assert all_of_it.describe() != camera.describe()


@pytest.mark.parametrize(
    ("words", "code", "match"),
    [
        (["drop.npz", "--surface-of", "density", "--surface", "none"], 2, "says that there is none"),
        (["drop.npz", "--surface-of", "density", "--opacity-by", "x"], 2, "--opacity-by and --surface-of exclude each other"),
        (["drop.npz", "--surface-of", "x"], 2, "must be a level of x > 0, and the median of its values is -"),
        (["drop.npy", "--surface-of", "density"], 2, "is for particles, and this is a volume"),
        (["scene:letters", "--surface-of", "density"], 2, "is for particle files, not for built-in scenes"),
        (["drop.npz", "--surface", "-1"], 2, "must be > 0"),
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
    ((scene, camera, _),) = asked
    own, own_camera = io.read_scene("liquid.ply", size=(8, 8))
    assert scene.surface == LIQUID == own.surface and camera.describe() == own_camera.describe()
    assert io.read_scene("liquid.ply", surface=False)[0].surface is None


@pytest.mark.parametrize("words", [
    ("--surface", "none"), ("--surface=none",), ("--tolerance", "0.1"), ("--opacity-by", "speed"), ("--exposure", "1"),
    ("--support", "1.5"), ("--clip", "plane:0,0,0,1,0,0"),
])  # fmt: skip
def test_what_only_a_medium_has_shows_a_liquid_as_one(words, asked, liquid, capsys):
    liquid()
    assert run(capsys, "render", "liquid.ply", *words, *TINY)[0] == 0
    assert asked[-1][0].surface is None


@pytest.fixture
def sources(monkeypatch):
    """What movies are asked to render, and with which settings."""
    asked = []

    def render_frames(sources, cameras, settings, client, output):
        asked.append((sources, settings))
        return frames_made(cameras)

    monkeypatch.setattr(cli_movie, "render_frames", render_frames)
    return asked


ORBIT = ["--orbit", "90", "--frames", "2", "--size", "8x8", "--samples", "8", "-o", "m.mp4"]


def test_a_movie_of_a_liquid_shows_its_surface_as_a_picture_does(asked, liquid, sources, capsys):
    liquid()
    code, out, err = run(capsys, "movie", "liquid.ply", *ORBIT)
    assert (code, err) == (0, []) and "is 0.5, as of a liquid" in " ".join(out.split())
    assert run(capsys, "movie", "liquid.ply", "--surface", "0.3", *ORBIT)[0] == 0
    assert run(capsys, "movie", "liquid.ply", "--surface", "none", *ORBIT)[0] == 0
    assert run(capsys, "movie", "liquid.ply", "--tolerance", "0.1", *ORBIT)[0] == 0
    assert [scene.surface for scene, _ in sources] == [LIQUID, js.Surface(0.3, **SHOWN), None, None]
    assert len({digest_of(scene) for scene, _ in sources[:3]}) == 3  # a surface is part of what a frame is made of


def test_a_sequence_is_shown_alike_in_all_frames_by_what_its_middle_file_is(asked, liquid, sources, capsys):
    liquid()
    even = Path("liquid.ply").read_text().split("\n")
    rough = np.random.default_rng(0).normal(scale=1.5, size=(len(of_lattice()[0]), 3))
    begin = even.index("end_header") + 1
    for number in range(3):
        rows = [f"{x} {y} {z} 0.5" for x, y, z in rough] if number == 0 else even[begin:-1]
        Path(f"s_{number}.ply").write_text("\n".join([*even[:begin], *rows, ""]))
    files = [f"s_{number}.ply" for number in range(3)]
    code, out, err = run(capsys, "movie", *files, *ORBIT)
    told = " ".join(out.split())
    assert (code, err) == (0, []) and told.count("surface where") == 1 and "all frames alike, by s_1.ply" in told
    assert run(capsys, "movie", *files, "--surface", "none", *ORBIT)[0] == 0
    surfaces, media = (moments for moments, _ in sources)
    assert [moment().surface for moment in surfaces] == [LIQUID] * 2 and all(moment().surface is None for moment in media)
    assert all(one.fingerprint != other.fingerprint for one, other in zip(surfaces, media, strict=True))


@pytest.mark.parametrize(
    ("command", "words", "match"),
    [
        ("render", ["--tolerance", "0.1"], "--surface and --tolerance exclude each other"),
        ("movie", ["--tolerance", "0.1", "--orbit", "9"], "--surface and --tolerance exclude each other"),
    ],
)
def test_a_surface_with_what_it_does_not_have_is_wrong_usage(command, words, match, asked, sources, capsys):
    code, _, err = run(capsys, command, "drop.npz", "--surface", *words)
    assert code == 2 and match in err[-1]


def test_even_particles_of_other_kinds_of_files_are_a_medium(asked, capsys):
    places, speed = of_lattice()
    np.savez("even.npz", position=places, speed=speed)
    assert run(capsys, "render", "even.npz", *TINY)[0] == 0
    assert asked[-1][0].surface is None


def stored(places, support):
    np.savez("stored.npz", position=places, dye=places[:, 0], support_radius=support)
    return io.read_scene("stored.npz", size=(8, 8))[0].surface


def test_archives_are_liquids_where_particles_keep_apart_and_one_support_is_two_spacings(asked, capsys):
    rng = np.random.default_rng(0)
    stirred = np.stack(np.meshgrid(*[np.arange(8.0)] * 3, indexing="ij"), -1).reshape(-1, 3) + rng.uniform(-0.2, 0.2, (512, 3))
    spray = rng.uniform(9, 30, (10, 3))
    liquid = np.concatenate([stirred, spray])
    assert stored(liquid, 2.1) == LIQUID
    assert run(capsys, "render", "stored.npz", *TINY)[0] == 0 and asked[-1][0].surface == LIQUID
    assert stored(liquid, 5.0) is None  # supports of a smoother field
    assert stored(liquid, rng.uniform(2.0, 2.2, len(liquid))) is None  # which adapt, as those of gas do
    assert stored(rng.uniform(0, 8, (512, 3)), 2.1) is None  # at random: many are close to each other
    assert stored(rng.normal(size=(512, 3)), 0.5) is None  # they cluster


@pytest.mark.parametrize(
    ("names", "column", "shape", "surface"),
    [
        ("x,y,z,pressure", 1.0, "ball", LIQUID),
        ("x,y,z,pressure", 1.0, "box", None),
        ("x,y,z,rho", 1000.0, "ball", LIQUID),
        ("x,y,z,rho", [1.0, 4.0], "ball", None),
        ("x,y,z,temperature", 300.0, "ball", None),
    ],
)
def test_tables_are_liquids_unless_they_are_as_gas(tmp_path, names, column, shape, surface):
    places = of_lattice()[0]
    if shape == "box":
        places = np.stack(np.meshgrid(*[np.arange(6.0)] * 3), -1).reshape(-1, 3)
    rows = np.column_stack([places, np.resize(column, len(places))])
    np.savetxt(tmp_path / "even.csv", rows, header=names, comments="", delimiter=",")
    assert io.read_scene(tmp_path / "even.csv", size=(8, 8))[0].surface == surface


def test_a_surface_is_smoothed_and_lit_as_is_said_and_so_is_that_of_read_scene(asked, capsys):
    words = ["--smoothing", "2", "--light", "head", "--occlusion", "0.5", "--antialias", "1"]
    assert run(capsys, "render", "drop.npz", "--surface", *words, *TINY)[0] == 0
    own = io.read_scene("drop.npz", surface=0.5, smoothing=2, light="head", occlusion=0.5, antialias=1)[0].surface
    assert asked[-1][0].surface == js.Surface(smoothing=2, occlusion=0.5) == own
    assert eval(repr(own), {"Surface": js.Surface}) == own
    code, _, err = run(capsys, "render", "drop.npz", "--light", "0,1,0", *TINY)
    assert code == 2 and "--light is of a surface, and there is none: give --surface" in err[-1]


def test_a_surface_is_written_as_a_mesh_and_nothing_else_is(asked, liquid, capsys):
    liquid()
    code, out, _ = run(capsys, "render", "liquid.ply", "--cell", "0.3", "-o", "mesh.ply")
    table = io.read_table("mesh.ply")
    assert code == 0 and "off the surface in the median" in out and len(table) > 100 and not asked
    assert run(capsys, "render", "drop.npz", "--surface", "0.001", "-o", "mesh.obj")[0] == 0 and Path("mesh.obj").stat().st_size
    for words, match in (
        (["drop.npz"], "give --surface"),
        (["liquid.ply", "--annotate"], "--annotate is of a picture"),
        (["liquid.ply", "--clip", "box:0,0,0,1,1,1"], "--clip is of a"),
    ):
        code, _, err = run(capsys, "render", *words, "-o", "none.obj")
        assert code == 2 and match in err[-1] and not Path("none.obj").exists()
    code, _, err = run(capsys, "render", "drop.npz", "liquid.ply", "-o", "both.obj")
    assert code == 2 and "both.obj is one mesh, but there are 2" in err[-1] and not Path("both.obj").exists()
    code, _, err = run(capsys, "render", "liquid.ply", "--smallest-piece", "3", "-o", "none.obj")
    assert code == 2 and "--smallest-piece must lie in [0, 1], got 3" in err[-1]
