"""Looks that an optimiser stepped out of range with are taken back into it, and keep their derivatives.

Flow: scene -> [in_range] -> viewing.

A step beyond the end of a range is taken back to it, and derivatives pass as if it had not been: so a further step may lead
inside again. What is off by more than rounding sets a fault; the image is that of the nearest colours and extinctions there are.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Int

from jaxsph.model.points import Points
from jaxsph.model.scene import Scene
from jaxsph.numerics import faults
from jaxsph.numerics.checks import ROUNDED


def scene_in_range(scene: Scene) -> tuple[Scene, Int[Array, ""]]:
    """The scene with all looks in range, and a fault word."""
    word = jnp.int32(faults.NONE)

    def kept(look: Any) -> Any:
        nonlocal word
        if look is None or isinstance(look, tuple):
            return look if look is None else tuple(map(kept, look))
        if isinstance(look, Points):
            (color, extinction), off = _shaded(look.color, look.extinction, look.valid)
            look = dataclasses.replace(look, color=color, extinction=extinction)
        else:
            (colors, extinction), off = _shaded(look.colors, look.extinction)
            control = {name: getattr(look, name) for name in ("values", "extinction_values") if getattr(look, name) is not None}
            ascending = {name: _ascending(values) for name, values in control.items()}
            for name, values in control.items():
                off |= (ascending[name] - values > _slack(values)).any()
            look = dataclasses.replace(look, colors=colors, extinction=extinction, **ascending)
        word |= faults.raised(faults.CLIPPED_LOOK, off)
        return look

    looks = {name: kept(getattr(scene, name)) for name in ("transfer", "volume_transfer", "points")}
    return dataclasses.replace(scene, **looks), word


def _shaded(color: Array, extinction: Array, valid: Any = True) -> tuple[tuple[Array, Array], Bool[Array, ""]]:
    """Colours in [0, 1] and extinctions >= 0; whether any was off by more than rounding."""
    shades, darkness = _clipped(color, 0, 1), _clipped(extinction, 0, jnp.inf)
    bright = (abs(shades - color) > ROUNDED * jnp.finfo(color.dtype).eps).any(-1) & valid
    glowing = (darkness - extinction > _slack(extinction)) & valid
    return (shades, darkness), bright.any() | glowing.any()


def _slack(values: Array) -> Array:
    """What rounding may have moved values by that are made of one another."""
    return ROUNDED * jnp.finfo(values.dtype).eps * jnp.max(jnp.where(jnp.isfinite(values), abs(values), 0), initial=0)


@functools.partial(jax.custom_jvp, nondiff_argnums=(1, 2))
def _clipped(value: Array, lo: float, hi: float) -> Array:
    """`value` in [lo, hi]; its derivative is 1 everywhere, and NaN stays NaN."""
    return jnp.clip(value, lo, hi)


@_clipped.defjvp
def _clipped_moved(lo: float, hi: float, primals: Any, tangents: Any) -> tuple[Array, Array]:
    return _clipped(*primals, lo, hi), tangents[0]


@jax.custom_jvp
def _ascending(values: Array) -> Array:
    """Each value, or the largest before it; derivatives are those of the values themselves."""
    return lax.cummax(values)


@_ascending.defjvp
def _ascending_moved(primals: Any, tangents: Any) -> tuple[Array, Array]:
    return _ascending(*primals), tangents[0]
