"""The command `project`: what it projects, that it is what the library has, and how it refuses."""

import dataclasses

import commanded
import numpy as np
import pytest

import jaxsph as js
from jaxsph import io
from jaxsph.cli import figures
from jaxsph.io.settle import supports

pytestmark = pytest.mark.usefixtures("quick_programs")
TINY = ["--size", "18x12"]
UPWARD = (0.0, 1.0, 0.0)
COUNT = 60


def columns():
    rng = np.random.default_rng(0)
    position = rng.uniform(0, 1, (COUNT, 3))
    return {"position": position, "mass": rng.uniform(1, 2, COUNT), "temperature": position[:, 0], "density": 1 + position[:, 1]}


@pytest.fixture
def file(empty, tmp_path):
    """A small particle file in an otherwise empty working directory."""
    np.savez(tmp_path / "gas.npz", support=np.full(COUNT, 0.3), **columns())
    np.savez(tmp_path / "bare.npz", position=columns()["position"], support=np.full(COUNT, 0.3))
    return "gas.npz"


def run(capsys, *arguments):
    return commanded.run(capsys, "project", *arguments)


def values(capsys, *arguments):
    """What is in the file that the command writes."""
    code, out, err = run(capsys, *TINY, *arguments, "-o", "out.npy")
    assert (code, err) == (0, []), err
    return np.load("out.npy"), out


def gas():
    given = columns()
    volume = given["mass"] / given["density"]
    position = given["position"].astype(np.float32)
    particles = js.Particles.from_arrays(position, np.float32(0.3), position[:, 0], volume.astype(np.float32), "poly6")
    return particles, given, volume


def test_arrows_are_means_of_a_vector_along_rays_by_mass(file, by_reference, capsys, monkeypatch):
    pytest.importorskip("matplotlib")
    velocity = np.stack([np.ones(COUNT), np.full(COUNT, 2.0), np.full(COUNT, 9.0)], 1)
    np.savez("moving.npz", support=np.full(COUNT, 0.3), velocity=velocity, **columns())
    drawn = []
    monkeypatch.setattr(figures, "draw_arrows", lambda axes, *arrows: drawn.append(arrows))
    picture = [*TINY, "-o", "out.png", "--annotate"]
    code, _, err = run(capsys, "moving.npz", *picture, "--arrows", "v")
    assert (code, err) == (0, [])
    right, up, name, _ = drawn[0]
    assert right.shape == (1, 13, 20) and name == "velocity"
    np.testing.assert_allclose(right[np.isfinite(right)], 1, rtol=1e-4)
    np.testing.assert_allclose(up[np.isfinite(up)], 2, rtol=1e-4)
    assert run(capsys, "moving.npz", *picture, "--arrows", "v", "--box-size", "1,1,1", "--center", "0,0,0", "--width", 1)[0] == 0
    assert np.isfinite(drawn[1][0]).all()  # of a period that is moved, too
    code, _, err = run(capsys, "moving.npz", *picture, "--arrows", "mass")
    assert code == 2 and "there is no such vector; there are velocity" in err[-1]
    code, _, err = run(capsys, "moving.npz", *TINY, "-o", "out.png", "--arrows", "velocity")
    assert code == 2 and "--arrows are drawn with a key: add --annotate" in err[-1]


@pytest.mark.parametrize("box", [(), ("--box-size", "400,400,400")])
@pytest.mark.parametrize("command", ["project", "slice"])
def test_strays_and_empty_boxes_do_not_rule_the_frame(empty, capsys, command, box):
    rng = np.random.default_rng(3)
    position = rng.normal(0, 1, (400, 3))
    position[0] = 150, -90, 0  # one in four hundred
    position = position % 400 if box else position  # the blob lies across a corner of its box
    np.savez("gas.npz", position=position, support=np.full(400, 1.0), mass=np.ones(400), temperature=rng.uniform(1, 2, 400))
    words = ["gas.npz", *box, "--color-by", "temperature"] if command == "slice" else ["gas.npz", *box]
    code, _, err = commanded.run(capsys, command, *words, "--size", "16x16", "-o", "out.npy", "--quiet")
    assert (code, err) == (0, [])
    drawn = np.load("out.npy")
    assert (np.isfinite(drawn) & (drawn > 0)).mean() > 0.3
    code, out, err = commanded.run(capsys, command, *words, "--size", "16x16", "-o", "out.npy")
    assert "1 of 400 particles lie outside of the picture; --width all" in out + " ".join(err)


def test_nothing_is_said_to_lie_outside_of_a_frame_where_nothing_does(empty, capsys):
    position = np.random.default_rng(3).normal(200, 1, (400, 3)).clip(198, 202)
    np.savez("gas.npz", position=position, support=np.full(400, 1.0), mass=np.ones(400))
    code, out, err = commanded.run(capsys, "project", "gas.npz", "--box-size", "400,400,400", "--size", "16x16", "-o", "out.npy")
    assert code == 0 and "lie outside" not in out + " ".join(err) and "--width 400" not in out


def test_without_options_it_is_the_column_density_along_z_as_raw_values_here(file, capsys):
    code, out, err = run(capsys, file, *TINY)
    assert (code, err) == (0, [])
    for said in ("60 particles", "0.3", "column density: mass a unit of area", "--view z", "gas.exr", "total"):
        assert said in out
    found = io.read_projection("gas.exr")
    particles, given, _ = gas()
    truth = js.reference.project(particles, js.Camera.along_axis(particles, "z", 18, 12), given["mass"]).values
    np.testing.assert_allclose(found.values, truth, atol=1e-3 * truth.max())
    assert found.name == "column.mass" and abs(float(found.total()) / given["mass"].sum() - 1) < 1e-4


def test_amounts_means_emission_and_slabs_are_those_asked_for(file, by_reference, capsys):
    particles, given, volume = gas()
    camera = js.Camera.along_axis(particles, "x", 18, 12, up=UPWARD)
    ray = {"pixel": "ray"}
    for arguments, of, weight, more in (
        (["--of", "number"], np.ones(COUNT), None, {}),
        (["--of", "Masses"], given["mass"], None, {}),
        (["--of", "temperature"], given["temperature"] * volume, None, {}),
        (["--of", "temperature", "--weight", "Mass"], given["temperature"], given["mass"], {}),
        (["--of", "temperature*density**2", "--along", "mean"], given["temperature"] * given["density"] ** 2, given["mass"], {}),
        (["--emission", 2], given["density"] * given["mass"], None, {}),
        (["--emission", 1.5, "--of", "temperature"], given["temperature"] * given["density"] ** 0.5 * given["mass"], None, {}),
        (["--depth-range", "0.4,0.6"], given["mass"], None, {"depth_range": (0.4, 0.6)}),
    ):
        found, _ = values(capsys, file, "--view", "x", "--pixel", "ray", *arguments)
        view = js.Camera.along_axis(particles, "x", 18, 12, up=UPWARD, **more) if more else camera
        truth = js.reference.project(particles, view, of, weight, **ray).values
        there = np.isfinite(truth) & np.isfinite(found)
        assert (np.isfinite(truth) != np.isfinite(found)).mean() < 0.03  # within rounding of a support's edge
        np.testing.assert_allclose(found[there], truth[there], atol=1e-3 * truth[there].max(), err_msg=str(arguments))


def test_the_largest_and_the_line_of_sight_are_those_of_the_camera(file, capsys):
    velocity = np.random.default_rng(1).normal(size=(COUNT, 3))
    np.savez("moving.npz", support=np.full(COUNT, 0.3), velocity=velocity, **columns())
    eye = np.array([3.0, 0.4, 0.6])
    away = columns()["position"] - eye
    turned = away - np.round(columns()["position"])
    for view, expected in (
        (["--view", "x"], -velocity[:, 0]),
        (["--eye", "3,0.4,0.6"], (velocity * away).sum(1) / np.linalg.norm(away, axis=1)),
        (
            ["--eye", "3,0.4,0.6", "--box-size", "1,1,1", "--center", "0,0,0"],
            (velocity * turned).sum(1) / np.linalg.norm(turned, axis=1),
        ),
    ):
        found, out = values(capsys, "moving.npz", "--of", "velocity.los", "--along", "max", *view)
        shown = set(found[np.isfinite(found)].tolist())
        assert "the largest velocity.los" in out and len(shown) > 3 and np.abs(expected[:, None] - [*shown]).min(0).max() < 1e-6
        assert abs(max(shown) - expected.max()) < 1e-6
        found, out = values(capsys, "moving.npz", "--of", "number", "--where", "velocity.los > 0", *view)
        assert f"{(expected > 0).sum():,} of {COUNT:,} particles" in out
    assert "leave it out" in commanded.refused(capsys, "project", "moving.npz", "--along", "max", "--weight", "mass")
    assert "'pressure'" in commanded.refused(capsys, "project", "moving.npz", "--of", "2*pressure")


@pytest.mark.slow
def test_chosen_particles_keep_the_densities_and_volumes_that_all_have_made(file, capsys):
    whole, some = (values(capsys, "bare.npz", "--of", "density", *more)[0] for more in ([], ["--where", "x < 0.5"]))
    others, out = values(capsys, "bare.npz", "--of", "density", "--where", "x >= 0.5")
    assert "left out by x >= 0.5" in out
    frames = [js.Camera.along_axis(io.read_particles("bare.npz", "x", where=one), "z", 18, 12) for one in ("x < 0.5", "x >= 0.5")]
    sums = [image.sum() * 4 * float(frame.half_height) ** 2 for image, frame in zip((some, others), frames, strict=True)]
    frame = js.Camera.along_axis(io.read_particles("bare.npz", "x"), "z", 18, 12)
    np.testing.assert_allclose(sum(sums), whole.sum() * 4 * float(frame.half_height) ** 2, rtol=1e-3)
    image, out = values(capsys, "bare.npz", "--box-size", "1,1,1", "--size", "12x12")
    assert "periodic box of 1 x 1 x 1" in out and abs(image.mean() / COUNT - 1) < 1e-4  # all in a unit of area


def test_a_picture_has_colours_and_a_bar_where_asked_and_a_file_without_masses_is_counted(file, by_reference, capsys):
    pytest.importorskip("matplotlib")
    code, out, err = run(capsys, "bare.npz", *TINY, "-o", "out.png", "--colormap", "heat", "--norm", "log", "--range", "1,100")
    assert (code, err) == (0, []) and "particles a unit of area" in out
    assert np.asarray(io.read_image("out.png").color).max() > 0.3
    code, _, err = run(capsys, file, *TINY, "-o", "out.png", "--annotate")
    assert (code, err) == (0, []) and np.asarray(io.read_image("out.png").color).shape[0] > 100


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--annotate"], "--annotate is for a picture"),
        (["-o", "a.jpg"], "a projection must be .exr or .npy or .fits or .png"),
        (["--view", "w"], "--view must be one of iso, x, y, z, face-on, edge-on, or X,Y,Z, got 'w'"),
        (["--view", "x", "--eye", 0, 0, 9], "--eye and --view exclude each other"),
        (["--emission", 2, "--weight", "mass"], "--emission and --weight exclude each other: an emission is an integral"),
        (["--depth-range", "2,1"], "--depth-range must be two numbers A,B that ascend"),
        (["--depth-range", "nan,1"], "--depth-range"),
        (["--eye", 0, 0, 9, "--depth-range", "-1,1"], "must be > 0"),
        (["--norm", "log"], "is for a picture"),
        (["--where", "entropy > 1"], "no quantity 'entropy'"),
    ],
)
def test_wrong_usage_is_told_in_one_line(file, capsys, arguments, said):
    assert said in commanded.refused(capsys, "project", file, *arguments)


def test_what_is_not_in_the_file_is_told_in_one_line(file, capsys):
    for arguments, said in ((["none.npz"], "none.npz"), ([file, "--of", "entropy"], "no quantity 'entropy'; there are mass")):
        code, _, err = run(capsys, *arguments, *TINY)
        assert code == 1 and len(err) == 1 and said in err[0], err
    code, _, err = run(capsys, "bare.npz", "--of", "mass", *TINY)
    assert code == 2 and "has no masses" in err[0]


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("support", 0.0, "--support must be finite and positive"), ("support", np.nan, "support"),
        ("mass", np.nan, "mass"), ("mass", np.inf, "mass"),
    ],
)  # fmt: skip
def test_a_row_that_cannot_be_projected_is_told_in_one_line(file, capsys, name, value, said):
    given = {"support": np.full(COUNT, 0.3)} | columns()
    given[name][7] = value
    np.savez("bad.npz", **given)
    code, _, err = run(capsys, "bad.npz", *TINY, "-o", "out.npy")
    assert code == 1 and len(err) == 1 and said in err[0] and "7" in err[0], err


def test_volumes_are_those_of_the_particles_where_the_density_is_a_placeholder(file, capsys):
    position = np.random.default_rng(0).uniform(-1, 1, (3000, 3))
    position = position[np.linalg.norm(position, axis=1) < 1]
    same = {"mass": np.full(len(position), 1 / len(position)), "rho": np.ones(len(position))}
    np.savez("ball.npz", position=position, **same)
    for more in ([], ["--share", "0.999"]):
        code, out, err = run(capsys, "ball.npz", *TINY, "--of", "volume", "-o", "out.npy", *more)
        assert (code, err) == (0, []) and "stored density `rho` is not used" in out
        total = float(out.partition("in the image, of ")[2].split()[0].rstrip(","))
        assert total == pytest.approx(4 * np.pi / 3, rel=0.15)


@pytest.mark.parametrize("of", [[], ["--of", "number"], ["--of", "mass", "--where", "x > 0.3"], ["--emission", "1"]])
def test_a_share_has_the_mass_of_all(empty, capsys, of):
    position = np.random.default_rng(0).uniform(0, 1, (400, 3))
    np.savez("many.npz", position=position, mass=np.full(400, 2.0))
    totals = []
    for share in ([], ["--share", "0.2"]):
        code, out, err = run(capsys, "many.npz", *TINY, "-o", "out.npy", *of, *share)
        assert (code, err) == (0, [])
        totals.append(float(out.partition("in the image, of ")[2].split()[0]))
    assert totals[1] == pytest.approx(totals[0], rel=1e-6)


@pytest.mark.parametrize(
    ("options", "asked"),
    [
        ([], 0),
        (["--of", "Mass"], 0),
        (["--of", "number"], 0),
        (["--along", "sum"], 0),
        (["--where", "x > 0.3"], 0),
        (["--of", "x"], 1),
    ],
)
def test_columns_of_masses_need_no_volumes(empty, capsys, monkeypatch, options, asked):
    sums = []
    monkeypatch.setattr(supports, "kernel_sum", lambda place, *given, **more: sums.append(1) or np.ones(len(place)))
    np.savez("many.npz", position=np.random.default_rng(0).uniform(0, 1, (400, 3)) ** 2, mass=np.linspace(1, 2, 400))
    code, out, err = run(capsys, "many.npz", *TINY, "-o", "out.npy", *options)
    assert (code, err) == (0, []) and bool(sums) == asked and ("\nvolume " in out) == asked


def test_volumes_are_those_of_the_particles_where_masses_differ_and_no_density_is_there(file, by_reference, capsys):
    given = {name: column for name, column in columns().items() if name != "density"}
    np.savez("weighed.npz", support=np.full(COUNT, 0.3), **given)
    found, _ = values(capsys, "weighed.npz", "--of", "volume")
    particles = io.read_particles("weighed.npz", "x")
    own = js.project(particles, js.Camera.along_axis(particles, "z", 18, 12), of="volume")
    np.testing.assert_allclose(found, own.values, rtol=1e-5, atol=1e-6 * found.max())


def test_names_that_are_computed_are_said_with_their_formula(empty, capsys):
    h5py = pytest.importorskip("h5py")
    with h5py.File("gas.hdf5", "w") as file:
        bases = {"UnitLength_in_cm": 3.086e21, "UnitMass_in_g": 2e43, "UnitVelocity_in_cm_per_s": 1e5}
        file.create_group("Header").attrs.update({"MassTable": np.zeros(6), "Time": 0.0, **bases})
        named = {"Coordinates": columns()["position"], "Masses": np.ones(COUNT), "SmoothingLength": np.full(COUNT, 0.4)}
        for name, column in {**named, "InternalEnergy": np.full(COUNT, 500.0), "Density": np.full(COUNT, 30.0)}.items():
            file[f"PartType0/{name}"] = column
    hot = 2 / 3 * 500e10 * 4 / 6.8 * 1.67262192e-24 / 1.380649e-16
    found, out = values(capsys, "gas.hdf5", "--of", "temperature", "--weight", "mass", "--where", "temperature > 1e4")
    assert np.nanmedian(found) == pytest.approx(hot, rel=1e-4)
    assert "temperature is computed" in out and "gamma = 5/3" in out and "4 / (3 + 5 X)" in out and "X = 0.76" in out
    grams, atoms = (
        values(capsys, "gas.hdf5", "--of", *of)[0] for of in (["Density", "--unit", "g/cm**2"], ["nH", "--unit", "cm**-2"])
    )
    np.testing.assert_allclose(atoms, grams * (0.76 / 1.67262192e-24), rtol=1e-5)
    code, out, err = commanded.run(capsys, "info", "gas.hdf5")
    assert (code, err) == (0, []) and "temperature is computed" in out and "pressure is computed" in out


def test_compiling_is_told_apart_in_the_time(file, capsys):
    line = next(line for line in values(capsys, file)[1].splitlines() if line.startswith("time"))
    assert all(f"{stage} " in line for stage in ("plan", "compile", "cast"))


@pytest.mark.parametrize(
    ("words", "unit", "code_unit"),
    [
        ([], "g/cm**2", 2e33 / 4e42), (["--of", "volume"], "cm", 2e21), (["--of", "number"], "1/cm**2", 1 / 4e42),
        (["--of", "density"], "g/cm**2", 2.5e-31 * 2e21), (["--weight", "mass", "--of", "density"], "g/cm**3", 2.5e-31),
        (["--emission", "2"], None, 1.0), (["--of", "heat"], None, 1.0),
    ],
)  # fmt: skip
def test_fits_has_the_unit_that_follows_from_those_of_the_file(words, unit, code_unit, file, by_reference, capsys):
    h5py, fits, units = (pytest.importorskip(name) for name in ("h5py", "astropy.io.fits", "astropy.units"))
    none = dict.fromkeys(("length_scaling", "mass_scaling", "velocity_scaling", "a_scaling", "h_scaling"), 0.0)
    stated = {"Coordinates": (1, 0, 2e21), "Masses": (0, 1, 2e33), "Density": (-3, 1, 2.5e-31)}
    with h5py.File("gas.hdf5", "w") as made:
        group, given = made.create_group("PartType0"), columns()
        group["Coordinates"], group["Masses"], group["Density"] = given["position"], given["mass"], given["density"]
        group["SmoothingLength"], group["heat"] = np.full(COUNT, 0.3), given["temperature"]
        for name, (length, mass, cgs) in stated.items():
            group[name].attrs.update(none | {"length_scaling": length, "mass_scaling": mass, "to_cgs": cgs})
    raw, _ = values(capsys, "gas.hdf5", *words)
    assert run(capsys, "gas.hdf5", *TINY, *words, "-o", "out.fits")[0] == 0
    with fits.open("out.fits") as found:
        header = found[0].header
        assert header["CUNIT1"] == "cm" and abs(header["CRVAL1"] / 1e21 - 1) < 0.2
        np.testing.assert_array_equal(found[0].data, raw[::-1])  # one command writes the same numbers to all files
        assert "BUNIT" not in header or units.Unit(header["BUNIT"]) == code_unit * units.Unit(unit)
    if unit is None:
        return
    assert run(capsys, "gas.hdf5", *TINY, *words, "--unit", unit, "-o", "out.fits")[0] == 0
    with fits.open("out.fits") as found:
        np.testing.assert_allclose(found[0].data, code_unit * raw.astype(np.float64)[::-1], rtol=1e-6)
        assert units.Unit(found[0].header["BUNIT"]) == units.Unit(unit)


@pytest.mark.parametrize("view", ["z", "x"])
def test_what_read_scene_gives_is_projected_as_by_the_command(file, capsys, view):
    """Columns go through all there is, whatever depths its picture is between."""
    found, out = values(capsys, file, "--view", view, "--center", "0.5,0.5,0.5", "--width", "0.4")
    scene, camera = io.read_scene(file, view=view, center=(0.5, 0.5, 0.5), width=0.4, size=(18, 12))
    whole = js.project(scene.particles, camera, of=columns()["mass"])
    np.testing.assert_allclose(whole.values, found, rtol=1e-4)
    assert whole.cut == 0 and "cut" not in repr(whole) and "lies outside of these depths" not in out
    np.testing.assert_array_equal(js.project(scene, camera, of=columns()["mass"]).values, whole.values)
    ends = camera.near_and_far()
    cut = js.project(scene.particles, camera, of=columns()["mass"], depth_range=ends)
    given = js.project(scene.particles, dataclasses.replace(camera, near=ends[0], far=ends[1]), of=columns()["mass"])
    np.testing.assert_array_equal(cut.values, given.values)
    assert float(cut.total()) < 0.9 * float(whole.total())


def test_columns_of_a_periodic_box_are_whole_around_any_place(file, capsys):
    image, out = values(capsys, "bare.npz", "--box-size", "1,1,1", "--center", "0.1,0.9,0.05", "--size", "12x12")
    assert abs(image.mean() / COUNT - 1) < 1e-4 and "outside of these depths" not in out


def test_what_depths_leave_out_of_the_picture_is_said(file, by_reference, capsys):
    _, out = values(capsys, file, "--view", "x", "--depth-range", "0.25,2")
    share = columns()["mass"][columns()["position"][:, 0] < 0.25].sum() / columns()["mass"].sum()
    assert f"{share:.1%} of what is in the picture lies outside of these depths" in out


@pytest.mark.parametrize(("density", "up", "other"), [("density", "y", "0,0,1"), ("Rhop", "z", "0,1,0")])
def test_what_is_up_is_said_where_the_kind_of_file_has_chosen_it_and_may_be_asked_for(
    file, density, up, other, by_reference, capsys
):
    given = columns()
    np.savez("fluid.npz", position=given["position"], support=np.full(COUNT, 0.3), **{density: given["density"]})
    how = ["fluid.npz", "--of", "number", "--view", "x"]
    chosen, said = values(capsys, *how)
    told = [line.split(maxsplit=1)[1] for line in said.splitlines() if line.startswith("up ")]
    assert len(told) == 1 and told[0].startswith(up) and f"--up {other}" in told[0]
    asked, said = values(capsys, *how, "--up", other)
    assert "\nup " not in said and np.abs(asked - chosen).max() > 0.1 * chosen.max()
