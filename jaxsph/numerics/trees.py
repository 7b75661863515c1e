"""Frozen dataclasses that are pytrees, of which some fields are static: they fix what is compiled; and lines that tell of them.

Flow: [trees] -> all that is traced.

Annotations are held to where a verb begins (`fitting`): until then there is in a leaf whatever `replace` or JAX puts there.
"""

from __future__ import annotations

import dataclasses
import functools
import inspect
import re
import typing
from collections.abc import Callable
from statistics import mode
from typing import Any, ClassVar, NamedTuple, ParamSpec, Self, TypeVar, dataclass_transform

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import AbstractArray

from jaxsph.numerics.checks import array_of, at_hand, at_once, is_traced, module_for, plain, require_kinds, require_real
from jaxsph.numerics.faults import MESSAGES, TOLD, describe, raise_for

Kind = TypeVar("Kind", bound=type)
Part = TypeVar("Part")
Given = ParamSpec("Given")
Result = TypeVar("Result")
MADE: set[type] = set()  # by `tree`
OPEN = {"open": True}  # metadata of a field that may be None until a verb finds what belongs there
MAX_LOOKED_AT = 1 << 22  # entries of an array that its range is told of: more take longer than a line should
FLOAT, SMALL = "float32", ("int8", "uint8", "int16", "uint16")  # integers that stay so where they may be: float32 holds them


@dataclass_transform(frozen_default=True, field_specifiers=(dataclasses.field,))
def tree(
    *, static: tuple[str, ...] = (), traced: tuple[str, ...] | None = None, unchecked: bool = False, **options: Any
) -> Callable[[Kind], Kind]:
    """Make a class a frozen dataclass and a pytree.

    Args:
        static: fields that are no leaves: hashable, and compared where programs are looked up.
        traced: the other fields, where it is shorter to tell those.
        unchecked: JAX makes it again without `__init__`: of classes that check their fields, as transformations put things into
            leaves that are no numbers.
        options: of `dataclasses.dataclass`.
    """

    def register(kind: Kind) -> Kind:
        made: Any = dataclasses.dataclass(frozen=True, **options)(kind)
        MADE.add(made)
        names = [field.name for field in dataclasses.fields(made)]
        leaves = [name for name in names if (name not in static if traced is None else name in traced)]
        fixed_names = [name for name in names if name not in leaves]
        if not unchecked:
            jax.tree_util.register_dataclass(made, leaves, fixed_names)
            return made

        def flatten(one: Any) -> tuple[list[Any], tuple[Any, ...]]:
            return [getattr(one, name) for name in leaves], tuple(getattr(one, name) for name in fixed_names)

        def flatten_with_keys(one: Any) -> tuple[list[tuple[Any, Any]], tuple[Any, ...]]:
            return [(jax.tree_util.GetAttrKey(name), getattr(one, name)) for name in leaves], flatten(one)[1]

        def unflatten(fixed: tuple[Any, ...], values: Any) -> Any:
            return unchecked_of(made, **dict(zip((*leaves, *fixed_names), (*values, *fixed), strict=True)))

        jax.tree_util.register_pytree_with_keys(made, flatten_with_keys, unflatten, flatten)
        return made

    return register


PAIR = property(lambda own: (getattr(own, own.PLACE), getattr(own, own.REST)))


@dataclasses.dataclass(frozen=True, kw_only=True)
class Placed:
    """A base of what holds a place, and beside it what rounding has left of that.

    `dataclasses.replace` hands on what was left of the former place. So it hands on that pair too, `placed`, which is looked up
    and no field; and of another place nothing is left but where it has the same numbers.
    """

    PLACE: ClassVar[str]
    REST: ClassVar[str]
    placed: dataclasses.InitVar[Any] = PAIR

    def __post_init__(self, placed: Any) -> None:
        if placed is not PAIR:
            fill(self, **{self.REST: left_of(getattr(self, self.PLACE), getattr(self, self.REST), *placed)})

    @property
    def dtype(self) -> Any:
        """What it is rendered in: float32 or float64."""
        return getattr(self, self.PLACE).dtype


def left_of(place: Any, rest: Any, former: Any, left: Any) -> Any:
    """What is left of a place in another's stead, of which `left` was; `rest` where that is of this place."""
    if rest is not left or place is former or place is None or not np.ndim(rest):
        return rest
    with at_once(place, former, left):
        xp, (now, before, left) = at_hand((place if hasattr(place, "dtype") else np.asarray(place), former, left))
        same = now == before if now.shape == before.shape else xp.zeros(now.shape, bool)
        return array_of(xp.where(same, left if now.shape == before.shape else 0, 0).astype(left.dtype))


def unchecked_of(kind: type[Any], /, **fields: Any) -> Any:
    """One of a class of such fields, made without its `__init__`."""
    made = object.__new__(kind)
    fill(made, **fields)
    return made


def fill(made: Any, /, **fields: Any) -> None:
    """Set fields of what is frozen, and is being made."""
    for name, value in fields.items():
        object.__setattr__(made, name, value)


def require_known(verb: str, **given: Any) -> None:
    """Raise `ValueError` where arguments of a verb that needs numbers are traced."""
    for name in (name for name, value in given.items() if is_traced(value)):
        outside = "call it outside of jit, vmap and grad, and call `jaxsph.render` under jit"
        raise ValueError(f"`{verb}` needs concrete arrays, and `{name}` is traced: {outside}")


def on_host(verb: Callable[Given, Result]) -> Callable[Given, Result]:
    """Mark a verb that needs numbers: what is traced, and what does not fit, is refused by name; all else is done at once."""
    names = list(inspect.signature(verb).parameters)
    names = [verb.__qualname__.partition(".")[0].lower() if name == "self" else name for name in names]

    def taken(name: str, value: Any) -> Any:
        require_kinds(verb, {name: value})
        require_known(verb.__qualname__, **{name: value})
        return fitting(name, value) if type(value) in MADE else value

    @functools.wraps(verb)
    def done(*given: Given.args, **more: Given.kwargs) -> Result:
        with at_once():
            first: Any = [*(taken(name, value) for name, value in zip(names, given, strict=False)), *given[len(names) :]]
            others: Any = {name: taken(name, value) for name, value in more.items()}
            return verb(*first, **others)

    return done


class Declared(NamedTuple):
    """What a field is annotated to hold: an array of dtypes and axes, or parts; if `free` a plain number, if `open` None."""

    name: str
    dtypes: tuple[str, ...]
    axes: tuple[int | str, ...]
    parts: tuple[type, ...]
    free: bool
    open: bool


@functools.cache
def _declared(kind: type) -> tuple[Declared, ...]:
    """Fields that hold arrays or parts; none of a class whose annotations cannot be looked up."""
    try:
        hints = typing.get_type_hints(kind)
    except NameError:
        return ()
    found = []
    for field in dataclasses.fields(kind):
        members = _members(hints[field.name])
        classes = list(dict.fromkeys(one for one in members if isinstance(one, type)))
        array: Any = next((one for one in classes if issubclass(one, AbstractArray)), None)
        parts = tuple(one for one in classes if dataclasses.is_dataclass(one) or one.__module__.startswith("jaxsph."))
        how = Any in members, type(None) in members or "open" in field.metadata
        if array is not None and re.fullmatch(r"[\w ]*", array.dim_str):  # no axes of any number, such as `*any`
            axes = tuple(int(axis) if axis.isdigit() else axis for axis in array.dim_str.split())
            found.append(Declared(field.name, tuple(array.dtypes), axes, (), *how))
        elif array is None and parts and not how[0]:
            found.append(Declared(field.name, (), (), parts, *how))
    return tuple(found)


def _members(hint: Any) -> list[Any]:
    """All that a field may be, or may be a tuple or a dictionary of."""
    return [member for one in typing.get_args(hint) if one is not Ellipsis for member in _members(one)] or [hint]


def fitting(name: str, part: Part, kind: type[Part] | None = None) -> Part:
    """A dataclass of arrays and parts with every leaf as it is annotated; under a trace, too, where shapes are known.

    Plain numbers, lists and arrays of NumPy become arrays; what is neither float32 nor float64, where floats are meant, becomes
    float32, and where some of a part's numbers are float64, all are.

    Raises:
        ValueError: naming what is of another shape than most that it goes with, holds no numbers, or is of another kind.
    """
    if kind is not None and not isinstance(part, kind):
        raise ValueError(f"`{name}` must be a `jaxsph.{kind.__name__}`, got {type(part).__name__}")
    given = [(one, getattr(part, one.name)) for one in _declared(type(part))]  # type: ignore[arg-type]
    given = [(one, value) for one, value in given if value is not None or not one.open]
    wide = jax.config.read("jax_enable_x64") and any(getattr(value, "dtype", None) == np.float64 for _, value in given)
    made = {one.name: _held(one, one.name, name, value, wide) for one, value in given}
    arrays = [(one, made[one.name]) for one, _ in given if one.dtypes]
    shapes = [(one, np.shape(each)) for one, value in arrays for each in (value.values() if type(value) is dict else (value,))]
    sizes: dict[Any, list[int]] = {}
    for one, shape in shapes:
        for axis, size in zip(one.axes, shape, strict=False):
            sizes.setdefault(axis, []).append(size)
    for one, shape in shapes:
        wanted = tuple(axis if isinstance(axis, int) else mode(sizes.get(axis, [1])) for axis in one.axes)
        if shape != wanted:
            raise ValueError(
                f"`{one.name}` of `{name}` must have shape {wanted}, got {shape}: arrays of a `{type(part).__name__}` go "
                "together, padding included; give one of that shape, or make all of it anew; for a batch take `jax.vmap`"
            )
    if all(made[one.name] is value for one, value in given):
        return part
    return unchecked_of(type(part), **{field.name: getattr(part, field.name) for field in dataclasses.fields(part)} | made)  # type: ignore[arg-type]


def _held(one: Declared, field: str, of: str, value: Any, wide: bool) -> Any:
    """What a field holds, of what it was given: itself, where that may be."""
    if isinstance(value, dict | tuple) and (one.parts or isinstance(value, dict)):
        entries = value if isinstance(value, dict) else dict(enumerate(value))
        kept = {key: _held(one, f"{field}[{key!r}]", of, each, wide) for key, each in entries.items()}
        same = all(kept[key] is each for key, each in entries.items())
        return value if same else kept if isinstance(value, dict) else tuple(kept.values())
    told = f"`{field}` of `{of}` must"
    if one.parts:
        if not isinstance(value, one.parts):
            kinds = " or ".join(f"`jaxsph.{kind.__name__}`" for kind in one.parts)
            raise ValueError(f"{told} be a {kinds}, got {type(value).__name__}")
        return fitting(f"{of}.{field}", value) if dataclasses.is_dataclass(value) else value
    if not isinstance(value, jax.Array):
        of_jax = any(isinstance(leaf, jax.Array) for leaf in jax.tree.leaves(value))
        if one.free and not of_jax:
            return value
        value = plain(f"{field}` of `{of}", value)
        try:
            value = jnp.asarray(value) if of_jax else np.asarray(value)
        except (TypeError, ValueError) as error:
            raise ValueError(f"{told} be an array of numbers, got {type(value).__name__}") from error
    elif value.dtype == (np.float64 if wide else np.float32) and FLOAT in one.dtypes:
        return value
    if "bool" in one.dtypes and value.dtype != bool:
        raise ValueError(f"{told} hold booleans, got dtype {value.dtype}; compare its numbers with something")
    require_real(f"{field}` of `{of}", value)
    as_it_is = FLOAT not in one.dtypes or (value.dtype.name in SMALL and value.dtype.name in one.dtypes)
    dtype = value.dtype if as_it_is else np.float64 if wide else np.float32
    if isinstance(value, jax.Array) and value.dtype == dtype:
        return value
    return array_of(module_for(value).asarray(value), dtype)


def line_of(name: str, *words: str | None) -> str:
    """`Name(words, words)` of the words that there are."""
    return f"{name}({', '.join(word for word in words if word)})"


def numbers_in(value: Any) -> np.ndarray | None:
    """Numbers, where there are some that can be looked at: nothing of tracers, deleted arrays, and other objects."""
    if isinstance(value, jax.Array):
        if isinstance(value, jax.core.Tracer) or value.is_deleted() or not value.is_fully_addressable:
            return None
    elif not isinstance(value, np.ndarray | np.generic | int | float):
        return None
    numbers = np.asarray(value)
    return numbers if numbers.dtype.kind in "biuf" and numbers.size <= MAX_LOOKED_AT else None


def kind_of(value: Any) -> str:
    """Type and shape, such as `float32[3,4]`; of what has none, its class."""
    shape, dtype = getattr(value, "shape", None), getattr(value, "dtype", None)
    if not isinstance(shape, tuple) or dtype is None:
        return type(value).__name__
    return f"{dtype}[{','.join(map(str, shape))}]"


def span_of(value: Any, valid: Any = True) -> str:
    """From the least to the greatest of those that are valid, NaN aside; where they are not known, what they are."""
    numbers, chosen = numbers_in(value), numbers_in(valid)
    if numbers is None or chosen is None:
        return kind_of(value)
    numbers = numbers[np.broadcast_to(chosen, numbers.shape) & ~np.isnan(numbers)] if numbers.shape else numbers[None]
    if not numbers.size:
        return "of nothing"
    low, high = (f"{float(end):.4g}" for end in (numbers.min(), numbers.max()))
    return low if low == high else f"{low} to {high}"


def row_of(value: Any) -> str:
    """A few numbers in brackets."""
    numbers = numbers_in(value)
    if numbers is None or numbers.ndim != 1:
        return kind_of(value)
    return f"({', '.join(f'{float(number):.4g}' for number in numbers)})"


def count_of(valid: Any) -> str:
    """How many are valid; where that is not known, in how many entries they are."""
    numbers = numbers_in(valid)
    return f"in {kind_of(valid)}" if numbers is None else f"{int(numbers.sum()):,}"


class Traceable:
    """What a verb gives, also from a trace: with a fault word, and of `jax.vmap` a batch, whose `LAYER` has more axes;
    `PLANNER` makes its plans.
    """

    LAYER: ClassVar[tuple[str, int]]
    PLANNER: ClassVar[str] = "plan"
    faults: Any

    def check(self) -> Self:
        """The same, for `jitted(scene).check().color`; if something went wrong under `jit`, that is raised with its remedy.

        Raises:
            CapacityError, ValueError: see `numerics.faults`; and of what is still traced: check it outside of `jit`.
        """
        if is_traced(self.faults):
            raise ValueError("`check` needs numbers: return the image, or its `faults`, from `jit` and check it outside")
        for word in np.ravel(np.asarray(self.faults)):
            raise_for(int(word) & ~TOLD, planner=self.PLANNER)
        return self

    @property
    def fault_messages(self) -> tuple[str, ...]:
        """What went wrong in words, each with a remedy; nothing where all is well (host side)."""
        word = int(np.bitwise_or.reduce(np.ravel(np.asarray(self.faults))))
        return tuple(describe(bit, self.PLANNER) for bit in MESSAGES if word & bit)

    @property
    def batch(self) -> tuple[int, ...]:
        """How many there are, along the axes that `jax.vmap` has put in front; nothing of one."""
        field, rank = self.LAYER
        return tuple(np.shape(getattr(self, field))[:-rank])

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width), of a batch those of each."""
        field, rank = self.LAYER
        height, width = np.shape(getattr(self, field))[-rank:][:2]
        return int(height), int(width)

    def __getitem__(self, index: Any) -> Self:
        """One of a batch, or some."""
        if not self.batch:
            raise TypeError(f"this is one `{type(self).__name__}` and no batch of them; its layers are arrays: take one of these")
        return jax.tree.map(lambda leaf: leaf[index], self)  # type: ignore[no-any-return]

    def as_one(self, verb: str) -> Self:
        """Itself, for a verb that needs one; `ValueError` of a batch, of what is traced, and of layers of several shapes."""
        name = type(self).__name__
        require_known(f"{name}.{verb}", **{name.lower(): self})
        if self.batch:
            raise ValueError(f"`{verb}` takes one `{name}`, this is a batch of {self.batch}, by `jax.vmap`; take one, by `[0]`")
        fitting(name.lower(), self)
        return self
