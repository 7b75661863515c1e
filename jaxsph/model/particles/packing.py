"""Columns of a set of particles or points: checked, with an entry for each, and padded to a capacity.

Flow: arrays -> [packing] -> Particles, Points.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxsph.numerics.checks import array_of, is_traced, require_finite, require_positive, require_real, require_shape

NEGLIGIBLE = 2.0**-16  # of a support that rounding may move a particle by, before what is lost is kept


def columns_of(what: str, given: dict[str, Any]) -> dict[str, Any]:
    """Arrays of real numbers, positions first, with an entry for each particle or point, also of one that is given for all."""
    columns = {name: value if isinstance(value, jax.Array) else np.asarray(value) for name, value in given.items()}
    for name, value in columns.items():
        require_real(name, value)
    position = columns["position"]
    if position.size == 0 and not isinstance(position, jax.Array):
        columns["position"] = position = position.reshape(0, 3)
    require_shape("position", position, (None, 3), f"one row (x, y, z) a {what}")
    count = position.shape[0]
    for name, value in list(columns.items())[1:]:
        row = (3,) if name == "color" else ()
        if value.shape == row:
            columns[name] = (jnp if is_traced(value) else np).broadcast_to(value, (count, *row))
        each = "one row" if row else "one value"
        require_shape(name, columns[name], (count, *row), f"{each} for each of the {count} {what}s, or one for all")
    return columns


def padded_to(value: Any, capacity: int, nothing: float, xp: Any, *, repeat: bool = True) -> Any:
    """A column up to its capacity with its first entry: whoever forgets what is `valid` meets no number of our own making.

    With `nothing` where there is no entry, or where it is not to be repeated.
    """
    missing = (capacity - value.shape[0], *value.shape[1:])
    more = xp.broadcast_to(value[:1], missing) if repeat and value.shape[0] else xp.full(missing, nothing, value.dtype)
    return xp.concatenate([value, more])


def packed(name: str, value: Any, capacity: int, dtype: Any, nothing: float, *, repeat: bool = True) -> Any:
    """`padded_to`, in a working precision; on the host where it is known. Of lengths, which must not be 0, `nothing` is > 0.

    Raises:
        ValueError: what is known overflows, or is a length of 0 in that precision.
    """
    xp = jnp if is_traced(value) else np
    with np.errstate(over="ignore"):  # what overflows is refused by name
        found = padded_to(value, capacity, nothing, xp, repeat=repeat).astype(dtype)
    if xp is np:
        require_finite(name, found, f"it overflows {found.dtype}: rescale it, or use float64 under jax.enable_x64")
        if nothing > 0:
            require_positive(name, found, f"it underflows {found.dtype}: rescale the scene or use float64")
    return found


def rest_of(given: Any, rounded: Any, reach: Any) -> Array | None:
    """What rounding positions has left, or None where they are unknown or that is a negligible part of all supports or radii."""
    if is_traced(given, rounded, reach) or not given.shape[0]:
        return None
    exact, near = np.asarray(given, np.float64), np.asarray(rounded, np.float64)
    rest = padded_to(exact - near[: len(exact)], len(near), 0.0, np)
    if not (np.abs(rest).max(1) > NEGLIGIBLE * np.asarray(reach, np.float64)).any():
        return None
    return array_of(rest, rounded.dtype)
