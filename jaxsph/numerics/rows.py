"""Equal rows of arrays, such as places that particles share: whether there are many, and which they are.

Flow: positions -> [rows] -> trees of places, notes on files, particles of pictures.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

MANY = 2  # rows a group, on average, from which on they are said to share places


def share_places(rows: Float[np.ndarray, "rows columns"]) -> bool:
    """Whether several rows are equal on average: by sums of their bits, which one sort counts."""
    bits = np.ascontiguousarray(np.asarray(rows, np.float64) + 0.0).view(np.uint64)  # there is no -0
    odd = np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9, 0x27D4EB2F165667C5], np.uint64)
    mixed = ((bits ^ (bits >> np.uint64(29))) * odd[: bits.shape[1]]).sum(1, dtype=np.uint64)
    return len(mixed) >= MANY * len(np.unique(mixed)) > 0


def distinct(rows: Float[np.ndarray, "rows columns"]) -> tuple[Int[np.ndarray, " places"], Int[np.ndarray, " rows"]]:
    """The index of one of each group of equal rows, and for every row the number of its group.

    A tree cannot part points that coincide, and would compare each with all others. Rows that all differ keep their order.
    """
    order = np.lexsort(rows.T)
    ordered = rows[order]
    is_first = np.append(True, (ordered[1:] != ordered[:-1]).any(axis=1))
    if is_first.all():
        every = np.arange(len(rows))
        return every, every
    group = np.empty(len(rows), np.int64)
    group[order] = np.cumsum(is_first) - 1
    return order[is_first], group
