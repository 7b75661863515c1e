"""What rooms a package has, what each is for, which import which, and on which floors they are: read from the code.

Flow: packages, layers of import-linter -> [house_rooms] -> `draw_house`.
"""

from __future__ import annotations

import ast
import functools
import re
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
Edge = tuple[str, str]


def rooms_of(package: Path) -> list[str]:
    """Folders and modules, by name."""
    return sorted(path.stem for path in package.iterdir() if path.suffix == ".py" or (path / "__init__.py").exists())


def modules_of(package: Path, room: str) -> list[Path]:
    """The files of a room, those of its folders too."""
    folder = package / room
    return sorted(folder.rglob("*.py")) if folder.is_dir() else [package / f"{room}.py"]


def contents_of(package: Path, room: str) -> list[str]:
    """What is in the folder of a room: folders, with a stroke, and modules."""
    inside = rooms_of(package / room)
    folders = [name for name in inside if (package / room / name).is_dir()]
    return [*(f"{name}/" for name in folders), *(name for name in inside if name not in folders and name != "__init__")]


def dotted(package: Path) -> str:
    """The name that a package is imported by."""
    return ".".join(package.relative_to(ROOT).parts)


def purpose_of(package: Path, room: str) -> str:
    """First line of a room's docstring."""
    folder = package / room
    file = folder / "__init__.py" if folder.is_dir() else package / f"{room}.py"
    return (ast.get_docstring(ast.parse(file.read_text(encoding="utf-8"))) or "").split("\n")[0].replace("`", "")


def imports_of(package: Path, room: str, rooms: list[str]) -> set[str]:
    """Other rooms that a room imports, anywhere in its files."""
    found = set()
    for file in modules_of(package, room):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            names = []
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom) and node.level == 0:
                names = [f"{node.module}.{alias.name}" for alias in node.names]
            for name in names:
                if f"{name}.".startswith(f"{dotted(package)}."):
                    first = name.removeprefix(dotted(package)).split(".")[1:2]
                    found.add(first[0] if first and first[0] in rooms else "__init__")
    return found - {room}


def named_rooms(package: Path) -> set[str]:
    """Rooms whose modules are looked up by name, `package.room.module:name` in a string."""
    entry = re.compile(rf"{re.escape(dotted(package))}\.(\w+)\.[\w.]+:\w+")
    strings = (
        node.value
        for file in package.rglob("*.py")
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8")))
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
    )
    return {match[1] for match in map(entry.fullmatch, strings) if match}


def floors_of(layers: list[str], imports: dict[str, set[str]]) -> list[list[str]]:
    """Rooms by floor from the ground up: those of the layers; a room that is in none stands right above what it imports."""
    floors = [[name for name in re.findall(r"\w+", layer) if name in imports] for layer in reversed(layers)]
    floors = [floor for floor in floors if floor]
    for room in sorted(set(imports) - {name for floor in floors for name in floor}, key=lambda name: (name == "__main__", name)):
        below = [k for k, floor in enumerate(floors) if imports[room] & set(floor)]
        nth = max(below, default=-1) + 1
        if nth == len(floors):
            floors.append([])
        floors[nth].append(room)
    return floors


def reduced(imports: dict[str, set[str]]) -> list[Edge]:
    """Imports to which no other way leads."""

    @functools.cache
    def reached(room: str) -> set[str]:
        return imports[room].union(*(reached(other) for other in imports[room]))

    return [
        (room, other)
        for room in sorted(imports)
        for other in sorted(imports[room])
        if not any(other in reached(between) for between in imports[room])
    ]
