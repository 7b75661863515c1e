"""The package: what is built holds what its users and its tests need, and asks for nothing that it does not use."""

import re
import tomllib
from pathlib import Path

import pytest

import jaxsph

ROOT = Path(__file__).parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
EXTRAS = PROJECT["project"]["optional-dependencies"]
MODULES = {"pynrrd": "nrrd", "imageio-ffmpeg": "imageio_ffmpeg"}  # of projects that are called otherwise


def named(extra):
    return [re.split(r"[<>=\[]", line)[0] for line in EXTRAS[extra]]


def test_type_checkers_are_told_that_there_are_types():
    assert "Typing :: Typed" in PROJECT["project"]["classifiers"]
    assert (ROOT / "jaxsph" / "py.typed").exists()


@pytest.mark.parametrize("extra", ["io", "color", "units", "xarray", "fits", "movie", "cluster"])
def test_an_extra_brings_only_what_the_package_imports(extra):
    code = "\n".join(file.read_text(encoding="utf-8") for file in (ROOT / "jaxsph").rglob("*.py"))
    for project in named(extra):
        module = MODULES.get(project, project)
        assert re.search(rf'^\s*(import|from) {module}\b|require\(\s*"{module}\b', code, re.MULTILINE), project


def test_what_tests_read_is_in_the_source_distribution():
    included = {path.strip("/") for path in PROJECT["tool"]["hatch"]["build"]["targets"]["sdist"]["include"]}
    code = "\n".join(file.read_text(encoding="utf-8") for file in (ROOT / "tests").rglob("*.py"))
    read = {path for path in re.findall(r'(?:ROOT|parent) / "([\w.]+)"', code) if (ROOT / path).exists()}
    assert {"docs", "notebooks", "benchmarks", "Makefile", "README.md"} <= read
    assert read - {"pyproject.toml"} <= included  # that one is always there


def test_the_version_has_one_place_that_citations_and_changes_agree_with():
    assert "version" in PROJECT["project"]["dynamic"]
    assert re.search(rf"^version: {re.escape(jaxsph.__version__)}$", (ROOT / "CITATION.cff").read_text(), re.MULTILINE)
    assert re.search(rf"^## {re.escape(jaxsph.__version__)}$", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), re.MULTILINE)


def test_libraries_that_tests_alone_import_come_with_the_tests():
    assert "meshio" in named("test")
