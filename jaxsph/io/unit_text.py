"""The grammar of units that people write: names, whole or fractional powers, `*` and `/`; nothing else gets through.

Flow: text of a user -> [unit_text] -> text that `unyt` may be given -> `unit_names`.

The library that knows units evaluates what it is given as code, so text is checked here first.
"""

from __future__ import annotations

import keyword
import re

MAX_LENGTH = 100  # characters of a unit
MAX_POWER = 12  # of a name: no quantity has more, and larger ones overflow
NAME = r"[^\W\d_][^\W_]{0,19}(?:_[^\W_]{1,19})?"
POWER = r"(?:[-+]?\d{1,2}(?:\.\d{1,4})?|\(\s*[-+]?\d{1,2}(?:\.\d{1,4}|\s*/\s*\d{1,2})?\s*\))"
FACTOR = re.compile(rf"\s*({NAME})\s*(?:(?:\*\*|\^)\s*({POWER}))?\s*")
RECIPROCAL = re.compile(r"\s*1\s*(?=/)")
NO_NAMES = frozenset(keyword.kwlist) | {"sqrt", "Symbol", "Integer", "Float", "Rational"}


def checked_unit(text: str) -> str:
    """The same unit, as `unyt` may be given it.

    Args:
        text: names with powers, between them `*` or `/`, such as `"Msun/kpc**3"`, `"g*cm**(-1/2)"` or `"1/s"`.

    Raises:
        ValueError: anything else; more than 100 characters; a power beyond 12.
    """
    if len(text) > MAX_LENGTH:
        raise ValueError(f"a unit may have {MAX_LENGTH} characters, this one has {len(text)}; write it as 'Msun/kpc**3'")
    found = RECIPROCAL.match(text)
    parts, at = (["1"], found.end()) if found else ([], 0)
    while True:
        if parts and at < len(text):
            if text[at] not in "*/":
                raise _refused(text)
            parts.append(text[at])
            at += 1
        elif parts:
            return "".join(parts)
        factor = FACTOR.match(text, at)
        if factor is None or factor[1] in NO_NAMES:
            raise _refused(text)
        parts.append(factor[1] + _power(factor[2], text))
        at = factor.end()


def _power(given: str | None, text: str) -> str:
    """Of a factor, in brackets."""
    if given is None:
        return ""
    inside = re.sub(r"[\s()]", "", given)
    over, _, under = inside.partition("/")
    if abs(float(over)) > MAX_POWER or (under and not 1 <= int(under) <= MAX_POWER):
        raise ValueError(f"{text!r} is no unit: powers lie between {-MAX_POWER} and {MAX_POWER}; write it as 'Msun/kpc**3'")
    return f"**({inside})"


def _refused(text: str) -> ValueError:
    rule = "names with whole or fractional powers, between them * or /"
    return ValueError(f"{text!r} is no unit: it may hold {rule}; write it as 'Msun/kpc**3'")
