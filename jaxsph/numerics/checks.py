"""Host-side checks of user input: name the argument, the offending value and the remedy; and arrays of what was checked.

Flow: user -> [checks] -> model.

Numbers with a unit, with a mask, or in another byte order are made plain, or refused. Units are known by the attribute `units`
or `unit`, as arrays of unyt, yt, astropy, pint and pynbody have one, so that none of these libraries is needed. Lengths are
converted to the unit of positions; where that is not known, what carries a unit is refused, as nothing could tell whether it is
the right one. A number without unit is meant in the unit of positions. What is plain already passes as it is.

Under a trace the values are unknown; then only shapes and dtypes are checked, and bad data becomes a fault bit
(`jaxsph.numerics.faults`). Values that are known are computed by NumPy, as of JAX's operations on them each would be a program to
compile for every shape; code that serves traces, too, is written for a module, either one.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import inspect
import numbers
import os
from collections.abc import Callable, Iterator
from typing import Any, ParamSpec, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxsph.numerics.names import refuse_unknown

ROUNDED = 8  # eps that a colour made of colours, or an extinction made of extinctions, may be out of range by

Progress = Callable[[int, int], None]
"""Told how far work is, as `progress(done, total)`."""
Record = TypeVar("Record")
Given = ParamSpec("Given")
Result = TypeVar("Result")


def record_of(kind: type[Record], given: dict[str, Any], verb: Callable[..., Any]) -> Record:
    """A dataclass of the keyword arguments that a verb has for it; `TypeError` names one that it does not have."""
    refuse_unknown(verb, given, [field.name for field in dataclasses.fields(kind)])  # type: ignore[arg-type]
    return kind(**given)


def is_traced(*values: Any) -> bool:
    """Whether any leaf of `values` is an abstract tracer, so that its numbers cannot be looked at."""
    return any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree_util.tree_leaves(values))


@contextlib.contextmanager
def as_usual() -> Iterator[None]:
    """Arrays of several dtypes and ranks go together as they do by default, whatever users forbid in code of their own."""
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        yield


@contextlib.contextmanager
def at_once(*given: Any) -> Iterator[bool]:
    """What is known is computed as outside of any trace under way, unless some of what is `given` is traced: yields whether."""
    traced = is_traced(given)
    with as_usual(), contextlib.nullcontext() if traced else jax.core.eval_context():
        yield traced


def module_for(*values: Any) -> Any:
    """NumPy, where all is known and at hand in this machine's memory; else `jax.numpy`, also where a device was chosen."""
    arrays = [leaf for leaf in jax.tree.leaves(values) if isinstance(leaf, Array)]
    elsewhere = (is_traced(one) or one.committed or any(device.platform != "cpu" for device in one.devices()) for one in arrays)
    return jnp if any(elsewhere) else np


def at_hand(value: Any) -> tuple[Any, Any]:
    """`module_for` a value, and the value with arrays of that module."""
    xp = module_for(value)
    return xp, jax.tree.map(xp.asarray, value)


def array_of(value: Any, dtype: Any = None) -> Array:
    """`jnp.asarray`, but without a program where that would have one compiled; never in memory that a caller may write to."""
    if isinstance(value, Array) or is_traced(value):
        return jnp.asarray(value, dtype)
    kind = jax.dtypes.canonicalize_dtype(np.asarray(value).dtype if dtype is None else dtype)
    with jax.core.eval_context():  # within a trace what is known stays so
        return jnp.asarray(np.array(value, kind), kind)


def product(one: Array, other: Any) -> Array:
    """`one * other`; numbers too small to be normal are 0, as XLA has them on CPUs."""
    xp = module_for(one, other)
    if xp is jnp:
        return one * other
    with np.errstate(all="ignore"):
        first, second = (part if isinstance(part, float) else _normal(np.asarray(part)) for part in (one, other))
        return array_of(_normal(first * second))


def _normal(number: Any) -> Any:
    return number * (abs(number) >= np.finfo(number.dtype).tiny)


def require_plan(name: str, value: Any, kind: type, maker: str) -> None:
    """Raise `ValueError` where what is to be a plan, or None, is neither."""
    if value is not None and not isinstance(value, kind):
        raise ValueError(f"`{name}` must be a plan, got {type(value).__name__}; make one with `jaxsph.{maker}`")


ANNOTATED: dict[str, tuple[str, Callable[[Any], bool]]] = {
    "int": ("a whole number", lambda value: isinstance(value, numbers.Integral) and not isinstance(value, bool)),
    "float": ("a number", lambda value: type(value) is not bool and (isinstance(value, numbers.Real) or _is_single(value))),
    "bool": ("True or False", lambda value: isinstance(value, bool | np.bool_)),
    "str": ("a text", lambda value: isinstance(value, str)),
    "os.PathLike[str]": ("a path", lambda value: isinstance(value, os.PathLike)),
    "None": ("None", lambda value: value is None),
}
"""What words of annotations are called, and what fits them."""
PLANS = {"plan", "like"}  # arguments that `require_plan` refuses, with the function that makes one


def _is_single(value: Any) -> bool:
    return unit_of(value) is not None or (hasattr(value, "dtype") and np.ndim(value) == 0)


def require_kinds(holder: Any, given: dict[str, Any]) -> None:
    """Raise `ValueError` where what is given is of no kind that annotations of a function or a class name, if all are simple."""
    names, space = holder.__annotations__, getattr(inspect.unwrap(holder), "__globals__", {})
    for name in given.keys() - PLANS:
        value = given[name]
        words = str(names.get(name, "Any")).split(" | ")
        classes = tuple(kind for word in words if isinstance(kind := space.get(word), type) and kind is not Any)
        simple = [ANNOTATED[word] for word in words if word in ANNOTATED]
        known = [*(f"a `jaxsph.{kind.__name__}`" for kind in classes), *(told for told, _ in simple)]
        if len(known) == len(words) and not (isinstance(value, classes) or any(fits(value) for _, fits in simple)):
            raise ValueError(f"`{name}` must be {' or '.join(known)}, got {value!r:.60} of type {type(value).__name__}")


def typed(verb: Callable[Given, Result]) -> Callable[Given, Result]:
    """Mark a verb whose arguments are held to its annotations by `require_kinds`."""
    parameters = list(inspect.signature(verb).parameters)

    @functools.wraps(verb)
    def checked(*given: Given.args, **more: Given.kwargs) -> Result:
        require_kinds(verb, dict(zip(parameters, given, strict=False)) | more)
        return verb(*given, **more)

    return checked


def require_sizes(plan: Any, zero: tuple[str, ...] = ()) -> None:
    """Raise `ValueError` unless all integers of a dataclass of sizes are at least 1, or not negative where `zero` is of use."""
    for field in dataclasses.fields(plan):
        size = getattr(plan, field.name)
        if isinstance(size, int) and not isinstance(size, bool) and size < (least := int(field.name not in zero)):
            raise ValueError(f"`{field.name}` must be at least {least}, got {size}")


def require_shape(name: str, value: Any, shape: tuple[int | None, ...], remedy: str) -> None:
    """Raise `ValueError` unless `value.shape` matches `shape` (`None` matches any length)."""
    got = tuple(np.shape(value))
    fits = len(got) == len(shape) and all(want is None or want == have for want, have in zip(shape, got, strict=True))
    if not fits:
        want = "(" + ", ".join("N" if n is None else str(n) for n in shape) + ("," if len(shape) == 1 else "") + ")"
        raise ValueError(f"`{name}` must have shape {want}, got {got}; {remedy}")


def vector_of(name: str, value: Any, remedy: str = "give x, y and z") -> np.ndarray:
    """Three finite numbers that carry no unit, in float64 (host side); else `ValueError`."""
    given = plain(name, value)
    require_shape(name, given, (3,), remedy)
    exact = np.asarray(require_real(name, given), np.float64)
    require_finite(name, exact, remedy)
    return exact


def require_real(name: str, value: Any) -> Any:
    """An array of NumPy's or JAX's; `ValueError` unless it is of real numbers."""
    array = value if isinstance(value, Array) else np.asarray(value)
    kind = np.dtype(array.dtype)
    if not (jax.dtypes.issubdtype(kind, np.floating) or jax.dtypes.issubdtype(kind, np.integer) or kind == np.bool_):
        raise ValueError(f"`{name}` must hold real numbers, got dtype {kind}; convert it to float32 or float64")
    return array


def require_finite(name: str, value: Any, remedy: str = "remove or repair these entries") -> None:
    """Raise `ValueError` naming the first entry of `value` that is NaN or infinite."""
    value = np.asarray(require_real(name, value))
    if value.dtype.kind in "iub" or np.isfinite([value.min(initial=0), value.max(initial=0)]).all():
        return
    bad = ~np.isfinite(value)
    if bad.any():
        first = f"{int(bad.sum())} of {value.size} are not, first {_first(name, value, bad)}"
        raise ValueError(f"`{name}` must be finite, but {first}; {remedy}")


def require_positive(name: str, value: Any, remedy: str, *, strict: bool = True) -> None:
    """Raise `ValueError` naming the first entry of `value` that is not above zero (`strict`) or is below it."""
    value = np.asarray(require_real(name, value))
    bad = ~(value > 0) if strict else ~(value >= 0)
    if bad.any():
        raise ValueError(f"`{name}` must be {'> 0' if strict else '>= 0'}, but {_first(name, value, bad)}; {remedy}")


def _first(name: str, value: np.ndarray, bad: np.ndarray) -> str:
    """The first of bad entries, with its index if it has one."""
    where = tuple(int(i) for i in np.argwhere(bad)[0])
    at = f"[{', '.join(map(str, where))}]" if where else ""
    return f"{name}{at} = {value[where]}"


def rounded_into(name: str, value: Any, ends: tuple[float, float], remedy: str) -> Any:
    """`value` in a range that rounding alone may have led out of; `ValueError` names the first entry that is farther out."""
    given = np.asarray(value)
    kept = np.clip(given, *ends).astype(given.dtype)
    if (kept == given).all():
        return value
    slack = 0.0
    if np.issubdtype(given.dtype, np.floating):
        finite = np.abs(given[np.isfinite(given)], dtype=np.float64)
        eps = float(np.finfo(jax.dtypes.canonicalize_dtype(given.dtype)).eps)
        slack = ROUNDED * eps * max(finite.max(initial=0), 0 if np.isinf(ends[1]) else ends[1])
    bad = np.abs(given.astype(np.float64) - kept.astype(np.float64)) > slack
    if bad.any():
        wanted = f">= {ends[0]:g}" if np.isinf(ends[1]) else f"in [{ends[0]:g}, {ends[1]:g}]"
        raise ValueError(f"`{name}` must be {wanted}, but {_first(name, given, bad)}; {remedy}")
    return kept


PLAIN = str, bytes, bool, int, float, complex, jax.Array
NO_UNITS = "", "1", "dimensionless", "NoUnit"
"""What units that are none call themselves."""
POSITIONS = "or in whatever unit positions are"
LIBRARIES = "such as `unyt.unyt_array(x)` or `astropy.units.Quantity(x)`"


def one_number(name: str, value: Any, *why: str) -> Any:
    """One real number that carries no unit, as `plain` has it; else `ValueError`."""
    number = plain(name, value, *why)
    require_shape(name, number, (), "give one number")
    require_real(name, number)
    return number


def own(name: str, value: Any) -> Any:
    """Numbers in their own unit, if they have one; `ValueError` of a mask that hides any, and of a list of such with units."""
    _require_whole(name, value)
    return _native(value if unit_of(value) is None else _numbers(value))


def plain(name: str, value: Any, why: str = "no unit is known here to convert it to", meant: str = POSITIONS) -> Any:
    """Numbers that carry no unit, or that of a pure number, such as percent; `ValueError` of a unit, and as `own`."""
    _require_whole(name, value)
    unit = unit_of(value)
    pure = value if unit is None else _pure(value, unit)
    if unit is not None and pure is None:
        raise ValueError(f'`{name}` is in {unit}, but {why}: pass {name}.to_value("{unit}"), {meant}')
    return _native(pure)


def with_unit(name: str, value: Any) -> tuple[Any, Any]:
    """Numbers in their own unit, and that; None where they carry none. Raises as `own`."""
    _require_whole(name, value)
    unit = unit_of(value)
    pure = None if unit is None else _pure(value, unit)
    return (own(name, value), unit) if pure is None else (_native(pure), None)


def in_unit(name: str, value: Any, unit: Any, power: int = 1, of: str = "position") -> Any:
    """Numbers in a power of a unit, that of `of`; those that carry none are taken to be in it.

    Args:
        name: of the argument.
        value: numbers, with or without a unit.
        unit: of lengths, an object or its name; None where it is not known.
        power: 1 for lengths, 3 for volumes, -1 for what is given a unit of length.
        of: whose unit that is.

    Raises:
        ValueError: a unit where none is known, or one of another kind; see `own`.
    """
    given = unit_of(value)
    if given is None or _pure(value, given) is not None:
        return plain(name, value)
    if unit is None:
        return plain(name, value, f"`{of}` has no unit to convert it to")
    _require_whole(name, value)
    wanted = unit if power == 1 else f"{unit}**{power}" if isinstance(unit, str) else unit**power
    try:
        same = type(given) is type(wanted) and bool(given == wanted)
        return _native(_numbers(value) if same else _converted(value, wanted))
    except Exception as error:  # libraries of units have errors of their own
        raise ValueError(
            f"`{name}` is in {given}, which cannot be converted to {wanted}, as `{of}` is in {unit}; "
            f"give it in that, or pass {name}.to_value(UNIT) of a unit that means the same"
        ) from error


def unit_of(value: Any) -> Any:
    """The unit that numbers carry, as an object or a name; None of what carries none."""
    if value is None or isinstance(value, (*PLAIN, list, tuple)) or type(value) is np.ndarray:
        return None
    for attribute in ("units", "unit"):
        unit = getattr(value, attribute, None)
        if unit is not None and not inspect.isroutine(unit) and not hasattr(unit, "__array__"):
            return unit
    return None


def name_of(unit: Any) -> str | None:
    """What a unit is called; None of none."""
    return None if unit is None else str(unit)


def _require_whole(name: str, value: Any) -> None:
    """Raise where a mask hides entries, or where entries of a list carry units or masks, which an array of them would lose."""
    if isinstance(value, PLAIN) or type(value) is np.ndarray:
        return
    if isinstance(value, list | tuple):
        for part in value:
            _require_whole(name, part)
            if (unit := unit_of(part)) is not None:
                raise ValueError(f"`{name}` is a list of numbers that carry units ({unit}); make it one array, {LIBRARIES}")
    mask = getattr(value, "mask", None)
    hidden = np.zeros(0, bool) if mask is None or inspect.isroutine(mask) else np.asarray(mask)
    if hidden.any():
        raise ValueError(
            f"`{name}` is masked in {int(hidden.sum())} of {hidden.size} entries, and masks are not kept: leave these out of all "
            f"arrays, as by x[~mask], or give them a value, as by {name}.filled(value)"
        )


def _pure(value: Any, unit: Any) -> Any:
    """Numbers of what has no dimension; None of what has."""
    if str(unit).strip() in NO_UNITS:
        return _numbers(value)
    try:
        return None if isinstance(unit, str) else _converted(value, unit**0)
    except Exception:  # libraries of units have errors of their own
        return None


def _converted(value: Any, unit: Any) -> Any:
    """Numbers in another unit of the same kind."""
    if hasattr(value, "to_value"):
        return value.to_value(unit)
    return _numbers(value.to(unit) if hasattr(value, "to") else value.in_units(unit))


def _numbers(value: Any) -> Any:
    """Numbers in the unit that they are in."""
    if not isinstance(value, np.ndarray):
        for attribute in ("value", "magnitude"):
            found = getattr(value, attribute, None)
            if found is not None and not inspect.isroutine(found):
                return np.asarray(found)
    return np.asarray(value)


def _native(value: Any) -> Any:
    """Numbers that JAX takes: in this machine's byte order, of no more than 8 bytes, and in no array of another kind."""
    if not isinstance(value, np.ndarray | np.generic):
        return value
    if value.dtype.kind == "f" and value.dtype.itemsize > 8:
        return np.asarray(value, np.float64)
    value = np.asarray(value) if isinstance(value, np.ndarray) else value
    return value if value.dtype.isnative else value.astype(value.dtype.newbyteorder("="))
