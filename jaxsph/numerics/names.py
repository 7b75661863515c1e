"""Names that are looked up when they are first used: those of the public surface, and of what few calls need.

Entries are `module:attribute`, or a module alone. This module imports nothing that takes time, as whatever is looked up by
name does so when it is used.
"""

from __future__ import annotations

import difflib
import importlib
import inspect
from collections.abc import Callable, Iterable
from typing import Any

INTEGRATORS: dict[str, str] = {}
"""Integrators by name, each a class without arguments; entered by rooms above, see `jaxsph.model.settings`."""
ALIKE = 0.6
"""Share of letters that two names must have in common, in their order."""


def did_you_mean(name: object, known: Iterable[str]) -> str:
    """`"; did you mean NAME?"` of the one that is most like it, but for case; or nothing where none is."""
    names = {one.lower(): one for one in known}
    alike = difflib.get_close_matches(str(name).lower(), names, 1, ALIKE)
    return f"; did you mean {names[alike[0]]}?" if alike else ""


def refuse_unknown(verb: Callable[..., Any], given: Iterable[str], known: Iterable[str]) -> None:
    """Raise `TypeError` that names an argument that a verb does not have, others that it has, and which that is most like."""
    for name in (name for name in given if name not in known):
        meant = did_you_mean(name, (*inspect.signature(verb).parameters, *known))
        raise TypeError(f"`{verb.__qualname__}` has no argument `{name}`; others that it has are {', '.join(known)}{meant}")


def import_by_name(entry: str) -> Any:
    """What an entry names: `module` or `module:attribute`.

    Checks and readers do not see such an import: it is for what few calls need and takes over 50 ms, written beside it.
    """
    name, _, attribute = entry.partition(":")
    module = importlib.import_module(name)
    return getattr(module, attribute) if attribute else module
