"""All commands that draw read the same words of placing and showing: each changes what they write; and bad words are refused."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from commanded import refused, run
from drawing_words import EYE, KEY, NOT_OF, UNIT, WORDS

import jaxsph as js
from jaxsph import io
from jaxsph.cli import figures as of_cli
from jaxsph.plot.image_figure import image_figure
from jaxsph.plot.places import described

h5py = pytest.importorskip("h5py")
pytest.importorskip("matplotlib"), pytest.importorskip("unyt")
pytestmark = pytest.mark.usefixtures("by_reference", "file")
SMALL = ["--size", "16x12"]
COMMANDS = {
    "render": ["render", "a.hdf5", *SMALL, "--samples", "24"],
    "project": ["project", "a.hdf5", *SMALL],
    "slice": ["slice", "a.hdf5", *SMALL, "--color-by", "heat"],
    "movie": ["movie", "a.hdf5", *SMALL, "--samples", "24", "--orbit", "30", "--frames", "1"],
}


@pytest.fixture
def file(empty):
    """Particles with units in an otherwise empty working directory."""
    rng, none = np.random.default_rng(0), dict.fromkeys(("velocity_scaling", "a_scaling", "h_scaling"), 0.0)
    columns = {
        "Coordinates": (rng.uniform(0, 1, (60, 3)), 1, 0, 3e21), "Masses": (rng.uniform(1, 2, 60), 0, 1, 2e33),
        "Density": (rng.uniform(1, 2, 60), -3, 1, 2.5e-31), "heat": (rng.uniform(0, 1, 60), 2, 1, 1e10),
        "SmoothingLength": (np.full(60, 0.3), 1, 0, 3e21), "spin": (rng.normal(size=(60, 3)), 0, 0, 1),
    }  # fmt: skip
    with h5py.File("a.hdf5", "w") as made:
        group = made.create_group("PartType0")
        for name, (column, length, mass, cgs) in columns.items():
            group[name] = column
            group[name].attrs.update(none | {"length_scaling": length, "mass_scaling": mass, "to_cgs": cgs})
            group[name].attrs["velocity_scaling"] = 2.0 if name == "heat" else 0.0
            group[name].attrs["length_scaling"] = 0.0 if name == "heat" else length


def drawn(capsys, command, *more):
    """Pixels of a picture; of a movie the bytes."""
    out = f"{command}.mp4" if command == "movie" else f"{command}.png"
    more = [*more, "--color-by", "heat"] if command in ("render", "movie") else more
    code, said, err = run(capsys, *COMMANDS[command], *more, "-o", out)
    assert (code, err) == (0, []), err
    return Path(out).read_bytes() if command == "movie" else np.asarray(io.read_image(out).color), said


@pytest.fixture(scope="module")
def pictures():
    """What commands draw, by the words that several tests ask for it with: the file is always the same."""
    return {}


def drawn_once(pictures, capsys, *words):
    """A picture that may have been drawn before."""
    if words not in pictures:
        pictures[words] = drawn(capsys, *words)
    return pictures[words]


@pytest.mark.parametrize(
    ("command", "word"), [(one, word) for one in COMMANDS for word in WORDS if one not in NOT_OF.get(word, ())]
)
def test_each_word_of_placing_and_showing_changes_what_each_command_draws(command, word, pictures, capsys):
    value, others = WORDS[word]
    asked = [word.split()[0], *([UNIT[command]] if value is None else value)]
    one, _ = drawn_once(pictures, capsys, command, *others)
    other, said = drawn(capsys, command, *others, *asked)
    assert not np.array_equal(one, other) if np.shape(one) == np.shape(other) else True
    assert word != "--clip" or command != "project" or "particles whose centres are inside" in said


@pytest.mark.parametrize("command", ["render", "project", "slice"])
def test_a_pdf_is_a_figure_and_a_page_of_vectors(command, capsys):
    for suffix, start in (("pdf", b"%PDF"), ("svg", b"<?xml")):
        assert run(capsys, *COMMANDS[command], "-o", f"a.{suffix}")[0] == 0
        assert Path(f"a.{suffix}").read_bytes().startswith(start) and Path(f"a.{suffix}").stat().st_size > 4000


def test_axes_in_perspective_are_refused_before_a_picture_is_made(capsys):
    assert "--axes is for parallel rays" in refused(capsys, *COMMANDS["render"], "--axes", "-o", "a.png")


@pytest.mark.parametrize("command", COMMANDS)
def test_bad_words_are_refused_alike_before_a_file_is_read(command, capsys):
    for words, said in (
        (["--unit", "Msun/pc;2"], "--unit: 'Msun/pc;2' is no unit"), (["--length-unit", "g"], "does not agree"),
        (["--dpi", "0"], "--dpi must be a number > 0"), (["--font-size", "no"], "--font-size must be"),
        (["--dpi", "1e5"], "340,000 pixels wide"),
        (["--background", "whiet"], "white"), (["--fov", "30", "--view", "x"], "--fov is of perspective views"),
    ):  # fmt: skip
        assert said in refused(capsys, command, "gone.hdf5", *COMMANDS[command][2:], *words)
    for words, said in ((["--unit", "K"], "does not agree"), (["--clip", "box:5,5,5,6,6,6"], "nothing is inside of --clip")):
        code, _, err = run(capsys, *COMMANDS[command], *words, *KEY, "-o", f"a.{'mp4' if command == 'movie' else 'png'}")
        assert code in (1, 2) and said in err[-1]


def test_a_slice_from_an_eye_is_the_plane_through_its_target(capsys):
    target = np.array([0.4, 0.5, 0.6])
    more = ["--eye", "0.4,0.5,3.6", "--target", "0.4,0.5,0.6", "--fov", "10"]
    assert run(capsys, *COMMANDS["slice"], *more, "-o", "eye.npy")[0] == 0
    width = 2 * 3 * np.tan(np.radians(5)) * 16 / 12
    across = ["--center", ",".join(map(str, target)), "--width", str(width)]
    assert run(capsys, *COMMANDS["slice"], *across, "-o", "plane.npy")[0] == 0
    np.testing.assert_allclose(np.load("eye.npy"), np.load("plane.npy"), rtol=1e-4)


def test_the_mean_on_a_plane_is_by_volume_or_what_is_asked_for(capsys):
    with h5py.File("a.hdf5") as made:
        columns = {name: made["PartType0"][name][:] for name in ("Coordinates", "heat", "Masses", "Density")}
    places = np.stack(np.meshgrid((np.arange(16) - 7.5) / 40 + 0.5, 0.5 - (np.arange(12) - 5.5) / 40, [0.5]), -1).reshape(-1, 3)
    of = {"number": np.ones(60), "Masses": columns["Masses"], "heat": columns["heat"] * columns["Masses"] / columns["Density"]}
    for weight, numbers in of.items():
        more = ["--of", "2*heat", "--weight", weight, "--center", "0.5,0.5,0.5", "--width", "0.4", "-o", "out.npy"]
        assert run(capsys, *COMMANDS["slice"][:-2], *more)[0] == 0
        by = js.Particles.from_arrays(columns["Coordinates"], 0.3, 2 * columns["heat"], volume=numbers, kernel="cubic_spline")
        np.testing.assert_allclose(np.load("out.npy").ravel(), js.sample(by, places), rtol=1e-4)
    told = refused(capsys, *COMMANDS["slice"], "--weight", "mass", "--field", "sum")
    assert "--field sum and --weight exclude each other" in told
    code, _, err = run(capsys, *COMMANDS["slice"], "--weight", "heat - 0.5", "-o", "out.npy")
    assert code == 1 and "--weight must be >= 0" in err[-1]


def test_columns_of_a_clip_are_those_of_the_particles_whose_centres_are_inside(capsys):
    view = ["--view", "z", "--center", "0.5,0.5,0.5", "--width", "2"]
    for more, name in ((["--clip", "box:0,0,0,0.5,1,1"], "clip.npy"), (["--where", "x <= 0.5"], "where.npy")):
        assert run(capsys, *COMMANDS["project"], *view, *more, "-o", name)[0] == 0
    np.testing.assert_allclose(np.load("clip.npy"), np.load("where.npy"), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(("command", "factor"), [("project", 2e33 / 1.988e33 / (3e21 / 3.0857e18) ** 2), ("slice", 1e10)])
def test_values_and_their_ends_are_in_the_unit_that_is_asked_for(command, factor, capsys):
    highest = []
    for more, name in ([], "own.npy"), (["--unit", UNIT[command]], "asked.npy"):
        code, out, _ = run(capsys, *COMMANDS[command], *more, "-o", name, "--json")
        highest.append(json.JSONDecoder().raw_decode(out)[0]["highest"])
        assert code == 0
    assert highest[1] / highest[0] == pytest.approx(factor, rel=1e-3)
    asked, own = np.load("asked.npy"), np.load("own.npy")
    np.testing.assert_allclose(asked[own > 0] / own[own > 0], factor, rtol=1e-3)


@pytest.mark.parametrize("command", ["project", "slice"])
def test_numbers_that_are_said_have_a_unit_and_are_those_of_the_file(command, capsys):
    fits, told, held = pytest.importorskip("astropy.io.fits"), {}, {}
    for more, name in ([], "a.npy"), ([], "a.fits"), (["--annotate"], "a.png"), (["--unit", UNIT[command]], "b.fits"):
        code, out, _ = run(capsys, *COMMANDS[command], *more, "-o", name, "--json")
        told[name], held[name] = json.JSONDecoder().raw_decode(out)[0], fits.getdata(name) if "fits" in name else None
        assert code == 0 and f"{told[name]['highest']:.6g} in " in out
    held["a.npy"] = np.load("a.npy")[::-1]
    np.testing.assert_array_equal(held["a.npy"], held["a.fits"])
    for name, values in held.items():
        assert values is None or np.nanmax(values) == pytest.approx(told[name]["highest"])
    assert told["a.npy"]["unit"] == told["a.fits"]["unit"] and told["a.npy"]["unit"][0].isdigit()
    assert told["b.fits"]["unit"] == UNIT[command].replace("**", "^")
    factor = told["b.fits"]["highest"] / told["a.png"]["highest"]  # a figure's own unit is another, perhaps
    assert factor == pytest.approx(1, rel=1e-3) or told["a.png"]["unit"] != told["b.fits"]["unit"]


def test_info_render_and_explain_name_units(capsys):
    code, out, _ = run(capsys, "info", "a.hdf5", "--quantity", "heat", "--json")
    assert code == 0 and "in units of 1e+10 cm^2 g s^-2" in out
    assert json.JSONDecoder().raw_decode(out)[0]["units"]["Density"] == "2.5e-31 g cm^-3"
    code, out, _ = run(capsys, "explain", "a.hdf5", *SMALL, "--samples", "24", "--pixel", "6,8", "--quantity", "heat", "--json")
    told = json.JSONDecoder().raw_decode(out)[0]
    assert code == 0 and (told["unit"], told["length_unit"]) == ("1e+10*cm**2*g*s**-2", "3e+21*cm")


@pytest.fixture
def figures(monkeypatch):
    """What figures are drawn of: pictures, and how."""
    found = []

    def drawn(pictures, scene, camera, **more):
        found.append((pictures, more))
        return image_figure(pictures, scene, camera, **more)

    monkeypatch.setattr(of_cli, "image_figure", drawn)
    return found


def changed(name, **columns):
    """A file like `a.hdf5`, of which columns are times something, or gone."""
    shutil.copy("a.hdf5", name)
    with h5py.File(name, "r+") as made:
        for column, factor in columns.items():
            made["PartType0"][column][:] *= factor or 1
            if factor is None:
                del made["PartType0"][column]


@pytest.mark.parametrize("command", ["render", "project", "slice"])
def test_panels_are_seen_as_the_first_wide_enough_and_in_colours_of_all(command, figures, capsys):
    changed("b.hdf5", Coordinates=1.8, heat=3.0)
    words = ["a.hdf5", "b.hdf5", *COMMANDS[command][2:], "--color-by" if command == "render" else "--of", "heat"]
    code, said, err = run(capsys, command, *words, "--panels", "-o", "p.png")
    assert (code, err) == (0, []) and "2 of 2: b.hdf5, seen as a.hdf5 is" in said
    (one, other), more = figures[0]
    told = [dict(each.metadata)["jaxsph.camera"].split(" near=")[0] for each in (one, other)]
    assert told[0] == told[1] and more["title"] == ["a", "b"]
    camera = described(dict(one.metadata)["jaxsph.camera"])
    for name in "ab":  # of which all is in the picture
        with h5py.File(f"{name}.hdf5") as made:
            place = (made["PartType0/Coordinates"][:] - camera.exact_eye()) @ np.asarray(camera.axes).T
        reach = camera.half_height * np.array([16 / 12, 1]) * (place[:, 2:] if camera.is_perspective else 1)
        assert (np.abs(place[:, :2]) <= reach).mean() > 0.98
    if command == "slice":
        ends = np.asarray(more["transfer"].values)[[0, -1]]
        assert ends[0] < 0.1 and ends[1] > 2
    assert run(capsys, command, *words, "--panels", "--title", "low;high", "-o", "p.pdf")[0] == 0
    assert figures[1][1]["title"] == ["low", "high"]


def test_contours_of_a_render_are_those_of_project_at_the_same_pixels(figures, capsys):
    for command in ("project", "render"):
        words = [*COMMANDS[command], *EYE, "--where", "heat > 0.3 and spin.los < 0.5", "--contours", "heat", "-o", "p.png"]
        assert run(capsys, *words)[0] == 0
    (values, levels), (own, asked) = (more["contours"] for _, more in figures)
    np.testing.assert_array_equal(own, values), np.testing.assert_array_equal(asked, levels)
    code, said, _ = run(capsys, *words[:-3], "0*heat + 2", *words[-2:])
    assert code == 0 and "of mean.0*heat + 2 nowhere, as it is all over 2" in said
    assert "--contours is for a file of particles" in refused(capsys, "render", "scene:mixer:particles=50", *SMALL, *words[-4:])


@pytest.mark.parametrize("command", ["project", "slice"])
def test_what_is_said_of_a_ratio_is_in_its_file(command, capsys):
    changed("b.hdf5", heat=1.5)
    how = [*SMALL, "--of", "heat", "--center", "0.5,0.5,0.5", "--width", "0.6", "--difference", "--json"]
    code, out, err = run(capsys, command, "a.hdf5", "b.hdf5", *how, "--norm", "log", "-o", "d.npy")
    assert code == 0, err
    told, values = json.JSONDecoder().raw_decode(out)[0], np.load("d.npy")
    assert code == 0 and told["unit"] == "1" and "b over a: " in out and "log10" not in out
    np.testing.assert_allclose([told["lowest"], told["highest"]], [np.nanmin(values), np.nanmax(values)])
    np.testing.assert_allclose(values[np.isfinite(values)], 1.5, rtol=1e-4)
    how[how.index("heat")] = "log10:heat"
    code, out, _ = run(capsys, "slice", "a.hdf5", "b.hdf5", *how, "-o", "d.npy")
    assert code == 0 and "log10 of b over a: " in out
    np.testing.assert_allclose(json.JSONDecoder().raw_decode(out)[0]["highest"], np.log10(1.5), rtol=1e-4)


@pytest.mark.parametrize("command", ["project", "slice"])
def test_a_difference_is_of_values_in_one_frame_and_in_colours_about_zero(command, figures, capsys):
    changed("b.hdf5", Masses=1.5, Density=1.5, heat=1.5)
    how = [*SMALL, "--of", "heat", "--center", "0.5,0.5,0.5", "--width", "0.6"]
    for name in "ab":
        assert run(capsys, command, f"{name}.hdf5", *how, "-o", f"{name}.npy")[0] == 0
    assert run(capsys, command, "a.hdf5", "b.hdf5", *how, "--difference", "-o", "d.npy")[0] == 0
    np.testing.assert_allclose(np.load("d.npy"), np.load("b.npy") - np.load("a.npy"), rtol=1e-5)
    how += ["--difference", "-o", "d.png", "--annotate"]
    for more, quantity, value in ([], "difference.", None), (["--norm", "log"], "ratio.", 1.5):
        code, _, err = run(capsys, command, "a.hdf5", "b.hdf5", *how, *more)
        assert code == 0, err
        (what,), drawn = figures.pop()
        ends = drawn["range"] if command == "project" else np.asarray(drawn["transfer"].values)[[0, -1]]
        assert drawn["labels"].quantity.startswith(quantity) and ends[1] > 0
        assert ends[1] == pytest.approx(1 / ends[0] if value else -ends[0])
        assert value is None or (np.abs(what.values[np.isfinite(what.values)] - value) < 1e-5).all()
        assert (drawn["labels"].unit == "") == (value is not None) and drawn["labels"].moment.startswith("b ")


@pytest.mark.parametrize(
    ("command", "files", "words", "said"),
    [
        ("project", "ab", [], "FILE must be one, with --panels several, with --difference two"), ("slice", "", [], "got none"),
        ("project", "a", ["--difference"], "got 1"), ("slice", "abb", ["--difference"], "got 3"),
        ("slice", "ab", ["--difference", "--panels"], "exclude each other"),
        ("render", "ab", ["--panels", "--title", "one"], "--title must name each of 2 panels"),
        ("project", "ab", ["--panels", "-o", "p.exr"], "--panels is for a picture"),
        ("project", "ab", ["--panels", "--of", "haet"], "a.hdf5: there is no quantity 'haet'; there are Density, Masses"),
        ("slice", "ac", ["--panels", "--of", "heat"], "c.hdf5: there is no quantity 'heat'; there are Density"),
        ("project", "ac", ["--panels", "--of", "heat"], "c.hdf5: there is no quantity 'heat'; there are Density"),
        ("project", "ad", ["--panels"], "d.hdf5: units must be those of a.hdf5, "),
        ("slice", "ad", ["--difference"], "d.hdf5: units must be those of a.hdf5, "),
        ("project", "a", ["--contours", "haet"], "there is no quantity 'haet'"),
        ("slice", "a", ["--contours", "haet"], "there is no quantity 'haet'"),
    ],
)  # fmt: skip
def test_files_that_are_not_of_one_figure_are_told(command, files, words, said, capsys):
    changed("b.hdf5"), changed("c.hdf5", heat=None), changed("d.hdf5")
    with h5py.File("d.hdf5", "r+") as made:
        made["PartType0/Coordinates"].attrs["to_cgs"] = 3e24
    how = [*words, *([] if "--of" in words or command == "render" else ["--of", "Density"])]
    how += [] if "-o" in words else ["-o", "p.png"]
    code, _, err = run(capsys, command, *(f"{name}.hdf5" for name in files), *SMALL, *how)
    assert code in (1, 2) and len(err) == 1 and said in err[0] and ("haet" not in said or "did you mean heat" in err[0]), err
