"""Names in back quotes on pages: which of them are nowhere in the repository.

The glossary's are words that the package uses anywhere. Those of other pages are to be found: `module.name` and `Class.name` are
defined there, `js.name` is public, `test_name` is a test, `"value"` and `name="value"` hold texts of the package, and a path is
that of a file.
"""

from __future__ import annotations

import ast
import functools
import operator
import re
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

import jax
from sizes import FUNCTIONS, PACKAGE, ROOT, modules, tree

import jaxsph as js

QUOTED = re.compile(r"`([^`\n]+)`")
FILES = {".ipynb", ".json", ".md", ".png", ".py"}
JAX = {"jax": jax, "lax": jax.lax, "js": js}


def quoted(page: str) -> set[str]:
    """What stands in back quotes in a line of a page."""
    return set(QUOTED.findall(page))


def identifiers(node: ast.AST) -> Iterator[str]:
    """Names that a file, or a part of it, defines or uses."""
    for part in ast.walk(node):
        for field in ("id", "attr", "arg", "name", "asname", "module"):
            name = getattr(part, field, None)
            if isinstance(name, str):
                yield from name.split(".")


@functools.cache
def texts() -> frozenset[object]:
    """Constants of the package."""
    nodes = (node for file in modules() for node in ast.walk(tree(file)))
    return frozenset(node.value for node in nodes if isinstance(node, ast.Constant) and node.value.__hash__)


def unused(names: set[str]) -> list[str]:
    """Which names the package nowhere uses."""
    known = {"jaxsph", *(file.stem for file in modules()), *(name for file in modules() for name in identifiers(tree(file)))}
    known |= texts()
    return sorted(name for name in names if not (is_file(name) or known.issuperset(name.split("."))))


def missing(names: set[str]) -> list[str]:
    """Which names lead nowhere; commands are left to the test of all pages."""
    return sorted(name for name in names if not (name.startswith("jaxsph ") or is_somewhere(name)))


def is_somewhere(name: str) -> bool:
    first, _, attributes = name.partition(".")
    if name.startswith("make "):
        return re.search(rf"^{name.removeprefix('make ')}:", (ROOT / "Makefile").read_text(), re.MULTILINE) is not None
    if Path(name).suffix in FILES:
        return is_file(name)
    if '"' in name:
        return set(name.split('"')[1::2]) <= texts() and (name[0] == '"' or name.partition("=")[0] in definitions())
    if first in JAX:
        try:
            return callable(operator.attrgetter(attributes)(JAX[first]))
        except AttributeError:
            return False
    return name in definitions()


def is_file(name: str) -> bool:
    """Of the repository, or of the package as modules call each other."""
    return Path(name).suffix in FILES and any((folder / name).is_file() for folder in (ROOT, PACKAGE))


@functools.cache
def definitions() -> dict[str, list[ast.AST]]:
    """What the package, benchmarks and tests define, by name, by `module.name` and by `Class.name`; of tests the tests alone."""
    found = defaultdict(list)
    for file in (*modules(), *modules(ROOT / "benchmarks")):
        of_file = file.parent.name if file.stem == "__init__" else file.stem
        for owner, body in ((of_file, tree(file).body), *((one.name, one.body) for one in classes(file))):
            for node in body:
                for name in _defined(node):
                    found[name].append(node)
                    found[f"{owner}.{name}"].append(node)
    for file in modules(ROOT / "tests"):
        if file.stem.startswith("test_"):
            for node in ast.walk(tree(file)):
                if isinstance(node, FUNCTIONS) and node.name.startswith("test_"):
                    found[node.name].append(node)
    return dict(found)


def classes(file: Path) -> list[ast.ClassDef]:
    return [node for node in ast.walk(tree(file)) if isinstance(node, ast.ClassDef)]


def _defined(node: ast.AST) -> list[str]:
    """Names that a statement defines."""
    if isinstance(node, (*FUNCTIONS, ast.ClassDef)):
        return [node.name]
    targets = node.targets if isinstance(node, ast.Assign) else [node.target] if isinstance(node, ast.AnnAssign) else []
    return [one.id for target in targets for one in ast.walk(target) if isinstance(one, ast.Name)]
