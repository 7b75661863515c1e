"""Arrays beside a Tipsy file: one number a particle, as text or as bytes.

Flow: `run.00010.smoothlength` -> [tipsy_arrays] -> columns of the table of `run.00010`.

As text, the number of particles stands in the first line and then a number a line; as bytes, the number in four bytes and then
floats of four bytes, in either order of bytes. Particles are all of the file, or gas alone. Source: the documentation of TIPSY,
University of Washington N-Body Shop.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

NAMES = "smoothlength", "den"
"""Suffixes that are looked for, and names of their columns."""
MAX_DIGITS = 64
"""Bytes of a number as text."""


def arrays_beside(path: Path, bodies: int, gas: int, rows: slice) -> tuple[dict[str, np.ndarray], list[str]]:
    """Columns of the particles in `rows`, of so many bodies of which the first are gas; and sentences on what is not used."""
    columns, said = {}, []
    for name in NAMES:
        file = path.with_name(f"{path.name}.{name}")
        if not file.is_file():
            continue
        values, trouble = _values(file, {bodies, gas})
        if values is not None and len(values) < rows.stop:
            values, trouble = None, "holds gas alone"
        if values is None:
            said.append(f"{file.name} is not used: it {trouble}")
        else:
            columns[name] = values[rows]
            said.append(f"column `{name}` is of {file.name}")
    return columns, said


def _values(file: Path, counts: set[int]) -> tuple[np.ndarray | None, str]:
    """The numbers of a file of one of these lengths, or what is wrong with it."""
    try:
        size = os.path.getsize(file)
        if size > max(counts) * MAX_DIGITS + MAX_DIGITS:
            return None, f"has {size} bytes, too many for {max(counts)} numbers"
        stored = file.read_bytes()
    except OSError as error:
        return None, f"cannot be read ({error.strerror})"
    for order in (">", "<"):
        count = int(np.frombuffer(stored[:4], f"{order}i4")[0]) if size >= 4 else -1
        if count in counts and size == 4 + 4 * count:
            return np.frombuffer(stored[4:], f"{order}f4").astype(np.float32), ""
    try:
        first, *numbers = stored.split()
        values = np.array(numbers, np.float64)
        count = int(first)
    except ValueError:
        return None, "is neither text of numbers nor floats of four bytes"
    if count not in counts or len(values) != count:
        return None, f"states {count} numbers and has {len(values)}, but there are {max(counts)} particles"
    return values.astype(np.float64), ""
