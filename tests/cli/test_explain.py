"""A pixel explained on the command line: a table, one JSON object, a figure; and pixels that are none are wrong usage."""

import json

import pytest
from commanded import apart, refused, run

import jaxsph as js

pytestmark = pytest.mark.usefixtures("quick_programs", "here")

TINY = ["--size", "24x16", "--samples", "16"]


def test_a_pixel_of_a_file_is_explained_in_a_table(capsys):
    code, out, prose, wrong = apart(capsys, "explain", "a.npz", "--color-by", "heat", "--pixel", 8, 12, *TINY)
    assert (code, wrong) == (0, []) and out.startswith("pixel 8 12: colour") and "particles" in out
    scene, camera = js.io.read_scene("a.npz", color_by="heat", size=(24, 16))
    assert out.strip() == str(js.explain(scene, camera, js.Settings(samples=16), pixel=(8, 12)))
    assert any(line.startswith("camera") for line in prose)


def test_json_has_the_budget_and_the_ray_in_one_object(capsys):
    code, out, _, wrong = apart(capsys, "explain", "a.npz", "--color-by", "heat", "--pixel=8,12", *TINY, "--json")
    told = json.loads(out)
    assert (code, wrong) == (0, []) and told["command"] == "explain" and told["pixel"] == [8, 12]
    assert (told["total"], told["sources"], told["certified"]) == (0, {}, True)
    assert len(told["depth"]) == len(told["quantity"]) == len(told["extinction"]) == len(told["transmittance"]) == 16
    assert told["transmittance"][-1] == pytest.approx(1 - told["alpha"], abs=1e-6)
    assert len(told["particles"]) == len(told["added"]) > 0 and sum(told["added"]) == pytest.approx(told["alpha"], abs=1e-6)


def test_a_figure_is_written_and_its_path_said(capsys):
    pytest.importorskip("matplotlib")
    code, out, err = run(capsys, "explain", "a.npz", "--color-by", "heat", "--pixel", 8, 12, *TINY, "-o", "pixel.png")
    assert (code, err) == (0, []) and "\npixel.png" in out
    with open("pixel.png", "rb") as file:
        assert file.read(4) == b"\x89PNG"


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--pixel", 16, 0], "--pixel must have a row from 0 to 15 and a column from 0 to 23, got 16 0"),
        (["--pixel", -1, 0], "got -1 0"), (["--pixel", "1.5,2"], "--pixel must be whole numbers R,C"),
        (["--pixel", "1"], "R,C, got '1'"), (["--pixel"], "--pixel"), ([], "--pixel R C"),
        (["--pixel", 1, 2, "-o", "a.exr"], ".png"), (["--pixel", 1, 2, "--tolerance", -1], "--tolerance must be >= 0"),
    ],
    ids=str,
)  # fmt: skip
def test_pixels_that_are_none_are_wrong_usage_in_one_line(capsys, arguments, said):
    assert said in refused(capsys, "explain", "a.npz", *arguments, *TINY)


def test_a_picture_of_a_surface_is_not_explained_as_that_of_a_medium(capsys):
    code, _, err = run(capsys, "explain", "a.npz", "--surface", "0.2", *TINY, "--pixel", 1, 1)
    assert code == 2 and "--surface none explains them" in err[-1]
    with pytest.raises(ValueError, match=r"`surface` is unknown to `explain`"):
        js.explain(*js.io.read_scene("a.npz", surface=0.2, size=(24, 16)), pixel=(8, 12))
