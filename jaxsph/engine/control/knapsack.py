"""A budget shared out: what to take so that most is gained and the variances of what is taken add up to no more.

Flow: interpolation_error -> [knapsack] -> schedule.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
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
    price = jnp.where(allowed & (variance <= budget), jnp.log2(variance) - jnp.log2(gain), jnp.inf)
    least = price.min(0)
    span = jnp.where(price < jnp.inf, price, -jnp.inf).max(0) - least
    shares = jnp.asarray([0, 2, *0.5 ** np.arange(1, HALVINGS + 1)], price.dtype)  # tries the least price, any, then halves

    def attempt(nth: Array, found: tuple[Array, Array]) -> tuple[Array, Array]:
        highest, total = found
        tried = highest + span * shares[nth]  # NaN where nothing is allowed: no price is below that
        spent = jnp.where(price <= tried, variance, 0).sum(0)
        keeps = spent <= budget
        return jnp.where(keeps, tried, highest), jnp.where(keeps, spent, total)

    # the least price alone may be too much, and then all are
    highest, total = lax.fori_loop(0, HALVINGS + 2, attempt, (least, jnp.full_like(budget, -1)))
    return (price <= highest) & (total >= 0), jnp.maximum(total, 0)
