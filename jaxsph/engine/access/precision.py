"""What a precision can tell apart: lengths that it can hold, weights that do not vanish, and units of quantities.

A view coordinate is off by some eps of the distance from the eye, whatever the support. That moves a particle; it is a fault
only where it could be seen: where the move is not small against the support, nor against what the image resolves there, the finer
of its pixels and its samples.

Of a quantity only matters where it lies among the control points, so both are in units of these: sums neither underflow nor
overflow nor lose digits. Densities of 1e-30 times weights of 1e-9 are no numbers in float32; differences between temperatures of
1e6 to 1e6 + 1 would be lost beside 1e6. So both are multiplied by a power of two and, where the points span less than their
distance from zero, moved by the least of them. Both steps are exact for all quantities among the control points, so ordinary
images stay the same bits but for the rounding that they save.

At a jump of the transfer function rounding alone decides which side a mean of quantities lies on. So the jump is put between the
quantities: it moves down by `PARTED` roundings, and quantities below it, but nearer than that, move as far again. What one
particle, or several of one quantity, rule is then on its own side.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxsph.model.camera.camera import Camera
from jaxsph.model.particles.kernels import Kernel
from jaxsph.model.particles.particles import Particles
from jaxsph.model.transfer.function import MIN_NORMALS, TransferFunction
from jaxsph.numerics.compiled import clamped, greater, is_subnormal, lesser, mantissa_and_exponent, power_of_two

LIFT = 30  # binary digits by which strengths are lifted at least, so that weak ones do not underflow
OFF = 2  # eps of its distance from the eye that a view coordinate may be off
SHARE = 1 / 16  # of a support, pixel or sample, that it may be off unnoticed
MIN_STEP = 16  # eps of its depth that a sample must be away from the next
RANGE = 0.4  # power of the largest number that lengths may reach, so that products of two and their quotients stay finite
MAX_SHELL_BITS = 16  # binary digits of a support's radius: a shell thinner than that may weigh nothing
PARTED = 8  # eps of the largest control point: more than a mean of one particle is off, or of tens of equal ones as a rule
MAX_QUANTITY = 2.0**60  # in units of the largest control point: beyond it they are clipped to it, as a mean that holds one is


def longest(dtype: Any) -> float:
    """Largest length that can be rendered; the least is its inverse."""
    return float(jnp.finfo(dtype).max) ** RANGE


def lift_of_sizes(kernel: Kernel) -> int:
    """Binary digits that sizes are lifted by, the root of what strengths are lifted by."""
    return -(-LIFT // kernel.degree)


def weakest(kernel: Kernel, dtype: Any) -> float:
    r"""Least strength, as a share of the largest, of a particle that is seen right up to its edge.

    Where $1 - q = \delta$ a weight is about $\delta^k$ times the strength, with k the kernel's order there. It must be a normal
    number at $\delta$ = 2^-MAX_SHELL_BITS.
    """
    lift = kernel.degree * lift_of_sizes(kernel)
    return 2.0 ** (int(jnp.finfo(dtype).minexp) + kernel.edge * MAX_SHELL_BITS - lift)


def too_fine(camera: Camera, samples: int) -> Bool[Array, ""]:
    """Whether neighbouring samples have (nearly) the same depth, or depths leave the range of lengths."""
    near, far = camera.near, camera.far
    limit = longest(near.dtype)
    if camera.is_perspective:
        step, bad = jnp.log(far / near) / samples, (near < 1 / limit) | (far > limit)
    else:
        largest = jnp.maximum(jnp.abs(near), jnp.abs(far))
        step, bad = (far - near) / (samples * largest), (largest < 1 / limit) | (largest > limit)
    return bad | (step < MIN_STEP * jnp.finfo(near.dtype).eps)


def unresolved(
    view: Float[Array, "particles 3"],
    distance: Float[Array, " particles"],
    support: Float[Array, " particles"],
    camera: Camera,
    depths: Float[Array, " samples"],
) -> Bool[Array, " particles"]:
    """Particles in view whose rounding could be seen, or whose lengths cannot be computed with."""
    dtype = view.dtype
    near, far, samples = camera.near.astype(dtype), camera.far.astype(dtype), depths.shape[0]
    half = camera.half_height.astype(dtype) * jnp.asarray([camera.width / camera.height, 1], dtype)
    depth = jnp.clip(view[:, 2], near, far) if camera.is_perspective else jnp.ones_like(support)
    step = depth * jnp.log(far / near) / samples if camera.is_perspective else (far - near) / samples
    pixel = depth * (2 * half[1] / camera.height)
    in_view = (jnp.abs(view[:, :2]) <= 2 * (support[:, None] + depth[:, None] * half)).all(1)
    moved = OFF * jnp.finfo(dtype).eps * distance > SHARE * jnp.maximum(support, jnp.minimum(pixel, step))
    around = jnp.maximum(distance, jnp.maximum(jnp.abs(near), jnp.abs(far)))
    beyond = jnp.maximum(around, support) > longest(dtype)
    return (in_view & (moved | (support < around / longest(dtype)))) | beyond


def in_units_of(particles: Particles, transfer: TransferFunction) -> tuple[Particles, TransferFunction]:
    """Both in units of the control points, of each of two quantities in those of its own.

    Of particles that carry one quantity the transfer function then has one set of control points.
    """
    if particles.extinction_quantity is None or transfer.extinction_values is None:
        transfer = transfer.joined()
        quantity, values = rescaled(particles.quantity.astype(transfer.values.dtype), transfer.values)
        quantity, values = parted(quantity, values, looks_of(transfer))
        return dataclasses.replace(particles, quantity=quantity), dataclasses.replace(transfer, values=values)
    first, second = (quantity.astype(transfer.values.dtype) for quantity in particles.quantities)
    quantity, values = parted(*rescaled(first, transfer.values), transfer.colors)
    other, extinction_values = parted(*rescaled(second, transfer.extinction_values), transfer.extinction[:, None])
    particles = dataclasses.replace(particles, quantity=quantity, extinction_quantity=other)
    return particles, dataclasses.replace(transfer, values=values, extinction_values=extinction_values)


def rescaled(
    quantity: Float[Array, " particles"], values: Float[Array, " points"]
) -> tuple[Float[Array, " particles"], Float[Array, " points"]]:
    """A quantity and control points, both in the same units, in which the largest control point is about 1.

    Differentiation: the units are constants.
    """
    largest = jnp.abs(values).max()
    unit = power_of_two(-mantissa_and_exponent(largest)[1], values.dtype)
    unit = lax.stop_gradient(jnp.where(largest > 0, greater(unit, jnp.finfo(unit.dtype).tiny), 1))
    scaled, values = clamped(quantity * unit, -MAX_QUANTITY, MAX_QUANTITY), values * unit
    quantity = jnp.where(jnp.isfinite(quantity), scaled, quantity)  # what is no number is to be found as such
    first, last = values[0], values[-1]
    narrow = (first * last > 0) & (last - first <= lesser(jnp.abs(first), jnp.abs(last)))
    least = lax.stop_gradient(jnp.where(narrow, first, 0))
    return quantity - least, values - least


def looks_of(transfer: TransferFunction) -> Float[Array, "points channels"]:
    """Colours and extinction at the control points of a transfer function of one quantity."""
    return jnp.column_stack([transfer.colors, transfer.extinction])


def parted(
    quantity: Float[Array, "*any"], values: Float[Array, " points"], looks: Float[Array, "points channels"]
) -> tuple[Array, Array]:
    """A quantity and control points, with jumps between the quantities, see above; the same bits where there are no jumps.

    A jump moves by no more than a quarter of the way to the control point before it. Points that repeat one another's look, as
    those that pad a table do, are none.

    Differentiation: what is moved moves by constants.
    """
    before = jnp.append(-jnp.inf, values[:-1])
    first = jnp.searchsorted(values, values)  # of equal points
    gap = jnp.minimum(PARTED * jnp.finfo(values.dtype).eps * jnp.abs(values).max(), (values - before[first]) / 4)
    steps = (before == values) & jnp.append(False, (looks[1:] != looks[:-1]).any(1))
    jumps = ((values[:, None] == values) & steps).any(1)  # all of a group of equal points that holds a step
    moved = lax.stop_gradient(jnp.where(jumps, gap, 0))

    def move(quantity: Array) -> Array:
        above = jnp.minimum(jnp.searchsorted(values, quantity, side="right"), values.shape[0] - 1)
        highest = values[above] - 2 * moved[above]
        return jnp.where((quantity < values[above]) & (quantity > highest), highest, quantity)

    still = lax.stop_gradient(quantity)
    return quantity + lax.cond(jumps.any(), lambda at: move(at) - at, jnp.zeros_like, still), values - moved


def sum_rounding(terms: Array, dtype: Any) -> Array:
    """How far a computed mean of `terms` can be off, as a share of the largest."""
    return (terms + 6) * jnp.finfo(dtype).eps


def too_small(values: Float[Array, " points"]) -> Bool[Array, ""]:
    """Whether control points are (nearly) subnormal numbers, and quantities among them would be taken for zero."""
    largest = jnp.abs(values).max()
    return ((largest > 0) | is_subnormal(values).any()) & (largest < MIN_NORMALS * jnp.finfo(values.dtype).tiny)
