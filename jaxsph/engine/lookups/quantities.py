r"""Quantities in units of the transfer function's, so that sums of them neither underflow nor overflow nor lose digits.

Flow: particles, transfer function -> [quantities] -> control, cast.

Only where a quantity lies among the control points matters. Densities of 1e-30 times weights of 1e-9 are no numbers in
float32; differences between temperatures of 1e6 to 1e6 + 1 would be lost beside 1e6. So quantities and control points are both
multiplied by a power of two and, where the points span less than their distance from zero, moved by the least of them.
Both steps are exact for all quantities among the control points, so ordinary images stay the same bits but for the rounding
that they save.
"""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxsph.model.particles.particles import Particles
from jaxsph.model.transfer.function import MIN_NORMALS, TransferFunction
from jaxsph.numerics import exponents
from jaxsph.numerics.extremes import clamped, greater, lesser

MAX_QUANTITY = (
    2.0**60
)  # in units of the largest control point: quantities beyond it are clipped to it, as a mean that holds one is


def in_units_of(particles: Particles, transfer: TransferFunction) -> tuple[Particles, TransferFunction]:
    """Both in units of the control points, of each of two quantities in those of its own.

    Of particles that carry one quantity the transfer function then has one set of control points.
    """
    if particles.extinction_quantity is None or transfer.extinction_values is None:
        transfer = transfer.joined()
        quantity, values = rescaled(particles.quantity.astype(transfer.values.dtype), transfer.values)
        return dataclasses.replace(particles, quantity=quantity), dataclasses.replace(transfer, values=values)
    first, second = (quantity.astype(transfer.values.dtype) for quantity in particles.quantities)
    quantity, values = rescaled(first, transfer.values)
    other, extinction_values = rescaled(second, transfer.extinction_values)
    particles = dataclasses.replace(particles, quantity=quantity, extinction_quantity=other)
    return particles, dataclasses.replace(transfer, values=values, extinction_values=extinction_values)


def rescaled(
    quantity: Float[Array, " particles"], values: Float[Array, " points"]
) -> tuple[Float[Array, " particles"], Float[Array, " points"]]:
    """A quantity and control points, both in the same units, in which the largest control point is about 1.

    Differentiation: the units are constants.
    """
    largest = jnp.abs(values).max()
    unit = exponents.power_of_two(-exponents.split(largest)[1], values.dtype)
    unit = lax.stop_gradient(jnp.where(largest > 0, greater(unit, jnp.finfo(unit.dtype).tiny), 1))
    scaled, values = clamped(quantity * unit, -MAX_QUANTITY, MAX_QUANTITY), values * unit
    quantity = jnp.where(jnp.isfinite(quantity), scaled, quantity)  # what is no number is to be found as such
    first, last = values[0], values[-1]
    narrow = (first * last > 0) & (last - first <= lesser(jnp.abs(first), jnp.abs(last)))
    least = lax.stop_gradient(jnp.where(narrow, first, 0))
    return quantity - least, values - least


def too_small(values: Float[Array, " points"]) -> Bool[Array, ""]:
    """Whether control points are (nearly) subnormal numbers, and quantities among them would be taken for zero."""
    largest = jnp.abs(values).max()
    return ((largest > 0) | exponents.is_subnormal(values).any()) & (largest < MIN_NORMALS * jnp.finfo(values.dtype).tiny)
