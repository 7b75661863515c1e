"""The names that `jaxsph` has for its users: few, and found when they are used."""

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest

import jaxsph as js
from jaxsph.numerics.names import import_by_name

PACKAGE = Path(js.__file__).parent
TREES = {file: ast.parse(file.read_text(encoding="utf-8")) for file in PACKAGE.rglob("*.py") if file != PACKAGE / "__init__.py"}
ROOMS = "|".join({file.relative_to(PACKAGE).parts[0].removesuffix(".py") for file in TREES})
ENTRY = re.compile(rf"jaxsph\.({ROOMS})\b.*")
IMPORTERS = (
    "import_by_name",
    "import_module",
    "__import__",
    "load_module",
    "exec_module",
    "find_spec",
    "run_module",
    "resolve_name",
)
NAMED_ELSEWHERE = {
    "numerics/names.py": "import_module(name)",  # what `import_by_name` is
    "io/damage.py": "import_module(module)",  # libraries that may not be installed, with words for when they are not
    "io/formats.py": "import_module(form.module)",  # readers of other packages
    "model/settings.py": "import_by_name(INTEGRATORS[name])",  # entered in `jaxsph.engine.cast`, and by other packages
    "cli/console.py": "find_spec('tqdm')",  # whether it is installed
    "io/units.py": "find_spec('unyt')",
}
MOST_BY_NAME, LEAST_MILLISECONDS = 12, 50  # imports by name; what each saves where it is not needed
HEAVY = ("jax", "numpy", "scipy", "matplotlib", "h5py", "jaxsph.io", "jaxsph.engine.render", "jaxsph.reference")


def loaded(code):
    """Modules that a process has loaded after some code."""
    told = subprocess.run([sys.executable, "-c", f"import sys\n{code}\nprint(*sys.modules)"], capture_output=True, text=True)
    assert told.returncode == 0, told.stderr
    return set(told.stdout.split())


def test_importing_jaxsph_imports_nothing_that_takes_time():
    assert not loaded("import jaxsph\ndir(jaxsph)") & set(HEAVY)


def test_listing_the_commands_imports_none_of_them():
    assert not loaded("from jaxsph.cli.main import app\napp()['render']") & {*HEAVY, "jaxsph.cli.commands.render"}


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


def entries():
    """What strings name of this package, with their lines; whatever way such a string is imported."""
    for file, tree in TREES.items():
        lines = file.read_text(encoding="utf-8").splitlines()
        for node in ast.walk(tree):
            if isinstance(node, ast.Constant) and isinstance(node.value, str) and ENTRY.fullmatch(node.value):
                yield pytest.param(node.value, lines[node.lineno - 1], id=node.value)


def importing_calls(tree):
    """Calls that import what a string names, but for entries that stand there."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and getattr(node.func, "attr", getattr(node.func, "id", None)) in IMPORTERS:
            told = ast.unparse(node).removeprefix("importlib.").removeprefix("util.")
            if not ENTRY.fullmatch(str(getattr(node.args[0], "value", None))):
                yield told


def test_few_imports_are_by_name():
    assert 0 < len([*entries()]) <= MOST_BY_NAME


@pytest.mark.parametrize(("entry", "line"), [*entries()])
def test_an_import_by_name_is_there_and_dear(entry, line):
    (milliseconds,) = re.findall(r"# ([\d,]+) ms", line)
    assert import_by_name(entry) is not None
    assert int(milliseconds.replace(",", "")) > LEAST_MILLISECONDS


def test_nothing_else_is_imported_by_a_string():
    calls = {str(file.relative_to(PACKAGE)): {*importing_calls(tree)} for file, tree in TREES.items()}
    assert {file: told for file, told in calls.items() if told} == {file: {one} for file, one in NAMED_ELSEWHERE.items()}


def test_all_names_are_found_and_known_to_editors():
    assert [name for name in js.__all__ if getattr(js, name, None) is None] == []
    assert set(dir(js)) == set(js.__all__) <= vars(js).keys()  # looked up once
    tree = ast.parse(Path(js.__file__).read_text(encoding="utf-8"))
    typed = next(node for node in tree.body if isinstance(node, ast.If))
    entries = {}
    for node in typed.body:
        for alias in node.names:
            told = f"{node.module}.{alias.name}" if node.module == "jaxsph" else f"{node.module}:{alias.name}"
            entries[alias.name] = told
    assert entries.keys() == set(js.__all__)
    for name, entry in entries.items():
        assert getattr(js, name) is import_by_name(entry)


def test_jaxsph_has_no_other_names():
    with pytest.raises(AttributeError, match="has no attribute 'octree_plans'"):
        js.octree_plans
