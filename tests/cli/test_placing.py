"""One door for cameras: the same options place the same camera in every command that offers them, and in Python."""

import itertools

import numpy as np
import pytest

import jaxsph as js
from jaxsph.cli import main as cli
from jaxsph.cli.commands import checks, columns, data, movie, planes, sweep, view

SIZE = (24, 16)
AT = {"center": (0.5, -0.25, 0.125), "width": 0.75}
PLACED = {
    **{name: {"view": name} | AT for name in ("x", "y", "z", "iso", "face-on", "edge-on")},
    "a direction": {"view": (1.0, -2.0, 0.5)} | AT,
    "up": {"view": "y", "up": (1.0, 0.0, 1.0)} | AT,
    "up along the line of sight": {"view": (0.0, 0.0, 2.0), "up": (0.0, 0.0, 1.0)} | AT,
    "the densest": {"view": "x", "center": "densest", "width": 2},
    "where masses are": {"view": "iso", "center": "mass", "width": "1.5"},
    "all": {"view": "z", "width": "all"},
    "all of a direction": {"view": (1.0, 1.0, 0.0), "width": "all", "center": (0.1, 0.2, 0.3)},
    "narrow": {"view": "iso", "fov_degrees": 12.0} | AT,
    "eye": {"eye": (1.0, 2.0, 7.0), "fov_degrees": 20.0},
    "eye and target": {"eye": (1.0, 2.0, 7.0), "target": (0.0, 0.5, 0.0), "up": (1.0, 0.0, 0.0)},
    "eye and center": {"eye": (1.0, 2.0, 7.0), "center": (0.0, 0.5, 0.0)},
}
COMMANDS = {
    "render": ([], js, "render", 1),
    "explain": (["--pixel", "1,1"], checks, "explained", 1),
    "transfer": ([], data, "transfer_figure", 2),
    "sweep": (["-o", "out"], sweep, "measured", 1),
    "view": (["--no-browser"], view, "Session", 1),
    "project": ([], columns, "projected", 2),
    "movie": (["--orbit", "9", "--frames", "2"], movie, "render_frames", 1),
    "slice": ([], planes, "slice_of", None),
}
"""What more each needs, and what is handed its camera: in which place."""


class EnoughError(ValueError):
    """The camera was handed on."""


@pytest.fixture
def handed(empty, monkeypatch):
    """What commands hand on instead of drawing: particles that turn are in an otherwise empty working directory."""
    position = np.random.default_rng(0).normal(size=(60, 3)).astype(np.float32)
    turning = np.cross((0.2, 0.9, 0.4), position) + 0.1 * position[::-1]
    mass = np.linspace(1, 2, 60)
    np.savez("a.npz", position=position, heat=mass, mass=mass, velocity=turning, support=np.full(60, 0.4, np.float32))
    given = []

    def enough(*arguments, **named):
        given.append((arguments, named))
        raise EnoughError("enough")

    for _, module, name, _ in COMMANDS.values():
        monkeypatch.setattr(module, name, enough)
    return given


def words(placed):
    return [
        f"--{name.removesuffix('_degrees')}={value if isinstance(value, str | float | int) else ','.join(map(str, value))}"
        for name, value in placed.items()
    ]


@pytest.fixture(scope="module")
def cameras():
    """Of Python, by the names of their options: the file is always the same."""
    return {}


def camera_of(cameras, name):
    """A camera that may have been placed before."""
    if name not in cameras:
        _, cameras[name] = js.io.read_scene("a.npz", size=SIZE, **PLACED[name])
    return cameras[name]


def placing(camera):
    return camera.exact_eye(), np.asarray(camera.axes), np.asarray(camera.half_height), camera.width, camera.height


@pytest.mark.parametrize(("command", "name"), list(itertools.product(COMMANDS, PLACED)))
def test_the_same_options_are_the_same_camera_in_every_command_and_in_python(command, name, handed, cameras, capsys):
    more, _, _, place = COMMANDS[command]
    code = cli.main([command, "a.npz", "--size", "24x16", *more, *words(PLACED[name])])
    assert (code, len(handed)) == (cli.FAILED, 1), capsys.readouterr().err
    camera = camera_of(cameras, name)
    (arguments, named), (eye, axes, half, *_) = handed[0], placing(camera)
    if command == "slice":
        np.testing.assert_allclose(-np.asarray(arguments[1].normal), axes[2], atol=1e-6)
        np.testing.assert_allclose(np.cross(np.cross(axes[2], named["up"]), axes[2]), axes[1], atol=1e-6)
        away = np.cross(np.asarray(arguments[1].point) - eye, axes[2])
        depth = (np.asarray(arguments[1].point) - eye) @ axes[2] if camera.is_perspective else 1
        assert np.abs(away).max() < 1e-5 and named["view_height"] == pytest.approx(2 * float(half) * depth, rel=1e-5)
        return
    found = arguments[place][0] if command == "movie" else arguments[place]
    for one, other in zip(placing(found), placing(camera), strict=True):
        if command == "movie":  # on its path, which goes around
            np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-4)
        else:
            np.testing.assert_array_equal(one, other)
    if command not in ("project", "movie"):
        assert found.near_and_far() == camera.near_and_far()


@pytest.mark.parametrize("command", COMMANDS)
def test_directions_that_are_none_are_refused_alike(command, handed, capsys):
    for option, said in (("--view=0,0,0", "`view` must be"), ("--view=top", "must be one of iso"), ("--width=0", "must be > 0")):
        code = cli.main([command, "a.npz", "--size", "24x16", *COMMANDS[command][0], option])
        err = capsys.readouterr().err
        assert code == cli.WRONG_USAGE and said.replace("`view`", "--view") in err and not handed
