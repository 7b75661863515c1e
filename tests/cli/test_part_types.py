"""Several types of particles in columns, slices and what is said of them: sums of all, or refusals by name."""

import json

import numpy as np
import pytest
from commanded import refused, run

from jaxsph import io
from jaxsph.cli import figures

h5py = pytest.importorskip("h5py")
pytestmark = pytest.mark.usefixtures("by_reference", "files")
VIEW = ["--center", "0.1,0,0", "--width", "3", "--size", "12x8"]
KINDS = "gas", "stars", "bh"


@pytest.fixture
def files(empty):
    """Gas and stars, and a few black holes with another mass of their own, in two snapshots of an otherwise empty directory."""
    for nth in range(2):
        rng = np.random.default_rng(nth)
        with h5py.File(f"s_{nth}.hdf5", "w") as file:
            number = np.array([60, 0, 0, 0, 40, 20])
            file.create_group("Header").attrs.update({"MassTable": np.zeros(6), "Time": float(nth), "NumPart_ThisFile": number})
            for kind, mass in ((0, 1.0), (4, 4.0), (5, 30.0)):
                group, count = file.create_group(f"PartType{kind}"), number[kind]
                group["Coordinates"], group["Velocities"] = rng.normal(size=(2, count, 3))
                group["Masses"], group["SmoothingLength"] = np.full(count, (1 + nth) * mass), np.full(count, 0.7)
                group["ParticleIDs"] = np.arange(count) + 1000 * kind
            file["PartType5/BH_Mass"], file["PartType0/InternalEnergy"] = np.full(20, 1e3), np.ones(60)


def values(capsys, command, kinds, *more):
    code, said, err = run(capsys, command, "s_0.hdf5", "--part-type", kinds, *VIEW, *more, "-o", "o.npy")
    assert (code, err) == (0, []), err
    return np.load("o.npy"), said


@pytest.mark.parametrize("more", [[], ["--clip", "plane:0,0,0,1,0,0"], ["--where", "z > -0.5"], ["--box-size", "8,8,8"]])
@pytest.mark.parametrize(("command", "of"), [("project", "mass"), ("slice", "density")])
def test_columns_and_slices_are_sums_of_all_types(command, of, more, capsys):
    together, said = values(capsys, command, "gas,4,bh", "--of", of, *more)
    each = [np.nan_to_num(values(capsys, command, kind, "--of", of, *more)[0]) for kind in KINDS]
    np.testing.assert_allclose(np.nan_to_num(together), sum(each), rtol=2e-4, atol=1e-5)
    assert "60 of gas, 40 of 4, 20 of bh" in said and all(one.any() for one in each)


@pytest.mark.parametrize("command", ["project", "slice"])
def test_means_of_types_are_by_mass(command, capsys):
    weigh = ["--weight", "mass"] if command == "project" else []
    together, said = values(capsys, command, "gas,stars", "--of", "Velocities.x", *weigh)
    assert "weighted by mass" in said
    parts = []
    for kind in ("gas", "stars"):
        of = "mass" if command == "project" else "density"
        mass = np.nan_to_num(values(capsys, command, kind, "--of", of)[0])
        parts.append((mass, np.nan_to_num(values(capsys, command, kind, "--of", "Velocities.x", "--weight", "mass")[0])))
    total = sum(mass for mass, _ in parts)
    truth = sum(mass * mean for mass, mean in parts)[total > 0] / total[total > 0]
    np.testing.assert_allclose(together[total > 0], truth, rtol=1e-3, atol=1e-4)


def test_what_a_type_lacks_and_looks_of_types_are_refused(capsys):
    for command in ("project", "slice"):
        how = [command, "s_0.hdf5", *VIEW, "-o", "o.npy", "--part-type"]
        code, _, err = run(capsys, *how, "gas,stars", "--of", "InternalEnergy")
        assert code == 1 and "no quantity 'InternalEnergy'" in err[0] and "left out InternalEnergy: of gas" in err[0]
        assert "--part-type gas:inferno,stars has looks of types" in refused(capsys, *how, "gas:inferno,stars")
        code, _, err = run(capsys, *how, "bulge")
        assert code == 1 and "no particles of type" in err[0]
    code, _, err = run(capsys, "movie", "s_0.hdf5", "s_1.hdf5", "--part-type", "gas,stars", "--size", "8x8")
    assert code == 2 and "--part-type must be one type of particles for a sequence, got 'gas,stars'" in err[0]


def test_a_look_of_one_type_colours_its_columns(capsys):
    pictures = []
    for kind in ("gas", "gas:inferno"):
        assert run(capsys, "project", "s_0.hdf5", "--part-type", kind, *VIEW, "-o", "o.png")[0] == 0
        pictures.append(np.asarray(io.read_image("o.png").color))
    assert not np.array_equal(*pictures)


def test_contours_over_a_render_are_those_of_all_types(capsys, monkeypatch):
    pytest.importorskip("matplotlib")
    found, draw = [], figures.image_figure
    monkeypatch.setattr(figures, "image_figure", lambda *given, **more: found.append(more["contours"][0]) or draw(*given, **more))
    more = ["--part-type", "gas,stars", *VIEW, "--view", "z", "--contours", "mass", "--clip", "none", "-o", "o.png"]
    for command in (["project"], ["render", "--samples", "24"]):
        code, _, err = run(capsys, command[0], "s_0.hdf5", *command[1:], *more)
        assert code == 0, err
    np.testing.assert_allclose(*found, rtol=1e-3, atol=1e-5)


def test_a_difference_of_types_is_of_all(capsys):
    code, _, err = run(
        capsys, "project", "s_0.hdf5", "s_1.hdf5", "--part-type", "gas,stars", *VIEW, "--difference", "-o", "d.npy"
    )
    assert code == 0, err
    each = []
    for nth in range(2):
        assert run(capsys, "project", f"s_{nth}.hdf5", "--part-type", "gas,stars", *VIEW, "-o", "o.npy")[0] == 0
        each.append(np.load("o.npy"))
    np.testing.assert_allclose(np.load("d.npy"), each[1] - each[0], rtol=1e-4, atol=1e-5)


def test_info_says_what_each_type_holds(capsys):
    code, out, _ = run(capsys, "info", "s_0.hdf5", "--part-type", "gas,bh", "--json")
    told = json.JSONDecoder().raw_decode(out)[0]
    assert code == 0 and {kind: one["particles"] for kind, one in told["types"].items()} == {"gas": 60, "bh": 20}
    assert "BH_Mass" in told["types"]["bh"]["attributes"]
