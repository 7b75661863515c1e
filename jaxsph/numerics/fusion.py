"""Keep XLA from fusing a computation into each of its consumers.

On CPUs XLA fuses cheap-looking producers into every consumer and evaluates them anew in each: shading was computed six times,
the sphere-against-pyramid test twelve times. `lax.optimization_barrier` is dropped before fusion there. A branch is a
boundary that fusion respects, so the computation is put behind one that is always taken. On accelerators a branch is a round
trip to the host, and fusion looks at what it costs: there is no barrier (`engine.runtime.tuning`).
"""

from __future__ import annotations

import contextlib
import contextvars
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool

_BARRIERS = contextvars.ContextVar("barriers", default=True)


@contextlib.contextmanager
def barriers(kept: bool) -> Iterator[None]:
    """Have barriers in what is traced meanwhile, or not."""
    token = _BARRIERS.set(kept)
    try:
        yield
    finally:
        _BARRIERS.reset(token)


def barriers_kept() -> bool:
    """Whether what is traced now is worked around XLA's fusion for CPUs."""
    return _BARRIERS.get()


def fusion_barrier(witness: Bool[Array, ""], function: Callable[..., Any], *arguments: Any) -> Any:
    """`function(*arguments)`, computed once however many consumers it has.

    Args:
        witness: any scalar that is not known when compiling. Its value does not matter: the branch is taken where the number
            of its bits is not negative, which holds for true, for false, and thus for comparisons with NaN.
        function: pure; returns a pytree of arrays.
    """
    if not barriers_kept():
        return function(*arguments)
    once = jax.jit(function, inline=True)  # so that it is traced once, however deep barriers are nested
    shapes = once.eval_shape(*arguments)

    def nothing(*_: Any) -> Any:
        return jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)

    always = lax.population_count(jnp.asarray(witness).astype(jnp.int32)) >= 0
    return lax.cond(always, once, nothing, *arguments)


def side_by_side(rows: Sequence[Array], axis: int) -> Array:
    """`jnp.stack`, of what is found in the same XLA kernel.

    On CPUs `jnp.stack` is a loop for each row, with all that rows share in each, and compiles as slowly as so many kernels of
    XLA's would. Here each element chooses.
    """
    if not barriers_kept():
        return jnp.stack(rows, axis)
    shape = [1] * (rows[0].ndim + 1)
    shape[axis] = len(rows)
    row, found = np.arange(len(rows)).reshape(shape), jnp.expand_dims(rows[-1], axis)  # known when compiling
    for k, value in enumerate(rows[:-1]):
        found = jnp.where(row == k, jnp.expand_dims(value, axis), found)
    return found


def together_of(first: Array, second: Array) -> Any:
    """Two arrays as one complex number: of every array that a loop or a branch gives XLA makes a kernel, that finds all anew."""
    return lax.complex(first, second) if barriers_kept() else (first, second)


def apart_of(pair: Any) -> tuple[Array, Array]:
    """The two arrays again."""
    return (pair.real, pair.imag) if barriers_kept() else pair
