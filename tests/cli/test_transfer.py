"""Transfer functions and keys on the command line: what is written and said, and how it refuses."""

import json

import numpy as np
import pytest
from commanded import refused, run

import jaxsph as js

TINY = ["--size", "24x16", "--samples", "8"]


@pytest.fixture
def file(empty, tmp_path):
    """A small particle file in an otherwise empty working directory."""
    (tmp_path / "in").mkdir()
    path, rng = tmp_path / "in" / "drop.npz", np.random.default_rng(0)
    position = rng.normal(size=(60, 3)).astype(np.float32)
    columns = {"density": rng.lognormal(0, 3, 60).astype(np.float32), "support": np.full(60, 0.8, np.float32)}
    np.savez(path, position=position, velocity=position, **columns)
    return path


def saved(capsys, file, *arguments):
    """The control values that the command would render with."""
    code, out, err = run(capsys, "transfer", file, "--save", "x.json", "--rays", 9, *arguments)
    assert (code, err) == (0, [])
    return np.array(json.loads(open("x.json").read())["values"]), out


def test_transfer_draws_a_figure_and_saves_a_function_that_render_takes(file, tmp_path, by_reference, capsys):
    pytest.importorskip("matplotlib")
    _, out = saved(capsys, file, "--quantity", "density", "--norm", "log", *TINY[:2])
    assert (tmp_path / "drop_transfer.png").stat().st_size > 1000 and "log," in out
    code, out, err = run(capsys, "render", file, "--quantity", "density", "--transfer", "x.json", "-o", "a.png", *TINY)
    assert (code, err) == (0, []) and "x.json" in out
    code, *_ = run(capsys, "render", file, "--quantity", "density", "--norm", "log", "-o", "b.png", *TINY)
    a, b = (js.io.read_image(tmp_path / name).color for name in ("a.png", "b.png"))
    assert code == 0 and np.array_equal(a, b) and np.asarray(a).max() > 0.2
    assert run(capsys, "transfer", "x.json", "-o", "y.pdf")[0] == 0 and (tmp_path / "y.pdf").exists()


def test_a_range_is_of_the_quantity_or_of_percentages_as_the_domain_has_it(file, capsys):
    pytest.importorskip("matplotlib")
    density = np.load(file)["density"].astype(np.float64)
    values, _ = saved(capsys, file, "--quantity", "density", "--norm", "log", "--range", "0.1,10")
    np.testing.assert_allclose(values, np.geomspace(0.1, 10, 16), rtol=1e-6)
    values, _ = saved(capsys, file, "--quantity", "density", "--norm", "percentile", "--range", "10,90")
    np.testing.assert_allclose(values[[0, -1]], np.percentile(density, [10, 90]), rtol=1e-5)


def test_a_preset_of_a_logarithmic_quantity_takes_no_logarithm_again(file, capsys):
    pytest.importorskip("matplotlib")
    values, out = saved(capsys, file, "--quantity", "log10:density", "--preset", "density")
    np.testing.assert_allclose(np.diff(values), np.diff(values)[0], rtol=1e-4)
    assert "(density)" in out


def test_annotate_writes_a_wider_picture_that_keeps_its_record(file, tmp_path, by_reference, capsys):
    pytest.importorskip("matplotlib")
    from PIL import Image

    code, _, err = run(capsys, "render", file, "--annotate", "-o", "a.png", *TINY)
    assert (code, err) == (0, [])
    with Image.open(tmp_path / "a.png") as opened:
        assert opened.size[0] > opened.size[1] * 24 / 16 > 24 and "jaxsph.camera" in opened.text
    assert run(capsys, "render", "scene:mixer:particles=40", "--annotate", "-o", "b.png", *TINY)[0] == 0


def test_a_volume_has_domains_and_a_key_too(empty, tmp_path, by_reference, capsys):
    pytest.importorskip("matplotlib")
    volume = js.Volume.from_array(np.geomspace(1, 1e4, 64).reshape(4, 4, 4).astype(np.float32), (0, 0, 0), 1.0)
    js.io.write_volume("v.vti", volume)
    code, out, err = run(capsys, "render", "v.vti", "--norm", "log", "--annotate", *TINY)
    assert (code, err) == (0, []) and ", log," in out and (tmp_path / "v.png").exists()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--norm", "loglog"], "linear, log, symlog, percentile, equalised"),
        (["--preset", "soup"], "fluid, density"),
        (["--quantity", "x", "--norm", "log", "--range", "-1,2"], "symlog"),
        (["--quantity", "log10:density", "--norm", "log"], "logarithm already"),
        (["--transfer", "x.json", "--colormap", "heat"], "--transfer says all of a look: leave out --colormap"),
        (["--unit", "kpc"], "does not state"),
        (["--annotate", "--unit", "kpc"], "does not state"),
        (["--annotate", "-o", "a.exr"], ".png"),
        (["--annotate", "--progressive"], "--progressive"),
    ],
)
def test_wrong_usage_is_told_in_one_line(file, capsys, arguments, said):
    assert said in refused(capsys, "render", file, *arguments, *TINY)


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        (["x.json"], 1, "no such file"),
        (["scene:mixer", "-o", "a.jpg"], 2, ".svg"),
        (["scene:mixer", "--save", "a.txt"], 2, ".json"),
        (["scene:mixer", "--rays", "0"], 2, "--rays"),
        (["x.json", "--norm", "log"], 2, "saved function"),
        (["scene:mixer", "-o", "nowhere/a.png"], 1, "no folder"),
    ],
)
def test_the_figure_is_refused_in_one_line(file, capsys, arguments, code, said):
    found, _, err = run(capsys, "transfer", *arguments)
    assert found == code and len(err) == 1 and said in err[0]


def test_info_says_which_units_a_file_states(tmp_path, capsys):
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "x.h5", "w") as stored:
        for name, value in {"hfact": 1.2, "massoftype": [1.0], "udist": 1e16, "umass": 2e33, "utime": 1e10, "time": 2.0}.items():
            stored[f"header/{name}"] = value
        stored["particles/xyz"], stored["particles/h"] = np.eye(3), np.ones(3)
    code, out, _ = run(capsys, "info", tmp_path / "x.h5")
    assert code == 0 and "stated for positions, h, mass, density" in out and "t = " in out


def test_values_that_a_logarithm_leaves_out_are_counted(empty, capsys):
    position = np.random.default_rng(0).normal(size=(60, 3)).astype(np.float32)
    np.savez("drop.npz", position=position, heat=np.arange(60, dtype=np.float32) - 9, support=np.full(60, 0.8, np.float32))
    more = ["--quantity", "heat", "--size", "24x16", "--rays", "9", "--optical-depth", "30"]
    code, out, _ = run(capsys, "transfer", "drop.npz", "--norm", "log", *more)
    assert code == 0 and "10 of 60 values are not positive" in out
    code, out, _ = run(capsys, "transfer", "drop.npz", "--norm", "symlog", *more)
    assert code == 0 and "not positive" not in out
