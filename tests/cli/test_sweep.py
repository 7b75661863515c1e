"""`jaxsph sweep`: what `js.sweep` measures, as a table and figures in a folder."""

import csv
import sys

import pytest
from commanded import refused, run

import jaxsph as js
from jaxsph.trade.sweep import TABLE

pytestmark = pytest.mark.usefixtures("by_reference")

PARTICLES, WIDTH, HEIGHT, SAMPLES = 200, 24, 16, 16
SOURCE = [f"scene:radial:particles={PARTICLES}", "--size", f"{WIDTH}x{HEIGHT}", "--samples", SAMPLES]
LEAST_WORK = ["--estimators=", "--baselines", "samples/2", "--repeats", 1, "--converged", 1, "--integral", 10]


@pytest.fixture
def rows(by_reference):
    view, settings = js.scenes.load("radial", PARTICLES, width=WIDTH, height=HEIGHT), js.Settings(samples=SAMPLES)
    return js.sweep(*view, settings, estimators=(), baselines=("samples/2",), repeats=1, converged=1, integral=0, name="radial")


def test_the_command_writes_table_and_figures_of_a_sequence(rows, tmp_path, capsys):
    pytest.importorskip("matplotlib")
    code, out, err = run(capsys, "sweep", *SOURCE, "-o", tmp_path / "new" / "out", "--moments", "0,2", *LEAST_WORK)
    assert (code, err) == (0, [])
    names = ("sweep.csv", "error.png", "pareto.png", "integral.png", "frames.png")
    assert sorted(path.name for path in (tmp_path / "new" / "out").iterdir()) == sorted(names)
    assert all(name in out for name in names) and "samples/2" in out and "frame 2" in out
    found = list(csv.DictReader((tmp_path / "new" / "out" / TABLE).open()))
    wanted = [(k, m) for k in (0.0, 2.0) for m in ("full rate", "samples/2")]
    assert [(float(row["frame"]), row["method"]) for row in found] == wanted and "to integral" in out
    assert {float(row["max_error"]) for row in found[1::2]} == {rows[1]["max_error"]}  # it does not move
    assert all(0 < float(row["integral_mean"]) <= float(row["integral_max"]) and row["integral"] == "10" for row in found)


def test_without_matplotlib_the_command_says_so_before_the_work(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with monkeypatch.context() as patch:
        patch.setattr("jaxsph.cli.scene.opened_of", lambda options: pytest.fail("a scene was made"))
        code, _, err = run(capsys, "sweep", *SOURCE, "-o", tmp_path / "out", *LEAST_WORK)
    assert code == 1 and len(err) == 1 and "jaxsph[color]" in err[0] and not (tmp_path / "out").exists()
    assert "is needed for the figures of a sweep" in err[0]
    code, out, err = run(capsys, "sweep", *SOURCE, "-o", tmp_path / "out", *LEAST_WORK, "--no-figures")
    assert (code, err) == (0, []) and "png" not in out and (tmp_path / "out" / TABLE).exists()


def test_a_folder_that_cannot_be_is_exit_code_1_and_one_line(tmp_path, capsys):
    (tmp_path / "taken").write_text("")
    code, _, err = run(capsys, "sweep", *SOURCE, "-o", tmp_path / "taken", *LEAST_WORK, "--no-figures")
    assert code == 1 and len(err) == 1 and "taken" in err[0] and "another one" in err[0]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "-o"),
        (["-o", "out", "--tolerances", "-1"], "--tolerances must be numbers >= 0, got '-1'"),
        (["-o", "out", "--tolerances", "none"], "'none'"),
        (["-o", "out", "--estimators", "exact"], "--estimators must be one of"),
        (["-o", "out", "--baselines", "half"], "samples/2"),
        (["-o", "out", "--repeats", "0"], "at least 1"),
        (["-o", "out", "--integral", "-1"], "at least 0"),
        (["-o", "out", "--integrator", "walks"], "--integrator must be one of"),
        (["-o", "out", "--samples", "0"], "--samples must be"),
        (["-o", "out", "--moments", "1,1"], "different"),
    ],
)
def test_wrong_usage_is_exit_code_2_and_one_line(capsys, arguments, message):
    assert message in refused(capsys, "sweep", "scene:radial", *arguments)


def test_a_frame_and_moments_exclude_each_other(capsys):
    assert "frame of scene:NAME and --moments exclude each other" in refused(
        capsys, "sweep", "scene:radial:frame=1", "-o", "out", "--moments", "1"
    )


def test_a_surface_has_no_tolerances_to_compare(tmp_path, capsys):
    words = [*SOURCE, "-o", tmp_path / "out", "--surface", 0.2, "--no-figures"]
    code, _, err = run(capsys, "sweep", *words, "--estimators", "pilot")
    assert code == 2 and "--surface and --estimators exclude each other" in err[-1]
    scene, camera = js.scenes.load("radial", PARTICLES, width=WIDTH, height=HEIGHT)
    shown = js.Scene(particles=scene.particles, transfer=scene.transfer, surface=js.Surface(0.2))
    with pytest.raises(ValueError, match=r"`estimators` must be \(\)"):
        js.sweep(shown, camera, js.Settings(samples=SAMPLES), estimators=("pilot",))
    code, out, err = run(capsys, "sweep", *words, *LEAST_WORK[1:])
    assert (code, err) == (0, []) and "samples/2" in out
    found = csv.DictReader((tmp_path / "out" / TABLE).open())
    assert [row["method"] for row in found] == ["full rate", "samples/2"]
