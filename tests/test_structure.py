"""How the code is built: its picture, its sizes, its walls, how deep calls go, and its words."""

import ast
import dataclasses
import functools
import importlib.util
import re
import sys
from collections import defaultdict
from pathlib import Path

import jax
import numpy as np
import pytest

import jaxsph as js
from jaxsph.engine.control.pilot import PilotPlan

ROOT = Path(__file__).parent.parent
PACKAGE = ROOT / "jaxsph"
MAX_LINES = 60  # of a function
MAX_FILES = 8  # of the package on the stack at once, arithmetic apart
# Ceilings that come down as the house is put in order, and go up by what a new capability takes; behind them what they are to be.
MAX_ALL_LINES = 48_900  # of the package: 33,500
MAX_NAMES = 40  # that `jaxsph` has for its users
MAX_PARAMETERS = 10  # of a function
MAX_ENTRIES = 16  # of a folder, modules and folders
MAX_CIRCLES = 0  # of modules that import each other, wherever in their files
FUNCTIONS = ast.FunctionDef, ast.AsyncFunctionDef
CALLS = re.compile(r"`([^`]+)`")
CAMEL = re.compile(r"(?<=[a-z])(?=[A-Z])")
FORMER = {"worklist", "stretch", "stretches", "owed"}  # words of identifiers that have gone
FORMER_NAMES = {"worth"}  # identifiers: a cotangent has its own word
FOLDERS = ("jaxsph", "tests", "benchmarks", "docs", "notebooks")
PAGES = {".py", ".md", ".ipynb", ".toml", ".cff", ".svg"}


@functools.cache
def tree(file):
    return ast.parse(file.read_text(encoding="utf-8"))


def modules(folder=PACKAGE):
    return sorted(folder.rglob("*.py"))


def functions():
    """Lines of every function, from `def` to its last, longest first."""
    found = (
        (node.end_lineno - node.lineno + 1, f"{file.relative_to(ROOT)}:{node.lineno} {node.name}")
        for file in modules()
        for node in ast.walk(tree(file))
        if isinstance(node, FUNCTIONS)
    )
    return sorted(found, reverse=True)


def identifiers(file):
    """Names that a file defines or uses."""
    for node in ast.walk(tree(file)):
        for part in ("id", "attr", "arg", "name", "asname", "module"):
            name = getattr(node, part, None)
            if isinstance(name, str):
                yield from name.split(".")


def test_the_pictures_of_the_house_are_what_the_code_makes_of_it(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "docs"))
    spec = importlib.util.spec_from_file_location("draw_house", ROOT / "docs" / "draw_house.py")
    house = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = house  # where its dataclasses look
    spec.loader.exec_module(house)
    for of, file in house.PICTURES.items():
        assert file.read_text(encoding="utf-8") == house.picture(of), "python docs/draw_house.py"


def test_functions_are_short():
    sizes = functions()
    print(*(f"{lines} {where}" for lines, where in sizes[:10]), sep="\n")
    assert not [f"{lines} {where}" for lines, where in sizes if lines > MAX_LINES]


def test_functions_take_few_arguments():
    found = {}
    for file in modules():
        for node in ast.walk(tree(file)):
            if isinstance(node, FUNCTIONS):
                named = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
                count = sum(one.arg not in ("self", "cls") for one in named)
                found[f"{file.relative_to(ROOT)}:{node.lineno} {node.name}"] = count
    assert not {where: count for where, count in found.items() if count > MAX_PARAMETERS}


def test_folders_can_be_taken_in_at_a_glance():
    entries = defaultdict(set)
    for file in modules():
        for inside in (file, *file.parents):
            if inside == PACKAGE:
                break
            entries[inside.parent.relative_to(ROOT)].add(inside.name)
    assert not {str(folder): len(names) for folder, names in entries.items() if len(names) > MAX_ENTRIES}


def test_the_package_is_small_and_has_few_names():
    assert len(js.__all__) <= MAX_NAMES
    assert sum(len(file.read_text(encoding="utf-8").splitlines()) for file in modules()) <= MAX_ALL_LINES


def module_name(file):
    name = ".".join(file.relative_to(ROOT).with_suffix("").parts)
    return name.removesuffix(".__init__")


@functools.cache
def imports():
    """Modules of the package that each of its modules imports, at its top or in its functions."""
    names = {module_name(file): file for file in modules()}
    found = {name: set() for name in names}
    for name, file in names.items():
        for node in ast.walk(tree(file)):
            if isinstance(node, ast.Import):
                found[name].update(alias.name for alias in node.names)
            elif isinstance(node, ast.ImportFrom) and node.module is not None:
                inside = {f"{node.module}.{alias.name}" for alias in node.names}
                found[name].update(inside & names.keys() or {node.module})
    return {name: (used & names.keys()) - {name} for name, used in found.items()}


def reached(name):
    """All modules that a module imports, and that these import, and so on."""
    seen, ahead = set(), [name]
    while ahead:
        new = imports()[ahead.pop()] - seen
        seen |= new
        ahead += new
    return frozenset(seen)


def test_modules_do_not_import_each_other_in_circles():
    ways = {name: reached(name) for name in imports()}
    circles = {frozenset(one for one in way if name in ways[one]) for name, way in ways.items() if name in way}
    assert len(circles) <= MAX_CIRCLES, [sorted(circle) for circle in circles]


@pytest.mark.parametrize(("room", "other"), [("control", "cast"), ("cast", "control")])
def test_what_is_enough_and_what_is_cast_know_nothing_of_each_other(room, other):
    found = defaultdict(list)
    for file in modules(PACKAGE / "engine" / room):
        for node in ast.walk(tree(file)):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import | ast.ImportFrom) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            if any(other in name.split(".") for name in names):
                found[file.name].append(node.lineno)
    assert not found


@functools.cache
def counted_file(name):
    """A file of the package that counts as one on the way; None for others."""
    apart = f"{PACKAGE}/numerics/", f"{PACKAGE}/engine/runtime/"
    inside = name.startswith(f"{PACKAGE}/") and not name.startswith(apart)
    return str(Path(name).relative_to(PACKAGE)) if inside else None


def deepest(call):
    """The files of the package that were on the stack at once, `numerics` apart, where they were most; outermost first."""
    longest: list[str] = []

    def look(frame, event, _):
        nonlocal longest
        if event != "call" or counted_file(frame.f_code.co_filename) is None:
            return
        files = {}
        while frame is not None:
            files[counted_file(frame.f_code.co_filename)] = True
            frame = frame.f_back
        files.pop(None, None)
        if len(files) > len(longest):
            longest = list(files)[::-1]

    before = sys.getprofile()
    sys.setprofile(look)
    try:
        call()
    finally:
        sys.setprofile(before)
    return longest


def test_no_way_from_settings_to_image_is_long(frames):
    rng = np.random.default_rng(5)
    scene, camera = frames.scene(rng), frames.camera(rng)
    settings = dataclasses.replace(frames.settings, tolerance=0.01, estimator="pilot")
    plan = dataclasses.replace(frames.plan(), control=PilotPlan())
    traced = jax.make_jaxpr(lambda scene: js.render(scene, camera, settings, plan=plan))
    files = deepest(lambda: traced(scene))
    assert files[0] == "engine/render.py"
    assert len(files) <= MAX_FILES, f"{len(files)} files: {' > '.join(files)}"


def test_every_name_in_the_glossary_is_in_the_code():
    known = {"jaxsph", *(file.stem for file in modules()), *(name for file in modules() for name in identifiers(file))}
    known |= {
        node.value
        for file in modules()
        for node in ast.walk(tree(file))
        if isinstance(node, ast.Constant) and node.value.__hash__
    }
    named = set(CALLS.findall((ROOT / "docs" / "glossary.md").read_text(encoding="utf-8")))
    files = {name for name in named if name.endswith(".py")}
    assert len(named) > 100
    assert not sorted(name for name in files if not (PACKAGE / name).exists())
    assert not sorted(name for name in named - files if not known.issuperset(name.split(".")))


def test_words_of_the_glossary_are_in_order():
    words = re.findall(r"^- \*\*(.+?)\*\*", (ROOT / "docs" / "glossary.md").read_text(encoding="utf-8"), re.MULTILINE)
    lower = [word.lower() for word in words]
    assert lower == sorted(set(lower))


def test_words_that_have_gone_stay_away():
    found = set()
    for folder in ("jaxsph", "tests", "benchmarks"):
        for file in modules(ROOT / folder):
            for name in {*identifiers(file), file.stem}:
                words = set(CAMEL.sub("_", name).lower().split("_"))
                if words & FORMER or name in FORMER_NAMES:
                    found.add(f"{file.relative_to(ROOT)}: {name}")
    assert not sorted(found)


def test_papers_are_called_by_their_authors():
    numbered = re.compile(r"\b(first|second|third)\s+paper\b", re.IGNORECASE)
    pages = [file for file in ROOT.iterdir() if file.suffix in PAGES]
    pages += [file for folder in FOLDERS for file in (ROOT / folder).rglob("*") if file.suffix in PAGES]
    assert not [str(page.relative_to(ROOT)) for page in pages if numbered.search(page.read_text(encoding="utf-8"))]
