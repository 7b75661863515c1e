"""Frozen dataclasses that are pytrees, of which some fields are static: they fix what is compiled.

Flow: [trees] -> all that is traced.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, TypeVar, dataclass_transform

import jax

Kind = TypeVar("Kind", bound=type)


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


def unchecked_of(kind: type[Any], /, **fields: Any) -> Any:
    """One of a class of such fields, made without its `__init__`."""
    made = object.__new__(kind)
    fill(made, **fields)
    return made


def fill(made: Any, /, **fields: Any) -> None:
    """Set fields of what is frozen, and is being made."""
    for name, value in fields.items():
        object.__setattr__(made, name, value)
