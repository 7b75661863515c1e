"""JSON files that people write by hand: what is no JSON, or says a thing twice, is refused with the file's name.

Flow: file -> [json_text] -> objects, lists and numbers -> camera_paths, transfers.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

MAX_DIGITS = 300
"""Of a whole number: what float64 holds."""


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
