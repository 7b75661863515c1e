"""Figures on pages, and the files that they are from.

A comment of a page names the files of `benchmarks/results/` that a block's figures are from:

    <!-- figures: access.json; trade.json (max_error, evaluations_full / evaluations); besides 512, 0.004 -->

It is of the paragraph, list or table that it stands in or right above, up to the next empty line; in a row of a table of its
cell. Each number of the block is then the rounding, at the digits that are printed, of a number in these files: of any, or
of those under the keys in brackets, of which `a / b` is a quotient of neighbours. Units are read: %, ms, MB and the like. Numbers
after `besides` are settings, or those of a paper. A page that a program writes is a file, too, and beginnings of its
headings are keys.
"""

from __future__ import annotations

import functools
import json
import re
from collections.abc import Iterator
from typing import NamedTuple

from tools import ROOT

RESULTS = ROOT / "benchmarks" / "results"
COMMENT = re.compile(r"<!-- figures: (.*?) -->")
NUMBER = re.compile(r"(?<![\w.,:/^*-])-?(\d{1,3}(?:,\d{3})+|\d+)(\.\d+)?(e-?\d+)?(?![\w^]|[.,:/]\d)(?:\s?(%|[a-zA-Z]+))?")
UNITS = {  # what a number of a file is multiplied by, for a number with that unit
    "%": (100, 1), "ms": (1e3, 1), "us": (1e6, 1), "ns": (1e9, 1), "k": (1e-3, 1), "M": (1e-6, 1), "million": (1e-6, 1),
    "MB": (1e-6, 1), "GB": (1e-9, 1), "GiB": (2**-30, 1), "MiB": (2**-20, 1),
}  # fmt: skip
ELSEWHERE = [  # what holds no figures: code, places of links, formulas; numbers of sections and of versions, years
    r"```.*?```", r"`[^`]*`", r"\]\([^)]*\)", r"<[^>]*>", r"\$[^$]*\$", r"\d+\.\d+\.\d+",
    r"(?i)\b(?:sections?|tables?|figures?|equations?|algorithms?)(?:(?:,| to| and)? \d+(?:\.\d+)*[a-z]?(?![\w-]))+",
    r"\b(?:19|20)\d\d\b(?! ?x)",
]  # fmt: skip


class Figure(NamedTuple):
    """A number as it is printed."""

    text: str
    value: float
    step: float  # of its last digit
    unit: str


class Block(NamedTuple):
    """A part of a page, and what a comment says of its figures."""

    text: str
    sources: tuple[str, ...] = ()
    besides: frozenset[float] = frozenset()


def figures(text: str) -> Iterator[Figure]:
    """All numbers that are printed."""
    for pattern in ELSEWHERE:
        text = re.sub(pattern, " ", text, flags=re.DOTALL)
    for found in NUMBER.finditer(text):
        whole, digits, power, unit = (part or "" for part in found.groups())
        step = float(f"1{power}") * 10.0 ** -max(len(digits) - 1, 0)
        unit = unit if unit in UNITS else ""
        yield Figure(f"{whole}{digits}{power} {unit}".strip(), float(whole.replace(",", "") + digits + power), step, unit)


def parts(page: str) -> Iterator[str]:
    """Paragraphs, lists and tables, each with the comment above; of tables without one the rows."""
    for part in re.split(r"\n\s*\n", re.sub(r"```.*?```", "\n\n", page, flags=re.DOTALL)):
        lines = part.strip().splitlines()
        if lines and lines[-1].startswith("|") and not COMMENT.fullmatch(lines[0].strip()):
            yield from lines
        else:
            yield part


def blocks(page: str) -> Iterator[Block]:
    """Parts of a page; of a row of a table with a comment the cell that the comment is in."""
    for part in parts(page):
        told = COMMENT.search(part)
        if told is None:
            yield Block(part)
            continue
        row = part.startswith("|")
        text = next(cell for cell in part.split(" | ") if COMMENT.search(cell)) if row else part
        sources = [source.strip() for source in told.group(1).split(";")]
        besides = [source.removeprefix("besides ") for source in sources if source.startswith("besides ")]
        named = tuple(source for source in sources if not source.startswith("besides "))
        yield Block(COMMENT.sub(" ", text), named, frozenset(figure.value for one in besides for figure in figures(one)))


@functools.cache
def measured(source: str) -> tuple[float, ...]:
    """All numbers that a source holds: a file, a file with keys, or a page."""
    name, _, keys = source.partition(" (")
    if name.endswith(".md"):
        sections = re.split(r"^#+ ", (ROOT / "docs" / name).read_text(encoding="utf-8"), flags=re.MULTILINE)
        wanted = [one.strip() for one in keys.rstrip(")").split(",") if one]
        some = [one for one in sections if not wanted or one.startswith(tuple(wanted))]
        return tuple(figure.value for one in some for figure in figures(one))
    found = json.loads((RESULTS / name).read_text(encoding="utf-8"))
    found.pop("run", None)
    if not keys:
        return tuple(numbers(found))
    wanted = [[part.strip() for part in key.split("/")] for key in keys.rstrip(")").split(",")]
    return tuple(value for one in wanted for value in under(found, one))


def numbers(found: object) -> Iterator[float]:
    """All numbers that are anywhere in what JSON holds, those in names of keys among them."""
    if isinstance(found, dict):
        for key, value in found.items():
            yield from (figure.value for figure in figures(key))
            yield from numbers(value)
    elif isinstance(found, list):
        for value in found:
            yield from numbers(value)
    elif isinstance(found, str):
        yield from (figure.value for figure in figures(found))
    elif isinstance(found, (int, float)) and not isinstance(found, bool):
        yield float(found)


def under(found: object, keys: list[str]) -> Iterator[float]:
    """Numbers under a key, or quotients of those under two keys of the same object."""
    if isinstance(found, dict):
        if len(keys) == 1 and keys[0] in found:
            yield from numbers(found[keys[0]])
        elif len(keys) == 2 and all(isinstance(found.get(key), (int, float)) for key in keys) and found[keys[1]]:
            yield found[keys[0]] / found[keys[1]]
    for value in found.values() if isinstance(found, dict) else found if isinstance(found, list) else ():
        yield from under(value, keys)


def is_measured(figure: Figure, block: Block) -> bool:
    """Whether it is the rounding of a number in the sources of its block, or of those besides."""
    if figure.value in block.besides:
        return True
    half = 0.5 * figure.step * (1 + 1e-9)
    return any(
        abs(abs(value) * scale - abs(figure.value)) <= half
        for source in block.sources for value in measured(source) for scale in UNITS.get(figure.unit, (1,))
    )  # fmt: skip


def unmeasured(page: str) -> list[tuple[str, tuple[str, ...]]]:
    """Figures of a page that are in none of the files that its comments name."""
    named = [block for block in blocks(page) if block.sources]
    return [(figure.text, block.sources) for block in named for figure in figures(block.text) if not is_measured(figure, block)]


def unnamed(page: str) -> list[str]:
    """Paragraphs, and cells of tables, that have figures and name a benchmark, and say not which files the figures are from."""
    texts = [cell for block in blocks(page) if not block.sources for cell in block.text.split(" | ")]
    some = [text for text in texts if re.search(r"benchmarks/\w+\.py", text)]
    return [text for text in some if any(figure.step < 1 or figure.unit for figure in figures(text))]
