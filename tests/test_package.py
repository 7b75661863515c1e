"""The package: what is built is the library alone, small, and asks for nothing that it does not use."""

import re
import tomllib
from pathlib import Path

import pytest

import jaxsph

ROOT = Path(__file__).parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
EXTRAS = PROJECT["project"]["optional-dependencies"]
BESIDE = [ROOT / name for name in ("README.md", "CHANGELOG.md", "LICENSE", "CITATION.cff")]
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


def test_what_is_built_is_the_library_alone():
    built = PROJECT["tool"]["hatch"]["build"]["targets"]
    assert built["wheel"]["packages"] == ["jaxsph"]
    assert {path.strip("/") for path in built["sdist"]["include"]} == {"jaxsph", *(file.name for file in BESIDE)}
    assert all(file.exists() for file in BESIDE)


def test_what_is_built_is_small():
    """The wheel takes at most 3 MB: data are packed already, and code takes less there than a part in 2.4 of its size."""
    files = [file for file in (ROOT / "jaxsph").rglob("*") if file.is_file() and "__pycache__" not in file.parts]
    data = sum(file.stat().st_size for file in files if file.suffix == ".npz")
    code = sum(file.stat().st_size for file in files if file.suffix != ".npz")
    assert data + code / 2.4 <= 3_000_000


def test_the_version_has_one_place_that_citations_and_changes_agree_with():
    assert "version" in PROJECT["project"]["dynamic"]
    assert re.search(rf"^version: {re.escape(jaxsph.__version__)}$", (ROOT / "CITATION.cff").read_text(), re.MULTILINE)
    assert re.search(rf"^## {re.escape(jaxsph.__version__)}$", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), re.MULTILINE)


def test_libraries_that_tests_alone_import_come_with_the_tests():
    assert "meshio" in named("test")
