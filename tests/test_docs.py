"""The README keeps its word: its Python runs as pasted, its commands and files exist."""

import importlib.util
import json
import re
from pathlib import Path

import jax
import pytest
from forced import ran

from jaxsph import io, scenes
from jaxsph.cli import main as cli

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text(encoding="utf-8")
SHELL = "".join(re.findall(r"```sh\n(.*?)```", README, re.DOTALL))
COMMANDS = re.findall(r"^(jaxsph \w+[^#\n]*)", SHELL, re.MULTILINE) + re.findall(r"`(jaxsph \w+[^`]*)`", README)
BLOCKS = re.findall(r"```python\n(.*?)```", README, re.DOTALL)


def smaller(code):
    """The same code with fewer particles, pixels and samples."""
    for many, few in (("20_000", "300"), ("5000", "300"), ("256", "24"), ("128", "16")):
        code = code.replace(many, few)
    return code


@pytest.mark.notebook
@pytest.mark.parametrize("block", BLOCKS, ids=range(len(BLOCKS)))
def test_python_blocks_run_as_pasted(block, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    exec(compile(smaller(block), "README.md", "exec"), {})
    assert list(tmp_path.glob("*.png"))
    assert not jax.config.jax_enable_x64


@pytest.mark.notebook
def test_the_page_for_users_of_jax_runs_as_pasted():
    """All of its blocks, one after the other."""
    page = (ROOT / "docs" / "for_jax_users.md").read_text(encoding="utf-8")
    blocks = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    told = "import json\nprint(json.dumps([float(value), list(images.color.shape)]))"
    value, shape = ran("\n".join([*blocks, told]), devices=1)  # compiled quickly
    assert len(blocks) == 4 and value > 0 and shape == [2, 16, 16, 3]


def test_there_are_blocks_to_run():
    assert len(BLOCKS) == 11 and all(len(block.split("\n")) <= 20 for block in BLOCKS)


def test_pictures_and_files_that_are_named_exist():
    for path in re.findall(r"!\[[^]]*\]\(([^)]+)\)", README):
        assert (ROOT / path).stat().st_size < 300_000
    assert (ROOT / "CITATION.cff").exists()


def test_commands_and_targets_that_are_named_exist():
    commands = {line.split()[1] for line in COMMANDS}
    assert {"render", "info", "sweep"} <= commands
    for command in commands:
        assert cli.main([command, "--help"]) == 0
    makefile = (ROOT / "Makefile").read_text()
    pages = README + (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    targets = set(re.findall(r"`make ([a-z-]+)", pages))
    assert {"demo", "test", "setup"} <= targets
    for target in targets:
        assert re.search(rf"^{target}:", makefile, re.MULTILINE), target


def test_options_that_are_named_exist(capsys):
    for line in COMMANDS:
        _, command, *arguments = line.split()
        assert cli.main([command, "--help"]) == 0
        known = capsys.readouterr().out
        assert all(argument in known for argument in arguments if argument.startswith("--")), line


def test_evaluations_that_the_readme_says_are_saved_were_measured():
    """Of each scene at 512 x 512 and a tolerance of 0.004."""
    records = json.loads((ROOT / "benchmarks" / "results" / "pilot.json").read_text())["records"]
    (sentence,) = re.findall(r"At 512 x 512 and 0.004 that takes (.*?) fewer kernel evaluations", README, re.DOTALL)
    said = {name.strip(): float(times) for times, name in re.findall(r"([\d.]+)(?: times)? \(([^)]+)\)", sentence)}
    assert len(said) == 4
    for name, times in said.items():
        (record,) = (
            row for row in records
            if (row["size"], row["tolerance"], row["variant"]) == (512, 0.004, "pilot") and row["scene"].replace("_", " ") in name
        )  # fmt: skip
        assert round(record["evaluations_saved"], 1) == times, name


def test_the_page_of_results_is_what_the_results_make_of_it():
    spec = importlib.util.spec_from_file_location("report", ROOT / "benchmarks" / "report.py")
    report = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(report)
    assert report.PAGE.read_text(encoding="utf-8") == report.page(), "python benchmarks/report.py"


def test_every_scene_and_format_is_named():
    assert all(f"`{name}`" in README for name in scenes.names())
    table = README[README.index("## Files") : README.index("## Built-in")]
    named = {*re.findall(r"`(\.\w+)`", table), ".gadget"}
    assert {suffix for form in io.FORMATS for suffix in form.suffixes[:1]} <= named
