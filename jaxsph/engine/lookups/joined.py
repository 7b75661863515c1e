"""Colour and extinction with control points of their own, in one table: of media that carry a single quantity.

Flow: TransferFunction with `extinction_values` -> [joined] -> TransferFunction.
"""

from __future__ import annotations

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxsph.model.transfer.function import TransferFunction


def joined(transfer: TransferFunction) -> TransferFunction:
    """The same functions of one quantity, both given at the control points of either.

    Between two neighbours of all control points both functions are linear, so that nothing changes but for rounding. At a jump of
    either, the first of equal points has what lies before it, the others what lies behind.

    Differentiation:
        By all numbers of `transfer`.
    """
    if transfer.extinction_values is None:
        return transfer
    values = jnp.sort(jnp.concatenate([transfer.values, transfer.extinction_values]))
    first = jnp.append(True, values[1:] > values[:-1])
    of_colors = transfer.values, transfer.colors
    of_extinction = transfer.extinction_values, transfer.extinction[:, None]
    colors, extinction = (
        jnp.where(first[:, None], _read(*table, values, "left"), _read(*table, values, "right"))
        for table in (of_colors, of_extinction)
    )
    return TransferFunction(values, colors, extinction[:, 0])


def _read(
    points: Float[Array, " points"], table: Float[Array, "points channels"], at: Float[Array, " places"], side: str
) -> Float[Array, "places channels"]:
    """What a table has at places, at a jump that of its left or right side."""
    last = points.shape[0] - 1
    above = jnp.searchsorted(lax.stop_gradient(points), lax.stop_gradient(at), side=side)
    before, after = jnp.clip(above - 1, 0, last), jnp.clip(above, 0, last)
    width = points[after] - points[before]
    part = jnp.where(width > 0, (at - points[before]) / jnp.where(width > 0, width, 1), 0)[:, None]
    return table[before] * (1 - part) + table[after] * part
