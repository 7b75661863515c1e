"""The greatest of all, where each of several devices holds a part of the particles.

What every particle is measured by (the largest support, the greatest strength) is then that of all parts, and no bit of what a
sample finds depends on who else is held.
"""

from __future__ import annotations

import contextlib
import contextvars
from collections.abc import Iterator

from jax import lax
from jaxtyping import Array, Shaped

_AXES: contextvars.ContextVar[tuple[str, ...]] = contextvars.ContextVar("axes", default=())


@contextlib.contextmanager
def across(axes: tuple[str, ...]) -> Iterator[None]:
    """Have the greatest of all parts found along axes of a mesh, in what is traced meanwhile under `jax.shard_map`."""
    token = _AXES.set(axes)
    try:
        yield
    finally:
        _AXES.reset(token)


def greatest_of_all(value: Shaped[Array, "*any"]) -> Shaped[Array, "*any"]:
    """Of the greatest of each part, the greatest of all; what is given, where there is one part."""
    axes = _AXES.get()
    return lax.pmax(value, axes) if axes else value
