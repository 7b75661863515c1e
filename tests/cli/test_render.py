"""`render` of several files, by several devices, and by parts that `merge` puts together; and nothing else is taken for those."""

from pathlib import Path

import jax
import numpy as np
import pytest
from commanded import refused, run

import jaxsph as js
from jaxsph.cli import main as cli
from jaxsph.cli.commands.render import Render, outputs_of, render_each
from jaxsph.cli.console import stem_of
from jaxsph.cli.voice import UsageError
from jaxsph.io.opening import values

pytestmark = pytest.mark.usefixtures("empty")
TOO_MANY = str(len(jax.local_devices()) + 1)
SCENE = ["scene:radial:particles=300", "--size", "24x40", "--samples", "16"]


@pytest.mark.parametrize(("text", "index"), [("2/2", 0), ("0/2", 0), ("1/2", 1)])
def test_a_part_is_called_as_it_was_asked_for(text, index):
    part = values.tile(text)
    assert (part, str(part)) == ((index, 2), text)


@pytest.mark.parametrize(("level", "said"), [(0.0, "nearly black"), (0.5, "")])
def test_a_picture_of_parts_that_shows_almost_nothing_says_so(tmp_path, capsys, monkeypatch, level, said):
    layer = np.zeros((8, 8), np.float32)
    made = js.Image(layer[..., None] + np.full(3, level, np.float32), layer, layer, layer, layer, True, 0, {})
    made.save("part.exr")
    monkeypatch.setattr("jaxsph.scale.parts.merge_tiles", lambda parts, names: made)
    code, _, err = run(capsys, "merge", "part.exr", "-o", "whole.png")
    assert code == 0 and len(err) == bool(said) and said in "".join(err)


@pytest.mark.slow
def test_parts_make_the_same_files_as_one_command(tmp_path, capsys):
    assert run(capsys, "render", *SCENE, "-o", "whole.exr")[0] == 0
    assert run(capsys, "render", *SCENE, "--tile", "1/2", "-o", "b.exr")[0] == 0
    code, out, err = run(capsys, "render", *SCENE, "--tile", "2/2")
    assert (code, err) == (0, []) and "radial_0_of_2.exr" in out and "2/2, rows 0 to" in out and "of 40" in out
    code, out, err = run(capsys, "merge", "b.exr", "radial_0_of_2.exr", "-o", "merged.exr")
    assert (code, err) == (0, []) and "merged.exr, 24 x 40, of 2 parts" in out
    whole, merged = (js.io.read_image(name) for name in ("whole.exr", "merged.exr"))
    for name in ("color", "transmittance", "depth", "error_bound", "evaluations"):
        np.testing.assert_array_equal(getattr(merged, name), getattr(whole, name), name)
    told, own = (dict(image.metadata) for image in (merged, whole))
    assert told.pop("jaxsph.command") != own.pop("jaxsph.command") and told == own and float(merged.color.max()) > 0.1
    assert run(capsys, "merge", "b.exr", "radial_0_of_2.exr", "-o", "merged.png")[0] == 0
    np.testing.assert_allclose(js.io.read_image("merged.png").color, np.asarray(whole.color).clip(0, 1), atol=0.502 / 255)

    for given, said in (
        (["b.exr"], "1 of 2 parts of the picture are missing: --tile 0/2"),
        (["b.exr", "b.exr"], "b.exr and b.exr are both part 1"),
        (["b.exr", "whole.exr"], "whole.exr is not a part"),
        (["b.exr", "gone.exr"], "gone.exr: there is no such file"),
    ):
        code, _, err = run(capsys, "merge", *given, "-o", "no.exr")
        assert code == 1 and len(err) == 1 and said in err[0]
    assert not (tmp_path / "no.exr").exists()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["render", *SCENE, "--tile", "3/2"], "I must lie in [0, N]"),
        (["render", *SCENE, "--tile", "half"], "as 1/4 for the second of four"),
        (["render", *SCENE, "--tile", "0/0"], "N be at least 1"),
        (["render", *SCENE, "--tile", "0/2", "-o", "part.png"], "a part must be .exr"),
        (["render", *SCENE, "--tile", "0/2", "--progressive"], "--progressive and --tile exclude"),
        (["render", *SCENE, "--tile", "0/2", "--screen", "quadtree", "--tolerance", "0.1"], "quadtree"),
        (["render", *SCENE, "--bracket", "-o", "a.png"], "only .exr holds"),
        (["render", *SCENE, "--bracket", "--tile", "0/2", "-o", "a.exr"], "--tile and --bracket exclude"),
        (["merge", "a.exr"], "-o"),
        (["merge", "a.png", "-o", "b.png"], "a.png: parts are .exr"),
        (["merge", "a.exr", "-o", "b.jpg"], "must be .exr or .png"),
    ],
)
def test_wrong_usage_is_told_in_one_line(capsys, arguments, said):
    assert said in refused(capsys, *arguments)


def test_a_picture_lies_in_the_bracket_of_its_file(tmp_path, capsys):
    code, out, err = run(capsys, "render", *SCENE, "--bracket", "-o", "a.exr")
    assert (code, err) == (0, []) and "lie between layers lower.* and upper.*" in out
    image = js.io.read_image("a.exr")
    pixels = np.concatenate([image.color, image.alpha[..., None]], -1)
    assert (image.lower <= pixels).all() and (pixels <= image.upper).all()


def test_more_parts_than_rows_of_tiles_are_refused(capsys):
    code, _, err = run(capsys, "render", *SCENE, "--tile", "0/4")
    assert code == 1 and "`count` must lie in [1, 3]" in err[0]


@pytest.mark.parametrize(("first", "count"), [(0, 3), (1, 3)])
def test_jobs_that_count_from_0_or_from_1_render_all_parts(first, count):
    assert {values.tile(f"{number}/{count}") for number in range(first, first + count)} == {(0, 3), (1, 3), (2, 3)}


def options(*sources, output=None):
    return Render(source=list(sources), output=output)


def test_pictures_are_named_after_their_files():
    assert outputs_of(["a/x.vtk", "scene:mixer"], None) == [Path("x.png"), Path("mixer.png")]
    assert outputs_of(["x.vtk", "y.vtk"], Path("out")) == [Path("out/x.png"), Path("out/y.png")]
    assert outputs_of(["x.vtk", "y.vtk"], Path("out/{}_1.exr")) == [Path("out/x_1.exr"), Path("out/y_1.exr")]
    numbered = outputs_of(["run/snap.00001", "run/snap.00002"], None)  # a number behind a point is kept
    assert numbered == [Path("snap.00001.png"), Path("snap.00002.png")] and stem_of("a/x.0.hdf5") == "x.0"
    of_folders = outputs_of(["a/s.npz", "b/s.npz"], Path("out/{}.exr"))  # equal names have the folders before them
    assert of_folders == [Path("out/a_s.exr"), Path("out/b_s.exr")]


@pytest.mark.parametrize(
    ("sources", "output", "message"),
    [(["a/x.vtk", "a/x.npz"], None, "called a_x"), (["x.vtk", "y.vtk"], Path("one.png"), r"one picture.*name with \{\}")],
)
def test_names_that_clash_are_refused(sources, output, message):
    with pytest.raises(UsageError, match=message):
        outputs_of(sources, output)


@pytest.mark.parametrize("sources", [[], ["x.vtk"]])
def test_one_file_or_none_is_rendered_as_ever(sources):
    seen = []
    render_each(options(*sources, output=Path("y.png")), seen.append)
    assert [(one.source, one.output) for one in seen] == [(sources[0] if sources else None, Path("y.png"))]


def test_a_name_with_a_place_for_that_of_the_file_is_one_of_one_file_too():
    seen = []
    render_each(options("a/x.vtk", output=Path("{}_1.png")), seen.append)
    assert [one.output for one in seen] == [Path("x_1.png")]


def test_a_file_that_fails_keeps_no_other_from_being_done(tmp_path):
    done = []

    def render(one):
        if one.source == "bad.vtk":
            raise ValueError("cut short")
        done.append(one.output)

    with pytest.raises(RuntimeError, match=r"1 of 3 failed: bad\.vtk: cut short"):
        render_each(options("a.vtk", "bad.vtk", "c.vtk", output=tmp_path / "out"), render)
    assert done == [tmp_path / "out" / "a.png", tmp_path / "out" / "c.png"]


@pytest.mark.parametrize(
    ("given", "why"),
    [
        ((TOO_MANY,), f"got {TOO_MANY}"), (("0",), "got 0"), (("some",), "must be all or a number of devices"),
        (("all", "--progressive"), "leave one of them out"),
    ],
)  # fmt: skip
def test_what_cannot_be_had_is_wrong_usage(tmp_path, capsys, given, why):
    output = tmp_path / "out.png"
    assert cli.main(["render", "scene:mixer", "-o", str(output), "--devices", *given]) == 2
    said = capsys.readouterr().err
    assert why in said and said.count("\n") == 1
    assert not output.exists()


@pytest.mark.slow
def test_a_picture_is_made_by_all_devices(tmp_path):
    output = tmp_path / "out.png"
    small = ["--size", "24x24", "--samples", "16"]
    assert cli.main(["render", "scene:mixer:particles=300", *small, "-o", str(output), "--devices", "all"]) == 0
    assert output.stat().st_size > 0
