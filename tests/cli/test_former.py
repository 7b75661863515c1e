"""Former spellings of options keep working; those that are not of the contract are told of, once, with the new word."""

import numpy as np
import pytest
from commanded import run

from jaxsph import io
from jaxsph.cli import main as cli
from jaxsph.cli.options.former import rewritten

pytestmark = pytest.mark.usefixtures("quick_programs")

TINY = ["--size", "24x16", "--samples", "16"]


def now(command, *words):
    """The command and the words as they are written now, and what is told."""
    made = rewritten(command, [str(word) for word in words], lambda of, name: name in cli.declared(of).names)
    return made.command, made.words, made.told


@pytest.mark.parametrize(
    ("words", "new"),
    [
        (["f", "--eye", 1, -2, 3, "--target", 0, 0, 0], ["f", "--eye=1,-2,3", "--target=0,0,0"]),
        (["--center", 1, 2, 3, "f"], ["--center=1,2,3", "f"]),
        (["--center", "densest", "f"], ["--center", "densest", "f"]),
        (["--up", 0, 0, 1, "--eye=1,2,3"], ["--up=0,0,1", "--eye=1,2,3"]),
        (["--quantity", "T", "--color-by", "T"], ["--color-by", "T", "--color-by", "T"]),
        (["--debug"], ["--verbose"]),
        (["--tolerance", "0.1", "-o", "x.png"], ["--tolerance", "0.1", "-o", "x.png"]),
    ],
    ids=str,
)
def test_names_of_the_contract_stay_and_nothing_is_told(words, new):
    assert now("render", *words) == ("render", new, [])


@pytest.mark.parametrize(
    ("words", "new", "told"),
    [
        (["--domain", "log"], ["--norm", "log"], "--domain is now --norm"),
        (["--opacity", 3], ["--optical-depth", "3"], "--opacity is now --optical-depth"),
        (["--box", 1, 2, 3], ["--box-size=1,2,3"], "--box is now --box-size 1,2,3"),
        (["--not-periodic"], ["--box-size=none"], "--not-periodic is now --box-size none"),
        (["--range", -1, 2], ["--range=-1,2"], "--range -1 2 is now --range -1,2"),
        (["--clip-plane", *range(6)], ["--clip=plane:0,1,2,3,4,5"], "--clip-plane is now --clip plane:0,1,2,3,4,5"),
        (["--clip-box", *range(6)], ["--clip=box:0,1,2,3,4,5"], "--clip-box is now --clip box:0,1,2,3,4,5"),
        (["--cut-box", *range(6)], ["--clip=~box:0,1,2,3,4,5"], "--cut-box is now --clip ~box:0,1,2,3,4,5"),
        (["--clip-sphere", *range(4)], ["--clip=sphere:0,1,2,3"], "--clip-sphere is now --clip sphere:0,1,2,3"),
        (["--cut-sphere", *range(4)], ["--clip=~sphere:0,1,2,3"], "--cut-sphere is now --clip ~sphere:0,1,2,3"),
        (["scene:x", "--particles", 9], ["scene:x:particles=9"], "--particles 9 is now scene:NAME:particles=9"),
        (["--points", "s", "--point-radius", 2], ["--points", "s:radius=2"], "--point-radius 2 is now --points FILE:radius=2"),
        (["--volume=v", "--volume-colormap", "ice"], ["--volume=v:colormap=ice"],
         "--volume-colormap ice is now --volume FILE:colormap=ice"),
    ],
    ids=lambda value: str(value[0]) if isinstance(value, list) else None,
)  # fmt: skip
def test_other_former_spellings_are_rewritten_and_told_of(words, new, told):
    assert now("render", *words) == ("render", new, [told])


def test_several_options_go_behind_one_file():
    words = ["--point-type", 4, "--points", "a:color=1,0,0", "--points", "b", "--point-radius", 1]
    _, new, told = now("render", *words)
    assert new == ["--points", "a:color=1,0,0,type=4,radius=1", "--points", "b:type=4,radius=1"] and len(told) == 2
    assert now("render", "scene:x", "--particles", 9, "--frame", 1)[1] == ["scene:x:particles=9,frame=1"]


def test_slices_and_lists_of_sweeps_are_rewritten():
    assert now("render", "f", "--slice", *range(6))[:2] == ("slice", ["f", "--plane=0,1,2,3,4,5"])
    words = ["f", "--tolerances", 0.1, 0.2, "--estimators", "--frames", 0, 2, "-o", "d"]
    assert now("sweep", *words)[1] == ["f", "--tolerances=0.1,0.2", "--estimators=", "--moments=0,2", "-o", "d"]
    assert now("movie", "f", "--frames", 5)[1:] == (["f", "--frames", "5"], [])
    assert now("project", "f", "--axis", "x", "--depth-range", 1, 2)[1] == ["f", "--view", "x", "--depth-range=1,2"]


def test_a_former_command_makes_the_same_picture_and_is_told_of_on_stderr(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    position = np.random.default_rng(0).normal(size=(60, 3)).astype(np.float32)
    np.savez("a.npz", position=position, heat=position[:, 0], support=np.full(60, 0.8, np.float32))
    code, _, err = run(capsys, "render", "a.npz", "--quantity", "heat", "--range", 0, 1, "--eye", 0, 0, 9, *TINY, "-o", "a.png")
    assert (code, err) == (0, ["jaxsph render: --range 0 1 is now --range 0,1"])
    code, _, err = run(capsys, "render", "a.npz", "--color-by", "heat", "--range", "0,1", "--eye=0,0,9", *TINY, "-o", "b.png")
    assert (code, err) == (0, [])
    a, b = (np.asarray(io.read_image(name).color) for name in ("a.png", "b.png"))
    assert np.array_equal(a, b) and a.max() > 0.1
    code, _, err = run(capsys, "render", "gone.npz", "--range", 0, 1)
    assert code == 1 and len(err) == 1 and "gone.npz" in err[0], "one line says why"
    code, out, err = run(capsys, "render", "a.npz", "--slice", 0, 0, 0, 0, 0, 1, *TINY[:2], "-o", "s.png")
    assert (code, err) == (0, ["jaxsph slice: `render --slice` is now `jaxsph slice --plane`"]) and "s.png" in out
