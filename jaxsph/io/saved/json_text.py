"""JSON files that people write by hand: what is no JSON, or says a thing twice, is refused with the file's name.

Flow: camera_paths, transfers -> [write_json] -> file -> [read_json] -> objects, lists and numbers -> camera_paths, transfers.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

from jaxsph.io.replace import written_whole

SUFFIX = ".json"
MAX_DIGITS = 300  # of a whole number: what float64 holds


def write_json(path: str | os.PathLike[str], what: str, text: str) -> None:
    """Write the text of `what` to a `.json`, whole or not at all; `ValueError` for another suffix, or where that cannot be."""
    file = Path(path)
    if file.suffix.lower() != SUFFIX:
        raise ValueError(f"{file}: a {what} is written as {SUFFIX}, not as {file.suffix!r}")
    with written_whole(file) as temporary:
        temporary.write_text(text + "\n", encoding="utf-8")


def require_version(found: Any, version: int) -> None:
    """Raise where an object is of another version than this."""
    stated = found.get("version", version)
    if isinstance(stated, bool) or stated != version:
        remedy = "update jaxsph" if isinstance(stated, int) and stated > version else "save it again"
        raise ValueError(f'"version" is {stated!r}, and this version of jaxsph reads {version}; {remedy}')


def read_json(file: Path) -> Any:
    """What a file says.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: no JSON; nested too deeply; a whole number of more than 300 digits; a name twice in one object.
    """
    if not file.exists():
        raise FileNotFoundError(f"{file}: there is no such file")
    try:
        return json.loads(file.read_text(encoding="utf-8"), object_pairs_hook=_object, parse_int=_whole)
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{file}: is no JSON: {error}; repair it there, or save it again") from error
    except RecursionError as error:
        raise ValueError(f"{file}: brackets are nested too deeply for a file of this kind; save it again") from error
    except ValueError as error:
        raise ValueError(f"{file}: {error}") from error


def numbers_only(name: str, given: Any) -> None:
    """Raise where rows of numbers hold text, true, false or null, which arrays would take for numbers."""
    if isinstance(given, list):
        for one in given:
            numbers_only(name, one)
    elif isinstance(given, bool) or not isinstance(given, int | float):
        raise ValueError(f'"{name}" must hold numbers, got {json.dumps(given)[:40]}; write numbers without quotes')


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """An object, in which the last of two would win unsaid."""
    made = dict(pairs)
    if len(made) < len(pairs):
        names = [name for name, _ in pairs]
        twice = next(name for name in names if names.count(name) > 1)
        raise ValueError(f'"{twice[:40]}" stands twice in one object; leave one of them out')
    return made


def _whole(digits: str) -> int:
    if len(digits) > MAX_DIGITS:
        raise ValueError(f"the number {digits[:12]}... has {len(digits)} digits, at most {MAX_DIGITS} are read; correct it")
    return int(digits)
