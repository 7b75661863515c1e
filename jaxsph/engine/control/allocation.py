r"""How a bundle's tolerance is shared among what its cells and slabs can be given.

Flow: errors -> [allocation] -> adapt, slabs -> schedule.

Errors of cells add up (`errors`), so a bundle has a budget to spend: choose a candidate for each cell such that the errors'
sum stays within the tolerance and the evaluations saved are most. The multiplier rule does that up to one cell: for a price
$\lambda$, each cell takes what maximises saving $- \lambda$ error; the least price that keeps the tolerance is found by
bisection. A smaller tolerance has a higher price, at which no cell takes more error: it never spends less. The paper's order
(section 4.4) spends the budget back to front, each cell taking the highest level that still fits.

Super-pixels are decided slab by slab: the candidate is paint for those slabs of a cell that are worth it at the price, so that
what it saves and how it errs depends on that, and the rule is as it was.

Decisions carry no gradient.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxsph.engine.access.grid import CELL_SAMPLES
from jaxsph.engine.control.errors import SUPER_PIXEL, Candidates, CellErrors, added_up

CHEAPEST, DEAREST = -20.0, 60.0  # powers of two between which the price is sought: evaluations over light
HALVINGS = 14
EMPTY = -1  # what a cell without particles is given


def choose(
    errors: CellErrors,
    saving: Candidates,
    on_offer: Candidates,
    rounding: Float[Array, " bundles"],
    tolerance: Float[Array, ""],
    allocation: str,
) -> tuple[Int[Array, "cells bundles"], Bool[Array, "slabs_of_a_cell cells bundles"]]:
    """The candidate of every cell: level 0 to 4, or super-pixel; and which slabs of super-pixels are painted.

    Args:
        errors: of all candidates.
        saving: kernel evaluations a ray that a candidate saves against level 0.
        on_offer: candidates that can be had; level 0 always can.
        rounding: how much two images of the bundle can differ by rounding alone, if any cell is not at level 0.
        tolerance: largest error of a pixel.
        allocation: `"budget"`, or `"greedy"` (back to front).
    """
    strict = Candidates(errors.strict, errors.error.slabs)
    allowed = jax.tree.map(lambda offered, own: offered & (own + rounding <= tolerance), on_offer, strict)
    allowed = allowed._replace(levels=allowed.levels.at[0].set(True))
    saving = jax.tree.map(lambda allowed, own: jnp.where(allowed, own, -jnp.inf), allowed, saving)
    error = jax.tree.map(lambda allowed, own: jnp.where(allowed, own, 0), allowed, errors.error)

    def fit(left: Array, cell: tuple[Candidates, Candidates]) -> tuple[Array, tuple[Array, Array]]:
        saving, error = cell
        some, slabs = jnp.zeros_like(left), saving.slabs
        for nth, (gain, own) in reversed(list(enumerate(zip(*(one.slabs for one in cell), strict=True)))):
            fitting = (gain > 0) & (some + own <= left)
            some, slabs = some + jnp.where(fitting, own, 0), slabs.at[nth].set(jnp.where(fitting, gain, -jnp.inf))
        levels = jnp.where(error.levels <= jnp.maximum(left, 0), saving.levels, -jnp.inf)  # level 0 always fits
        chosen, taken, painted = _best(Candidates(levels, slabs), error, 0)
        return left - taken, (chosen, painted)

    def halve(_: Array, ends: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = ends
        middle = 0.5 * (low + high)
        keeps = _best(saving, error, jnp.exp2(middle))[1].sum(0) + rounding <= tolerance
        return jnp.where(keeps, low, middle), jnp.where(keeps, middle, high)

    if allocation == "greedy":
        cells = jax.tree.map(lambda value: jnp.moveaxis(value, 1, 0), (saving, error))
        chosen, painted = lax.scan(fit, tolerance - rounding, cells, reverse=True)[1]
        return lax.stop_gradient((chosen, jnp.moveaxis(painted, 0, 1)))  # type: ignore[no-any-return]
    price = lax.fori_loop(0, HALVINGS, halve, tuple(jnp.full_like(rounding, end) for end in (CHEAPEST, DEAREST)))[1]
    chosen, taken, painted = _best(saving, error, jnp.exp2(price))
    keeps = taken.sum(0) + rounding <= tolerance
    return lax.stop_gradient((jnp.where(keeps, chosen, 0), keeps & painted))  # type: ignore[no-any-return]


def bound(
    error: Candidates, chosen: Int[Array, "cells bundles"], painted: Bool[Array, "slabs_of_a_cell cells bundles"], rounding: Array
) -> tuple[Float[Array, " bundles"], Float[Array, " bundles"]]:
    """What the pixels of each bundle can differ by from the reference: exactly 0 where all is at level 0; and by paint alone."""
    of_paint = added_up(jnp.where(painted, error.slabs, 0))  # as it was added up where it was chosen
    taken = jnp.where(chosen == SUPER_PIXEL, of_paint, error.levels[0])
    for level, own in enumerate(error.levels[1:], 1):
        taken = jnp.where(chosen == level, own, taken)
    return jnp.where((chosen > 0).any(0), taken.sum(0) + rounding, 0), of_paint.sum(0)


def kept(
    error: Candidates,
    chosen: Int[Array, "cells bundles"],
    painted: Bool[Array, "slabs_of_a_cell cells bundles"],
    rounding: Float[Array, " bundles"],
    tolerance: Float[Array, ""],
) -> tuple[Array, Array, Float[Array, " bundles"], Float[Array, " bundles"]]:
    """What was chosen, at full rate in bundles where that is more than the tolerance; and `bound` of it.

    XLA may compute anew, in other instructions, whether a slab is worth a price that it is worth exactly. So what is chosen is
    held against the tolerance once more, when it is known as bits.
    """
    largest, of_paint = bound(error, chosen, painted, rounding)
    within = largest <= tolerance
    chosen, painted = jnp.where(within, chosen, 0), painted & within
    return chosen, painted, jnp.where(within, largest, 0), jnp.where(within, of_paint, 0)


def _best(saving: Candidates, error: Candidates, price: Array | float) -> tuple[Array, Array, Array]:
    """The candidate of most `saving - price * error`, the first of equals, its error, and the slabs that are painted.

    What saves less than nothing is never chosen. Painted are the slabs that are worth it one by one, so that each cell is as
    good as it can be.
    """
    gains = saving.slabs - price * error.slabs
    painted = gains > 0
    net, taken = (added_up(jnp.where(painted, value, 0)) for value in (gains, error.slabs))
    offers = [*zip(saving.levels - price * error.levels, error.levels, strict=True), (net, taken)]
    best, taken, chosen = *offers[0], jnp.zeros(net.shape, jnp.int32)
    for candidate, (gain, own) in zip([*range(1, len(offers) - 1), SUPER_PIXEL], offers[1:], strict=True):
        better = gain > best
        best, taken = jnp.where(better, gain, best), jnp.where(better, own, taken)
        chosen = jnp.where(better, candidate, chosen)
    return chosen, taken, painted & (chosen == SUPER_PIXEL)


def rounding_of(filled: Int[Array, " bundles"], dtype: Any) -> Float[Array, " bundles"]:
    """What rounding adds to the bound of bundles that have so many filled cells, see `adapt`."""
    return 2 * jnp.finfo(dtype).eps * (CELL_SAMPLES * (filled + 1)).astype(dtype)
