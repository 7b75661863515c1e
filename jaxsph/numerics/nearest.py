"""What was probably meant by a name that there is not.

Flow: name, names that there are -> [nearest] -> a question for the end of a message.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable

ALIKE = 0.6
"""Share of letters that two names must have in common, in their order."""


def nearest(name: str, known: Iterable[str]) -> str | None:
    """The name that is most like `name`, but for case; None where none is like it."""
    names = {one.lower(): one for one in known}
    found = difflib.get_close_matches(name.lower(), names, 1, ALIKE)
    return names[found[0]] if found else None


def did_you_mean(name: object, known: Iterable[str]) -> str:
    """`"; did you mean NAME?"`, or nothing where no name is like it."""
    found = nearest(str(name), known)
    return "" if found is None else f"; did you mean {found}?"
