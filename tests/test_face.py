"""The names that `jaxsph` has for its users: few, and found when they are used."""

import ast
import importlib
import re
import subprocess
import sys
from pathlib import Path

import pytest

import jaxsph as js
from jaxsph.numerics.names import found

PACKAGES = ("jaxsph", "jaxsph.model", "jaxsph.scale", "jaxsph.sequence")
MODEL = Path(js.__file__).parent / "model"
FROM_ABOVE = sorted({entry for file in MODEL.rglob("*.py") for entry in re.findall(r'found\("(.+?)"\)', file.read_text())})
HEAVY = ("jax", "numpy", "scipy", "matplotlib", "h5py", "jaxsph.io", "jaxsph.engine.render", "jaxsph.reference")


def loaded(code):
    """Modules that a process has loaded after some code."""
    told = subprocess.run([sys.executable, "-c", f"import sys\n{code}\nprint(*sys.modules)"], capture_output=True, text=True)
    assert told.returncode == 0, told.stderr
    return set(told.stdout.split())


def test_importing_jaxsph_imports_nothing_that_takes_time():
    assert not loaded("import jaxsph, jaxsph.model, jaxsph.scale, jaxsph.sequence\ndir(jaxsph)") & set(HEAVY)


def test_things_are_made_without_files_figures_and_the_engine():
    code = "from jaxsph.model import Image, Settings\nSettings(integrator='segments', screen='quadtree')"
    assert not loaded(code) & {"jaxsph.io", "jaxsph.engine.render", "matplotlib", "scipy"}


def test_methods_are_there_whatever_is_imported_first(tmp_path):
    code = f"""
import numpy as np
from jaxsph.model import Image
one = np.ones((2, 2), np.float32)
Image(np.zeros((2, 2, 3), np.float32), one, one, one, one, True, 0, {{}}).save({str(tmp_path / "a.png")!r})
"""
    assert "jaxsph.io" in loaded(code)
    assert (tmp_path / "a.png").exists()


@pytest.mark.parametrize("entry", FROM_ABOVE)
def test_what_methods_of_the_model_find_above_it_is_there(entry):
    assert len(FROM_ABOVE) == 16 and callable(found(entry))


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
        assert getattr(module, name) is found(entry)


def test_jaxsph_has_no_other_names():
    with pytest.raises(AttributeError, match="has no attribute 'octree_plans'"):
        js.octree_plans
