"""Which particles and where, on the command line: what each option shows, and how what is wrong is refused."""

import jax.numpy as jnp
import numpy as np
import pytest
from commanded import refused, run

import jaxsph as js
from jaxsph import io

TINY = ["--size", "24x16", "--samples", "16"]
pytestmark = pytest.mark.usefixtures("quick_programs")
PLACES = np.random.default_rng(1).uniform(-0.3, 1.3, (2000, 3))


@pytest.fixture
def file(empty):
    """Particles of a unit box in an otherwise empty working directory."""
    position = np.random.default_rng(0).uniform(0, 1, (80, 3)).astype(np.float32)
    columns = {"temperature": 10 ** (4 * position[:, 0]), "pressure": position[:, 1], "support": np.full(80, 0.25, np.float32)}
    np.savez("box.npz", position=position, **columns)
    return "box.npz"


def made(capsys, file, *arguments):
    """What the command said, and the header of its picture."""
    code, out, err = run(capsys, "render", file, "-o", "out.exr", *TINY, *arguments)
    assert (code, err) == (0, []), err
    return out, dict(io.read_image("out.exr").metadata)


def test_a_condition_and_a_share_choose_particles_and_are_said_and_kept(file, seen, capsys):
    out, kept = made(capsys, file, "--where", "temperature > 1e2 and pressure < 0.7", "--quantity", "pressure")
    with np.load(file) as stored:
        some = (stored["temperature"] > 1e2) & (stored["pressure"] < 0.7)
        np.testing.assert_array_equal(seen.scene.particles.to_numpy()["position"], stored["position"][some])
    assert "left out by temperature > 1e2" in out and "left out by pressure < 0.7" in out
    assert kept["jaxsph.where"] == "temperature > 1e2 and pressure < 0.7"
    out, kept = made(capsys, file, "--share", 0.5)
    assert seen.scene.particles.num_particles == 40
    assert "40 of 80 particles, for a quick look: their field is another one" in out and kept["jaxsph.share"] == 0.5


def box_of(place):
    return ((place >= (0, 0, 0)) & (place <= (0.6, 0.7, 0.5))).all(-1)


def ball_of(place, center=(0.5, 0.5, 0.9), radius=0.4):
    return np.linalg.norm(place - center, axis=-1) <= radius


CLIPPED = {
    "plane": (["--clip", "plane:0.5,0.5,0.5,1,0,-1"], lambda place: (place - 0.5) @ (1, 0, -1) >= 0),
    "inside of a box": (["--clip", "box:0,0,0,0.6,0.7,0.5"], box_of),
    "outside of a box": (["--clip", "~box:0,0,0,0.6,0.7,0.5"], lambda place: ~box_of(place)),
    "inside of a sphere": (["--clip", "sphere:0.5,0.5,0.9,0.4"], ball_of),
    "outside of a sphere": (["--clip", "~sphere:0.5,0.5,0.9,0.4"], lambda place: ~ball_of(place)),
    "several": (
        ["--clip", "~sphere:0.2,0.2,0.9,0.3", "--clip", "~sphere:0.8,0.8,0.9,0.3", "--clip", "plane:0,0,0.1,0,0,1"],
        lambda place: (place[:, 2] >= 0.1) & ~ball_of(place, (0.2, 0.2, 0.9), 0.3) & ~ball_of(place, (0.8, 0.8, 0.9), 0.3),
    ),
}


@pytest.mark.parametrize("name", CLIPPED)
def test_each_clip_shows_its_part_of_space(file, seen, capsys, name):
    arguments, truth = CLIPPED[name]
    _, kept = made(capsys, file, *arguments)
    found = np.asarray(seen.scene.within.contains(tuple(jnp.asarray(PLACES.T, jnp.float32))))
    np.testing.assert_array_equal(found, truth(PLACES))
    assert 0.02 < found.mean() < 0.98
    assert kept["jaxsph.clip"] == " ".join(arguments[1::2])


def test_the_camera_frames_what_boxes_and_spheres_leave(file, seen, capsys):
    made(capsys, file)
    whole = seen.camera
    made(capsys, file, "--clip", "box:0.4,0.4,0.4,0.6,0.6,0.6")
    near, far = (np.linalg.norm(camera.exact_eye() - 0.5) for camera in (seen.camera, whole))
    assert near < 0.3 * far and abs(np.asarray(seen.camera.axes)[2] @ (0.5 - seen.camera.exact_eye()) / near - 1) < 1e-2
    made(capsys, file, "--clip", "plane:0.5,0.5,0.5,1,0,0")
    assert np.linalg.norm(seen.camera.exact_eye() - (0.75, 0.5, 0.5)) < far  # what is lit is half of it, around x = 0.75


def test_a_box_and_its_middle_are_those_asked_for(file, seen, capsys):
    out, _ = made(capsys, file, "--box-size", "1,1,1")
    assert "periodic box of 1 x 1 x 1" in out
    np.testing.assert_allclose(seen.scene.particles.box.corners(), [(0, 0, 0), (1, 1, 1)])
    assert made(capsys, file)[0].count("periodic") == 0 and seen.scene.particles.box is None
    out, _ = made(capsys, file, "--box-size", "1,1,1", "--center", "0.9,0.25,-0.5")
    assert "0.9 0.25 -0.5" in out
    lower, upper = seen.scene.particles.bounds()
    np.testing.assert_allclose((lower + upper) / 2, (0.9, 0.25, -0.5), atol=1e-6)
    place = seen.scene.particles.to_numpy()["position"]
    assert (place >= lower - 1e-6).all() and (place <= upper + 1e-6).all()
    for middle in ([0.9, 0.25, -0.5], ["densest"]):  # FILE may come after it
        assert run(capsys, "render", "-o", "out.exr", *TINY, "--box-size", "1,1,1", "--center", *middle, file)[0] == 0
    densest = io.read_scene(file, box=(1, 1, 1), center="densest")[0].particles.bounds()
    np.testing.assert_allclose(seen.scene.particles.bounds(), densest)


def test_the_box_of_a_file_can_be_left_aside(empty, seen, capsys):
    h5py = pytest.importorskip("h5py")
    with h5py.File("a.hdf5", "w") as file:
        file.create_group("Header").attrs.update({"BoxSize": 1.0, "NumPart_ThisFile": [30, 0, 0, 0, 0, 0]})
        part = file.create_group("PartType0")
        part["Coordinates"] = np.random.default_rng(0).uniform(0, 1, (30, 3))
        part["SmoothingLength"], part["Density"] = np.full(30, 0.3), np.linspace(1, 2, 30)
    made(capsys, "a.hdf5")
    assert seen.scene.particles.box is not None
    made(capsys, "a.hdf5", "--box-size", "none")
    assert seen.scene.particles.box is None


def test_a_slice_is_written_as_values_or_as_a_picture(file, by_reference, capsys):
    plane = ["--plane", "0.5,0.5,0.5,0,0,1", "--color-by", "pressure", "--size", "24x16"]
    for name in ("a.npy", "a.exr", "a.png"):
        code, out, err = run(capsys, "slice", file, "-o", name, *plane)
        assert (code, err) == (0, []) and "of the pixels inside of supports" in out and out.count("y; --up 0,0,1 has z") == 1
    particles = io.read_particles(file, "pressure")
    expected = js.slice(particles, js.Plane((0.5, 0.5, 0.5), (0, 0, 1)), width=24, height=16)
    np.testing.assert_allclose(np.load("a.npy"), expected.values, atol=1e-6)
    assert np.asarray(io.read_image("a.png").color).max() > 0.3


def test_a_slice_between_two_blocks_goes_to_the_nearest_particles(empty, by_reference, capsys):
    place = np.random.default_rng(0).uniform(0, 1, (80, 3)) + np.where(np.arange(80) % 2, 0, 3)[:, None] * [0, 0, 1]
    np.savez("blocks.npz", position=place, heat=place[:, 0], support=np.full(80, 0.3))
    code, out, _ = run(capsys, "slice", "blocks.npz", "--color-by", "heat", "--size", "16x16", "-o", "a.npy")
    nearest = np.abs(place[:, 2] - np.median(place[:, 2])).min()
    assert code == 0 and "moved by" in out and "to the nearest particles" in out
    assert abs(float(out.split("moved by ")[1].split()[0]) - nearest) < 0.3 and np.isfinite(np.load("a.npy")).mean() > 0.2


def test_a_slice_of_a_density_is_the_sum_of_masses_over_kernels_unless_the_mean_is_asked_for(empty, capsys):
    rng = np.random.default_rng(0)
    position, mass, density = rng.uniform(0, 1, (80, 3)), rng.uniform(1, 2, 80), rng.lognormal(0, 1, 80)
    np.savez("gas.npz", position=position, mass=mass, density=density, heat=density, support=np.full(80, 0.25))
    particles, plane = io.read_particles("gas.npz", "density"), ["--plane", "0.5,0.5,0.5,0,0,1", "--size", "24x16", "-o", "a.npy"]
    for more, of, said in (
        (["density"], {"of": mass, "normalised": False}, "mass summed over kernels; --field mean"),
        (["log10:density"], {"of": mass, "normalised": False}, "mass summed over kernels"),
        (["density", "--field", "mean"], {}, "the normalised mean of density, whose sum --field sum has"),
        (["heat"], {}, "the normalised mean of heat"),
        (["log10:heat"], None, "the normalised mean of log10:heat"),
        (
            ["heat", "--field", "sum"],
            {"of": density * particles.to_numpy()["volume"], "normalised": False},
            "heat times volume summed",
        ),
    ):
        code, out, err = run(capsys, "slice", "gas.npz", *plane, "--color-by", *more)
        assert (code, err) == (0, []) and said in out
        shown = io.read_particles("gas.npz", more[0]) if of is None else particles
        expected = js.slice(shown, js.Plane((0.5, 0.5, 0.5), (0, 0, 1)), width=24, height=16, **of or {}).values
        if of is not None and "log10" in more[0]:
            expected = np.log10(np.where(expected > 0, expected, np.nan))
        np.testing.assert_allclose(np.nan_to_num(np.load("a.npy")), np.nan_to_num(expected), rtol=1e-5, atol=1e-5)


def test_info_says_what_would_be_left(file, capsys):
    code, out, err = run(capsys, "info", file, "--where", "pressure < 0.5", "--box-size", "1,1,1")
    assert (code, err) == (0, []) and "left out by pressure < 0.5" in out and "periodic box of 1 x 1 x 1" in out


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--clip", "plane:0,0,0,0,0,0"], "--clip: plane:0,0,0,0,0,0: normal must not be (0, 0, 0)"),
        (["--clip", "box:0,0,0,1,-1,1"], "--clip: box:0,0,0,1,-1,1: lower must be below upper"),
        (["--clip", "~sphere:0,0,0,-1"], "--clip: ~sphere:0,0,0,-1: radius must be > 0"),
        (["--clip", "sphere:0,0,nan,1"], "center must be finite"),
        (["--clip", "spere:0,0,0,1"], "did you mean sphere?"),
        (["--clip", "box:5,5,5,6,6,6"], "nothing is inside of --clip; there is something from"),
        (["--clip", "none", "--clip", "box:0,0,0,1,1,1"], "--clip: none stands alone"),
        (["--where", "entropy > 1"], "no quantity 'entropy'; there are temperature, pressure"),
        (["--where", "temperature >"], "the condition 'temperature >' is not understood at its end"),
        (["--where", "temperature > 1 and (pressure"], "at character 21, '(pressure'"),
        (["--share", 0], "--share must be above 0 and at most 1, got 0"),
        (["--share", 2], "--share must be above 0 and at most 1, got 2"),
        (["--box-size", "1,0,1"], "--box-size must be three lengths > 0 as LX,LY,LZ, or none, got '1,0,1'"),
        (["--center", "9,9,9"], "--center = 9 9 9 is outside of everything: that lies from"),
        (["--center", "middle"], "--center must be X,Y,Z, densest or mass, got 'middle'"),
        (["--center", "densets"], "did you mean densest?"),
        (["--center", "0,0"], "--center must be X,Y,Z, densest or mass, got '0,0'"),
        (["--box-size", "1,1,1", "--center", "inf,0,0"], "--center must be"),
        (["--width", "0"], "--width must be > 0 and finite, got 0"),
        (["--width", "-3 kpc"], "--width must be > 0 and finite, got -3"),
        (["--width", "wide"], "--width must be a length, such as 30 or '30 kpc', got 'wide'"),
        (["--width", "3 kpc"], "--width = '3 kpc' has a unit, but the file does not state that of its lengths"),
        (["-o", "a.npy"], "an image must be .exr or .png"),
    ],
)
def test_wrong_usage_is_told_in_one_line(file, seen, capsys, arguments, said):
    assert said in refused(capsys, "render", file, *TINY, *arguments)


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        (["--plane", "0,0,0,0,0,0"], 2, "--plane: 0,0,0,0,0,0: normal must not be (0, 0, 0)"),
        (["--plane", "0,0,0,0,0,1", "-o", "a.jpg"], 2, "an image must be .exr or .npy or .fits or .png"),
        (["--plane", "0,0,9,0,0,1"], 1, "no particle reaches the plane; there are particles from"),
        (
            ["--plane", "1,1,-0.2,0,0,1", "--size", "1x1", "--width", "1"],
            1,
            "no pixel is inside of a support: give a larger --size; there",
        ),
        (["--plane", "0,0,0,0,0,1", "--view", "x"], 2, "--plane and --view exclude each other"),
        (["--tolerance", "1"], 2, "Unknown option: --tolerance"),
        (["-o", "key.npy", "--annotate"], 2, "--annotate is for a picture"),
    ],
)
def test_slices_that_cannot_be_are_told_in_one_line(file, by_reference, capsys, arguments, code, said):
    found, _, err = run(capsys, "slice", file, *TINY[:2], *arguments)
    assert found == code and len(err) == 1 and said in err[0], err


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--where", "temperature > 10 and pressure > 2"], "80 left out by pressure > 2; --where must leave some"),
        (["--box-size", "0.2,1,1"], "no side shorter than the largest support, but 0.2 < 0.25"),
    ],
)
def test_work_that_cannot_be_done_is_told_in_one_line(file, capsys, arguments, said):
    code, _, err = run(capsys, "render", file, *TINY, *arguments)
    assert code == 1 and len(err) == 1 and said in err[0], err


@pytest.mark.parametrize("option", [["--where", "x > 0"], ["--share", 0.5], ["--box-size", "1,1,1"]])
def test_options_of_particle_files_are_not_for_scenes_and_volumes(empty, capsys, option):
    np.save("a.npy", np.zeros((4, 4, 4), np.float32))
    for source in ("scene:radial", "a.npy"):
        code, _, err = run(capsys, "render", source, *TINY, *option)
        assert code == 2 and len(err) == 1 and option[0] in err[0]


def test_a_slice_of_particles_with_a_density_has_colours_of_one_quantity(empty, capsys, by_reference):
    generator = np.random.default_rng(0)
    density = generator.lognormal(0, 3, 80).astype(np.float32)
    np.savez("a.npz", position=generator.uniform(0, 1, (80, 3)), density=density, heat=density**0.5, support=np.full(80, 0.25))
    code, out, err = run(capsys, "slice", "a.npz", "--color-by", "heat", *TINY[:2], "-o", "a.png")
    assert (code, err) == (0, []) and "heat" in out and "opacity" not in out
