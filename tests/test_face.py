"""The names that `jaxsph` has for its users: few, and found when they are used."""

import ast
import importlib
import re
import subprocess
import sys
from pathlib import Path

import pytest

import jaxsph as js
from jaxsph.numerics.names import import_by_name

PACKAGES = ("jaxsph", "jaxsph.scale", "jaxsph.sequence")
ENTRY = re.compile(r'"(jaxsph\.[\w.]+:\w+)"')
LINES = [
    line
    for file in Path(js.__file__).parent.rglob("*.py")
    if file != Path(js.__file__)
    for line in file.read_text(encoding="utf-8").splitlines()
    if ENTRY.search(line)
]
MOST_BY_NAME, LEAST_MILLISECONDS = 12, 50  # imports by name; what each saves where it is not needed
HEAVY = ("jax", "numpy", "scipy", "matplotlib", "h5py", "jaxsph.io", "jaxsph.engine.render", "jaxsph.reference")


def loaded(code):
    """Modules that a process has loaded after some code."""
    told = subprocess.run([sys.executable, "-c", f"import sys\n{code}\nprint(*sys.modules)"], capture_output=True, text=True)
    assert told.returncode == 0, told.stderr
    return set(told.stdout.split())


def test_importing_jaxsph_imports_nothing_that_takes_time():
    assert not loaded("import jaxsph, jaxsph.scale, jaxsph.sequence\ndir(jaxsph)") & set(HEAVY)


def test_things_are_made_without_files_figures_and_the_engine():
    code = "from jaxsph import Image, Settings\nSettings(integrator='segments', screen='quadtree')"
    assert not loaded(code) & {"jaxsph.io", "jaxsph.engine.render", "matplotlib", "scipy"}


def test_methods_are_there_whatever_is_imported_first(tmp_path):
    code = f"""
import numpy as np
from jaxsph.model.image import Image
one = np.ones((2, 2), np.float32)
Image(np.zeros((2, 2, 3), np.float32), one, one, one, one, True, 0, {{}}).save({str(tmp_path / "a.png")!r})
"""
    assert "jaxsph.io" in loaded(code)
    assert (tmp_path / "a.png").exists()


def test_few_imports_are_by_name():
    assert len(LINES) <= MOST_BY_NAME, LINES


@pytest.mark.parametrize("line", LINES)
def test_an_import_by_name_is_there_and_dear(line):
    (entry,), (milliseconds,) = ENTRY.findall(line), re.findall(r"# ([\d,]+) ms", line)
    assert import_by_name(entry) is not None
    assert int(milliseconds.replace(",", "")) > LEAST_MILLISECONDS


@pytest.mark.parametrize("package", PACKAGES)
def test_all_names_are_found_and_known_to_editors(package):
    module = importlib.import_module(package)
    assert [name for name in module.__all__ if getattr(module, name, None) is None] == []
    assert set(dir(module)) == set(module.__all__)
    tree = ast.parse(Path(module.__file__).read_text(encoding="utf-8"))
    typed = next(node for node in tree.body if isinstance(node, ast.If))
    entries = {}
    for node in typed.body:
        for alias in node.names:
            told = f"{node.module}.{alias.name}" if node.module == "jaxsph" else f"{node.module}:{alias.name}"
            entries[alias.name] = told
    assert entries.keys() == set(module.__all__)
    for name, entry in entries.items():
        assert getattr(module, name) is import_by_name(entry)


def test_jaxsph_has_no_other_names():
    with pytest.raises(AttributeError, match="has no attribute 'octree_plans'"):
        js.octree_plans
