r"""Which candidate every cell gets: as much work saved as the tolerance allows.

Flow: errors -> [levels] -> merge -> cast -> image.

Errors of cells add up (`errors`), so a bundle has a budget to spend: choose a candidate for each cell such that the errors'
sum stays within the tolerance and the evaluations saved are most. The multiplier rule does that up to one cell: for a price
$\lambda$, each cell takes what maximises saving $- \lambda$ error; the least price that keeps the tolerance is found by
bisection. A smaller tolerance has a higher price, at which no cell takes more error: it never spends less.

The paper's order (section 4.4) spends the budget back to front, each cell taking the highest level that still fits.

Decisions carry no gradient.
"""

from __future__ import annotations

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxsph.engine.control.errors import CANDIDATES, CellErrors

CHEAPEST, DEAREST = -20.0, 60.0  # powers of two between which the price is sought: evaluations over light
HALVINGS = 20


def choose(
    errors: CellErrors,
    saving: Float[Array, "candidates cells bundles"],
    on_offer: Bool[Array, "candidates cells bundles"],
    rounding: Float[Array, " bundles"],
    tolerance: Float[Array, ""],
    allocation: str,
) -> Int[Array, "cells bundles"]:
    """The candidate of every cell: level 0 to 4, or super-pixel.

    Args:
        errors: of all candidates.
        saving: kernel evaluations a ray that a candidate saves against level 0.
        on_offer: candidates that can be had; level 0 always can.
        rounding: how much two images of the bundle can differ by rounding alone, if any cell is not at level 0.
        tolerance: largest error of a pixel.
        allocation: `"budget"`, or `"greedy"` (back to front).
    """
    allowed = on_offer & (errors.strict + rounding <= tolerance)
    error = jnp.where(allowed, errors.error, jnp.inf).at[0].set(0)
    if allocation == "greedy":
        chosen = _back_to_front(saving, error, tolerance - rounding)
    else:
        chosen = _at_best_price(saving, error, rounding, tolerance)
    return lax.stop_gradient(chosen)


def bound(error: Float[Array, "candidates cells bundles"], chosen: Int[Array, "cells bundles"], rounding: Array) -> Array:
    """What the pixels of each bundle can differ by from the reference, (bundles,): exactly 0 where all is at level 0."""
    taken = jnp.take_along_axis(error, chosen[None], 0)[0]
    return jnp.where((chosen > 0).any(0), taken.sum(0) + rounding, 0)


def _best(saving: Array, error: Array, price: Array | float) -> tuple[Array, Array]:
    """The candidate of most `saving - price * error`, the first of equals, and its error; none with an infinite error."""
    best, taken, chosen = saving[0], error[0], jnp.zeros(saving.shape[1:], jnp.int32)
    for candidate in range(1, CANDIDATES):
        possible = error[candidate] < jnp.inf
        net = saving[candidate] - price * jnp.where(possible, error[candidate], 0)
        better = possible & (net > best)
        best, taken = jnp.where(better, net, best), jnp.where(better, error[candidate], taken)
        chosen = jnp.where(better, candidate, chosen)
    return chosen, taken


def _at_best_price(saving: Array, error: Array, rounding: Array, tolerance: Array) -> Array:
    def halve(_: Array, ends: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = ends
        middle = 0.5 * (low + high)
        keeps = _best(saving, error, jnp.exp2(middle))[1].sum(0) + rounding <= tolerance
        return jnp.where(keeps, low, middle), jnp.where(keeps, middle, high)

    low, high = (jnp.full_like(rounding, end) for end in (CHEAPEST, DEAREST))
    _, high = lax.fori_loop(0, HALVINGS, halve, (low, high))
    chosen, taken = _best(saving, error, jnp.exp2(high))
    return jnp.where(taken.sum(0) + rounding <= tolerance, chosen, 0)


def _back_to_front(saving: Array, error: Array, left: Array) -> Array:
    def step(left: Array, cell: tuple[Array, ...]) -> tuple[Array, Array]:
        saving, error = cell
        chosen, taken = _best(saving, jnp.where(error <= left, error, jnp.inf), 0)
        return left - taken, chosen

    cells = tuple(jnp.moveaxis(value, 1, 0) for value in (saving, error))
    return lax.scan(step, left, cells, reverse=True)[1]
