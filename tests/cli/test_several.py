"""Several files at once on the command line."""

from pathlib import Path

import pytest

from jaxsph.cli.commands.render import Render, outputs_of, render_each
from jaxsph.cli.scene import stem_of
from jaxsph.cli.voice import UsageError


def options(*sources, output=None):
    return Render(source=list(sources), output=output)


def test_pictures_are_named_after_their_files():
    assert outputs_of(["a/x.vtk", "scene:mixer"], None) == [Path("x.png"), Path("mixer.png")]
    assert outputs_of(["x.vtk", "y.vtk"], Path("out")) == [Path("out/x.png"), Path("out/y.png")]
    assert outputs_of(["x.vtk", "y.vtk"], Path("out/{}_1.exr")) == [Path("out/x_1.exr"), Path("out/y_1.exr")]


def test_numbers_behind_a_point_are_kept_in_names():
    assert outputs_of(["run/snap.00001", "run/snap.00002"], None) == [Path("snap.00001.png"), Path("snap.00002.png")]
    assert stem_of("snap.00001") == "snap.00001" and stem_of("scene:mixer") == "mixer" and stem_of("a/x.0.hdf5") == "x.0"


def test_equal_names_in_two_folders_have_the_folders_before_them():
    assert outputs_of(["a/s.npz", "b/s.npz"], Path("out/{}.exr")) == [Path("out/a_s.exr"), Path("out/b_s.exr")]


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


def test_a_file_that_fails_keeps_no_other_from_being_done(tmp_path):
    done = []

    def render(one):
        if one.source == "bad.vtk":
            raise ValueError("cut short")
        done.append(one.output)

    with pytest.raises(RuntimeError, match=r"1 of 3 failed: bad\.vtk: cut short"):
        render_each(options("a.vtk", "bad.vtk", "c.vtk", output=tmp_path / "out"), render)
    assert done == [tmp_path / "out" / "a.png", tmp_path / "out" / "c.png"]
