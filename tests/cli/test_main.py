"""The command line: what it writes, what it says, and how it refuses."""

import argparse
import subprocess
import sys
import warnings

import numpy as np
import pytest
from commanded import refused, run

import jaxsph as js
from jaxsph import io
from jaxsph.cli.commands import checks
from jaxsph.cli.commands.render import Render
from jaxsph.cli.console import camera_line, tell_if_unseen, warnings_in_lines
from jaxsph.cli.groups import settings_of
from jaxsph.io.settle import assemble

pytestmark = pytest.mark.usefixtures("quick_programs")

TINY = ["--size", "24x16", "--samples", "16"]


@pytest.fixture
def file(empty, tmp_path):
    """A small particle file in an otherwise empty working directory."""
    (tmp_path / "in").mkdir()
    generator = np.random.default_rng(0)
    path = tmp_path / "in" / "drop.npz"
    position = generator.normal(size=(60, 3)).astype(np.float32)
    columns = {"temperature": position[:, 0], "pressure": position[:, 1] ** 2, "support": np.full(60, 0.8, np.float32)}
    np.savez(path, position=position, **columns)
    return path


def test_a_draft_takes_a_quarter_of_the_samples_and_what_is_known_of_errors_is_said(file, by_reference, capsys):
    code, out, err = run(capsys, "render", file, "-o", "out.png", "--size", "8x8", "--draft")
    assert (code, err) == (0, []) and by_reference[-1].samples == js.Settings().samples // 4
    assert "not estimated; --tolerance 0.01 keeps and tells it" in out
    code, out, err = run(capsys, "render", file, "-o", "out.png", "--size", "8x8")
    assert "one pixel in a thousand is off by 0.013 to 0.065" in " ".join(out.split())
    code, _, err = run(capsys, "render", file, "-o", "out.png", "--draft", "--samples", "9")
    assert code == 2 and "--draft and --samples exclude each other" in err[-1]


def test_lengths_are_in_the_unit_that_is_said_where_the_file_says_none(file, by_reference, capsys):
    pytest.importorskip("unyt")
    across = ["--view", "z", "--center", "0,0,0", "--width", "2 kpc", "-o", "out.png", *TINY]
    code, out, err = run(capsys, "render", file, "--length-unit", "Mpc", *across)
    assert (code, err) == (0, []) and "lengths are in Mpc, as --length-unit says" in out and "width     0.002 (2 kpc)" in out
    for words, said in ((["--length-unit", "g"], "does not agree"), ([], "the file does not state that of its lengths")):
        code, _, err = run(capsys, "render", file, *words, *across)
        assert code in (1, 2) and said in err[-1]


def test_render_writes_an_exr_and_says_what_it_picked(file, tmp_path, capsys):
    code, out, err = run(capsys, "render", file, "-o", "out.exr", *TINY)
    assert (code, err) == (0, [])
    image = io.read_image(tmp_path / "out.exr")
    assert image.color.shape == (16, 24, 3) and np.asarray(image.alpha).max() > 0.1
    for said in ("60 particles", "temperature", "coolwarm", "0.8", "--eye", "out.exr", "24 x 16", "16 samples", "M kernel"):
        assert said in out


@pytest.mark.core
def test_without_output_the_picture_lands_here_and_is_named(file, tmp_path, by_reference, capsys):
    code, out, _ = run(capsys, "render", file, *TINY)
    assert code == 0 and (tmp_path / "drop.png").stat().st_size > 0 and "drop.png" in out


def test_the_picture_is_the_one_that_the_library_makes(file, tmp_path, capsys):
    arguments = ["--quantity", "pressure", "--colormap", "heat", "--support", "0.5", "--range", "0,2"]
    code, out, _ = run(capsys, "render", file, "-o", "out.exr", *TINY, *arguments)
    assert code == 0 and "pressure" in out and "heat" in out
    more = {"colormap": "heat", "support": 0.5, "range": (0, 2), "size": (24, 16)}
    js.render(*io.read_scene(file, color_by="pressure", **more), js.Settings(samples=16)).save("own.exr")
    found, own = (io.read_image(tmp_path / name) for name in ("out.exr", "own.exr"))
    for layer in ("color", "transmittance", "depth", "error_bound", "evaluations"):
        np.testing.assert_array_equal(getattr(found, layer), getattr(own, layer), layer)
    assert np.asarray(found.color).max() > 0.1


def test_colour_and_opacity_are_by_the_quantities_asked_for(file, by_reference, capsys):
    names = ["--color-by", "temperature", "--opacity-by", "log10:pressure"]
    code, out, _ = run(capsys, "render", file, "-o", "a.exr", *names, *TINY)
    assert code == 0 and "by log10:pressure" in out and "over temperature" in out
    scene, camera = io.read_scene(file, color_by="temperature", opacity_by="log10:pressure", size=(24, 16))
    own = js.render(scene, camera, js.Settings(samples=16))
    np.testing.assert_allclose(io.read_image("a.exr").color, own.color, atol=1e-6)
    code, _, err = run(capsys, "render", file, "--opacity-by", "dust", *TINY)
    assert code == 1 and "no quantity 'dust'" in err[0]


def test_a_camera_that_is_said_is_the_one_used(file, tmp_path, by_reference, capsys):
    _, out, _ = run(capsys, "render", file, "-o", "placed.exr", *TINY, "--eye", 0, 0, 9, "--target", 0, 0, 0, "--fov", 30)
    assert "--eye 0,0,9" in out and "--fov 30" in out
    placed = np.asarray(io.read_image(tmp_path / "placed.exr").color)
    line = next(line for line in out.splitlines() if line.startswith("camera"))
    pasted = line.split("camera")[1].split(", depths")[0].split()
    assert run(capsys, "render", file, "-o", "pasted.exr", *TINY, *pasted)[0] == 0  # what it says can be said to it
    assert np.abs(placed - np.asarray(io.read_image(tmp_path / "pasted.exr").color)).max() < 1e-3


@pytest.mark.core
def test_a_tolerance_is_what_the_renderer_is_asked_for_and_its_bound_is_told(file, by_reference, capsys):
    more = ["--integrator", "samples", "--tolerance", 0.01, "--estimator", "interval"]
    code, out, err = run(capsys, "render", file, "-o", "out.exr", *TINY, *more)
    (settings,) = by_reference
    assert (code, err) == (0, []) and (settings.tolerance, settings.estimator, settings.samples) == (0.01, "interval", 16)
    assert "at most 0.003 (certified), tolerance 0.01" in out
    assert np.asarray(io.read_image("out.exr").error_bound).max() == np.float32(0.003)


def test_pixels_of_unknown_error_are_counted_apart(file, by_reference, capsys, monkeypatch):
    monkeypatch.setattr("by_reference.BOUND", np.array([[np.inf], *[[0.003]] * 7]))
    more = ["--integrator", "samples", "--tolerance", 0.01, "--estimator", "interval"]
    code, out, _ = run(capsys, "render", file, "-o", "out.exr", "--size", "12x8", "--samples", 16, *more)
    assert code == 0 and "at most 0.003" in out and "unknown in 12 pixels" in out


@pytest.mark.slow
def test_segments_are_asked_for_by_name_and_their_error_is_about_what_the_light_integral_is(file, tmp_path, capsys):
    arguments = ["--size", "12x8", "--samples", "64"]
    code, out, err = run(capsys, "render", file, "-o", "out.exr", *arguments, "--integrator", "segments", "--tolerance", 0.01)
    assert (code, err) == (0, [])
    (line,) = (line for line in out.splitlines() if line.startswith("error"))
    assert line.startswith("error     at most about ")
    assert line.endswith(" (estimated against the light integral), tolerance 0.01")
    image = io.read_image(tmp_path / "out.exr")
    told = dict(image.metadata)
    assert (told["jaxsph.integrator"], told["jaxsph.estimator"], told["jaxsph.certified"]) == ("segments", "segments", 0)
    assert np.asarray(image.error_bound).max() > 0
    code, out, _ = run(capsys, "render", file, "-o", "out.exr", *arguments, "--integrator", "samples", "--tolerance", 0.01)
    told = dict(io.read_image(tmp_path / "out.exr").metadata)
    assert code == 0 and (told["jaxsph.integrator"], told["jaxsph.estimator"]) == ("samples", "interval")
    assert "(certified), tolerance 0.01" in out


def test_scenes_render_at_any_number_of_particles(empty, tmp_path, by_reference, capsys):
    code, out, err = run(capsys, "render", "scene:dam_break:particles=60,frame=0", *TINY)
    assert (code, err) == (0, []) and "60 particles" in out and (tmp_path / "dam_break.png").exists()


@pytest.mark.core
def test_info_glances_at_files_of_many_particles(empty, capsys, monkeypatch):
    monkeypatch.setattr(assemble, "GLANCED", 50)
    np.savez("many.npz", position=np.random.default_rng(0).uniform(0, 1, (400, 3)) ** 2, mass=np.linspace(1, 2, 400))
    code, out, err = run(capsys, "info", "many.npz")
    assert (code, err) == (0, []) and "a glance at 50 of 400 particles" in out and "400 particles" in out.splitlines()[0]


def test_info_lists_attributes_and_what_would_be_rendered(file, capsys):
    code, out, err = run(capsys, "info", file)
    assert (code, err) == (0, [])
    attributes = ("position", "60 x 3", "temperature", "pressure", "float32")
    for said in ("60 particles", *attributes, "support   0.8", "would show", "quantity  temperature"):
        assert said in out
    assert run(capsys, "info", "scene:radial")[0] == 0


@pytest.mark.parametrize("renderer", ["by_reference", pytest.param("file", marks=pytest.mark.slow)])
def test_the_demo_prints_paths_tolerance_error_and_time(tmp_path, monkeypatch, capsys, request, renderer):
    request.getfixturevalue(renderer)
    monkeypatch.setattr(checks, "CHECK", 8)
    load = js.scenes.load
    monkeypatch.setattr(js.scenes, "load", lambda name, **sizes: load(name, 300, **sizes))
    code, out, _ = run(capsys, "demo", "-o", tmp_path / "demo", "--size", "8x8")
    assert code == 0 and (tmp_path / "demo.exr").exists() and (tmp_path / "demo.png").exists()
    told = dict(line.split(maxsplit=1) for line in out.splitlines())
    assert str(tmp_path / "demo") in told["image"] and told["tolerance"].startswith("0.004, certified") and " s " in told["time"]
    assert float(told["error"].split(",")[0]) < 1e-4


WRONG_USAGE = [
    (["render"], "FILE"),
    (["paint", "FILE"], "there is no command 'paint'"),
    (["render", "FILE", "--size", "0x4"], "at least 1 pixel"),
    (["render", "FILE", "--size", "big"], "--size must be pixels, at least 1 pixel each way, as 640x480, got 'big'"),
    (["render", "FILE", "--integrator", "walks"], "--integrator must be one of samples, segments"),
    (["render", "FILE", "--samples", "0"], "--samples must be"),
    (["render", "FILE", "--samples", "many"], "--samples must be a whole number, got 'many'"),
    (["render", "FILE", "--tolerance", "-1"], "--tolerance must be"),
    (["render", "FILE", "-o", "out.jpg"], ".exr or .png"),
    (["render", "FILE", "--target", "0", "0", "0"], "--target needs --eye"),
    (["render", "FILE", "--eye", "0", "0", "0", "--target", "0", "0", "0"], "must differ"),
    (["render", "FILE", "--fov", "180"], "--fov must lie in (0, 180), got 180"),
    (["render", "FILE", "--support", "0"], "--support must be > 0"),
    (["render", "FILE", "--colormap", "nope"], "viridis"),
    (["render", "FILE", "--range", "1,0"], "--range must be two finite numbers that ascend"),
    (["render", "FILE", "--memory", "0"], "--memory"),
    (["render", "scene:nowhere"], "mixer, radial, checker_board, dam_break"),
    (["render", "scene:mixer:frame=9"], "one of [0, 1, 2]"),
    (["render", "scene:mixer", "--quantity", "x"], "--color-by is for particle files, not for built-in scenes"),
    (["render", "scene:mixer:particles=0"], "at least 1"),
]


@pytest.mark.parametrize(("arguments", "message"), WRONG_USAGE, ids=[" ".join(case[0]) for case in WRONG_USAGE])
@pytest.mark.core
def test_wrong_usage_is_exit_code_2_and_one_line(file, capsys, arguments, message):
    assert message in refused(capsys, *[file if argument == "FILE" else argument for argument in arguments])


@pytest.mark.core
def test_failures_are_exit_code_1_and_one_line(file, tmp_path, capsys):
    (tmp_path / "broken.npz").write_bytes(file.read_bytes()[:100])
    (tmp_path / "taken.png").mkdir()
    cases = [
        (["render", "absent.npz"], "absent.npz"),
        (["info", "absent.npz"], "absent.npz"),
        (["render", "broken.npz"], "broken.npz"),
        (["render", file, "--quantity", "salinity"], "temperature, pressure"),
        (["render", file, "-o", "no/such/folder/out.png"], "no folder"),
        (["render", file, "-o", "taken.png"], "cannot be written"),
    ]
    for arguments, message in cases:
        code, _, err = run(capsys, *arguments)
        assert code == 1 and len(err) == 1 and message in err[0] and "Traceback" not in err[0], arguments


def test_an_image_that_would_not_fit_the_memory_limit_says_so(file, capsys):
    code, _, err = run(capsys, "render", file, "--size", "4096x4096", "--memory", "1e-6")
    assert code == 1 and len(err) == 1 and "memory_limit" in err[0]


def test_verbose_shows_where_a_failure_comes_from(tmp_path, capsys):
    code, _, err = run(capsys, "render", tmp_path / "absent.npz", "--verbose")
    assert code == 1 and err[0].startswith("Traceback") and err[-1].startswith("jaxsph render:")


def test_an_empty_set_is_a_black_picture(empty, tmp_path, by_reference, capsys):
    np.savez("none.npz", position=np.zeros((0, 3)), temperature=np.zeros(0))
    assert run(capsys, "info", "none.npz")[0] == 0
    code, _, err = run(capsys, "render", "none.npz", *TINY, "-o", "none.exr")
    assert (code, err) == (0, []) and np.asarray(io.read_image(tmp_path / "none.exr").color).max() == 0
    for command, told in (("slice", "0.0% of the pixels inside of supports"), ("project", "0 particles")):
        for name in ("none.png", "none.npy"):
            code, out, err = run(capsys, command, "none.npz", "--size", "24x16", "-o", name)
            assert (code, err) == (0, []) and told in out and "0 particles" in out


@pytest.mark.core
def test_help_and_version_are_exit_code_0(capsys):
    for arguments in (["--help"], ["render", "--help"], ["info", "--help"], ["--version"]):
        code, out, err = run(capsys, *arguments)
        assert code == 0 and out and not err
    assert js.__version__ in out


def test_it_runs_as_a_module():
    done = subprocess.run([sys.executable, "-m", "jaxsph", "render"], capture_output=True, text=True, timeout=120)
    assert done.returncode == 2 and done.stderr.count("\n") == 1


@pytest.fixture
def ball(empty):
    """A volume in an otherwise empty working directory."""
    x = np.linspace(-1, 1, 9)
    values = (200 * np.clip(1.2 - np.sqrt(x[:, None, None] ** 2 + x[:, None] ** 2 + x**2), 0, 1)).astype(np.uint8)
    io.write_volume("ball.vti", js.Volume.from_array(values, (-1, -1, -1), 0.25))


def test_a_volume_is_rendered_and_described(ball, by_reference, capsys):
    code, out, err = run(capsys, "render", "ball.vti", "-o", "out.exr", "--colormap", "heat", *TINY)
    assert (code, err) == (0, [])
    assert all(said in out for said in ("9 x 9 x 9 points", "uint8", "heat over", "= 0 .. ", "--eye"))
    assert np.asarray(io.read_image("out.exr").alpha).max() > 0.3
    code, out, _ = run(capsys, "info", "ball.vti")
    assert code == 0 and all(said in out for said in ("VTK XML image, 9 x 9 x 9", "spacing 0.25 0.25 0.25", "0 to 200"))
    code, _, err = run(capsys, "render", "ball.vti", "--support", "1", *TINY)
    assert code == 2 and err == ["jaxsph render: --support is for particles, and this is a volume (see `jaxsph render --help`)"]
    code, _, err = run(capsys, "render", "ball.vti", "--quantity", "rho", *TINY)
    assert code == 1 and err == ["jaxsph render: ball.vti: has no quantity 'rho'; it has values"]


def test_a_volume_is_cut_at_a_level(ball, capsys):
    np.save("plane.npy", np.ones((1, 9, 9)))
    for command in ("render", "info"):
        code, _, err = run(capsys, command, "plane.npy")
        assert code == 1 and err[0].startswith(f"jaxsph {command}: plane.npy: the array values must have at least two points")
    code, _, _ = run(capsys, "render", "ball.vti", "-o", "iso.exr", "--iso", "100", *TINY)
    assert code == 0 and set(np.unique(io.read_image("iso.exr").alpha)) == {0, 1}


def test_stages_are_of_a_quadtree_whose_rays_are_of_points():
    settings = settings_of(Render(progressive=True, tolerance=0.1))
    assert (settings.screen, settings.integrator_used) == ("quadtree", "samples")


@pytest.mark.slow
def test_progressive_rewrites_the_file_at_each_stage_and_tells_errors_and_rays(tmp_path, capsys):
    output = tmp_path / "stages.png"
    tiny = ("--size", "40x32", "--samples", "16")
    code, out, err = run(capsys, "render", "scene:mixer:particles=400", *tiny, "--progressive", "-o", str(output))
    assert (code, err) == (0, [])
    stages = [line for line in out.splitlines() if line.startswith("stage ")]
    assert len(stages) > 1
    assert all(said in stages[0] for said in ("estimated error", "rays cast", "left at most"))
    assert [file.name for file in tmp_path.iterdir() if file.suffix == ".png"] == ["stages.png"] and output.stat().st_size > 0


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["--optical-depth", -3], 2, "--optical-depth must be > 0"), (["--up", 0, 0, 0], 2, "--up = [0.0, 0.0, 0.0] is zero"),
        (["--eye", 1e300, 0, 0], 2, "--eye"), (["--box-size", "1e300,1,1"], 1, ""),
        (["--optical-depth", 1e300], 2, "--optical-depth must be a number of at most 1e6"),
        (["--qantity", "x"], 2, "(see `jaxsph render --help`)"),
    ],
    ids=str,
)  # fmt: skip
def test_messages_name_options_in_one_line(file, capsys, arguments, code, message):
    got, _, err = run(capsys, "render", file, *TINY, *arguments)
    assert got == code and len(err) == 1 and message in err[0], err


def test_a_moment_beyond_all_numbers_is_refused_in_one_line(capsys):
    code, _, err = run(capsys, "render", "scene:letters:frame=1e300", *TINY)
    assert code == 2 and len(err) == 1 and err[0].startswith("jaxsph render: frame of scene:NAME of scene 'letters'")


def test_the_camera_line_gives_back_what_was_given(file, capsys):
    camera = js.Camera.look_at((60, 50, 100), (0, 0, 0), near=90, far=1000)
    given = argparse.Namespace(eye=[60.0, 50.0, 100.0], target=[0.0, 0.0, 0.0])
    assert "--eye 60,50,100 --target 0,0,0 --fov 45" in camera_line(camera, given)
    assert "--target 0,0,0" not in camera_line(camera)


@pytest.mark.parametrize(
    ("eye", "up", "seen"), [((0, -2, 0), (0, 0, 1), "y"), ((0, 2, 0), (0, 0, 1), "0,1,0"), ((0, 3, -4), (0, 1, 0), "0,0.6,-0.8")]
)
def test_the_camera_line_gives_a_view_that_was_chosen(eye, up, seen):
    camera = js.Camera.orthographic(eye, (0, 0, 0), up, near=1, far=9)
    assert camera_line(camera).startswith(f"--view {seen} --center ")
    assert camera_line(camera, argparse.Namespace(view="face-on")).startswith("--view face-on ")


@pytest.mark.parametrize(("level", "said"), [(0.01, "darker than 5%"), (0.99, "brighter than 95%"), (0.5, "")])
def test_a_picture_that_shows_almost_nothing_says_what_to_try(capsys, level, said):
    picture = np.full((40, 40, 3), level)
    picture[0, 0] = 0.5
    tell_if_unseen("render", "a.png", [picture])
    err = capsys.readouterr().err
    assert err.count("\n") == bool(said) and said in err and ("--exposure" in err) == bool(said)
    tell_if_unseen("movie", "a.mp4", [picture, np.full((4, 4, 3), 0.5)])
    assert capsys.readouterr().err == "", "one frame that is seen is enough"


def test_a_missed_tolerance_is_a_line_of_the_command(capsys):
    with warnings_in_lines("render", lambda _: False):
        warnings.warn("3 of 9 pixels:\n the tolerance is not kept", stacklevel=1)
        np.float32(1e38) * np.float32(1e38)
    assert capsys.readouterr().err == "jaxsph render: 3 of 9 pixels: the tolerance is not kept\n"
