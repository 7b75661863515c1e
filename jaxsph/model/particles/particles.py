"""The particle set: a padded, masked pytree of positions, supports, quantities and volumes.

Flow: files, scenes -> [particles] -> access -> cast -> image.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxsph.model.clips import Box
from jaxsph.model.particles import kernels
from jaxsph.numerics import checks
from jaxsph.numerics.checks import array_of, at_hand, at_once, is_traced, module_for
from jaxsph.numerics.names import import_by_name
from jaxsph.numerics.rows import distinct
from jaxsph.numerics.trees import Placed, count_of, line_of, on_host, span_of, tree

NEGLIGIBLE = 2.0**-16  # of a support that rounding may move a particle by, before what is lost is kept
NOTHING = {"position": 0.0, "support": 1.0, "quantity": 0.0, "volume": 0.0}  # what entries hold where there is no particle
MAX_ENTRIES = 2**31 - 1  # that 32-bit ids tell apart
NEIGHBOURS = 32  # particles within the distance by which the densest place is told
SECOND = "extinction_quantity"  # a column that there may be or not
LEAST = {"support": "give the support radius H > 0 of every particle", "volume": "volumes cannot be negative"}


def columns_of(what: str, given: dict[str, Any], least: dict[str, str]) -> dict[str, Any]:
    """Arrays of finite real numbers, positions first, with an entry for each particle or point, also if one is given for all.

    Args:
        what: they are of.
        given: by name.
        least: columns that must be >= 0, of which the first must be > 0, and what is said where they are not.
    """
    columns = {name: checks.require_real(name, value) for name, value in given.items()}
    position = columns["position"]
    if position.size == 0 and not isinstance(position, jax.Array):
        columns["position"] = position = position.reshape(0, 3)
    checks.require_shape("position", position, (None, 3), f"one row (x, y, z) a {what}")
    count, reach = position.shape[0], next(iter(least))
    for name, value in columns.items():
        if name != "position":
            row = (3,) if name == "color" else ()
            if value.shape == row:
                columns[name] = (jnp if is_traced(value) else np).broadcast_to(value, (count, *row))
            each = "one row" if row else "one value"
            checks.require_shape(name, columns[name], (count, *row), f"{each} for each of the {count} {what}s, or one for all")
        if not is_traced(value):
            checks.require_finite(name, columns[name])
            if name in least:
                checks.require_positive(name, columns[name], least[name], strict=name == reach)
            share, ends = np.asarray(value), {"color": "[0, 1]", "opacity": "[0, 1)"}.get(name)
            if ends and ((share < 0) | (share > 1) | ((share == 1) & (name == "opacity"))).any():
                raise ValueError(f"`{name}` must be in {ends}, got {share.min():.6g} .. {share.max():.6g}")
    return columns


def padded_to(value: Any, capacity: int, xp: Any, nothing: float = 0.0, *, repeat: bool = True) -> Any:
    """A column up to its capacity with its first entry: whoever forgets what is `valid` meets no number of our own making.

    With `nothing` where there is no entry, or where it is not to be repeated.
    """
    value = xp.asarray(value)
    missing = (capacity - value.shape[0], *value.shape[1:])
    more = xp.broadcast_to(value[:1], missing) if repeat and value.shape[0] else xp.full(missing, nothing, value.dtype)
    return xp.concatenate([value, more])


def packed(what: str, columns: dict[str, Any], reach: str, capacity: int | None) -> dict[str, Any]:
    """Columns in a working precision, up to a capacity, `valid`, and `position_rest`: what rounding positions has left, or None
    where they are unknown or that is a negligible part of all supports or radii, `reach`. On the host where they are known.

    Raises `ValueError`: less room than there are, what is known overflows, or is a length of 0 in that precision.
    """
    position, made = columns["position"], {}
    count, dtype = position.shape[0], jnp.promote_types(jax.dtypes.canonicalize_dtype(position.dtype), jnp.float32)
    room = capacity_class(count) if capacity is None else capacity
    if room > MAX_ENTRIES:
        raise ValueError(f"`capacity` must be at most {MAX_ENTRIES:,} entries, got {room:,}")
    if room < max(count, 1):
        raise ValueError(f"`capacity` must be at least the number of {what}s ({count}) and 1, got {room}")
    for name, value in columns.items():
        xp, repeat = jnp if is_traced(value) else np, (reach, name) != ("support", "volume")  # padding weighs nothing
        with np.errstate(over="ignore"):  # what overflows is refused by name
            made[name] = padded_to(value, room, xp, float(name == reach), repeat=repeat).astype(dtype)
        if xp is np:
            checks.require_finite(name, made[name], f"it overflows {dtype}: rescale it, or use float64 under jax.enable_x64")
            if name == reach:
                checks.require_positive(name, made[name], f"it underflows {dtype}: rescale the scene or use float64")
    rest = None
    if count and not is_traced(position, made[reach]):
        exact, size = np.asarray(position, np.float64), np.asarray(made[reach], np.float64)
        lost = padded_to(exact - np.asarray(made["position"], np.float64)[:count], room, np)
        rest = array_of(lost, dtype) if (np.abs(lost).max(1) > NEGLIGIBLE * size).any() else None
    valid = array_of(np.arange(room) < count)
    return {name: array_of(value) for name, value in made.items()} | {"valid": valid, "position_rest": rest}


def capacity_class(count: int) -> int:
    """The least of 4, 5, 6, 7 times a power of two that is at least `count` and 1: four classes an octave."""
    step = max(1 << max((count - 1).bit_length() - 1, 0), 4) // 4
    return max(-(-count // step) * step, 1)


class PaddedSet(Placed):
    """What has centres and radii, in arrays that are padded to a capacity."""

    PLACE, REST = "position", "position_rest"
    position: Any
    position_rest: Any
    valid: Any

    @property
    def capacity(self) -> int:
        """Number of entries, padding included (static)."""
        return int(self.valid.shape[0])

    def __len__(self) -> int:
        """How many exist, without padding (host side)."""
        return int(np.asarray(self.valid).sum())

    def exact_position(self) -> np.ndarray:
        """Positions in float64, (capacity, 3), with what float32 could not hold (host side)."""
        position = np.asarray(self.position, np.float64)
        return position if self.position_rest is None else position + np.asarray(self.position_rest, np.float64)

    def unpadded(self, column: Any) -> np.ndarray:
        """The entries of a column that exist, in float64 (host side)."""
        return np.asarray(column, np.float64)[np.asarray(self.valid)]

    def places(self) -> np.ndarray:
        """Exact positions without padding, (N, 3) float64 (host side)."""
        return self.unpadded(self.exact_position())


@tree(static=("kernel", "length_unit"))
class Particles(PaddedSet):
    """SPH particles that carry a quantity; make them with `from_arrays`.

    The arrays are padded to a capacity, with the first particle at volume 0; `valid` marks the particles that exist. Values
    may be changed by `dataclasses.replace` under jit without recompiling.

    Attributes:
        position: view-independent (world) coordinates, length units.
        support: support radius H > 0 (the kernel is 0 at distance H), length units.
        quantity: the carried quantity q, the input of the transfer function; of two, that of colours.
        volume: V >= 0, any unit: only ratios between particles matter.
        valid: which entries are particles; the rest is padding and contributes nothing.
        kernel: its name, one of `jaxsph.model.particles.kernels.KERNELS`.
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

    def __repr__(self) -> str:
        second = self.extinction_quantity
        return line_of(
            "Particles",
            f"{count_of(self.valid)}, {self.kernel}, {getattr(self.position, 'dtype', 'of no type')}",
            f"quantity {span_of(self.quantity, self.valid)}",
            None if second is None else f"extinction by {span_of(second, self.valid)}",
            f"support {span_of(self.support, self.valid)}" + ("" if self.length_unit is None else f" {self.length_unit}"),
            None if self.box is None else "periodic",
        )

    @classmethod
    @checks.typed
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
        position, unit = checks.with_unit("position", position)
        given = {"position": position, "support": checks.in_unit("support", support, unit)}
        given |= {name: checks.own(name, value) for name, value in _quantities(quantity).items()}
        arrays = columns_of("particle", given | {"volume": checks.in_unit("volume", volume, unit, 3)}, LEAST)
        entries = packed("particle", arrays, "support", capacity)
        if not is_traced(arrays["volume"]):
            _require_volumes(arrays["volume"], entries["volume"])
        box = box if isinstance(box, Box) else checks.in_unit("box", box, unit)
        period = _period(box, arrays["support"], entries["position"].dtype)
        return cls(**entries, kernel=kernel, box=period, length_unit=checks.name_of(unit))

    @classmethod
    def from_columns(
        cls,
        columns: Any,
        *,
        quantity: Any = None,
        support: Any = None,
        support_in_h: float | None = None,
        kernel: str | None = None,
        box: Any = None,
        where: str | None = None,
        share: float | None = None,
        opacity_by: str | None = None,
    ) -> Particles:
        """Particles of named columns: a dictionary, a data frame, a structured array, or a snapshot of another library.

        Roles are told by names, as in files: positions by `position`, `pos`, `coordinates` or `x`, `y`, `z`; masses, densities,
        volumes, velocities by theirs. Columns may carry units (unyt, astropy, pynbody, swiftsimio): lengths are converted to that
        of positions, quantities keep their own. What cannot be settled otherwise is: supports by the 32nd neighbour, volumes
        by sums of kernels.

        Args:
            columns: what has columns by `[name]`, or as attributes.
            quantity: name of a column, or of what is derived (`"density"`, `"speed"`, `"log10:temperature"`), or (N,) numbers;
                None picks the most telling one, see `jaxsph.io.read_particles`.
            support: a support radius, (N,) of them, or the name of a column; None for the column `support`.
            support_in_h: how many smoothing lengths a support radius is, where a column holds these: 2 where the kernel ends at
                two of them (Phantom, pynbody), 1 where it ends at one (Gadget). `support` may name the column.
            kernel: name of the smoothing kernel; None is poly6.
            box: (Lx, Ly, Lz) or one side of a periodic box whose lower corner is the origin.
            where, share, opacity_by: as for `jaxsph.io.read_particles`.

        Raises:
            ValueError: no positions, columns of several lengths, smoothing lengths without `support_in_h`, an unknown quantity,
                numbers that are not finite, units that cannot be converted.

        Example:
            `js.Particles.from_columns({"x": x, "y": y, "z": z, "h": h, "mass": m, "rho": rho}, quantity="rho", support_in_h=2)`
        """
        settle = {"quantity": quantity, "support": support, "support_in_h": support_in_h, "kernel": kernel, "box": box}
        settle |= {"where": where, "share": share, "opacity_by": opacity_by}
        return import_by_name("jaxsph.io.settle.columns:particles_from_columns")(columns, **settle)[0]  # type: ignore[no-any-return]  # 300 ms

    def padded(self, capacity: int) -> Particles:
        """The same particles in arrays of `capacity` entries.

        Raises:
            ValueError: where that is less than there are.
        """
        if capacity < self.capacity:
            raise ValueError(f"`capacity` must be at least {self.capacity}, the entries there are, got {capacity}")
        with at_once(self):
            return (_padded if module_for(self) is np else _PADDED)(self, capacity)

    def at(self, entries: Any) -> Particles:
        """The particles of those entries (integers or a slice), in as many."""
        xp = module_for(self, entries)
        with at_once(self, entries):
            if not is_traced(entries):
                entries = np.arange(self.capacity)[entries if isinstance(entries, slice) else np.asarray(entries)]
            return (_taken if xp is np else _TAKEN)(self, entries)

    def _each(self, changed: Callable[[str, Any], Any]) -> Particles:
        """With all arrays changed, by name."""
        arrays = self.columns | {"valid": self.valid, "position_rest": self.position_rest}
        made: dict[str, Any] = {name: array_of(changed(name, one)) for name, one in arrays.items() if one is not None}
        return dataclasses.replace(self, **made)

    def centered(self, at: Any) -> Particles:
        """The same periodic set with the period moved such that a point is in its middle, and positions moved into it.

        Coordinates stay what they are but for whole periods: the point is where it was.

        Args:
            at: (3,) length units, or `"densest"` for the particle whose neighbours are nearest (host side).

        Raises:
            ValueError: a set without a box, or another point.
        """
        if self.box is None:
            remedy = "give `box=(Lx, Ly, Lz)` to `Particles.from_arrays`"
            raise ValueError(f"particles must have a periodic box to be centred; {remedy}")
        if isinstance(at, str):
            if at != "densest":
                raise ValueError(f"`at` must be x, y and z or 'densest', got {at!r}")
            at = self.densest()
        at = checks.in_unit("at", at, self.length_unit)
        if is_traced(at, self):
            corner = jnp.asarray(at, self.dtype) - 0.5 * self.box.sides
            return dataclasses.replace(self, box=Box(corner, corner + self.box.sides)).wrapped()
        middle = checks.vector_of("at", at, "give x, y and z, or 'densest'")
        lower, upper = self.box.corners()
        corners = (middle + sign * (upper - lower) / 2 for sign in (-1, 1))
        return dataclasses.replace(self, box=Box(*corners).of_dtype(self.dtype)).wrapped()

    def densest(self) -> np.ndarray:
        """Where particles lie closest together, across faces, too, (3,) float64: the one of nearest neighbours (host side)."""
        place = position = self.places()
        if not len(place):
            raise ValueError("there are no particles, so none is the densest; give x, y and z")
        sides = None
        if self.box is not None:
            lower, upper = self.box.corners()
            sides = upper - lower
            place = np.mod(position - lower, sides)
            place = np.where(place >= sides, 0, place)
        first, group = distinct(place)
        points, piled = place[first], np.bincount(group)[group] >= NEIGHBOURS  # of a pile no distance is known but the support
        tree = scipy.spatial.KDTree(points, boxsize=sides)
        nearest = tree.query(points, k=[min(NEIGHBOURS, len(points))], workers=-1)[0][:, 0][group]
        known = (nearest > 0) & ~piled
        return np.asarray(position[np.where(known, nearest, self.unpadded(self.support)).argmin()])

    def wrapped(self) -> Particles:
        """The same particles; of a periodic set, with all positions in its box.

        Differentiation:
            Positions are moved by whole periods, which are held fixed.
        """
        if self.box is None:
            return self
        xp, (position, box) = at_hand((lax.stop_gradient(self.position), self.box))
        with np.errstate(all="ignore"):
            turns = xp.floor((position - box.lower) / sides_of(box)[0])
        return self.moved(xp.where(xp.isfinite(turns), -turns, 0), self.box)

    def moved(self, turns: Float[Array, "particles 3"], box: Box) -> Particles:
        """The same particles so many sides of a box further; with what that rounds off, where what rounding has left is kept."""
        _, (position, rest, turns, box) = at_hand((self.position, self.position_rest, turns, box))
        sides, left_of_sides = sides_of(box)
        position, left = two_sum(position, turns * sides)
        rest = None if rest is None else array_of(rest + (left + turns * left_of_sides))
        return dataclasses.replace(self, position=array_of(position), position_rest=rest)

    @on_host
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
    def num_particles(self) -> int:
        """Number of particles that exist (host side)."""
        return len(self)

    @on_host
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper corner of the box around every support, (3,) and (3,), float64, length units (host side).

        An empty set has the box of zeros, a periodic one its own.
        """
        if self.box is not None:
            return self.box.corners()
        position, support = self.places(), self.unpadded(self.support)[:, None]
        if not len(position):
            return np.zeros(3), np.zeros(3)
        return (position - support).min(0), (position + support).max(0)


def _quantities(given: Any) -> dict[str, Any]:
    """One quantity or a pair, by name. A sequence of two numbers is one quantity, of two particles."""
    pair = isinstance(given, tuple | list) and any(np.ndim(part) > 0 for part in given)
    if not pair:
        return {"quantity": given}
    if len(given) != 2:
        wrong = f"`quantity` must be one array, or a pair (by which to colour, by which to absorb), got {len(given)};"
        raise ValueError(f"{wrong} colour is looked up by the first, extinction by the second")
    return {"quantity": given[0], SECOND: given[1]}


def _period(box: Any, support: Any, dtype: Any) -> Box | None:
    """A periodic box as given, or by its sides."""
    if box is None:
        return None
    if is_traced(box):
        box = box if isinstance(box, Box) else Box(jnp.zeros(3, dtype), box)
    else:
        if not isinstance(box, Box):
            remedy = "give the sides Lx, Ly and Lz of the period, or a `jaxsph.Box`"
            sides = checks.vector_of("box", box, remedy)
            checks.require_positive("box", sides, remedy)
            box = Box([0.0, 0.0, 0.0], sides.tolist())
        box = box.of_dtype(dtype)
    if not is_traced(box, support) and np.size(support):
        shortest, largest = float(np.asarray(box.sides).min()), float(np.asarray(support).max())
        if largest > shortest:
            raise ValueError(
                f"`box` must have no side shorter than the largest support, but {shortest:.6g} < {largest:.6g}: a particle would "
                "overlap more than its neighbouring images; give a larger box, or smaller supports"
            )
    return jax.tree.map(lambda leaf: leaf.astype(dtype), box)


def _require_volumes(given: Any, rounded: Any) -> None:
    """Refuse volumes that are not 0 and underflow."""
    given, tiny = np.asarray(given, np.float64), np.finfo(rounded.dtype).tiny
    lost = np.flatnonzero((given > 0) & (given < tiny))
    if lost.size:
        i = int(lost[0])
        wrong = f"`volume` must be 0 or at least {tiny:.3g}, but volume[{i}] = {given[i]:.6g} underflows {rounded.dtype}; only"
        raise ValueError(f"{wrong} ratios of volumes matter, so multiply all of them by the same number")


def sides_of(box: Box) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
    """Sides of a box, and what rounding them has left."""
    sides, left = two_sum(box.upper, -box.lower)
    return two_sum(sides, left + (box.rest[1] - box.rest[0]))


def two_sum(first: Array, second: Array) -> tuple[Array, Array]:
    """A sum, and what rounding it has left (Knuth 1969, section 4.2.2)."""
    total = first + second
    held: Any = lax.stop_gradient if isinstance(total, jax.Array) else lambda one: one  # NumPy's have no derivative
    part = held(total - first)
    left = (held(first) - (held(total) - part)) + (held(second) - part)
    return total, left


def _padded(particles: Particles, capacity: int) -> Particles:
    xp, weightless = module_for(particles), ("volume", "valid")
    return particles._each(lambda name, column: padded_to(column, capacity, xp, repeat=name not in weightless))


def _taken(particles: Particles, entries: Any) -> Particles:
    xp = module_for(particles, entries)
    return particles._each(lambda _, column: xp.asarray(column)[entries])


_PADDED, _TAKEN = jax.jit(_padded, static_argnums=1), jax.jit(_taken)  # of arrays of a device, in one program each
