"""How much code there is: lines of each folder, and how much of what makes it long; neither may be more than `sizes.json` says.

    python tests/shared/sizes.py

writes the table as the code is now. Lines may go from one folder to another; in sum they only fall, as each counter does.
"""

from __future__ import annotations

import ast
import functools
import json
import re
import sys
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Iterator
from pathlib import Path

ROOT = Path(__file__).parent.parent.parent
PACKAGE = ROOT / "jaxsph"
TABLE = ROOT / "tests" / "sizes.json"
SHORT = 5  # lines of a function's body
FUNCTIONS = ast.FunctionDef, ast.AsyncFunctionDef
RENDER = "jaxsph.engine.render"


@functools.cache
def tree(file: Path) -> ast.Module:
    return ast.parse(file.read_text(encoding="utf-8"))


def modules(folder: Path = PACKAGE) -> list[Path]:
    return sorted(folder.rglob("*.py"))


def lines_of(file: Path) -> int:
    return len(file.read_text(encoding="utf-8").splitlines())


def lines_of_folders() -> Counter[str]:
    """Of the engine's folders one by one; the files beside them are a row of their own."""
    found: Counter[str] = Counter()
    for file in modules():
        folder = file.parent.relative_to(ROOT).parts
        found["/".join(folder[: 3 if "engine" in folder else 2])] += lines_of(file)
    return found


def definitions(*kinds: type) -> Iterator[tuple[str, Path, ast.AST]]:
    """Classes or functions of the package: where they are, file, definition."""
    for file in modules():
        for node in ast.walk(tree(file)):
            if isinstance(node, kinds):
                yield f"{file.relative_to(ROOT)}:{node.lineno} {node.name}", file, node


@functools.cache
def files() -> dict[str, Path]:
    """Modules by the names that they are imported by."""
    return {".".join(file.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): file for file in modules()}


@functools.cache
def imports(top: bool = False) -> dict[str, set[str]]:
    """Modules of the package that each of its modules imports: at its `top`, or anywhere."""
    found: dict[str, set[str]] = {name: set() for name in files()}
    for name, file in files().items():
        for node in tree(file).body if top else ast.walk(tree(file)):
            if isinstance(node, ast.Import):
                found[name].update(alias.name for alias in node.names)
            elif isinstance(node, ast.ImportFrom) and node.module is not None:
                inside = {f"{node.module}.{alias.name}" for alias in node.names}
                found[name].update(inside & files().keys() or {node.module})
    return {name: (used & files().keys()) - {name} for name, used in found.items()}


def reached(name: str, top: bool = False) -> frozenset[str]:
    """All modules that a module imports, and that these import, and so on."""
    seen, ahead = set(), [name]
    while ahead:
        new = imports(top)[ahead.pop()] - seen
        seen |= new
        ahead += new
    return frozenset(seen)


def loaded_by_render() -> list[str]:
    """Modules that a frame needs to begin with."""
    return [f"{lines_of(files()[name])} {name}" for name in {RENDER, *reached(RENDER, top=True)}]


def of_engine() -> list[str]:
    """Modules of the engine."""
    return [f"{lines_of(file)} {name}" for name, file in files().items() if name.startswith("jaxsph.engine")]


def of_tests() -> list[str]:
    """Test files, and what they share."""
    return [f"{lines_of(file)} {file.relative_to(ROOT)}" for file in modules(ROOT / "tests")]


def classes() -> list[str]:
    return [where for where, *_ in definitions(ast.ClassDef)]


def _named(node: ast.AST) -> str | None:
    return getattr(node, "id", None) or getattr(node, "attr", None)


@functools.cache
def _names(file: Path) -> Counter[str | None]:
    """Names that a file uses, each as often as it does."""
    return Counter(_named(node) for node in ast.walk(tree(file)))


def _body(function: ast.AST) -> list[ast.stmt]:
    """Statements, the docstring apart."""
    return function.body[ast.get_docstring(function) is not None :]


def records_made_once() -> list[str]:
    """Named tuples and dataclasses without a method that one place makes."""
    calls = Counter(_named(node.func) for file in modules() for node in ast.walk(tree(file)) if isinstance(node, ast.Call))
    return [
        where
        for where, _, node in definitions(ast.ClassDef)
        if any(re.search("NamedTuple|dataclass", ast.unparse(mark)) for mark in [*node.bases, *node.decorator_list])
        and not any(isinstance(one, FUNCTIONS) for one in node.body)
        and calls[node.name] == 1
    ]


def short_functions_named_once() -> list[str]:
    """Private functions of a few lines, undecorated, that one place of their file names."""
    return [
        where
        for where, file, node in definitions(*FUNCTIONS)
        if re.match("_(?!_)", node.name) and not node.decorator_list and _names(file)[node.name] == 1
        if node.end_lineno - node.body[-len(_body(node)) or -1].lineno < SHORT
    ]  # fmt: skip


def _is_forward(function: ast.AST) -> bool:
    """Whether all that it does is to call another with what it was given."""
    call = getattr(function.body[-1], "value", None)
    if len(_body(function)) != 1 or not isinstance(call, ast.Call):
        return False
    given = [*call.args, *(one.value for one in call.keywords)]
    return all(isinstance(one.value if isinstance(one, ast.Starred) else one, ast.Name) for one in given)


def forwards() -> list[str]:
    return [where for where, _, node in definitions(*FUNCTIONS) if _is_forward(node)]


def classes_of_one_name() -> list[str]:
    found = defaultdict(set)
    for _, file, node in definitions(ast.ClassDef):
        found[node.name].add(str(file.relative_to(ROOT)))
    return [f"{name}: {', '.join(sorted(places))}" for name, places in found.items() if len(places) > 1]


COUNTERS: dict[str, Callable[[], Collection[str]]] = {
    "lines of the tests": of_tests,
    "modules": files,
    "classes": classes,
    "modules of the engine": of_engine,
    "lines of the engine": of_engine,
    "modules that render loads": loaded_by_render,
    "lines that render loads": loaded_by_render,
    "records without a method that are made in one place": records_made_once,
    "short private functions that are named in one place": short_functions_named_once,
    "functions that forward": forwards,
    "names of classes in several modules": classes_of_one_name,
}


def counted(what: str) -> tuple[int, Collection[str]]:
    """How much there is, and what it is."""
    found = COUNTERS[what]()
    return sum(int(one.split()[0]) for one in found) if what.startswith("lines") else len(found), found


def allowed() -> dict[str, dict[str, int]]:
    return json.loads(TABLE.read_text(encoding="utf-8"))


def write() -> None:
    """The table as the code is now.

    Raises:
        SystemExit: the folders have more lines in sum than all rows.
    """
    before, lines = allowed(), lines_of_folders()
    more = sum(lines.values()) - sum(before["lines"].values())
    if more > 0:
        sys.exit(f"{more} lines more than all rows of {TABLE.name}: take them away elsewhere, or raise a row by hand and say why")
    counters = {what: min(counted(what)[0], before["counters"].get(what, sys.maxsize)) for what in COUNTERS}
    text = json.dumps({"lines": dict(sorted(lines.items())), "counters": counters}, indent=4)
    TABLE.write_text(f"{text}\n", encoding="utf-8")


if __name__ == "__main__":
    write()
