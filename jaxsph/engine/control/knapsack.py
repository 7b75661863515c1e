"""A budget shared out: what to take so that most is gained and the variances of what is taken add up to no more.

Flow: interpolation_error -> [knapsack] -> schedule.
"""

from __future__ import annotations

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

HALVINGS = 10  # of the range of prices in octaves


def select_under_budget(
    variance: Float[Array, "choices bundles"],
    gain: Float[Array, "choices bundles"],
    allowed: Bool[Array, "choices bundles"],
    budget: Float[Array, " bundles"],
) -> tuple[Bool[Array, "choices bundles"], Float[Array, " bundles"]]:
    """Take choices of the least variance a gain, as many as keep the budget: the highest such price is sought by bisection.

    Args:
        variance: of every choice, positive.
        gain: by every choice, positive.

    Returns:
        What is taken, and the sum of its variances, at most the budget.
    """
    allowed &= variance <= budget
    price = jnp.where(allowed, jnp.log2(variance) - jnp.log2(gain), jnp.inf)
    least, most = price.min(0), jnp.where(allowed, price, -jnp.inf).max(0)
    low, high = (jnp.where(allowed.any(0), end, 0) for end in (least, most))

    def halve(_: Array, ends: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = ends
        middle = 0.5 * (low + high)
        keeps = jnp.where(price <= middle, variance, 0).sum(0) <= budget
        return jnp.where(keeps, middle, low), jnp.where(keeps, high, middle)

    all_fit = jnp.where(allowed, variance, 0).sum(0) <= budget
    highest = jnp.where(all_fit, high, lax.fori_loop(0, HALVINGS, halve, (low, high))[0])
    taken = allowed & (price <= highest)
    total = jnp.where(taken, variance, 0).sum(0)
    fits = total <= budget  # the least price alone may be too much
    return taken & fits, jnp.where(fits, total, 0)
