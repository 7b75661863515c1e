"""An output never replaces an input, by whatever name: of every command that writes."""

import os
import shutil

import numpy as np
import pytest
from commanded import run

import jaxsph as js

SIZE = ["--size", "6x6", "--samples", "4"]


@pytest.fixture
def folder(empty, tmp_path):
    """Particles that are called like every kind of output, as what is in a file says its format; and links to them."""
    np.savez("drop.npz", position=np.random.default_rng(5).normal(size=(40, 3)), support=np.full(40, 0.7))
    for name in ("png", "exr", "npy", "fits", "mp4", "pdf", "json"):
        shutil.copy("drop.npz", f"drop.{name}")
    (tmp_path / "drop_frames").mkdir()
    shutil.copy("drop.npz", "drop_frames/00000.png")
    (tmp_path / "table").mkdir()
    (tmp_path / "table" / "sweep.csv").write_text("x,y,z\n0,0,0\n1,1,1\n")
    (tmp_path / "words.png").write_text("no-cache = true\n")
    os.symlink("drop.png", "soft.png")
    os.link("drop.png", "hard.png")
    js.CameraPath.from_keys([(0.0, js.Camera.look_at((0, 0, 4), (0, 0, 0), near=1.0, far=9.0))]).save("keys.json")
    os.symlink("keys.json", "keys.mp4")
    js.TransferFunction.from_points([0.0, 1.0], np.zeros((2, 3)), [0.0, 1.0]).save("look.json")
    return tmp_path


@pytest.mark.parametrize(
    "words",
    [
        ["render", "drop.png", *SIZE],  # where nothing says so, a picture is named after its source
        ["render", "drop.exr", "-o", "drop_frames/../drop.exr", *SIZE], ["render", "drop.png", "-o", "soft.png", *SIZE],
        ["render", "soft.png", "-o", "drop.png", *SIZE], ["render", "drop.png", "-o", "hard.png", *SIZE],
        ["render", "drop.npz", "--points", "drop.png:radius=1", "-o", "drop.png", *SIZE],
        ["render", "drop.npz", "--config", "words.png", "-o", "words.png"],
        ["render", "drop.npz", "soft.png", "-o", "{}.png", *SIZE], ["project", "drop.npy", "-o", "drop.npy", *SIZE[:2]],
        ["project", "drop.exr", *SIZE[:2]], ["slice", "drop.npy", "-o", "drop.npy", *SIZE[:2]],
        ["explain", "drop.pdf", "--pixel", "1,1", "-o", "drop.pdf", *SIZE], ["merge", "drop.exr", "-o", "drop.exr"],
        ["transfer", "drop.png", "-o", "drop.png", *SIZE[:2]],
        ["transfer", "drop.npz", "--transfer", "look.json", "--save", "look.json", *SIZE[:2]],
        ["movie", "drop.mp4", "--orbit", "90", "--frames", "2", *SIZE],
        ["movie", "drop_frames/00000.png", "--orbit", "90", "--frames", "2", "-o", "drop.mp4", *SIZE],
        ["movie", "drop.npz", "--camera", "keys.json", "-o", "keys.mp4", *SIZE],
        ["sweep", "table/sweep.csv", "-o", "table", "--no-figures", *SIZE], ["demo", "--config", "words.png", "-o", "words"],
    ],
)  # fmt: skip
def test_no_command_replaces_what_it_reads(words, folder, capsys):
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    code, _, err = run(capsys, *words)
    assert code in (1, 2) and "is read, and would be lost" in err[-1]
    left = {path: path.read_bytes() for path in before}
    assert left == before


def test_parts_of_a_snapshot_are_inputs_whichever_is_named(folder, capsys):
    for number in range(3):
        shutil.copy("drop.npz", f"snap.{number}.png")
    os.symlink("snap.2.png", "other.png")
    for name in ("snap.0.png", "snap.2.png", "other.png"):
        code, _, err = run(capsys, "render", "snap.1.png", "-o", name, *SIZE)
        assert code == 2 and "is read, and would be lost" in err[-1]
    assert {(folder / f"snap.{number}.png").read_bytes() for number in range(3)} == {(folder / "drop.npz").read_bytes()}


def test_what_no_command_reads_may_be_replaced_as_ever(folder, by_reference, capsys):
    assert run(capsys, "render", "drop.npz", "-o", "drop.png", *SIZE)[0] == 0
    assert (folder / "drop.png").read_bytes() != (folder / "drop.npz").read_bytes()
    assert run(capsys, "render", "drop.npz", "-o", "drop.png", *SIZE)[0] == 0
