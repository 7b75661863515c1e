"""Volume: numbers on the points of a regular grid, and what lies between them.

Flow: files, scenes, resampled particles -> [volume] -> field -> cast -> image.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Num

from jaxsph.numerics import checks
from jaxsph.numerics.checks import array_of, is_traced
from jaxsph.numerics.trees import Placed, kind_of, line_of, numbers_in, on_host, row_of, span_of, tree

KEPT = ("uint8", "int8", "uint16", "int16")  # integers that stay as they are in memory: float32 holds each of them exactly


@tree(static=("length_unit",))
class Volume(Placed):
    r"""A quantity given at the points $x = \text{lower} + (i, j, k) \cdot \text{spacing}$ of a grid; make it with `from_array`.

    Between grid points it is trilinear; outside of the box that they span there is nothing. Nor is there in a cell that has a
    corner whose value is NaN: so holes and masks are said. Values may be changed by
    `dataclasses.replace` under jit without recompiling, and an image can be differentiated by them where they are floats.

    Attributes:
        values: at the grid points, in the units of the transfer function.
        lower: position of the point (0, 0, 0), length units.
        spacing: between neighbouring points along x, y and z, > 0, length units.
        lower_rest: what rounding a float64 `lower` has left, length units.
        length_unit: what the unit of lengths is called, where the place was given with one (static).
    """

    PLACE, REST = "lower", "lower_rest"
    values: Num[Array, "nx ny nz"]
    lower: Float[Array, "3"]
    spacing: Float[Array, "3"]
    lower_rest: Float[Array, "3"]
    length_unit: str | None = None

    def __repr__(self) -> str:
        unit = "" if self.length_unit is None else f" {self.length_unit}"
        place = f"from {row_of(self.lower)}", f"spacing {row_of(self.spacing)}{unit}"
        numbers = None if numbers_in(self.values) is None else f"values {span_of(self.values)}"
        return line_of("Volume", kind_of(self.values), numbers, *place)

    @classmethod
    def from_array(cls, values: Any, lower: Any = (0.0, 0.0, 0.0), spacing: Any = 1.0) -> Volume:
        """Check and pack the values of a grid.

        Arrays may carry units, such as those of unyt and astropy. `spacing` is then converted to the unit of `lower`, if that is
        not the origin, and values keep their own, which control points of the transfer function are numbers in.

        Args:
            values: (Nx, Ny, Nz) at the grid points, at least two along each axis; the first index counts along x. Integers of 8
                and 16 bits are kept as they are; wider ones, booleans and half floats become float32, which rounds integers
                beyond 2^24. NaN is where there is nothing: the (up to eight) cells around such a point are not shown, in pictures
                and references alike, and have no part in ranges of colours and in derivatives.
            lower: (3,) position of the point (0, 0, 0), length units.
            spacing: between neighbouring points, length units: a number, or (3,) for x, y and z; > 0.

        Returns:
            Volume that is rendered in float64 if `values` are float64 and x64 is enabled, else in float32.

        Raises:
            ValueError: other shapes, an axis of one point, values that are infinite, all NaN or too large, a spacing that
                is not > 0 and finite, a `lower` that is not finite; masked arrays, units that cannot be converted.
        """
        values, (lower, unit) = checks.own("values", values), checks.with_unit("lower", lower)
        if unit is None and not is_traced(lower) and not np.any(lower):  # the origin is it in any unit
            spacing, unit = checks.with_unit("spacing", spacing)
        else:
            spacing = checks.in_unit("spacing", spacing, unit, of="lower")
        given = checks.require_real("values", values)
        if given.ndim != 3:
            raise ValueError(f"`values` must have shape (Nx, Ny, Nz), got {given.shape}; reshape it to three axes")
        require_grid("`values`", given.shape)
        if not is_traced(given):
            _refuse_infinite(given, "repair them; NaN is what stands for nothing")
        with np.errstate(over="ignore"):  # what overflows is refused by name
            wide = given.dtype if jnp.issubdtype(given.dtype, jnp.floating) else jnp.float32
            wide = jnp.promote_types(jax.dtypes.canonicalize_dtype(wide), jnp.float32)
            packed = array_of(given, given.dtype if np.dtype(given.dtype).name in KEPT else wide)
        if not is_traced(given) and packed.dtype != given.dtype:
            rescale = f"they overflow {packed.dtype}: rescale them, or use float64 under jax.enable_x64"
            _refuse_infinite(packed, rescale)
        dtype = jnp.float64 if packed.dtype == jnp.float64 else jnp.float32
        exact = jnp.asarray(lower) if is_traced(lower) else checks.vector_of("lower", lower)
        steps = jnp.broadcast_to(spacing, 3) if is_traced(spacing) else spacing
        if not is_traced(steps):
            several = steps if np.ndim(steps) else np.broadcast_to(steps, 3)
            steps = checks.vector_of("spacing", several, "give one number, or one for each of x, y and z")
            checks.require_positive("spacing", steps, "spacing is the distance between neighbouring grid points")
            change = f"it underflows {np.dtype(dtype)}: change the unit of length"
            checks.require_positive("spacing", np.asarray(steps, dtype), change)
        near = exact.astype(dtype)
        return cls(packed, array_of(near), array_of(steps, dtype), array_of(exact - near, dtype), checks.name_of(unit))

    @property
    def shape(self) -> tuple[int, int, int]:
        """Grid points along x, y and z (static)."""
        return self.values.shape  # type: ignore[return-value]

    @on_host
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper corner of the grid, (3,) and (3,), float64, length units (host side)."""
        lower = np.asarray(self.lower, np.float64) + np.asarray(self.lower_rest, np.float64)
        return lower, lower + (np.array(self.shape) - 1) * np.asarray(self.spacing, np.float64)


def _refuse_infinite(values: Any, remedy: str) -> None:
    """Raise `ValueError` of values that are infinite, or of which none is a number."""
    values = np.asarray(values)
    if values.dtype.kind not in "iub" and np.isnan(values.min()):
        if np.isnan(values).all():
            raise ValueError("`values` must hold a number, but all of them are NaN: nothing would be shown; check the array")
        values = np.where(np.isnan(values), 0, values)
    checks.require_finite("values", values, remedy)


def require_grid(name: str, shape: tuple[int, ...]) -> None:
    """Raise `ValueError` of an axis of one point: nothing lies between points there."""
    if min(shape[-3:], default=2) < 2:
        told = f"{name} must have at least two points along each axis, got shape {shape}"
        raise ValueError(f"{told}; repeat a single plane to give it a thickness")
