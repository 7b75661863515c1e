r"""Wider spaced samples in interpolated slabs: where light bends little along the rays, fewer samples tell as much.

Flow: interpolation_error -> [spacing] -> schedule -> cast.

Samples are the middles of what they stand for. With g the light that a unit of depth sends to the eye, a sample that stands
for w fine ones is off by $(w^2 - 1) g'' / 24$ from their mean. The nodes of the lattice know g, and so its second differences
along their rays, without any sample more. Rays between nodes may meet a kink that those miss: `DEVIATION_PER_BEND` times the
nodes' root mean square is one deviation.
"""

from __future__ import annotations

import functools

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxsph.engine.field.schedule import MAX_SPACING_LEVEL

HALVINGS = 10  # of the range of prices in octaves
DEVIATION_PER_BEND = 3.0  # times the root mean square bend over the nodes that rays are taken to bend by, as one deviation
MIN_DEVIATION = 8  # eps: what they differ by, at least


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


def second_differences(
    colors: list[list[Float[Array, " nodes"]]],
    extinction: list[Float[Array, " nodes"]],
    step: Float[Array, "fewer nodes"],
    before: Float[Array, " nodes"],
    previous: Float[Array, "4 nodes"],
) -> tuple[Float[Array, " nodes"], Float[Array, "4 nodes"]]:
    """How much the light of a slab bends at the nodes: sum over layers of the largest second difference times the step.

    Args:
        colors, extinction: at the layers of nodes of a slab and at the first of the next.
        step: path length between layers.
        before: optical thickness in front of the slab.
        previous: what reaches the eye from a unit of length, of red, green, blue and as such, one layer before.

    Returns:
        The bend, and `previous` of the next slab.
    """
    light, behind = [], before
    for k in range(len(extinction)):
        seen = jnp.exp(-behind) * extinction[k]
        light.append([*(seen * color[k] for color in colors), seen])
        if k < step.shape[0]:
            behind = behind + extinction[k] * step[k]
    total, last = jnp.zeros_like(before), list(previous)
    for here, after, length in zip(light, light[1:], step, strict=False):
        of_channels = [jnp.abs(a - 2 * b + c) for a, b, c in zip(last, here, after, strict=True)]
        total, last = total + functools.reduce(jnp.maximum, of_channels) * length, here
    return total, jnp.stack(last)


def choose_spacing(
    taken: Bool[Array, "slabs bundles"], bend: Float[Array, "slabs bundles"], budget: Float[Array, " bundles"], node_samples: int
) -> tuple[Int[Array, "slabs bundles"], Float[Array, " bundles"]]:
    """Levels of interpolated slabs, from the widest spaced down: aligned groups of slabs, all interpolated, share samples.

    Args:
        taken: slabs that are interpolated.
        bend: root mean square over the nodes of a bundle.
        budget: variance that wider spacing may add.
        node_samples: fine samples between nodes.

    Returns:
        Level of each slab; and the variance.
    """
    level, spent = jnp.zeros(taken.shape, jnp.int32), jnp.zeros_like(budget)
    least = MIN_DEVIATION * jnp.finfo(budget.dtype).eps
    for coarse in range(MAX_SPACING_LEVEL, 0, -1):
        share = 1 << coarse
        whole = taken.shape[0] // share * share
        if not whole:
            continue
        groups = (taken & (level == 0))[:whole].reshape(-1, share, taken.shape[1])
        curved = functools.reduce(jnp.add, (bend[k:whole:share] for k in range(share)))
        deviation = DEVIATION_PER_BEND * (share**2 - 1) / (24 * node_samples**2) * curved + least
        chosen, more = select_under_budget(deviation**2, jnp.ones_like(deviation), groups.all(1), budget - spent)
        level = level.at[:whole].max(coarse * jnp.repeat(chosen, share, 0))
        spent += more
    return level, spent
