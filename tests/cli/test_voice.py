"""What goes where: results on stdout, prose on stderr, all of it as JSON, and one line where a command fails."""

import json
from pathlib import Path

import numpy as np
import pytest
from commanded import apart, refused, run

import jaxsph as js
from jaxsph import io
from jaxsph.cli import voice
from jaxsph.cli.voice import by_option

TINY = ["--size", "12x8", "--samples", "8"]
pytestmark = pytest.mark.usefixtures("here", "seen")


def test_stdout_holds_the_result_and_stderr_the_prose(capsys):
    code, out, prose, wrong = apart(capsys, "render", "a.npz", *TINY)
    assert (code, out, wrong) == (0, "a.png\n", []) and any("60 particles" in line for line in prose)
    assert apart(capsys, "render", "a.npz", *TINY, "-q") == (0, "a.png\n", [], [])
    code, out, prose, wrong = apart(capsys, "info", "a.npz", "--color-by", "heat")
    assert code == 0 and "60 particles" in out and "quantity  heat" in out and not prose + wrong


def test_a_command_that_fails_says_one_line_and_with_verbose_where_it_comes_from(capsys):
    code, out, prose, wrong = apart(capsys, "render", "a.npz", *TINY, "--width", "3 kpc")
    assert (code, out, prose, len(wrong)) == (2, "", [], 1)
    code, _, _, wrong = apart(capsys, "render", "a.npz", *TINY, "--width", "3 kpc", "-v")
    assert code == 2 and wrong[0].startswith("Traceback") and wrong[-1].startswith("jaxsph render: --width")


@pytest.mark.parametrize(
    ("arguments", "keys"),
    [
        (["render", "a.npz", *TINY], {"file": "a.png", "size": [12, 8], "particles": 60}),
        (["info", "a.npz", "--color-by=heat"], {"particles": 60, "quantity": "heat", "source": "a.npz"}),
        (["info", "scene:radial:particles=9"], {"particles": 9}),
        (["doctor"], {"version": js.__version__}),
        (["doctor", "--completion", "bash"], {"shell": "bash"}),
    ],
    ids=str,
)
def test_json_is_one_object_with_what_was_made_and_chosen(capsys, arguments, keys):
    code, out, _, wrong = apart(capsys, *arguments, "--json")
    told = json.loads(out)
    assert (code, wrong) == (0, []) and told["command"] == arguments[0] and {key: told[key] for key in keys} == keys
    assert all(set(line) == {"what", "text"} for line in told["said"])
    if arguments[0] == "render":
        assert told["settings"]["samples"] == 8 and "--eye" in told["camera"] and told["error"]["bound"] == 0.5


@pytest.mark.slow
def test_json_of_projections_and_slices(capsys):
    told = json.loads(apart(capsys, "project", "a.npz", "--size", "12x8", "--json", "-o", "p.npy")[1])
    assert told["file"] == "p.npy" and told["total"] == pytest.approx(60, rel=1e-3) and told["name"] == "column.mass"
    told = json.loads(apart(capsys, "slice", "a.npz", "--size", "12x8", "--json", "-o", "s.npy")[1])
    values = np.load("s.npy")
    assert told["file"] == "s.npy" and told["highest"] == pytest.approx(float(np.nanmax(values)))


def test_json_has_null_for_what_is_no_number(capsys):
    voice.begin(as_json=True)
    voice.report(error=float("nan"), layer=np.array([1, np.inf]), path=Path("a"))
    voice.end("render")
    told = json.loads(capsys.readouterr().out)
    assert (told["error"], told["layer"], told["path"]) == (None, [1.0, None], "a")


def test_doctor_says_versions_devices_and_the_cache(capsys):
    code, out, err = run(capsys, "doctor")
    assert (code, err) == (0, []) and all(
        word in out for word in (js.__version__, "jax ", "cyclopts ", "devices", "cpu", "cache", "compiled programs")
    )


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_shells_complete_commands_and_options(capsys, shell):
    code, out, err = run(capsys, "doctor", "--completion", shell)
    assert (code, err) == (0, []) and "render" in out and "color-by" in out
    assert "did you mean bash?" in refused(capsys, "doctor", "--completion", "bsh")


def test_the_background_is_behind_the_picture(capsys):
    for name, background in (("w", "white"), ("n", "#000"), ("c", "0,0,1")):
        assert run(capsys, "render", "a.npz", *TINY, "--background", background, "-o", f"{name}.png")[0] == 0
    pixel = {name: np.asarray(io.read_image(f"{name}.png").color)[0, 0] for name in "wnc"}
    np.testing.assert_allclose(pixel["w"], 0.75, atol=1 / 255)  # 0.25 in front of a half of white
    np.testing.assert_allclose(pixel["n"], 0.25, atol=1 / 255)
    np.testing.assert_allclose(pixel["c"], (0.25, 0.25, 0.75), atol=1 / 255)
    from PIL import Image

    assert run(capsys, "render", "a.npz", *TINY, "--background", "transparent", "-o", "t.png")[0] == 0
    with Image.open("t.png") as opened:
        assert opened.mode == "RGBA" and opened.getpixel((0, 0)) == (127, 127, 127, 128)
    assert "--background white is for .png" in refused(capsys, "render", "a.npz", *TINY, "--background", "white", "-o", "x.exr")
    assert run(capsys, "render", "a.npz", *TINY, "--background", "transparent", "-o", "x.exr")[0] == 0


def test_messages_name_options_for_arguments():
    known = ("--fov", "--eye", "--share")
    assert by_option("`fov_degrees` must be > 0, or `eye` ...", known) == "--fov must be > 0, or --eye ..."
    assert by_option("a.npz: `share` must; `count` must", known) == "a.npz: --share must; `count` must"


def test_jaxsph_alone_shows_first_steps(capsys):
    code, out, _, wrong = apart(capsys)
    assert (code, wrong) == (0, []) and out.count("  jaxsph ") >= 2 and "--help" in out
