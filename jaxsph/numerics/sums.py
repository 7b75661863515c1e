"""Running sums, in a few small kernels whatever the length.

Of `lax.associative_scan` XLA makes dozens of kernels, which takes it half a second for each scan; its own cumulative sum is up
to ten times as slow as these on CPUs. So sums are taken in groups of `STEP`, those of the groups' totals in the same way, and
each level is one kernel that adds a triangle of entries.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

STEP = 8


def running_sum(value: Int[Array, "*any"], axis: int = -1) -> Int[Array, "*any"]:
    """Sums of the entries up to each along an axis, that included: as `jnp.cumsum`, for integers."""
    axis %= value.ndim
    before_axis, number, behind = value.shape[:axis], value.shape[axis], value.shape[axis + 1 :]
    groups = -(-number // STEP)
    padding = [(0, groups * STEP - number if k == axis else 0) for k in range(value.ndim)]
    grouped = jnp.pad(value, padding).reshape(*before_axis, groups, 1, STEP, *behind)
    up_to = np.tri(STEP, dtype=bool).reshape(STEP, STEP, *(1 for _ in behind))
    sums = jnp.where(up_to, grouped, 0).sum(axis + 2, dtype=value.dtype)
    if groups > 1:
        total = sums[(slice(None),) * (axis + 1) + (-1,)]
        sums += jnp.expand_dims(running_sum(total, axis) - total, axis + 1)
    return sums.reshape(*before_axis, groups * STEP, *behind)[(slice(None),) * axis + (slice(number),)]
