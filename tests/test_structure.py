"""How the code is built: its picture, its sizes, its walls, how deep calls go, and its words."""

import re
import sys
import threading
from collections import OrderedDict

import numpy as np
import pytest
import sizes
from named import identifiers, quoted, unused
from sizes import FUNCTIONS, PACKAGE, ROOT, definitions, imports, modules, reached, tree
from tools import tool

import jaxsph as js
from jaxsph.engine.runtime.programs import PROGRAMS

# Ceilings that come down as the house is put in order; behind them what they are to be.
MOST_TOKENS = 408_800  # of the package: to become 360,000; extremes, voxels and forecasts took 9,200, compiled slices 1,500
SPARE_TOKENS = 600  # that a folder may be given beyond those it has: a function
MAX_LINES = 60  # of a function
MAX_PARAMETERS, MAX_PRIVATE = 10, 12  # of a function; of one that no user calls
MAX_NAMES = 40  # that `jaxsph` has for its users
MAX_FILES, MAX_FUNCTIONS = 12, 28  # of the package on the stack at once: 9, 20
MAX_CIRCLES = 0  # of modules that import each other, wherever in their files
CAMEL = re.compile(r"(?<=[a-z])(?=[A-Z])")
FORMER = {"worklist", "stretch", "stretches", "owed"}  # words of identifiers that have gone
FORMER_NAMES = {"worth"}  # identifiers: a cotangent has its own word
FOLDERS = ("jaxsph", "tests", "benchmarks", "docs", "notebooks")
PAGES = {".py", ".md", ".ipynb", ".toml", ".cff", ".svg"}


def test_the_pictures_of_the_house_are_what_the_code_makes_of_it(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "docs"))
    house = tool("docs", "draw_house")
    for of, file in house.PICTURES.items():
        assert file.read_text(encoding="utf-8") == house.picture(of), "python docs/draw_house.py"


def test_functions_are_short():
    lengths = sorted(((node.end_lineno - node.lineno + 1, where) for where, _, node in definitions(*FUNCTIONS)), reverse=True)
    print(*(f"{lines} {where}" for lines, where in lengths[:10]), sep="\n")
    assert not [f"{lines} {where}" for lines, where in lengths if lines > MAX_LINES]


def test_functions_take_few_arguments():
    found = {}
    for where, file, node in definitions(*FUNCTIONS):
        named = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
        count = sum(one.arg not in ("self", "cls") for one in named)
        private = node.name.startswith("_") or PACKAGE / "engine" in file.parents
        if count > (MAX_PRIVATE if private else MAX_PARAMETERS):
            found[where] = count
    assert not found


def test_the_package_has_few_names():
    assert len(js.__all__) <= MAX_NAMES


def test_the_package_is_small():
    assert sum(sizes.allowed()["tokens"].values()) <= MOST_TOKENS


def test_folders_keep_to_their_tokens():
    allowed, tokens = sizes.allowed()["tokens"], sizes.tokens_of_folders()
    over = {name: f"{count}, not {allowed.get(name, 0)}" for name, count in tokens.items() if count > allowed.get(name, 0)}
    assert not over, "a capability that needs tokens says so in its commit: python tests/shared/sizes.py writes the rows"
    spare = {name: f"{tokens[name]}, not {most}" for name, most in allowed.items() if most > tokens[name] + SPARE_TOKENS}
    assert not spare, "rows fall with the code: python tests/shared/sizes.py"


@pytest.mark.parametrize("what", sizes.COUNTERS)
def test_counters_keep_to_their_rows(what):
    found = sizes.COUNTERS[what]()
    most = sizes.allowed()["counters"][what]
    assert len(found) <= most, "\n".join([f"{len(found)} {what}, not {most}:", *sorted(found)])


def test_modules_do_not_import_each_other_in_circles():
    ways = {name: reached(name) for name in imports()}
    circles = {frozenset(one for one in way if name in ways[one]) for name, way in ways.items() if name in way}
    assert len(circles) <= MAX_CIRCLES, [sorted(circle) for circle in circles]


def deepest(call):
    """The most files of the package that were on the stack of a thread at once, and the most functions; outermost first."""
    files, functions = [], []

    def look(frame, event, _):
        nonlocal files, functions
        if event != "call" or not frame.f_code.co_filename.startswith(f"{PACKAGE}/"):
            return
        stack = []
        while frame is not None:
            code, frame = frame.f_code, frame.f_back
            if code.co_filename.startswith(f"{PACKAGE}/") and not code.co_name.endswith(("comp>", "genexpr>")):
                stack.append(code)
        functions = max(functions, stack[::-1], key=len)
        files = max(files, list(dict.fromkeys(code.co_filename for code in stack[::-1])), key=len)

    before = sys.getprofile()
    threading.setprofile(look)
    sys.setprofile(look)
    try:
        call()
    finally:
        threading.setprofile(None)
        sys.setprofile(before)
    return [name.removeprefix(f"{PACKAGE}/") for name in files], [code.co_qualname for code in functions]


def test_no_way_from_settings_to_image_is_long(frames, quick_programs, monkeypatch):
    monkeypatch.setattr(PROGRAMS, "_kept", OrderedDict())  # a program that is at hand is not traced
    rng = np.random.default_rng(5)
    scene, camera = frames.scene(rng), frames.camera(rng)
    files, functions = deepest(lambda: js.render(scene, camera, frames.settings, plan=frames.plan()))
    assert files[0] == "engine/render.py" and functions[0] == "render"
    assert len(files) <= MAX_FILES, f"{len(files)} files: {' > '.join(files)}"
    assert len(functions) <= MAX_FUNCTIONS, f"{len(functions)} functions: {' > '.join(functions)}"


def test_every_name_in_the_glossary_is_in_the_code():
    named = quoted((ROOT / "docs" / "glossary.md").read_text(encoding="utf-8"))
    assert len(named) > 60
    assert not unused(named)


def test_words_of_the_glossary_are_in_order():
    words = re.findall(r"^- \*\*(.+?)\*\*", (ROOT / "docs" / "glossary.md").read_text(encoding="utf-8"), re.MULTILINE)
    lower = [word.lower() for word in words]
    assert lower == sorted(set(lower))


def test_words_that_have_gone_stay_away():
    found = set()
    for folder in ("jaxsph", "tests", "benchmarks"):
        for file in modules(ROOT / folder):
            for name in {*identifiers(tree(file)), file.stem}:
                words = set(CAMEL.sub("_", name).lower().split("_"))
                if words & FORMER or name in FORMER_NAMES:
                    found.add(f"{file.relative_to(ROOT)}: {name}")
    assert not sorted(found)


def test_papers_are_called_by_their_authors():
    numbered = re.compile(r"\b(first|second|third)\s+paper\b", re.IGNORECASE)
    pages = [file for file in ROOT.iterdir() if file.suffix in PAGES]
    pages += [file for folder in FOLDERS for file in (ROOT / folder).rglob("*") if file.suffix in PAGES]
    assert not [str(page.relative_to(ROOT)) for page in pages if numbered.search(page.read_text(encoding="utf-8"))]
