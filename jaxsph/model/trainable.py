"""What an optimiser may train of a scene or a camera: its numbers by name, and the way back.

Flow: scene, camera -> [trainable] -> numbers -> optax -> [rebuild] -> scene, camera -> render.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsph.numerics.checks import array_of, as_usual

FIXED = {"near", "far", "snug", "box", "within", "splats_beyond", "rest", "eye_rest", "position_rest", "lower_rest"}
"""What is looked at and how, and digits of places, which move with these."""
AXES, TURN = r"\baxes$", "turn"


def trainable(part: Any) -> tuple[dict[str, Array], Callable[[dict[str, Any]], Any]]:
    r"""The numbers of a scene or a camera that may be trained, and a function that puts such numbers back.

    Every place is there once: what rounding has left of it (`position_rest`, `eye_rest`) stays as it is, so that a step of s
    moves a particle or an eye by s. A camera stays one: in place of its axes there is a `turn` t, which is 0 at first and turns
    each axis a to $a + k (t \times a + t \times (t \times a) / 2)$ with $k = 4 / (4 + |t|^2)$, by $2 \arctan(|t| / 2)$ about t.
    Integers, flags, near and far, clips and periods are no numbers to train, and entries that only pad arrays stay as they are.

    Args:
        part: a `jaxsph.Scene`, `Camera`, `Particles`, `TransferFunction`, `Points`, `Volume`, `Surface`, or a dictionary or a
            tuple of such.

    Returns:
        A dictionary of arrays of floats by name: `numbers["particles.position"]` of a scene, `numbers["eye"]` of a camera,
        `numbers["volume.0.values"]` of the first of several volumes; and `rebuild(numbers)`, a part of the same kind, also under
        `jit`, `grad` and `vmap`. What is left out of its argument keeps its value: `rebuild({"transfer.colors": colors})`.
        Ranges are the caller's: colours in [0, 1], supports > 0.

    Raises:
        ValueError: no such part; `rebuild`: a name that the part does not have, an array of another shape.
    """
    # A tuple of numbers is one array, as the colour of a surface.
    leaves, kind = jax.tree_util.tree_flatten_with_path(part, is_leaf=_is_row)
    every = {jax.tree_util.keystr(path, simple=True, separator="."): leaf for path, leaf in leaves}
    free = {name: array_of(leaf) for name, leaf in every.items() if not FIXED & {*name.split(".")} and _is_float(leaf)}
    if not free:
        raise ValueError(f"`part` must be a scene, a camera or a part of one, with numbers to train, got {type(part).__name__}")
    numbers = {re.sub(AXES, TURN, name): 0 * leaf[0] if re.search(AXES, name) else leaf for name, leaf in free.items()}

    @as_usual()
    def rebuild(given: dict[str, Any]) -> Any:
        made = dict(every)
        for name, value in given.items():
            if name not in numbers:
                raise ValueError(f"`numbers` has {name!r}, which is not to be trained; known are {', '.join(numbers)}")
            if jnp.shape(value) != (wanted := numbers[name].shape):
                raise ValueError(f"`{name}` must have shape {wanted}, got {jnp.shape(value)}; for a batch take `jax.vmap`")
            place = name if name in free else re.sub(f"{TURN}$", "axes", name)
            former, valid = free[place], every.get(re.sub(r"\w+$", "valid", place))
            new = jnp.asarray(value, former.dtype)
            new = new if place == name else _turned(former, new)
            made[place] = new if valid is None else jnp.where(valid, new.T, former.T).T
        return jax.tree.unflatten(kind, list(made.values()))

    return numbers, rebuild


def _is_row(value: Any) -> bool:
    return isinstance(value, tuple) and value != () and all(isinstance(one, float) for one in value)


def _is_float(leaf: Any) -> bool:
    return isinstance(leaf, float | tuple) or jnp.issubdtype(getattr(leaf, "dtype", bool), jnp.floating)


def _turned(axes: Float[Array, "3 3"], turn: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """Axes turned by a rotation: orthonormal, and the same bits where it is 0."""
    once = jnp.cross(turn, axes)
    return axes + (once + jnp.cross(turn, once) / 2) * (4 / (4 + (turn * turn).sum()))
