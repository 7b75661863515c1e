"""The README and the pages keep their word: Python runs as pasted, commands and files exist, numbers were measured."""

import functools
import json
import re
from pathlib import Path

import jax
import numpy as np
import pytest
from forced import ran
from tools import tool

from jaxsph import io, scenes
from jaxsph.cli import main as cli

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text(encoding="utf-8")
FILES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
PAGES = {str(file.relative_to(ROOT)): file.read_text(encoding="utf-8") for file in FILES}
MADE = {"mine.py", "count.py", "test_mine.py", "test_count.py", "my_reader.py"}  # by who follows a recipe
SHELL = "".join(block for page in PAGES.values() for block in re.findall(r"```sh\n(.*?)```", page, re.DOTALL))
INLINE = [line for page in PAGES.values() for line in re.findall(r"`(jaxsph \w+[^`\n]*)`", page)]
COMMANDS = [line for line in [*re.findall(r"^(jaxsph \w+[^#\n]*)", SHELL, re.MULTILINE), *INLINE] if "COMMAND" not in line]
ELSEWHERE = "docs/extending.md", "docs/for_jax_users.md", "docs/gradients.md", "docs/viewing.md"  # pages whose blocks others run
BLOCKS = {
    f"{name}:{number}": block
    for name, page in PAGES.items() if name not in ELSEWHERE
    for number, block in enumerate(re.findall(r"```python\n(.*?)```", page, re.DOTALL))
}  # fmt: skip
GUIDES = "README.md", "CONTRIBUTING.md", "docs/extending.md", "docs/packaging.md"  # which name files of this package
RESULTS = ROOT / "benchmarks" / "results"


def smaller(code):
    """The same code with fewer particles, pixels and samples."""
    for many, few in (("20_000", "300"), ("5000", "300"), ("256", "24"), ("128", "16")):
        code = code.replace(many, few)
    return code


@functools.cache
def helped(command):
    """What the help of a command says."""
    page = tool("docs", "write_command_line")
    return "\n".join(page.told(command))


@pytest.mark.notebook
@pytest.mark.parametrize("block", BLOCKS.values(), ids=BLOCKS)
def test_python_blocks_run_as_pasted(block, empty, tmp_path):
    exec(compile(smaller(block), "README.md", "exec"), {})
    assert not re.search(r'"[\w{:}]+\.png"', block) or list(tmp_path.glob("*.png"))
    assert not jax.config.jax_enable_x64


@pytest.mark.notebook
def test_the_page_of_gradients_runs_as_pasted(empty):
    blocks = re.findall(r"```python\n(.*?)```", PAGES["docs/gradients.md"], re.DOTALL)
    known = {}
    exec(compile(smaller("\n".join(blocks)), "gradients.md", "exec"), known)
    assert len(blocks) == 2
    for name in ("scene.particles.position", "camera.eye", "camera.turn"):
        assert not np.allclose(known["unknown"][name], known["numbers"][name] + 0.01, rtol=0, atol=1e-5)


@pytest.mark.notebook
def test_the_page_for_users_of_jax_runs_as_pasted():
    """All of its blocks, one after the other."""
    blocks = re.findall(r"```python\n(.*?)```", PAGES["docs/for_jax_users.md"], re.DOTALL)
    told = "import json\nprint(json.dumps([float(value), list(images.color.shape)]))"
    value, shape = ran("\n".join([*blocks, told]), devices=1)  # compiled quickly
    assert len(blocks) == 5 and value > 0 and shape == [2, 16, 16, 3]


def test_there_are_blocks_to_run():
    assert len(BLOCKS) == 13 and all(len(block.split("\n")) <= 20 for block in BLOCKS.values())
    example, gradient = (re.findall(r"^.*\S", block, re.MULTILINE) for name, block in BLOCKS.items() if name.startswith("README"))
    assert len(example) <= 10 and len(gradient) <= 8


def test_the_readme_is_read_in_a_minute():
    lines = README.splitlines()
    assert len(lines) <= 150 and max(map(len, lines)) <= 160


def test_pictures_and_files_that_are_named_exist():
    for name, page in PAGES.items():
        for path in re.findall(r"!\[[^]]*\]\(([^)]+)\)", page) + re.findall(r'<img src="([^"]+)"', page):
            assert ((ROOT / name).parent / path).stat().st_size < 1_000_000, path
    assert (ROOT / "docs" / "gallery" / "front.jpg").stat().st_size < 200_000
    places = [ROOT / place for place in (".", "jaxsph", "jaxsph/engine", "jaxsph/scenes")]
    for path in re.findall(r"`(?:python )?([\w/]+\.(?:py|json|cff))", "".join(PAGES[name] for name in GUIDES)):
        assert Path(path).name in MADE or any((place / path).exists() for place in places), path


def test_links_from_page_to_page_lead_somewhere():
    """To files, and to headings as GitHub and the site call them."""
    for name, page in PAGES.items():
        for path, place in re.findall(r"\]\((?!https?:)([^)#]*)(?:#([^)]*))?\)", page):
            file = ((ROOT / name).parent / path) if path else ROOT / name
            assert file.exists(), f"{name}: {path}"
            if place:
                headings = re.findall(r"^#+ (.*)$", file.read_text(encoding="utf-8"), re.MULTILINE)
                known = {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}
                assert place in known, f"{name}: {path}#{place}"


def test_commands_and_targets_that_are_named_exist():
    commands = {line.split()[1] for line in COMMANDS}
    assert {"render", "info", "sweep"} <= commands <= cli.COMMANDS.keys()
    makefile = (ROOT / "Makefile").read_text()
    targets = set(re.findall(r"`make ([a-z-]+)", "".join(PAGES.values())))
    assert {"demo", "test", "setup", "docs"} <= targets
    for target in targets:
        assert re.search(rf"^{target}:", makefile, re.MULTILINE), target


def test_options_that_are_named_exist():
    for line in COMMANDS:
        _, command, *arguments = line.split()
        options = [argument for argument in arguments if re.fullmatch(r"--[\w-]+", argument)]
        assert all(option in helped(command) for option in options if option != "--help"), line


def test_evaluations_that_are_said_to_be_saved_were_measured():
    """Of each scene at 512 x 512 and a tolerance of 0.004."""
    records = json.loads((RESULTS / "pilot.json").read_text())["records"]
    page = PAGES["docs/error_control.md"]
    (sentence,) = re.findall(r"At 512 x 512 and 0.004 that takes (.*?) fewer kernel evaluations", page, re.DOTALL)
    said = {name.strip(): float(times) for times, name in re.findall(r"([\d.]+)(?: times)? \(([^)]+)\)", sentence)}
    assert len(said) == 4
    for name, times in said.items():
        (record,) = (
            row for row in records
            if (row["size"], row["tolerance"], row["variant"]) == (512, 0.004, "pilot") and row["scene"].replace("_", " ") in name
        )  # fmt: skip
        assert round(record["evaluations_saved"], 1) == times, name


def test_errors_and_times_of_the_readme_were_measured():
    def results(name):
        return json.loads((RESULTS / f"{name}.json").read_text())

    def row(*words):
        return next(line for line in README.splitlines() if line.startswith("|") and all(word in line for word in words))

    built_in = [scene for scene in results("truth")["scenes"] if scene["scene"] in scenes.names()]
    assert len(built_in) == 6
    for kind, tolerance, line in (("samples", None, row("default, 256 points")), ("segments", 0.01, row("--tolerance 0.01"))):
        worst = [
            one["p999"] for scene in built_in for one in scene["rows"]
            if (one["integrator"], one["samples"], one["tolerance"]) == (kind, 256, tolerance)
        ]  # fmt: skip
        assert f"{min(worst):.3f} to {max(worst):.3f}" in line
    mixer = next(scene for scene in built_in if scene["scene"] == "mixer")["rows"]
    kept = next(one for one in mixer if (one["integrator"], one["tolerance"]) == ("segments", 0.01))
    told = [f"{kept['p999']:.3f}", f"{kept['seconds']:.2f}", f"{kept['points_time']:.2f}"]
    assert told == re.findall(r"0\.\d+(?= of the| s\b)", row("points alone"))
    frames = results("first_frames")["medians"]
    assert f"{frames['full rate']['next']:.2f} s" in row("43,740 particles")
    times = frames["full rate, compiled before"]["process"], frames["full rate"]["process"]
    assert [f"{time:.1f} s" for time in times] == re.findall(r"[\d.]+ s\b", row("never compiled"))
    ours, theirs = (
        next(one for one in results("vtk_grid")["records"] if one["scene"] == "mixer" and one["contender"] == name)
        for name in ("jaxsph, full rate", "VTK, 256 nodes")
    )
    assert [f"{ours['total']:.2f} s", f"{theirs['total']:.0f} s"] == re.findall(r"[\d.]+ s\b", row("VTK by a grid"))
    assert round(theirs["mean_error"] / ours["mean_error"]) == 5
    gradient = next(one for one in results("gradients")["frames"] if one["size"] == 512)
    assert f"takes {gradient['backward_to_frame']:.1f} times as long as a picture" in README


def test_the_table_of_accesses_has_the_figures_of_its_benchmark():
    told = [line for line in PAGES["docs/accuracy_and_limits.md"].splitlines() if line.startswith("| octree")]
    ratios = [row["ratio"] for row in json.loads((RESULTS / "access.json").read_text())["object space"]["rows"].values()]
    figures = [float(figure) for line in told for figure in re.findall(r"[\d.]+", line.split("|")[2])]
    assert figures == [float(f"{ratio:.2g}") for ratio in ratios]


@pytest.mark.parametrize(("name", "folder"), [("report", "benchmarks"), ("write_command_line", "docs")])
def test_pages_that_are_written_are_what_their_programs_make_of_results_and_commands(name, folder):
    writer = tool(folder, name)
    assert writer.PAGE.read_text(encoding="utf-8") == writer.page(), f"python {folder}/{name}.py"


def test_every_scene_and_format_is_named():
    page = PAGES["docs/files.md"]
    assert all(f"`{name}`" in page for name in scenes.names())
    table = page[page.index("## Files of particles") : page.index("## Files that are written")]
    named = {*re.findall(r"`(\.\w+)`", table), ".gadget"}
    assert {suffix for form in io.FORMATS for suffix in form.suffixes[:1]} <= named
