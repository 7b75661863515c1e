"""Transfer function: what a quantity looks like.

Flow: [transfer] -> cast -> image.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxsph.numerics.checks import is_traced, require_finite, require_positive, require_real, require_shape


@dataclasses.dataclass(frozen=True)
class TransferFunction:
    """Piecewise linear map of a quantity Q to colour and extinction, clamped at its ends.

    Two equal neighbours in `values` make a jump; the later point holds at the jump itself.

    Attributes:
        values: ascending control points, in units of the quantity.
        colors: RGB in [0, 1] at the control points.
        extinction: >= 0 at the control points, per length unit.
    """

    values: Float[Array, " points"]
    colors: Float[Array, "points 3"]
    extinction: Float[Array, " points"]

    @classmethod
    def from_points(cls, values: Any, colors: Any, extinction: Any) -> TransferFunction:
        """Check and pack control points.

        Args:
            values: (K,) ascending (equal neighbours allowed), K >= 1, units of the quantity.
            colors: (K, 3) in [0, 1].
            extinction: (K,) >= 0, per length unit.

        Raises:
            ValueError: wrong shapes, non-finite values, values that descend, colours outside [0, 1], extinction < 0.
        """
        given = {"values": values, "colors": colors, "extinction": extinction}
        given = {name: value if isinstance(value, jax.Array) else np.asarray(value) for name, value in given.items()}
        for name, value in given.items():
            require_real(name, value)
        require_shape("values", given["values"], (None,), "one number a control point")
        points = given["values"].shape[0]
        if points < 1:
            raise ValueError("`values` must hold at least one control point, got none")
        require_shape("colors", given["colors"], (points, 3), f"one RGB row for each of the {points} values")
        require_shape("extinction", given["extinction"], (points,), f"one number for each of the {points} values")
        if not is_traced(*given.values()):
            for name, value in given.items():
                require_finite(name, value)
            require_positive("extinction", given["extinction"], "extinction is a loss of light, never a gain", strict=False)
            require_positive("colors", given["colors"], "colours lie in [0, 1]", strict=False)
            require_positive("1 - colors", 1 - np.asarray(given["colors"], np.float64), "colours lie in [0, 1]", strict=False)
            descents = np.flatnonzero(np.diff(np.asarray(given["values"])) < 0)
            if descents.size:
                i = int(descents[0])
                before, after = given["values"][i], given["values"][i + 1]
                raise ValueError(f"`values` must ascend, but values[{i}] = {before} > values[{i + 1}] = {after}; sort the control points")
        dtype = jnp.promote_types(jax.dtypes.canonicalize_dtype(jnp.result_type(*given.values())), jnp.float32)
        packed = {name: jnp.asarray(value, dtype) for name, value in given.items()}
        if not is_traced(*given.values()):
            for name, value in packed.items():
                require_finite(name, value, f"it overflows {dtype}: rescale it, or use float64 under jax.enable_x64")
        return cls(**packed)

    def __call__(self, quantity: Float[Array, "..."]) -> tuple[Float[Array, "... 3"], Float[Array, "..."]]:
        """Colour and extinction of `quantity` (any shape): `colour(Q)` (..., 3), `extinction(Q)` (...) per length unit."""
        channels = self.interpolate(jnp.asarray(quantity, self.values.dtype))
        return jnp.stack(channels[:3], -1), channels[3]

    def interpolate(self, quantity: Float[Array, "..."]) -> list[Float[Array, "..."]]:
        """The same as separate channels `[red, green, blue, extinction]`, each shaped like `quantity`."""
        table = jnp.concatenate([self.colors, self.extinction[:, None]], 1).T
        if self.values.shape[0] == 1:
            return [jnp.broadcast_to(row[0], quantity.shape) for row in table]
        right = jnp.clip(_count_not_above(self.values, quantity), 1, self.values.shape[0] - 1)
        left = right - 1
        start = self.values[left]
        width = self.values[right] - start
        beyond = (quantity >= start).astype(quantity.dtype)
        where = jnp.where(width > 0, jnp.clip((quantity - start) / jnp.where(width > 0, width, 1), 0, 1), beyond)
        return [row[left] * (1 - where) + row[right] * where for row in table]


COMPARE_ALL = 16  # up to this many control points counting comparisons vectorises better than bisection gathers


def _count_not_above(values: Float[Array, " points"], quantity: Float[Array, "..."]) -> Array:
    """How many control points are <= quantity."""
    if values.shape[0] <= COMPARE_ALL:
        count = jnp.zeros(quantity.shape, jnp.int32)
        for i in range(values.shape[0]):
            count += (quantity >= values[i]).astype(jnp.int32)
        return count
    return jnp.searchsorted(values, quantity, side="right", method="scan_unrolled").astype(jnp.int32)


jax.tree_util.register_dataclass(TransferFunction, data_fields=["values", "colors", "extinction"], meta_fields=[])
