"""Points and several volumes on the command line: what is put in one picture, what is said of it, and how it refuses."""

import numpy as np
import pytest
from commanded import refused, run
from images import layers

import jaxsph as js
from jaxsph import io
from jaxsph.cli.scene import apart
from jaxsph.model.camera.camera import BoundingBox

pytestmark = pytest.mark.usefixtures("quick_programs")

TINY = ["--size", "24x16", "--samples", "16"]
STARS = "x,y,z,radius,r,g,b,opacity,mass\n0.5,0.5,0.5,0.4,1,0,0,0.9,1\n-0.5,0,0,0.3,0,0,1,0.9,5\n"


@pytest.fixture
def files(empty, tmp_path):
    """Stars in a box of gas, and particles, in the working directory."""
    (tmp_path / "stars.csv").write_text(STARS)
    (tmp_path / "bare.csv").write_text("x,y,z,mass\n0,0,0,1\n0.1,0.2,0.3,5\n")
    (tmp_path / "far.csv").write_text("x,y,z,radius\n1000,0,0,0.1\n1001,0,0,0.1\n")
    x = np.linspace(-1, 1, 9)
    ball = np.clip(1.2 - np.sqrt(x[:, None, None] ** 2 + x[:, None] ** 2 + x**2), 0, 1).astype(np.float32)
    io.write_volume("gas.vti", js.Volume.from_array(ball, (-1, -1, -1), 0.25))
    position = np.random.default_rng(0).normal(size=(60, 3)).astype(np.float32)
    np.savez("drop.npz", position=position, temperature=position[:, 0], support=np.full(60, 0.8, np.float32))
    return tmp_path


def pictured(seen, capsys, *arguments):
    """Scene and camera that `render` gives, what was said, and what there is to be warned of."""
    code, out, err = run(capsys, "render", *arguments, *TINY)
    assert code == 0, err
    return seen.scene, seen.camera, out, err


def ends_of(part, axes):
    """The outermost places of a part: corners of a volume, of balls what is farthest along each axis of the camera."""
    if isinstance(part, js.Volume):
        lower, upper = part.bounds()
        return np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)]) * (upper - lower) + lower
    valid = np.asarray(part.valid)
    radius = np.asarray(part.support if isinstance(part, js.Particles) else part.radius, np.float64)[valid]
    center = np.asarray(part.position, np.float64)[valid]
    return np.concatenate([center + sign * radius[:, None] * axis for axis in axes for sign in (-1, 1)])


def framed(camera, *parts):
    """Whether all of each part is in view, and between near and far."""
    axes = np.asarray(camera.axes, np.float64)
    for part in parts:
        view = (ends_of(part, axes) - camera.exact_eye()) @ axes.T
        aside = np.abs(view[:, :2]) / view[:, 2:] / float(camera.half_height) / (camera.width / camera.height, 1)
        if not ((aside <= 1).all() and (view[:, 2] >= float(camera.near)).all() and (view[:, 2] <= float(camera.far)).all()):
            return False
    return True


@pytest.mark.slow
def test_a_volume_and_points_share_a_picture_that_is_the_references(files, capsys, monkeypatch):
    given, render = [], js.render

    def recorded(scene, camera, settings, **more):
        given.append((scene, camera, settings))
        return render(scene, camera, settings, **more)

    monkeypatch.setattr(js, "render", recorded)
    code, out, err = run(capsys, "render", "gas.vti", "--points", "stars.csv", "-o", "out.exr", *TINY)
    assert (code, err) == (0, [])
    for said in ("stars.csv", "2 points", "columns `r`, `g`, `b`", "column `radius`", "column `opacity`", "9 x 9 x 9 points"):
        assert said in out
    image = io.read_image("out.exr")
    ((scene, camera, settings),) = given
    assert len(scene.volumes) == len(scene.point_sets) == 1 and framed(camera, scene.volumes[0][0], scene.point_sets[0])
    truth = js.reference.render(scene, camera, settings)
    assert np.abs(layers(image) - layers(truth)).max() < 1e-4
    assert truth.alpha.max() > 0.5 and truth.color[..., 0].max() > 0.3


def test_points_alone_need_no_source(files, capsys, by_reference):
    code, out, err = run(capsys, "render", "--points", "stars.csv", *TINY)
    assert (code, err) == (0, []) and (files / "stars.png").stat().st_size > 0 and "2 points" in out


def test_all_parts_are_in_one_scene_and_in_view(files, seen, capsys):
    arguments = ("drop.npz", "--volume", "gas.vti", "--volume", "gas.vti", "--points", "stars.csv", "--points", "stars.csv")
    scene, camera, _, err = pictured(seen, capsys, *arguments, "--mix", "opacity")
    assert scene.particles.num_particles == 60 and len(scene.volumes) == len(scene.point_sets) == 2 and scene.mix == "opacity"
    scene.check()
    assert not err and framed(camera, scene.particles, scene.volumes[0][0], scene.point_sets[0])


@pytest.mark.parametrize("source", ["scene:mixer:particles=300", "gas.vti", None])
def test_any_source_takes_points_and_none_too(files, seen, capsys, source):
    scene, camera, *_ = pictured(seen, capsys, "--points", "stars.csv", *([source] if source else []))
    scene.check()
    assert scene.point_sets[0].num_points == 2 and framed(camera, scene.point_sets[0])


def test_an_iso_surface_takes_points_and_a_camera_that_is_said_is_used(files, seen, capsys):
    arguments = ("gas.vti", "--iso", "0.5", "--points", "stars.csv", "--eye", 0, 0, 9, "--target", 0, 0, 0)
    scene, camera, *_ = pictured(seen, capsys, *arguments)
    assert len(scene.media) == 1 and len(scene.point_sets) == 1
    np.testing.assert_array_equal(camera.exact_eye(), (0, 0, 9))
    assert float(camera.near) < 8.1 and float(camera.far) > 9.9


@pytest.mark.parametrize(
    ("options", "radius", "color", "said"),
    [
        (":radius=0.25", [0.25, 0.25], [(1, 1, 1), (1, 1, 1)], "given by the caller"),
        (":radius=mass,color=1,0.5,0", [1, 5], [(1, 0.5, 0), (1, 0.5, 0)], "column `mass`"),
        (":radius=1,color=mass,colormap=gray", [1, 1], [(32 / 255,) * 3, (1, 1, 1)], "gray over mass"),
    ],
)
def test_radius_colour_and_opacity_are_numbers_or_columns(files, seen, capsys, options, radius, color, said):
    scene, _, out, _ = pictured(seen, capsys, "--points", f"bare.csv{options},opacity=0.5")
    points = scene.points[0]
    np.testing.assert_array_equal(points.radius[:2], radius)
    np.testing.assert_allclose(points.color[:2], color, atol=1e-3)
    np.testing.assert_allclose(np.asarray(points.extinction)[:2] * np.asarray(points.radius)[:2], np.log(2) / 0.833287, rtol=1e-5)
    assert said in out


def test_parts_that_lie_far_apart_are_warned_of_and_pictured(files, seen, capsys):
    scene, camera, _, err = pictured(seen, capsys, "gas.vti", "--points", "far.csv:opacity=0.5")
    assert len(err) == 1 and framed(camera, scene.volumes[0][0], scene.points[0])
    assert err[0].startswith("jaxsph render: warning: gas.vti in [-1, 1] x [-1, 1] x [-1, 1] and far.csv in [999.9, 1001] x")
    assert "lie 998.9 apart: are they in the same units?" in err[0]


def test_info_says_what_would_be_taken(files, capsys):
    code, out, err = run(capsys, "info", "--points", "bare.csv:radius=0.5", "--volume", "gas.vti")
    assert (code, err) == (0, [])
    for said in (
        "2 points",
        "mass",
        "as points",
        "radius    0.5: given by the caller",
        "white",
        "opacity 0.8",
        "9 x 9 x 9",
        "--eye",
    ):
        assert said in out
    assert out.count("camera") == 1
    code, out, err = run(capsys, "info", "gas.vti", "--points", "far.csv")
    assert code == 0 and "--points" not in out and len(err) == 1 and err[0].startswith("jaxsph info: warning: ")


WRONG_USAGE = [
    (["render"], "a particle file, a volume or scene:NAME is needed as FILE, or --points FILE, or --volume FILE"),
    (["info"], "or --points FILE, or --volume FILE"),
    (["render", "--points", "stars.csv:radius=0"], "--points: stars.csv:radius=0: must be a radius > 0, got '0'"),
    (["render", "--points", "stars.csv:radius=nan"], "must be a radius > 0, got 'nan'"),
    (["render", "--points", "stars.csv:opacity=1"], "must be an opacity in [0, 1), got '1'"),
    (
        ["render", "--points", "stars.csv:radus=1"],
        "no option 'radus'; there are type, radius, opacity, color, colormap; did you mean radius?",
    ),
    (["render", "--points", "stars.csv:color=1,2"], "R,G,B from 0 to 1, as in 1,0.5,0, got '1,2'"),
    (["render", "--points", "stars.csv:color=255,0,0"], "got '255,0,0'"),
    (["render", "--points", "stars.csv:color=a,b,c"], "got 'a,b,c'"),
    (["render", "--points", "stars.csv", "--quantity", "mass"], "--color-by is for FILE or scene:NAME, and there is none"),
    (["render", "--points", "stars.csv", "--mix", "sum"], "--mix must be one of extinction, opacity, got 'sum'"),
    (["render", "--points"], "--points needs a value"),
]


@pytest.mark.parametrize(("arguments", "message"), WRONG_USAGE, ids=[" ".join(case[0]) for case in WRONG_USAGE])
def test_wrong_usage_is_exit_code_2_and_one_line(files, capsys, arguments, message):
    assert message in refused(capsys, *arguments)


FAILURES = [
    (["--points", "bare.csv"], "bare.csv: has no radius of its points: there are mass; give `radius=NUMBER` (:radius=R)"),
    (["--points", "stars.csv:color=age"], "`color`: there is no column 'age': there are radius, r, g, b,"),
    (["--points", "stars.csv:type=4"], "have no particle types"),
    (["--points", "stars.csv:type=-1"], "have no particle types"),
    (["--points", "nowhere.csv"], "there is no such file"),
    (["drop.npz", "--volume", "drop.npz"], "volumes are read from .vti"),
    (["--volume", "gas.vti:quantity=rho"], "gas.vti: has no quantity 'rho'"),
]


@pytest.mark.parametrize(("arguments", "message"), FAILURES, ids=[" ".join(case[0]) for case in FAILURES])
def test_failures_are_exit_code_1_and_one_line(files, capsys, arguments, message):
    code, _, err = run(capsys, "render", *arguments, *TINY)
    assert code == 1 and len(err) == 1 and message in err[0]


def test_empty_parts_are_not_framed_and_not_warned_of():
    none = js.Points.from_arrays([], 1.0, opacity=0.5)
    one = js.Points.from_arrays([(100.0, 0, 0)], 1.0, opacity=0.5)
    np.testing.assert_array_equal(BoundingBox.around([none, one]), one.bounds())
    assert not apart([("none", none), ("one", one)]) and not BoundingBox.around([none]).upper.any()


def test_only_boxes_farther_apart_than_they_are_large_are_warned_of():
    def ball(x, radius=1.0):
        return js.Points.from_arrays([(x, 0.0, 0.0)], radius, opacity=0.5)

    assert not apart([("a", ball(0.0)), ("b", ball(5.0))])  # 3 apart, diagonals of 3.46
    assert not apart([("a", ball(0.0)), ("b", ball(6.0, 1.5))])
    assert len(apart([("a", ball(0.0)), ("b", ball(6.0)), ("c", ball(20.0))])) == 3
