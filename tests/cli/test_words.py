"""Words and files of options: how they may be spelled, what wins, what is refused, and that a picture holds its command."""

import json
import os
from pathlib import Path

import numpy as np
import pytest
from commanded import run

from jaxsph import io
from jaxsph.cli import main as cli
from jaxsph.cli.table import completed

TINY = ["--size", "24x16", "--samples", "16"]
pytestmark = pytest.mark.usefixtures("here")


def test_a_file_of_options_holds_where_nothing_else_is_said(seen, capsys):
    text = 'samples = 32\n[camera]\nsize = "20x10"\neye = [0, 0, 9]\nfov = 30\n[movie]\norbit = 9\n[render]\ncolor-by = "cold"\n'
    Path("look.toml").write_text(text)
    code, out, err = run(capsys, "render", "a.npz", "--config", "look.toml", "--fov", 20)
    assert (code, err) == (0, []) and "quantity  cold" in out
    _, camera, settings = seen[-1]
    assert settings.samples == 32 and (camera.width, camera.height) == (20, 10)
    np.testing.assert_array_equal(camera.exact_eye(), (0, 0, 9))
    assert np.degrees(np.arctan(float(camera.half_height))) * 2 == pytest.approx(20)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('colormpa = "heat"', "--config look.toml: 'colormpa' is no option of `jaxsph render`; did you mean colormap?"),
        ('[look]\nnrom = "log"', "--config look.toml, [look]: 'nrom' is no option of `jaxsph render`; did you mean norm?"),
        ("annotate = 3", "annotate must be true or false, got 3"),
        ("size = ", "--config look.toml: is no TOML"),
        ('size = "big"', "--size must be pixels"),
    ],
)
def test_a_file_that_cannot_be_is_named_with_its_place(seen, capsys, text, said):
    Path("look.toml").write_text(text)
    code, _, err = run(capsys, "render", "a.npz", "--config", "look.toml")
    assert code == 2 and len(err) == 1 and said in err[0] and not seen
    code, _, err = run(capsys, "render", "a.npz", "--config", "gone.toml")
    assert code == 1 and len(err) == 1 and "gone.toml" in err[0]


def test_what_is_no_file_of_options_is_refused(seen, capsys, monkeypatch):
    """What never ends is not opened, and brackets that nest deeply and bytes without end are wrong usage, too."""
    monkeypatch.setattr("jaxsph.io.damage.MAX_TEXT", 20_000)
    Path("folder.toml").mkdir()
    os.mkfifo("pipe.toml")
    Path("deep.toml").write_text("a = " + "[" * 9000)
    Path("long.toml").write_text("# long\n" * 9000)
    words = {
        "folder.toml": "is a folder",
        "pipe.toml": "a named pipe",
        "deep.toml": "too deeply",
        "long.toml": "more than 20,000 bytes",
    }
    for file, said in words.items():
        code, _, err = run(capsys, "render", "a.npz", "--config", file)
        assert code == 2 and len(err) == 1 and f"--config {file}: " in err[0] and said in err[0] and not seen
    code, _, err = run(capsys, "render", "a.npz", "--config", "/dev/zero")
    assert code == 2 and "which may never end" in err[0]


def test_an_option_of_a_file_may_be_a_list(seen, capsys):
    Path("look.toml").write_text('clip = ["box:-1,-1,-1,1,1,1", "~sphere:0,0,0,0.2"]\nwhere = "heat > -1 and cold < 3"\n')
    assert run(capsys, "render", "a.npz", *TINY, "--config", "look.toml")[0] == 0
    more = ["--clip", "box:-1,-1,-1,1,1,1", "--clip", "~sphere:0,0,0,0.2", "--where", "heat > -1 and cold < 3"]
    assert run(capsys, "render", "a.npz", *TINY, *more)[0] == 0
    (one, camera, settings), (other, again, same) = seen
    assert repr(one) == repr(other) and camera.describe() == again.describe() and settings == same


@pytest.mark.parametrize("suffix", ["png", "exr"])
def test_a_picture_holds_its_command_and_is_made_again_by_it(seen, capsys, suffix):
    assert run(capsys, "render", "a.npz", *TINY, "--eye", 0, 0, 9, "--quantity", "cold", "-o", f"x.{suffix}")[0] == 0
    words = json.loads(dict(io.read_image(f"x.{suffix}").metadata)["jaxsph.command"])
    assert words[0] == "render" and "a.npz" in words and "--eye=0,0,9" in words and "--color-by=cold" in words
    assert run(capsys, *words)[0] == 0
    (_, one, first), (_, other, second) = seen
    assert one.describe() == other.describe() and first == second


@pytest.mark.parametrize(
    ("words", "new"),
    [
        (["f", "--eye", "1", "-2", "3", "--target", "0", "0", "0"], ["f", "--eye=1,-2,3", "--target=0,0,0"]),
        (["--eye", "-1,-2,3", "--target=0,0,0", "f"], ["--eye=-1,-2,3", "--target=0,0,0", "f"]),
        (["--center", "densest", "f"], ["--center=densest", "f"]),
        (["--eye", "1,2,3", "4", "--eye", "0", "0", "f"], ["4", "--eye=0,0", "f"]),
        (["--quantity", "T"], ["--color-by=T"]),
        (["--surface", "f", "-q"], ["--surface=0.5", "f", "--quiet"]),
        (["--surface", "none", "f", "--quiet", "-q"], ["--surface=none", "f", "--quiet"]),
        (["--clip", "box:a", "--clip", "box:b", "-o", "x", "-o=y"], ["--clip=box:a", "--clip=box:b", "--output=y"]),
        (["--fov", "--size", "8x8", "--", "-f"], ["--fov", "--size=8x8", "--", "-f"]),
    ],
    ids=" ".join,
)
def test_places_may_be_several_words_and_each_option_has_one_spelling(words, new):
    assert completed("render", words, cli.declared("render")) == new
