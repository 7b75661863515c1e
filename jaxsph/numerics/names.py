"""Names of the public surface: found when they are first used, and former ones, which warn and tell the new word.

Flow: table of names -> [names] -> `__getattr__` of a package; former arguments -> [names] -> arguments.

Entries are `module:attribute`, or a module alone. This module imports nothing that takes time, as whatever is looked up by
name does so when it is used.
"""

from __future__ import annotations

import functools
import importlib
import inspect
import sys
import warnings
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

Function = TypeVar("Function", bound=Callable[..., Any])


def found(entry: str) -> Any:
    """What an entry names: `module`, `module:attribute` or `module:attribute.attribute`."""
    module, _, name = entry.partition(":")
    return functools.reduce(getattr, name.split(".") if name else (), importlib.import_module(module))


def lazy(
    package: str, names: Mapping[str, str], former: Mapping[str, tuple[str, str]] | None = None
) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """`__getattr__` and `__dir__` of a package whose names are imported when they are first used (PEP 562).

    Args:
        package: its `__name__`.
        names: an entry for each.
        former: an entry and the new word for each name that is going; the first use in a process warns.
    """
    space = vars(sys.modules[package])

    def look_up(name: str) -> Any:
        if name in names:
            entry = names[name]
        elif former and name in former:
            entry, now = former[name]
            warnings.warn(f"`{package}.{name}` is now `{now}`; the old name goes with the next version", FutureWarning, 2)
        else:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        space[name] = found(entry)
        return space[name]

    return look_up, lambda: sorted({*space.get("__all__", ()), *names})


def renamed(**former: str) -> Callable[[Function], Function]:
    """Let a function take keywords by former names, with a warning that tells the new word: `@renamed(old="new")`.

    Raises:
        TypeError: when called with both.
    """

    def decorate(function: Function) -> Function:
        @functools.wraps(function)
        def call(*arguments: Any, **given: Any) -> Any:
            for old, new in former.items():
                if old in given:
                    if new in given:
                        raise TypeError(f"`{old}` is the former name of `{new}`: give `{new}` alone")
                    what = f"`{old}` of `{function.__qualname__}` is now `{new}`; the old name goes with the next version"
                    warnings.warn(what, FutureWarning, 2)
                    given[new] = given.pop(old)
            return function(*arguments, **given)

        call.__signature__ = inspect.signature(function)  # type: ignore[attr-defined]
        return call  # type: ignore[return-value]

    return decorate
