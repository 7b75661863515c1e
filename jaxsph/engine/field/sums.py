"""Sums over particles or points at samples: of weights, and of one or more quantities times weights.

Flow: gather, nodes -> [sums] -> media.

On CPUs XLA makes a kernel of every array that a loop carries, and each evaluates every weight again. So two sums travel as one
complex number there, and are taken apart where they are read; elsewhere each is an array of its own (`numerics.tuning`). Three
are what a reduction of three operands gives, which is one kernel as well: with it, a block of particles with two quantities takes
1.1 to 1.25 times as long as with one, as three sums that a loop carries it took 1.5 times.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterable

import jax.numpy as jnp
from jax import custom_jvp, lax
from jaxtyping import Array, Float

from jaxsph.numerics.fusion import barriers_kept
from jaxsph.numerics.trees import tree

REDUCED = 2  # quantities whose sums, of weights among them, are reduced rather than carried


@tree(static=("num_quantities",))
class Sums:
    """Sums up to one common factor.

    Attributes:
        packed: one or two sums an array, in the order of `all`.
        num_quantities: how many there are besides that of weights.
    """

    packed: tuple[Array, ...]
    num_quantities: int

    @property
    def all(self) -> tuple[Float[Array, "..."], ...]:
        """Of V W, then of (q - reference) V W for each quantity q."""
        parts = [part for pair in self.packed for part in ((pair.real, pair.imag) if jnp.iscomplexobj(pair) else (pair,))]
        return tuple(parts[: 1 + self.num_quantities])


def sums_of(channels: list[Float[Array, "..."]]) -> Sums:
    """Those sums, that of weights first."""
    number = len(channels) - 1
    if not barriers_kept() or number == REDUCED:
        return Sums(tuple(channels), number)
    seconds = [*channels[1::2], jnp.zeros_like(channels[0])]
    return Sums(tuple(lax.complex(*pair) for pair in zip(channels[::2], seconds, strict=False)), number)


def with_block(sums: Sums, block: Iterable[tuple[Array, Iterable[Array]]]) -> Sums:
    """Sums with a block of particles more: the weight of each, and what it is multiplied by for each quantity."""
    if not barriers_kept() or sums.num_quantities != REDUCED:
        channels = list(sums.all)
        for weight, factors in block:
            channels = [channels[0] + weight, *(old + weight * q for old, q in zip(channels[1:], factors, strict=True))]
        return sums_of(channels)
    added = in_halves([[weight, *(weight * q for q in factors)] for weight, factors in block])
    return sums_of([old + new for old, new in zip(sums.all, added, strict=True)])


@custom_jvp
def in_halves(parts: list[list[Array]]) -> tuple[Array, ...]:
    """Element-wise sums of lists, in one loop: within the halves of `parts` written out, over the halves by a reduction."""
    halves = [
        [functools.reduce(jnp.add, terms) for terms in zip(*half, strict=True)] for half in (parts[::2], parts[1::2]) if half
    ]
    operands = tuple(jnp.stack(pair) for pair in zip(*halves, strict=True))
    start = tuple(jnp.zeros((), value.dtype) for value in operands)
    return tuple(lax.reduce(operands, start, lambda a, b: tuple(p + q for p, q in zip(a, b, strict=True)), (0,)))


# JAX's own rule takes the reduction apart: its sums are rounded otherwise, and may lie on the other side of a kink
in_halves.defjvp(lambda parts, moves: (in_halves(*parts), in_halves(*moves)))


def by_rays(sums: Sums) -> list[Float[Array, "tasks samples rays"]]:
    """The sum of weights and those of quantities, rays in a row: short rows do not vectorise."""
    rows = tuple(value.reshape(*value.shape[:2], -1) for value in sums.packed)
    return list(dataclasses.replace(sums, packed=rows).all)
