"""Lengths with units, wherever a length is given, are those of the file."""

import h5py
import numpy as np
import pytest
from commanded import refused, run

from jaxsph import io

pytest.importorskip("unyt")
MPC = 3.0856775814913673e24


@pytest.fixture
def file(tmp_path, monkeypatch):
    """Particles in Mpc / h, comoving, at a = 0.5."""
    monkeypatch.chdir(tmp_path)
    rng, none = np.random.default_rng(2), dict.fromkeys(("length_scaling", "mass_scaling", "velocity_scaling"), 0.0)
    with h5py.File("a.hdf5", "w") as made:
        made.create_group("Header").attrs.update({"Redshift": 1.0, "HubbleParam": 0.7, "MassTable": np.zeros(6)})
        group = made.create_group("PartType0")
        group["Coordinates"], group["Masses"] = rng.uniform(-1, 1, (60, 3)), np.ones(60)
        group["Coordinates"].attrs.update(none | {"length_scaling": 1.0, "a_scaling": 1.0, "h_scaling": -1.0, "to_cgs": MPC})
    return "a.hdf5"


SAME = (
    (["--center", "100kpc,0,-0.2Mpc"], ["--center", "0.1,0,-0.2"]), (["--support", "400 kpc"], ["--support", "0.4"]),
    (["--clip", "sphere:0,0,0,500kpc"], ["--clip", "sphere:0,0,0,0.5"]),
    (["--depth-range", "-300kpc,0.2"], ["--depth-range", "-0.3,0.2"]),
    (["--eye", "0,0,3000kpc", "--target", "100kpc,0,0"], ["--eye", "0,0,3", "--target", "0.1,0,0"]),
    (["--clip", "~box:-1e2kpc,-1,-1,1,1,1", "--clip", "plane:0,0,1e5pc,0,0,1"],
     ["--clip", "~box:-0.1,-1,-1,1,1,1", "--clip", "plane:0,0,0.1,0,0,1"]),
)  # fmt: skip


@pytest.mark.parametrize(("words", "plain"), SAME, ids=lambda words: words[0])
def test_lengths_with_units_are_those_of_the_file(words, plain, file, by_reference, capsys):
    for given, name in (words, "a.npy"), (plain, "b.npy"):
        more = [] if given[0] == "--support" else ["--support", "0.3"]
        code, _, err = run(capsys, "project", file, "--size", "8x8", *given, *more, "-o", name)
        assert code == 0, err
    np.testing.assert_allclose(np.load("a.npy"), np.load("b.npy"), rtol=1e-6)


def test_a_plane_of_a_slice_may_have_units(file, by_reference, capsys):
    for place, name in ("0,0,100kpc", "a.npy"), ("0,0,0.1", "b.npy"):
        words = ["--plane", f"{place},0,0,1", "--support", "0.5", "--of", "x", "--size", "8x8", "-o", name]
        assert run(capsys, "slice", file, *words)[0] == 0
    np.testing.assert_allclose(np.load("a.npy"), np.load("b.npy"))


def test_python_reads_the_same_lengths(file):
    how = {"support": "300 kpc", "width": "1 Mpc", "size": (16, 16), "color_by": "x"}
    one = io.read_scene(file, center=("100 kpc", 0, "-0.2 Mpc"), **how)[1]
    other = io.read_scene(file, center=(0.1, 0, -0.2), **how)[1]
    np.testing.assert_allclose(one.exact_eye(), other.exact_eye())
    assert io.read_particles(file, "x", support="300 kpc").support[0] == pytest.approx(0.3)
    with pytest.raises(ValueError, match="'s' does not agree"):
        io.read_scene(file, center="1 s,0,0", **how)


def test_a_width_says_in_which_frame_it_is(file, by_reference, capsys):
    words = ["project", file, "--support", "0.3", "--size", "8x8", "--width", "400kpc", "-o", "a.npy"]
    assert "0.4 (400 kpc a h^-1, comoving, as the file has it: --physical takes a and h out)" in run(capsys, *words)[1]
    assert "0.4 (400 kpc, physical)" in run(capsys, *words, "--physical")[1]


def test_a_file_without_units_refuses_them_by_name(file, capsys):
    np.savez("b.npz", position=np.eye(3), support=np.ones(3))
    for words in (["--center", "1kpc,0,0"], ["--clip", "sphere:0,0,0,1kpc"]):
        assert f"{words[0]} = '{words[1]}' has a unit, but the file does not state" in refused(capsys, "project", "b.npz", *words)
    assert "does not agree" in refused(capsys, "project", file, "--center", "1s,0,0")
