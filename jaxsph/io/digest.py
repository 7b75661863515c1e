"""A digest of arrays: by which what was made of them is known again.

Flow: scene, camera -> [digest] -> fingerprints of frames and of parts of pictures.
"""

from __future__ import annotations

import hashlib
from typing import Any

import jax
import numpy as np

HEX_DIGITS = 24
"""Of a fingerprint: 96 bits, so that no two of a billion pictures share one but with a chance of 1e-11."""


def digest_of(tree: Any) -> str:
    """A digest of a tree of arrays: structure, types, shapes and numbers."""
    leaves, structure = jax.tree.flatten(tree)
    digest = hashlib.sha256(repr(structure).encode())
    for leaf in map(np.asarray, leaves):
        digest.update(f"{leaf.dtype} {leaf.shape}".encode())
        digest.update(np.ascontiguousarray(leaf).tobytes())
    return digest.hexdigest()


def fingerprint(kind: str, *parts: Any) -> str:
    """A letter, and a digest of what can be written down exactly."""
    return kind + hashlib.sha256(repr(parts).encode()).hexdigest()[:HEX_DIGITS]
