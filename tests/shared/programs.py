"""What XLA makes of a function."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import jax


def copies_in_loops(function: Callable[..., Any], arguments: tuple[Any, ...], shape: tuple[int, ...]) -> list[str]:
    """Copies of arrays whose shape ends in `shape`, anywhere but at the top of the compiled program."""
    sides = ",".join(str(side) for side in shape)
    copy = re.compile(rf"\w+\[(\d+,)*{sides}\]\S* copy\(")
    found, top = [], False
    for line in jax.jit(function).lower(*arguments).compile().as_text().splitlines():
        if line.startswith(("%", "ENTRY")):
            top = line.startswith("ENTRY")
        elif not top and copy.search(line):
            found.append(line.strip())
    return found
