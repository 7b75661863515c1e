"""Words of ASCII formats to numbers, each on its own: an array of words would be as wide as the longest of them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np


def numbers(tokens: Sequence[bytes] | Sequence[str], dtype: np.dtype) -> np.ndarray:
    """One number a token, in the native order of `dtype`; integers keep all their digits.

    Raises:
        ValueError: a token that is no number.
        OverflowError: an integer that `dtype` cannot hold.
    """
    native = dtype.newbyteorder("=")
    return np.fromiter(map(int if native.kind in "iu" else float, tokens), native, len(tokens))
