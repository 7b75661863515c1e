"""Short words about arrays, for the one line that `repr` gives of what holds them.

Flow: arrays, tracers, or whatever a transformation puts in their places -> [short] -> words.
"""

from __future__ import annotations

from typing import Any

import jax
import numpy as np

MAX_LOOKED_AT = 1 << 22  # entries of an array that its range is told of: more take longer than a line should


def line(name: str, *words: str | None) -> str:
    """`Name(words, words)` of the words that there are."""
    return f"{name}({', '.join(word for word in words if word)})"


def known(value: Any) -> np.ndarray | None:
    """Numbers, where there are some that can be looked at: nothing of tracers, deleted arrays, and other objects."""
    if isinstance(value, jax.Array):
        if isinstance(value, jax.core.Tracer) or value.is_deleted() or not value.is_fully_addressable:
            return None
    elif not isinstance(value, np.ndarray | np.generic | int | float):
        return None
    numbers = np.asarray(value)
    return numbers if numbers.dtype.kind in "biuf" and numbers.size <= MAX_LOOKED_AT else None


def kind(value: Any) -> str:
    """Type and shape, such as `float32[3,4]`; of what has none, its class."""
    shape, dtype = getattr(value, "shape", None), getattr(value, "dtype", None)
    if not isinstance(shape, tuple) or dtype is None:
        return type(value).__name__
    return f"{dtype}[{','.join(map(str, shape))}]"


def span(value: Any, valid: Any = True) -> str:
    """From the least to the greatest of those that are valid, NaN aside; where they are not known, what they are."""
    numbers, chosen = known(value), known(valid)
    if numbers is None or chosen is None:
        return kind(value)
    numbers = numbers[np.broadcast_to(chosen, numbers.shape) & ~np.isnan(numbers)] if numbers.shape else numbers[None]
    if not numbers.size:
        return "of nothing"
    low, high = (f"{float(end):.4g}" for end in (numbers.min(), numbers.max()))
    return low if low == high else f"{low} to {high}"


def vector(value: Any) -> str:
    """A few numbers in brackets."""
    numbers = known(value)
    if numbers is None or numbers.ndim != 1:
        return kind(value)
    return f"({', '.join(f'{float(number):.4g}' for number in numbers)})"


def count(valid: Any) -> str:
    """How many are valid; where that is not known, in how many entries they are."""
    numbers = known(valid)
    return f"in {kind(valid)}" if numbers is None else f"{int(numbers.sum()):,}"
