r"""Samples whose quantity rounding may put on either side of a jump of the transfer function: no error is known of their rays.

Flow: sums, jumps -> [jumps: samples in doubt] -> march -> error bounds.

**Theorem.** Let $w_j$ be the weights of the n particles of a slab, $\hat w_j$ and $\hat Q$ weights and mean as computed. With
k the `edge` of the kernel, $m_j$ strengths and $\delta_j$ = reach - support, which is more than rounding moves a sample against
a particle, let $\psi = 2 \max_j (m_j^{1/k} \delta_j / H_j) (n / \sum \hat w_j)^{1/k}$. Then

$$|\hat Q - Q| \le \min(k \psi (1 + \psi)^{k - 1}, 1) (q_{max} - q_{min})
  + (n + 6) \epsilon \max_j |q_j - r| + 2 \epsilon |\hat Q|.$$

*Argument.* The k-th root of a weight changes by at most $2 m_j^{1/k}$ a support (`LIPSCHITZ`), thus by $\phi_j$, at most
$2 m_j^{1/k} \delta_j / H_j$, and the weight by $k \phi_j (\hat w_j^{1/k} + \phi_j)^{k - 1}$. By the inequality of Hoelder these
add up to at most $k \psi (1 + \psi)^{k - 1} \sum \hat w_j$. With exact sums the mean moves by their share of
$\sum (q_j - Q)(\hat w_j - w_j) / \sum \hat w_j$, and not out of the range of quantities. The rest is what sums relative to r,
their quotient and the addition of r round (`sum_rounding`). Where all quantities are the same, nothing is rounded. $\square$

A jump is moved by `PARTED` roundings, and quantities below it with it: sides can be taken otherwise only where $\hat Q$ is less
than that bound and those two moves away from it. What follows a jump is moved with it: beside it no error is known, whatever the
quantities, where over these moves colours change by more than `UNSEEN` eps, or the thickness of a sample by as much over `ADDED`.
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxsph.engine.access.grid import Grid
from jaxsph.engine.access.precision import PARTED, looks_of, sum_rounding
from jaxsph.engine.field.sums import Sums, by_rays, fetch, known_at, particle_at
from jaxsph.engine.field.tasks import SlabTask
from jaxsph.model.particles.kernels import Kernel
from jaxsph.model.transfer.function import TransferFunction
from jaxsph.numerics.compiled import ratio
from jaxsph.numerics.trees import tree

BLOCK = 16  # particles of a turn
UNSEEN = 2048  # eps that a colour may be off by
ADDED = 32  # times less that the thickness of a sample may be, as those of a ray add up
LIPSCHITZ = 2  # slope of the edge-th root of any kernel of support 1, at most


@tree()
class Jumps:
    """Of a transfer function of one quantity.

    Attributes:
        values: where it jumps, infinite for points at which it does not.
        parted: how far jumps, and quantities beside them, may have been moved in all; no wider is what counts as one.
        changes: of colours and extinction over so much behind each.
    """

    values: Float[Array, " points"]
    parted: Float[Array, ""]
    changes: Float[Array, "points 4"]

    @classmethod
    def of(cls, transfer: TransferFunction) -> Jumps:
        """Those that are `precision.parted`, and control points so near each other that they may as well be one."""
        values, looks = lax.stop_gradient((transfer.values, looks_of(transfer)))
        parted = 2 * PARTED * jnp.finfo(values.dtype).eps * jnp.abs(values).max()
        steps = (values[1:] - values[:-1] <= parted) & (looks[1:] != looks[:-1]).any(1)
        changes = parted * ratio(jnp.abs(looks[1:] - looks[:-1]), (values[1:] - values[:-1])[:, None])
        return cls(jnp.where(jnp.pad(steps, (1, 0)), values, jnp.inf), parted, jnp.pad(changes, ((0, 1), (0, 0))))

    @property
    def some(self) -> Bool[Array, ""]:
        """Whether there are any."""
        return (self.values < jnp.inf).any()

    def beside(
        self, quantity: Float[Array, "*any"], off: Float[Array, "*any"], path: Float[Array, "*lengths"]
    ) -> Bool[Array, "*any"]:
        """Whether quantities that are `off` by so much may be on the other side; those that are off by nothing keep theirs."""
        near = jnp.abs(quantity[..., None] - self.values) <= (off + self.parted)[..., None]
        change = jnp.maximum(self.changes[:, :3].max(1), ADDED * self.changes[:, 3] * path[..., None])
        return (near & ((off > 0)[..., None] | (change > UNSEEN * jnp.finfo(change.dtype).eps))).any(-1)


def beside_jumps(sums: Sums, task: SlabTask, grid: Grid, kernel: Kernel, jumps: tuple[Jumps, ...]) -> Bool[Array, "..."]:
    """Samples, (tasks, samples, rays), that may be on either side of a jump, by the theorem above.

    Of those at full rate alone: bounds of others know no sides.
    """
    weight, *weighted = by_rays(sums)
    eps = jnp.finfo(weight.dtype).eps

    def widen(some: SlabTask, nth: Array, ends: list[Array]) -> list[Array]:
        particle, inside = particle_at(grid.lists.rank, *some.nth_block(BLOCK, nth))
        block = fetch(grid.ordered, particle, inside, some.references)
        counts = block.size > 0
        size = jnp.where(counts, block.size, 1)
        loose = size ** (kernel.degree / kernel.edge) * (known_at(grid.ordered.reach, particle) * block.scale / size - 1)
        rows = [loose, *(sign * quantity for quantity in block.quantities for sign in (-1, 1))]
        return [jnp.maximum(end, jnp.where(counts, row, -jnp.inf).max(1)) for end, row in zip(ends, rows, strict=True)]

    start: Any = [jnp.full(task.depth.shape[0], -jnp.inf, weight.dtype)] * (1 + 2 * len(weighted))
    ends = task.over_blocks(BLOCK, (), widen, start)
    loose, *ends = (end[:, None, None] for end in ends)
    terms = task.entry.count[:, None, None].astype(weight.dtype)
    psi = LIPSCHITZ * loose * ratio(terms, weight) ** (1 / kernel.edge)
    share = jnp.minimum(kernel.edge * psi * (1 + psi) ** (kernel.edge - 1), 1)
    doubt = jnp.zeros(task.shape, bool)
    for value, reference, low, high, one in zip(weighted, task.entry.references, ends[::2], ends[1::2], jumps, strict=True):
        quantity = reference[:, None, None] + ratio(value, weight)
        off = share * (high + low) + sum_rounding(terms, weight.dtype) * jnp.maximum(high, low) + 2 * eps * jnp.abs(quantity)
        doubt |= one.beside(quantity, jnp.where(high + low > 0, off, 0), task.path())
    return doubt & (weight > 0) & (task.entry.level == 0)[:, None, None]
