"""How much code there is: tokens of each folder, and how many of what makes it long; neither may be more than `sizes.json` says.

    python tests/shared/sizes.py

writes the table as the code is now. Tokens may go from one folder to another; in sum they grow only for a capability that
is worth them, by `MOST_TOKENS` of `test_structure.py`. Tokens are Python's, without comments and line ends, a docstring is
one: code that is packed into fewer lines has as many.
"""

from __future__ import annotations

import ast
import functools
import json
import re
import subprocess
import sys
import tokenize
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Iterator
from pathlib import Path

ROOT = Path(__file__).parent.parent.parent
PACKAGE = ROOT / "jaxsph"
TABLE = ROOT / "tests" / "sizes.json"
FUNCTIONS = ast.FunctionDef, ast.AsyncFunctionDef
FRAME = """
import sys
import jaxsph as js
particles = js.Particles.from_arrays([[0.0, 0.0, 0.0]], 1.0, [1.0], [1.0])
transfer = js.TransferFunction.from_points([0.0, 2.0], [(1.0, 1.0, 1.0)] * 2, [1.0, 1.0])
js.render(js.Scene(particles, transfer), js.Camera.framing(particles, width=8, height=8), js.Settings(samples=16))
print(*sys.modules)
"""
NOT_COUNTED = {
    tokenize.COMMENT,
    tokenize.DEDENT,
    tokenize.ENCODING,
    tokenize.ENDMARKER,
    tokenize.INDENT,
    tokenize.NEWLINE,
    tokenize.NL,
}


@functools.cache
def tree(file: Path) -> ast.Module:
    return ast.parse(file.read_text(encoding="utf-8"))


def modules(folder: Path = PACKAGE) -> list[Path]:
    return sorted(folder.rglob("*.py"))


def lines_of(file: Path) -> int:
    return len(file.read_text(encoding="utf-8").splitlines())


@functools.cache
def tokens_of(file: Path) -> int:
    with file.open("rb") as content:
        return sum(token.type not in NOT_COUNTED for token in tokenize.tokenize(content.readline))


def tokens_of_folders() -> Counter[str]:
    """Of the engine's folders one by one; the files beside them are a row of their own."""
    found: Counter[str] = Counter()
    for file in modules():
        folder = file.parent.relative_to(ROOT).parts
        found["/".join(folder[: 3 if "engine" in folder else 2])] += tokens_of(file)
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
def imports() -> dict[str, set[str]]:
    """Modules of the package that each of its modules imports, wherever in its file."""
    found: dict[str, set[str]] = {name: set() for name in files()}
    for name, file in files().items():
        for node in ast.walk(tree(file)):
            if isinstance(node, ast.Import):
                found[name].update(alias.name for alias in node.names)
            elif isinstance(node, ast.ImportFrom) and node.module is not None:
                inside = {f"{node.module}.{alias.name}" for alias in node.names}
                found[name].update(inside & files().keys() or {node.module})
    return {name: (used & files().keys()) - {name} for name, used in found.items()}


def reached(name: str) -> frozenset[str]:
    """All modules that a module imports, and that these import, and so on."""
    seen, ahead = set(), [name]
    while ahead:
        new = imports()[ahead.pop()] - seen
        seen |= new
        ahead += new
    return frozenset(seen)


def loaded_by_render() -> list[str]:
    """Modules that a process has loaded once it has rendered a frame."""
    told = subprocess.run([sys.executable, "-c", FRAME], capture_output=True, text=True, check=True, cwd=ROOT)
    return [f"{lines_of(files()[name])} {name}" for name in told.stdout.split() if name in files()]


def classes() -> list[str]:
    return [where for where, *_ in definitions(ast.ClassDef)]


def _named(node: ast.AST) -> str | None:
    return getattr(node, "id", None) or getattr(node, "attr", None)


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


def classes_of_one_name() -> list[str]:
    found = defaultdict(set)
    for _, file, node in definitions(ast.ClassDef):
        found[node.name].add(str(file.relative_to(ROOT)))
    return [f"{name}: {', '.join(sorted(places))}" for name, places in found.items() if len(places) > 1]


COUNTERS: dict[str, Callable[[], Collection[str]]] = {
    "modules": files,
    "classes": classes,
    "modules that render loads": loaded_by_render,
    "records without a method that are made in one place": records_made_once,
    "names of classes in several modules": classes_of_one_name,
}


def allowed() -> dict[str, dict[str, int]]:
    return json.loads(TABLE.read_text(encoding="utf-8"))


def write() -> None:
    """Write the table as the code is now."""
    table = {
        "tokens": dict(sorted(tokens_of_folders().items())),
        "counters": {what: len(found()) for what, found in COUNTERS.items()},
    }
    TABLE.write_text(f"{json.dumps(table, indent=4)}\n", encoding="utf-8")


if __name__ == "__main__":
    write()
