"""Bundles dealt out like cards, so that every part has about as much to do wherever the fluid is.

Flow: grid -> [parts] -> cast.
"""

from __future__ import annotations

from typing import Any

import jax
from jaxtyping import Array, Int


def dealt(tree: Any, nth: Int[Array, ""] | int, parts: int) -> Any:
    """Of arrays whose last axis is bundles, every `parts`-th from the `nth` on."""
    if parts == 1:
        return tree
    return jax.tree.map(lambda value: value.reshape(*value.shape[:-1], -1, parts)[..., nth], tree)
