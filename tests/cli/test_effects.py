"""Whatever option a command lists changes numbers, those of `render` in every command alike, or is refused by name."""

import functools
import json
import re
from pathlib import Path

import jax
import numpy as np
import pytest
from commanded import refused, run
from drawing_words import NOT_OF, UNIT as DRAWN, WORDS as SHOWN

import jaxsph as js
from jaxsph.cli import groups, main as cli
from jaxsph.cli.commands import checks, columns, data, movie, sweep, view
from jaxsph.cli.table import COMMANDS
from jaxsph.model.projection import Projection

h5py = pytest.importorskip("h5py")
pytest.importorskip("matplotlib")
SMALL, FEW = ["--size", "12x8"], ["--samples", "16"]
EYE, ONE, COLOR = ("--eye", "2,2,6"), ("--tolerance", "0.1"), ("--color-by", "heat")
BASE = {
    "render": ["a.hdf5", *SMALL, *FEW, "-o", "o.png"], "explain": ["a.hdf5", *SMALL, *FEW, "--pixel", "1,1"],
    "transfer": ["a.hdf5", *SMALL, "-o", "o.png"], "sweep": ["a.hdf5", *SMALL, *FEW, "-o", "out", "--no-figures"],
    "view": ["a.hdf5", *SMALL, *FEW, "--no-browser"], "project": ["a.hdf5", *SMALL, "-o", "o.png"],
    "movie": ["a.hdf5", *SMALL, *FEW, "--orbit", "9", "--frames", "2", "-o", "o.mp4"], "info": ["a.hdf5", "--json"],
    "slice": ["a.hdf5", *SMALL, "--of", "heat", "-o", "o.png", "--json"],
}  # fmt: skip
SEQUENCE = ["movie", "a.hdf5", "b.hdf5", *SMALL, *FEW, "--box-size", "none", "-o", "o.mp4"]
GROUPS = {
    "--color-by": ("heat",), "--opacity-by": ("Masses",), "--support": ("0.2",), "--kernel": ("wendland_c2",),
    "--part-type": ("stars",), "--box-size": ("none",), "--where": ("heat > 0.5",), "--share": ("0.5",),
    "--frame": ("mass", "--color-by", "velocity.x"), "--physical": (), "--points": ("p.npz:radius=0.3",), "--volume": ("v.npy",),
    "--iso": ("0.5", "v.npy"), "--mix": ("opacity", "--volume", "v.npy"), "--center": ("2.2,2,2",), "--width": ("1",),
    "--view": ("x",), "--eye": EYE[1:], "--target": ("2.3,2,2", *EYE), "--up": ("1,0,0",), "--fov": ("9", *EYE),
    "--size": ("20x12",), "--clip": ("sphere:2,2,2,0.3",), "--colormap": ("inferno",), "--norm": ("log", *COLOR),
    "--range": ("0.2,2",), "--preset": ("temperature",), "--transfer": ("t.json",), "--exposure": ("2",),
    "--optical-depth": ("3",), "--surface": ("0.3",), "--surface-of": ("heat",), "--smoothing": ("2", "--surface", "0.3"),
    "--light": ("head", "--surface", "0.3"), "--occlusion": ("0.1", "--surface", "0.3"), "--background": ("white",),
    "--antialias": ("1", "--surface", "0.3"), "--samples": ("8",), "--integrator": ("segments",), "--memory": ("1",),
    "--tolerance": ("0.05",), "--estimator": ("pilot", *ONE), "--relax": ("0.5", *ONE), "--screen": ("quadtree", *ONE),
    "--annotate": (), "--axes": (), "--title": ("A title",), "--dpi": ("300",), "--font-size": ("11",),
    "--length-unit": ("Mpc",), "--unit": ("kg/m**3",), "--contours": ("2*heat",), "--panels": (),
}  # fmt: skip
"""Options of several commands: a value of each, and what else is asked for with and without it."""
OWN = {
    "render": {
        "--draft": "--draft and --samples exclude",
        "--cell": None, "--smallest-piece": None, "--progressive": None, "--devices": None, "--tile": None, "--bracket": None,
    },
    "explain": {"--draft": "--draft and --samples exclude", "--pixel": ("2,3",), "--output": None},
    "transfer": {"--rays": ("9",), "--unit": ("kg/m**3",), "--save": None, "--output": None},
    "sweep": {
        "--tolerances": ("0.3",), "--estimators": ("pilot",), "--baselines": ("samples/4",),
        "--moments": ("0,1", "scene:radial:particles=50"),
        "--repeats": ("2",), "--converged": ("2",), "--integral": ("7",), "--no-figures": None,
    },
    "view": {"--port": None, "--no-browser": None},
    "movie": {
        "--camera": None, "--orbit": ("90",), "--fps": None, "--frames": ("3",), "--frame-format": ("exr",),
        "--workers": None, "--client": None, "--gaps": "is of a sequence", "--strict": "is of a sequence",
    },
    "project": {
        "--of": ("heat",), "--weight": ("mass",), "--along": ("max",), "--emission": ("2",), "--pixel": ("ray",),
        "--norm": ("log",), "--frame": ("mass", "--of", "velocity.x"),
        "--tolerance": ("0.1",), "--arrows": "add --annotate", "--depth-range": ("1.9,2.1",),
        "--difference": None,
    },
    "slice": {
        "--physical": ("--of", "Density"), "--of": ("Masses",), "--weight": ("mass",), "--plane": ("2,2,2,1,0,0",),
        "--field": ("sum",), "--difference": None,
    },
    "info": {},
}  # fmt: skip
"""Options of a command alone; what is tried where its tests are (None), or refused as it stands here."""
ELSEWHERE = {"merge": {"--output"}, "demo": {"--output", "--size"}, "doctor": {"--completion"}}
COMMON = {"--quiet", "--verbose", "--json", "--config", "--no-cache", "--output"}
"""See `test_words.py` and `test_voice.py`."""
OF_A_FIGURE = {"--box-size", "--background", *(f"--{one.replace('_', '-')}" for one in groups.KEYED.split())}
FLAGS = {"--physical", "--annotate", "--axes", "--panels", "--draft", "--gaps", "--strict"}
AS_RENDER = "explain", "transfer", "sweep", "view", "movie"
TOGETHER = (
    ("--color-by", "--norm", "--range", "--colormap", "--exposure", "--where", "--center", "--width", "--view", "--up"),
    ("--opacity-by", "--support", "--kernel", "--box-size", "--share", "--optical-depth", "--clip", "--target", "--fov"),
    ("--part-type", "--physical", "--frame", "--preset", "--mix", "--estimator", "--tolerance"),
    ("--smoothing", "--light", "--occlusion", "--antialias"), ("--surface-of",), ("--iso",), ("--points", "--integrator"),
    ("--transfer", "--relax"),
    ("--eye", "--screen", "--memory", "--samples", "--size", "--volume", "--surface"),
)  # fmt: skip
"""Options that go together, as all commands that draw a scene read them."""


class EnoughError(ValueError):
    """All that says what is to be made was handed on."""


def file_of(name, moved=0.0):
    """Gas and stars that turn, in a period and by a scale factor."""
    rng, counts = np.random.default_rng(0), np.array([40, 0, 0, 0, 20, 0])
    with h5py.File(name, "w") as made:
        header = {
            "Time": 0.5 + moved,
            "Redshift": 1 / (0.5 + moved) - 1,
            "HubbleParam": 0.7,
            "BoxSize": 4.0,
            "MassTable": np.zeros(6),
        }
        made.create_group("Header").attrs.update(header | {"NumPart_ThisFile": counts})
        units = {"UnitLength_in_cm": 3e21, "UnitMass_in_g": 2e43, "UnitVelocity_in_cm_per_s": 1e5}
        made.create_group("Parameters").attrs.update(units)
        for kind in (0, 4):
            group, count = made.create_group(f"PartType{kind}"), counts[kind]
            place = rng.normal(2, 0.3, (count, 3))
            group["Coordinates"], group["Velocities"] = place + moved, np.cross((0.2, 0.9, 0.4), place) + 7
            group["Masses"], group["heat"], group["Density"] = rng.lognormal(0, 1, (3, count))
            group["SmoothingLength"], group["ParticleIDs"] = np.full(count, 0.35), np.arange(count) + 1000 * kind


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """What commands read."""
    place = tmp_path_factory.mktemp("effects")
    file_of(place / "a.hdf5"), file_of(place / "b.hdf5", 0.1)
    np.save(place / "v.npy", np.random.default_rng(1).random((6, 6, 6), np.float32))
    points = np.random.default_rng(2).normal(2, 0.3, (9, 3))
    np.savez(place / "p.npz", position=points, mass=np.ones(9), radius=np.full(9, 0.2))
    look = js.TransferFunction.from_points([0.0, 1.0], [(0.2, 0.4, 0.9), (1.0, 0.5, 0.1)], [0.5, 4.0])
    look.save(place / "t.json")
    return place


@pytest.fixture
def handed(folder, monkeypatch):
    """What commands hand on to what draws, which here draws next to nothing."""
    monkeypatch.chdir(folder)
    given = []

    def enough(*arguments, **named):
        given.append((arguments, {name: value for name, value in named.items() if name not in ("progress", "folder")}))
        raise EnoughError("enough")

    def project_nothing(clock, scene, camera, asked, **how):
        given.append(((scene, camera, asked), how))
        clock.seconds.update(compile=0.0, cast=0.0)
        values = 1.0 + np.arange(camera.width * camera.height).reshape(camera.height, camera.width)
        return Projection(values, None, np.float64(1), False, name=asked[2])

    for module, name in (
        (js, "render"), (checks, "explained"), (data, "transfer_figure"), (sweep, "measured"), (view, "Session"),
        (movie, "render_frames"),
    ):  # fmt: skip
        monkeypatch.setattr(module, name, enough)
    monkeypatch.setattr(columns, "projected", project_nothing)
    return given


def numbers(value):
    """All that was handed on, as something that can be compared; scenes of a sequence are made."""
    leaves, tree = jax.tree.flatten(value)
    leaves = [numbers(leaf()) if callable(leaf) else repr(np.asarray(leaf).tolist()) for leaf in leaves]
    return re.sub(" at 0x[0-9a-f]+", "", f"{leaves} {tree}")


@functools.cache
def offered(command):
    """Options of a command."""
    return {one.name for one in cli.arguments_of(command) if one.name.startswith("--") and one.parse}


def said(option, *others):
    """Words for an option with its value, if it has one, and what goes with it; and another file, if that is for another."""
    words = [option, *others]
    value = [] if option in FLAGS else words[1:2]
    more = words[1 + len(value) :]
    file = [word for word in more if word.endswith(".npy") or word.startswith("scene:")] if len(more) % 2 else []
    return [option, *value], [word for word in more if word not in file], file


def outcome(capsys, given, words):
    """Numbers that a command hands on, writes and says."""
    given.clear(), Path("o.png").unlink(missing_ok=True)
    code, out, err = run(capsys, *words)
    assert code == cli.DONE or (code == cli.FAILED and "enough" in err[-1]), err
    told = json.JSONDecoder().raw_decode(out)[0] if words[0] in ("info", "slice") else {}
    told = {name: value for name, value in told.items() if words[0] == "info" or name in ("lowest", "highest", "inside")}
    drawn = np.asarray(js.io.read_image("o.png").to_uint8()).tolist() if Path("o.png").exists() else None
    return numbers(given), told, drawn


@pytest.fixture(scope="module")
def known():
    """Outcomes by the words of their command."""
    return {}


def once(capsys, handed, known, words):
    """The outcome of a command that may have been asked before."""
    if tuple(words) not in known:
        known[tuple(words)] = outcome(capsys, handed, words)
    return known[tuple(words)]


def tried(command):
    """Options that are tried with a command one by one, and how."""
    shared = {} if command in AS_RENDER else {option: how for option, how in GROUPS.items() if option in offered(command)}
    covered = {word for word in SHOWN if command in DRAWN and command not in NOT_OF.get(word, ())}
    return {option: how for option, how in {**shared, **OWN[command]}.items() if option not in covered}


@pytest.mark.parametrize("command", COMMANDS)
def test_every_option_that_a_command_lists_is_tried(command):
    together = {one for group in TOGETHER for one in group} if command in AS_RENDER else {*GROUPS}
    known = (
        together | ({*SHOWN} if command in DRAWN else set()) | ELSEWHERE.get(command, set()) | {*OWN.get(command, ())} | COMMON
    )
    assert offered(command) <= known and {*OWN.get(command, ())} <= offered(command)


@pytest.mark.parametrize(
    ("command", "option"), [(one, option) for one in OWN for option, how in tried(one).items() if how is not None]
)
def test_each_option_changes_numbers_or_is_refused_by_name(command, option, handed, known, capsys):
    how = tried(command)[option]
    if isinstance(how, str):
        assert how in refused(capsys, command, *BASE[command], option, *(["velocity"] if option == "--arrows" else []))
        return
    words, others, file = said(option, *how)
    base = [command, *(file or BASE[command][:1]), *BASE[command][1:], *others]
    before = once(capsys, handed, known, base)
    assert outcome(capsys, handed, [*base, *words]) != before


@pytest.mark.parametrize("option", [one for one in GROUPS if one in offered("movie") and one not in OF_A_FIGURE])
def test_each_option_changes_a_sequence_or_is_refused_by_name(option, handed, known, capsys):
    words, others, _ = said(option, *GROUPS[option])
    if option in ("--points", "--volume", "--iso", "--mix"):
        assert "for" in refused(capsys, *SEQUENCE, *others, *words)
        return
    assert outcome(capsys, handed, [*SEQUENCE, *others, *words]) != once(capsys, handed, known, [*SEQUENCE, *others])


@pytest.fixture(scope="module")
def scenes():
    """What commands were about to show, by their words."""
    return {}


def shown(capsys, given, scenes, words):
    """The scene that a command hands on, and its settings, if it has some; it may have been asked before."""
    if tuple(words) not in scenes:
        assert "enough" in run(capsys, *words)[2][-1]
        arguments, _ = given.pop()
        scene = next(value for value in arguments if isinstance(value, js.Scene))
        settings = next((value for value in arguments if isinstance(value, js.Settings)), None)
        scenes[tuple(words)] = numbers(scene), numbers(settings)
    return scenes[tuple(words)]


@pytest.mark.parametrize(("command", "group"), [(one, group) for one in AS_RENDER for group in TOGETHER], ids=str)
def test_options_show_the_same_scene_in_every_command(command, group, handed, scenes, capsys):
    asked, files = {}, []
    for option in group:
        if option in offered(command):
            (_, *value), others, file = said(option, *GROUPS[option])
            asked |= dict(zip(others[::2], others[1::2], strict=True)) | {option: (value or [None])[0]}
            files += file
    asked = {option: value for option, value in asked.items() if option in offered(command)}
    words = [word for pair in asked.items() for word in pair if word is not None]
    if command == "explain" and any("surface" in word or "mooth" in word for word in words):
        assert "a surface of particles has no error" in refused(capsys, command, *BASE[command], *words)
        return
    (scene, settings), (same_scene, same_settings) = (
        shown(capsys, handed, scenes, [one, *(files or BASE[one][:1]), *BASE[one][3 if "--size" in asked else 1 :], *words])
        for one in ("render", command)
    )
    assert scene == same_scene
    assert settings == same_settings or not ("--tolerance" in asked and "--tolerance" in offered(command))


ONLY_SEEN = {
    "--colormap": "heat", "--norm": "log", "--range": "1,2", "--background": "transparent", "--part-type": "gas:inferno",
    "--title": "T", "--annotate": None, "--axes": None, "--dpi": "300", "--font-size": "9", "--length-unit": "kpc",
    "--contours": "heat", "--preset": "density", "--transfer": "t.json", "--panels": None,
}  # fmt: skip
"""What only changes a picture."""


@pytest.mark.parametrize("out", ["project .npy", "project .fits", "project .exr", "project", "slice .npy", "slice .fits"])
def test_what_only_changes_a_picture_is_refused_for_numbers(out, capsys):
    command, _, suffix = out.partition(" ")
    for option, value in ONLY_SEEN.items():
        if option in offered(command):
            words = [option, *([] if value is None else [value]), *(["-o", f"o{suffix}"] if suffix else [])]
            assert f"{option}{' TYPE:LOOK' * (option == '--part-type')} is for a picture: name one with -o OUT.png" in refused(
                capsys, command, "gone.hdf5", *words
            )


def test_what_a_mesh_does_not_have_is_refused_by_name(capsys):
    meshed = {"--color-by", "--support", "--kernel", "--box-size", "--where", "--share", "--frame", "--physical"}
    meshed |= {"--part-type", "--smoothing", "--surface", "--surface-of"}
    for option in sorted(offered("render") & {*GROUPS} - meshed):
        words, others, _ = said(option, *GROUPS[option])
        words = [*words, "--eye", "2,2,6"] if option in ("--target", "--fov") else words
        more = [*others, "--tolerance", "0.1"] if option == "--relax" and "--tolerance" not in others else others
        assert refused(capsys, "render", "gone.hdf5", *more, *words, "--cell", "0.1", "-o", "o.ply")


def test_what_a_saved_function_does_not_have_is_refused_by_name(folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    for option in sorted(offered("transfer") & {*GROUPS}):
        words, others, _ = said(option, *GROUPS[option])
        told = refused(capsys, "transfer", "t.json", *others, *words)
        assert "this is a saved function" in told


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ("render gone --estimator pilot", "--estimator is of a tolerance: give --tolerance T"),
        ("explain gone --pixel 1,1 --relax 0.5", "--relax is of a tolerance"),
        ("view gone --screen quadtree", "--screen is of a tolerance"),
        ("render gone --tolerance 0.1 --integrator segments --relax 0.1", "--relax and --integrator segments exclude each other"),
        ("movie gone --orbit 9 --tolerance 0.1 --estimator pilot --relax 1", "--relax and --estimator pilot exclude each other"),
        ("render gone --tolerance 0.1 --progressive --estimator interval", "--estimator interval and --progressive exclude"),
        ("render gone --mix opacity", "--mix is of what shares a picture: add --points or --volume"),
        ("movie gone --orbit 9 --gaps", "--gaps is of a sequence of files"),
        ("info gone --part-type gas:heat", "nothing is drawn"),
        ("render gone --surface 0.3 --exposure 2", "--exposure and --surface exclude each other: a surface has no extinction"),
        ("view gone --surface-of u --optical-depth 2", "--optical-depth and --surface-of exclude each other"),
        ("render gone --iso 1 --norm log", "--norm and --iso exclude each other"),
        ("render gone --part-type gas:heat --transfer t.json", "--transfer and --part-type TYPE:LOOK exclude each other"),
        ("slice gone --plane 0,0,0,1,0,0 --fov 9", "--fov and --plane exclude each other: a plane is seen by parallel rays"),
        ("slice gone other --difference --preset density", "--preset and --difference exclude each other"),
        ("project gone other --difference --colormap heat -o o.npy", "--colormap is for a picture"),
        ("explain --points gone --pixel 1,1 --where x>1", "--where is for FILE or scene:NAME"),
        ("info --volume gone --physical", "--physical is for FILE or scene:NAME"),
        ("render gone --contours u -o o.exr", "--contours is for a picture"),
        ("movie gone other --part-type gas,stars", "--part-type must be one type of particles for a sequence, got 'gas,stars'"),
        ("view gone other --part-type gas,stars", "--part-type must be one type"),
        ("movie gone other --center mass", "--center mass"),
        ("render gone --part-type gas,stars --surface 1 -o o.ply", "--part-type must be one type without a look for a mesh"),
        ("render gone --frame fast", "--frame must be one of"),
    ],
)  # fmt: skip
def test_what_would_do_nothing_is_refused_before_a_file_is_read(words, told, empty, capsys):
    assert told in refused(capsys, *words.split())


def test_a_sequence_in_a_period_has_what_is_asked_for_in_the_middle(handed, capsys):
    for center in ("2.4,2,2", "densest"):
        assert "enough" in run(capsys, *SEQUENCE[:-4], "-o", "o.mp4", "--center", center, "--width", "1", "--view", "z")[2][-1]
        camera, place = handed[-1][0][1][0], handed[-1][0][0][0]().particle_set.bounds()
        wanted = np.mean(place, 0) if center == "densest" else (2.4, 2, 2)
        np.testing.assert_allclose(camera.exact_eye()[:2], wanted[:2], atol=1e-4)


def test_a_center_beside_a_target_is_refused_where_nothing_repeats(here, capsys):
    words = ["a.npz", *SMALL, "--eye", "0,0,9", "--target", "0,0,0", "--center", "0.1,0,0"]
    assert "--center and --target exclude each other" in refused(capsys, "render", *words)
