"""What particles hold: the amounts and weights that a projection sums up, as given or by name.

Flow: particles, names or arrays -> [held] -> project, reference.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxsph.model.particles.particles import Particles
from jaxsph.numerics.checks import array_of, is_traced, require_finite, require_positive, require_real
from jaxsph.numerics.given import NO_UNITS, own, plain, unit_of

COLUMNS = ("volume", "quantity")


@dataclasses.dataclass(frozen=True)
class Held:
    """Amounts, or values times weights and weights.

    Attributes:
        amounts: over powers of two, such that float32 holds them; 0 where there is no particle.
        exponents: of those powers, of each channel.
        is_mean: whether there is a weight.
        name: of what was asked for.
    """

    amounts: Float[Array, "particles channels"]
    exponents: tuple[int, ...]
    is_mean: bool
    name: str


def unit_held(particles: Particles, of: Any, weight: Any) -> str:
    """The unit of what is summed up, as far as `of` carries one: of a mean that itself, else of it a unit of area."""
    unit = unit_of(of)
    if unit is None or str(unit) in NO_UNITS:
        return ""
    area = "a unit of area" if particles.length_unit is None else f"/ ({particles.length_unit})**2"
    return str(unit) if weight is not None else f"{unit} {area}"


def held_by(particles: Particles, of: Any, weight: Any) -> Held:
    """What is to be summed up, checked.

    Raises:
        ValueError: an unknown name, another length, numbers that are not finite, weights < 0.
    """
    of = ("volume" if weight is None else "quantity") if of is None else of
    name = of if isinstance(of, str) else "values"
    values = _numbers(particles, "of", of)
    if weight is None:
        return Held(*_scaled(particles, [values]), False, name)
    weights = _numbers(particles, "weight", weight)
    if not is_traced(weights):
        require_positive("weight", weights, "means need weights that are not negative", strict=False)
    return Held(*_scaled(particles, [values * weights, weights]), True, name)


def require_usable(particles: Particles) -> None:
    """Raise `ValueError` that names the first position or support that has no column (host side)."""
    valid = np.asarray(particles.valid)
    support = np.where(valid, particles.support, 1)
    require_finite("particles.position", np.where(valid[:, None], particles.position, 0))
    require_finite("particles.support", support)
    require_positive("particles.support", support, "give the support radius H > 0 of every particle")


def emission_measure(mass: Any, density: Any, coefficient: Any = 1.0, power: float = 2.0) -> Any:
    r"""Amounts whose projection is the integral of $A \rho^n$ along rays: $A_j \rho_j^{n-1} m_j$.

    For n = 1 that is $A$ times the column density, exactly. For others it is the SPH sum of $A \rho^{n-1}$, each particle with
    the density of its own; the power of the summed density at a point is another number, and no sum over particles.

    Args:
        mass, density: of particles, in the order of their arrays.
        coefficient: A, one number or one a particle, such as a cooling function of the temperature.
        power: n.

    Raises:
        ValueError: arrays with units, as the unit of what they give is not worked out here; masked arrays.
    """
    given = {"mass": mass, "density": density, "coefficient": coefficient}
    mass, density, coefficient = (
        plain(name, value, "units are not multiplied here", "and name that of the result yourself")
        for name, value in given.items()
    )
    if any(is_traced(value) for value in (mass, density, coefficient)):
        return coefficient * jnp.asarray(density) ** (power - 1) * mass
    parts = [np.asarray(value, np.float64) for value in (mass, density, coefficient)]
    return parts[2] * parts[1] ** (power - 1) * parts[0]


def _numbers(particles: Particles, name: str, given: Any) -> Any:
    """A column of particles: a number for each entry, in float64 where they are known."""
    if isinstance(given, str):
        if given not in COLUMNS:
            known = " or ".join(map(repr, COLUMNS))
            raise ValueError(f"`{name}` must be {known}, columns that particles have, or one number a particle; got {given!r}")
        given = getattr(particles, given)
    given = own(name, given)
    value = given if is_traced(given) else np.asarray(given)
    require_real(name, value)
    count = None if is_traced(particles.valid) else particles.num_particles
    if value.ndim != 1 or value.shape[0] not in (count, particles.capacity):
        expected = f"({particles.capacity if count is None else count},)"
        raise ValueError(f"`{name}` must have shape {expected}, one number for each particle, got {tuple(value.shape)}")
    if is_traced(value):
        return jnp.pad(value, (0, particles.capacity - value.shape[0]))
    if value.shape[0] == count:
        require_finite(name, value)
    value = value.astype(np.float64)
    return np.pad(value, (0, particles.capacity - value.shape[0]))


def _scaled(particles: Particles, channels: list[Any]) -> tuple[Any, tuple[int, ...]]:
    """Channels side by side, over the power of two next to their largest number where that is known."""
    dtype = particles.dtype
    if is_traced(particles.valid, *channels):
        return jnp.stack([jnp.where(particles.valid, one, 0).astype(dtype) for one in channels], 1), (0,) * len(channels)
    known = [np.where(np.asarray(particles.valid), one, 0) for one in channels]
    largest = [float(np.abs(one).max(initial=0)) for one in known]
    exponents = tuple(math.frexp(one)[1] if math.isfinite(one) else 0 for one in largest)
    columns = [np.ldexp(one, -exponent).astype(dtype) for one, exponent in zip(known, exponents, strict=True)]
    return array_of(np.stack(columns, 1)), exponents
