"""Keep XLA from fusing a computation into each of its consumers.

On CPU, XLA fuses cheap-looking producers into every consumer and evaluates them anew in each: shading was computed six times,
the sphere-against-pyramid test twelve times. `lax.optimization_barrier` is dropped before fusion there. A branch is a
boundary that fusion respects, so the computation is put behind one that is always taken.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool


def computed_once(witness: Bool[Array, ""], function: Callable[..., Any], *arguments: Any) -> Any:
    """`function(*arguments)`, computed once however many consumers it has.

    Args:
        witness: any scalar that is not known when compiling. Its value does not matter: the branch is taken where the number
            of its bits is not negative, which holds for true, for false, and thus for comparisons with NaN.
        function: pure; returns a pytree of arrays.
    """
    shapes = jax.eval_shape(function, *arguments)

    def nothing(*_: Any) -> Any:
        return jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)

    always = lax.population_count(jnp.asarray(witness).astype(jnp.int32)) >= 0
    return lax.cond(always, function, nothing, *arguments)
