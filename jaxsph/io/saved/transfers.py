"""Transfer functions as JSON files.

Flow: TransferFunction -> [write_transfer] -> file -> [read_transfer] -> TransferFunction.

```json
{"format": "jaxsph transfer function", "version": 1, "dtype": "float32",
 "values": [0, 1], "colors": [[0, 0, 0], [1, 1, 1]], "extinction": [0, 2]}
```
Numbers are written with as many digits as their dtype needs, so that a file gives the same function again, and can be edited by
hand. `note` may hold any text. What else a version of the class has stands under the name of its field.
"""

from __future__ import annotations

import dataclasses
import json
import os
from typing import Any

import numpy as np

from jaxsph.io.damage import naming, regular_file
from jaxsph.io.saved.json_text import numbers_only, read_json, require_version, write_json
from jaxsph.model.transfer.function import TransferFunction

FORMAT, VERSION = "jaxsph transfer function", 1
REQUIRED = "values", "colors", "extinction"
KNOWN = {"format", "version", "dtype", "note"}


def write_transfer(path: str | os.PathLike[str], transfer: TransferFunction) -> None:
    """Write `transfer` to `path`, a `.json`, whole or not at all.

    Raises `ValueError`: another suffix, or a place that cannot be written to.
    """
    head = {"format": FORMAT, "version": VERSION, "dtype": str(transfer.values.dtype)}
    fields = {field.name: getattr(transfer, field.name) for field in dataclasses.fields(transfer)}
    rows = [f'  "{name}": {_text(value)}' for name, value in fields.items() if value is not None]
    start = [f"  {json.dumps(name)}: {json.dumps(value)}" for name, value in head.items()]
    write_json(path, "transfer function", "{\n" + ",\n".join(start + rows) + "\n}")


def read_transfer(path: str | os.PathLike[str]) -> TransferFunction:
    """Read a transfer function that `write_transfer`, or a person, wrote.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: no regular file, no JSON, of another format or version, a field that is missing or unknown, or what
            `TransferFunction.from_points` refuses.
    """
    file = regular_file(path)
    found = read_json(file)
    with naming(file):
        return TransferFunction.from_points(**_fields(found))


def _fields(found: Any) -> dict[str, Any]:
    if not isinstance(found, dict) or found.get("format") != FORMAT:
        raise ValueError(
            f'is JSON, but no transfer function: "format" must be "{FORMAT}"; `TransferFunction.save` writes such files'
        )
    require_version({"version": None} | found, VERSION)
    names = {field.name for field in dataclasses.fields(TransferFunction)}
    missing = [name for name in REQUIRED if name not in found]
    unknown = sorted(set(found) - names - KNOWN)
    if missing or unknown:
        may = ", ".join(sorted((names | KNOWN) - set(REQUIRED)))
        what = f"lacks {', '.join(missing)}" if missing else f"has {', '.join(unknown)}, unknown to this version"
        raise ValueError(f"{what}; it must hold {', '.join(REQUIRED)}, and may hold {may}")
    dtype = found.get("dtype", "float32")
    if dtype not in ("float32", "float64"):
        raise ValueError(f'"dtype" must be float32 or float64, got {dtype!r}')
    return {name: _numbers(name, found[name], dtype) for name in names if found.get(name) is not None}


def _numbers(name: str, given: Any, dtype: str) -> np.ndarray:
    numbers_only(name, given)
    try:
        with np.errstate(over="ignore"):  # what float32 cannot hold is refused as not finite
            return np.asarray(given, np.float64).astype(dtype)
    except (TypeError, ValueError) as error:
        raise ValueError(f'"{name}" must hold numbers in rows of one length: {error}') from error


def _text(value: Any) -> str:
    """JSON of an array, in lines of a row each where it has rows."""
    rows = np.asarray(value)
    if rows.ndim > 1:
        return "[" + ",\n    ".join(_text(row) for row in rows) + "]"
    return "[" + ", ".join(str(number) for number in rows) + "]"
