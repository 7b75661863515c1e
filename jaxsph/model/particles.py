"""The particle set: a padded, masked pytree of positions, supports, quantities and volumes.

Flow: files, scenes -> [particles] -> access -> cast -> image.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxsph.model import kernels
from jaxsph.model.clips.shapes import Box
from jaxsph.numerics.checks import is_traced, require_finite, require_positive, require_real, require_shape
from jaxsph.numerics.given import in_unit, name_of, own, with_unit

NEGLIGIBLE = 2.0**-16  # of a support that rounding may move a particle by, before what is lost is kept


NOTHING = {"position": 0.0, "support": 1.0, "quantity": 0.0, "volume": 0.0}  # what entries hold where there is no particle
SECOND = "extinction_quantity"  # a column that there may be or not


def capacity_class(count: int) -> int:
    """The least of 4, 5, 6, 7 times a power of two that is at least `count` and 1: four classes an octave."""
    step = max(1 << max((count - 1).bit_length() - 1, 0), 4) // 4
    return max(-(-count // step) * step, 1)


@dataclasses.dataclass(frozen=True)
class Particles:
    """SPH particles that carry a quantity; make them with `from_arrays`.

    The arrays are padded to a capacity, with the first particle at volume 0; `valid` marks the particles that exist. Values
    may be changed by `dataclasses.replace` under jit without recompiling.

    Attributes:
        position: view-independent (world) coordinates, length units.
        support: support radius H > 0 (the kernel is 0 at distance H), length units.
        quantity: the carried quantity q, the input of the transfer function; of two, that of colours.
        volume: V >= 0, any unit: only ratios between particles matter.
        valid: which entries are particles; the rest is padding and contributes nothing.
        kernel: its name, one of `jaxsph.model.kernels.KERNELS`.
        position_rest: what rounding float64 positions to `position` has left, length units; None where that is a negligible
            part of every support.
        extinction_quantity: the second carried quantity, by which extinction is looked up; None where there is one alone.
        box: the period, if there is one: supports reach across its faces, and one period is shown. Positions may be outside.
        length_unit: what the unit of lengths is called, where positions were given with one (static).
    """

    position: Float[Array, "particles 3"]
    support: Float[Array, " particles"]
    quantity: Float[Array, " particles"]
    volume: Float[Array, " particles"]
    valid: Bool[Array, " particles"]
    kernel: str = "poly6"
    position_rest: Float[Array, "particles 3"] | None = None
    extinction_quantity: Float[Array, " particles"] | None = None
    box: Box | None = None
    length_unit: str | None = None

    @classmethod
    def from_arrays(
        cls,
        position: Any,
        support: Any,
        quantity: Any,
        volume: Any = 1.0,
        kernel: str = "poly6",
        *,
        capacity: int | None = None,
        box: Any = None,
    ) -> Particles:
        """Check and pack arrays of particles.

        Arrays may carry units, such as those of unyt and astropy. Lengths and volumes are then converted to the unit of
        `position`, and numbers without one are meant in it. Carried quantities keep their own unit, and a transfer function's
        values are numbers in that.

        Args:
            position: (N, 3), length units; N = 0 is an empty scene.
            support: (N,) or a number: support radius H > 0, length units.
            quantity: (N,) or a number; or a pair of such, (N,) at least one: colour is then looked up by the first, extinction
                by the second, with a transfer function that has `extinction_values`.
            volume: (N,) or a number, >= 0.
            kernel: name of the smoothing kernel.
            capacity: pad to this many entries; default the class of N, see `capacity_class`, so that sets of similar size
                share compiled programs.
            box: (Lx, Ly, Lz), the sides of a periodic box whose lower corner is the origin, or a `jaxsph.Box`; length units.

        Returns:
            Particles of dtype float64 if `position` is float64 and x64 is enabled, else float32. float16 and bfloat16
            are promoted to float32. Where float64 positions become float32, what that loses is kept in `position_rest` if it
            matters: far from the origin, or beside small supports, images are those of the float64 positions.

        Raises:
            ValueError: wrong shapes, non-finite values, supports <= 0, volumes < 0, unknown kernel, capacity < N, numbers that
                the dtype cannot hold, a periodic box with a side that is not > 0 or shorter than a support; masked arrays, units
                that cannot be converted to that of positions.
        """
        kernels.by_name(kernel)
        position, unit = with_unit("position", position)
        given = {"position": position, "support": in_unit("support", support, unit)}
        given |= {name: own(name, value) for name, value in _quantities(quantity).items()}
        arrays = _columns(given | {"volume": in_unit("volume", volume, unit, 3)})
        box, count = box if isinstance(box, Box) else in_unit("box", box, unit), arrays["position"].shape[0]
        _require_usable(arrays)
        dtype = jnp.promote_types(jax.dtypes.canonicalize_dtype(arrays["position"].dtype), jnp.float32)
        capacity = capacity_class(count) if capacity is None else capacity
        if capacity < max(count, 1):
            raise ValueError(f"`capacity` must be at least the number of particles ({count}) and 1, got {capacity}")
        packed = {name: _padded(name, value, dtype, capacity) for name, value in arrays.items()}
        rest = None
        if not is_traced(*arrays.values()) and count:
            _require_representable(arrays, packed)
            rest = rest_of(arrays["position"], packed["position"], packed["support"])
        valid, period, called = jnp.arange(capacity) < count, _period(box, arrays["support"], dtype), name_of(unit)
        return cls(**packed, valid=valid, kernel=kernel, position_rest=rest, box=period, length_unit=called)

    def padded(self, capacity: int) -> Particles:
        """The same particles in arrays of `capacity` entries.

        Raises:
            ValueError: where that is less than there are.
        """
        if capacity < self.capacity:
            raise ValueError(f"`capacity` must be at least {self.capacity}, the entries there are, got {capacity}")
        padded = {name: _repeated(name, column, capacity, jnp) for name, column in self.columns.items()}
        valid = jnp.pad(self.valid, (0, capacity - self.capacity))
        rest = None if self.position_rest is None else _repeated("position", self.position_rest, capacity, jnp)
        return dataclasses.replace(self, **padded, valid=valid, position_rest=rest)

    def at(self, entries: Any) -> Particles:
        """The particles of those entries (integers or a slice), in as many."""
        columns: dict[str, Any] = {name: column[entries] for name, column in (self.columns | {"valid": self.valid}).items()}
        rest = None if self.position_rest is None else self.position_rest[entries]
        return dataclasses.replace(self, **columns, position_rest=rest)

    def centered(self, at: Any) -> Particles:
        """The same periodic set with the period moved such that a point is in its middle, and positions moved into it.

        Coordinates stay what they are but for whole periods: the point is where it was.

        Args:
            at: (3,) length units, or `"densest"` for the particle around which most others are (host side).

        Raises:
            ValueError: a set without a box, or another point.
        """
        from jaxsph.model import periodic

        return periodic.centered(self, at)

    def to_numpy(self) -> dict[str, np.ndarray]:
        """The particles that exist, without padding (host side): all `columns`."""
        valid = np.asarray(self.valid)
        return {name: np.asarray(column)[valid] for name, column in self.columns.items()}

    @property
    def columns(self) -> dict[str, Float[Array, "particles ..."]]:
        """`position`, `support`, `quantity` and `volume`; and `extinction_quantity`, where there is one."""
        names = NOTHING if self.extinction_quantity is None else (*NOTHING, SECOND)
        return {name: getattr(self, name) for name in names}

    @property
    def quantities(self) -> tuple[Float[Array, " particles"], ...]:
        """That by which colour and extinction are looked up; or two, one for each."""
        return (self.quantity,) if self.extinction_quantity is None else (self.quantity, self.extinction_quantity)

    @property
    def capacity(self) -> int:
        """Number of entries, padding included (static)."""
        return int(self.support.shape[0])

    @property
    def num_particles(self) -> int:
        """Number of particles that exist (host side)."""
        return int(np.asarray(self.valid).sum())

    @property
    def dtype(self) -> Any:
        """float32 or float64."""
        return self.position.dtype

    def exact_position(self) -> np.ndarray:
        """Positions in float64, (capacity, 3), with what float32 could not hold (host side)."""
        position = np.asarray(self.position, np.float64)
        return position if self.position_rest is None else position + np.asarray(self.position_rest, np.float64)

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper corner of the box around every support, (3,) and (3,), float64, length units (host side).

        An empty set has the box of zeros, a periodic one its own.
        """
        if self.box is not None:
            return self.box.corners()
        valid = np.asarray(self.valid)
        if not valid.any():
            return np.zeros(3), np.zeros(3)
        position = self.exact_position()[valid]
        support = np.asarray(self.support, np.float64)[valid, None]
        return (position - support).min(0), (position + support).max(0)


def _columns(given: dict[str, Any]) -> dict[str, Any]:
    """Arrays of real numbers, positions first, with an entry for each particle."""
    arrays = {name: value if isinstance(value, jax.Array) else np.asarray(value) for name, value in given.items()}
    for name, value in arrays.items():
        require_real(name, value)
    if arrays["position"].size == 0 and not isinstance(arrays["position"], jax.Array):
        arrays["position"] = arrays["position"].reshape(0, 3)
    require_shape("position", arrays["position"], (None, 3), "one row (x, y, z) a particle")
    count = arrays["position"].shape[0]
    for name in list(arrays)[1:]:
        if arrays[name].ndim == 0:
            arrays[name] = (jnp if is_traced(arrays[name]) else np).broadcast_to(arrays[name], (count,))
        require_shape(name, arrays[name], (count,), f"one value for each of the {count} particles, or one number for all")
    return arrays


def _require_usable(arrays: dict[str, Any]) -> None:
    """Raise where values that are known are not finite, supports not positive, or volumes negative."""
    if is_traced(*arrays.values()):
        return
    for name, value in arrays.items():
        require_finite(name, value)
    require_positive("support", arrays["support"], "give the support radius H > 0 of every particle")
    require_positive("volume", arrays["volume"], "volumes cannot be negative", strict=False)


def _quantities(given: Any) -> dict[str, Any]:
    """One quantity or a pair, by name. A sequence of numbers alone is one quantity, as it is where there are two particles."""
    pair = isinstance(given, tuple | list) and any(np.ndim(part) > 0 for part in given)
    if not pair:
        return {"quantity": given}
    if len(given) != 2:
        raise ValueError(
            f"`quantity` must be one array, or a pair (by which to colour, by which to absorb), got {len(given)}; "
            "colour is looked up by the first, extinction by the second"
        )
    return {"quantity": given[0], SECOND: given[1]}


def _period(box: Any, support: Any, dtype: Any) -> Box | None:
    """A periodic box as given, or by its sides."""
    if box is None:
        return None
    if is_traced(box):
        box = box if isinstance(box, Box) else Box(jnp.zeros(3, dtype), box)
    else:
        if not isinstance(box, Box):
            for check in (functools.partial(require_shape, shape=(3,)), require_finite, require_positive):
                check("box", box, remedy="give the sides Lx, Ly and Lz of the period, or a `jaxsph.Box`")
        given = box if isinstance(box, Box) else Box(np.zeros(3).tolist(), np.asarray(box, np.float64).tolist())
        box = given.of_dtype(dtype)
    if not is_traced(box, support) and np.size(support):
        shortest, largest = float(np.asarray(box.sides).min()), float(np.asarray(support).max())
        if largest > shortest:
            raise ValueError(
                f"`box` must have no side shorter than the largest support, but {shortest:.6g} < {largest:.6g}: a particle would "
                "overlap more than its neighbouring images; give a larger box, or smaller supports"
            )
    return jax.tree.map(lambda leaf: leaf.astype(dtype), box)


def _padded(name: str, value: Any, dtype: Any, capacity: int) -> Array:
    xp = jnp if is_traced(value) else np
    with np.errstate(over="ignore"):  # what overflows is refused by name, later
        return jnp.asarray(_repeated(name, value, capacity, xp).astype(dtype))


def _repeated(name: str, value: Any, capacity: int, xp: Any) -> Any:
    """A column up to its capacity with its first entry: whoever forgets what is `valid` meets no number of our own making."""
    missing = (capacity - value.shape[0], *value.shape[1:])
    if name == "volume" or not value.shape[0]:
        return xp.concatenate([value, xp.full(missing, NOTHING.get(name, 0.0), value.dtype)])
    return xp.concatenate([value, xp.broadcast_to(value[:1], missing)])


def rest_of(given: Any, packed: Array, support: Array) -> Array | None:
    """What rounding `given` to `packed` has left, or None where that is negligible."""
    given, rounded = np.asarray(given, np.float64), np.asarray(packed, np.float64)
    rest = _repeated("position", given - rounded[: len(given)], len(rounded), np)
    if not (np.abs(rest).max(1) > NEGLIGIBLE * np.asarray(support, np.float64)).any():
        return None
    return jnp.asarray(rest, packed.dtype)


def _require_representable(given: dict[str, Any], packed: dict[str, Array]) -> None:
    """Refuse numbers that the working precision cannot hold (a support that becomes 0, a quantity that becomes inf)."""
    for name in given:
        require_finite(name, packed[name], f"it overflows {packed[name].dtype}: rescale it, or use float64 under jax.enable_x64")
    count = given["position"].shape[0]
    require_positive(
        "support",
        np.asarray(packed["support"])[:count],  # on the host: a device would compile a program for every count
        f"it underflows {packed['support'].dtype}: rescale the scene or use float64",
    )
    tiny = np.finfo(packed["volume"].dtype).tiny
    given_volume = np.asarray(given["volume"], np.float64)
    lost = (given_volume > 0) & (given_volume < tiny)
    if lost.any():
        i = int(np.flatnonzero(lost)[0])
        raise ValueError(
            f"`volume` must be 0 or at least {tiny:.3g}, but volume[{i}] = {given_volume[i]:.6g} underflows "
            f"{packed['volume'].dtype}; only ratios of volumes matter, so multiply all of them by the same number"
        )


STATIC = ["kernel", "length_unit"]
jax.tree_util.register_dataclass(
    Particles, data_fields=[f.name for f in dataclasses.fields(Particles) if f.name not in STATIC], meta_fields=STATIC
)
