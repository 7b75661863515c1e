r"""Which particles of a table are shown: conditions such as `Temperature > 1e4 and Density < 2`, and shares.

Flow: ParticleTable, text -> [where: parse -> look up -> mask] -> assemble.

A condition is parsed as a Python expression, of which only these are understood, and nothing is run: names of quantities as
`jaxsph.io.settle.quantities` has them (`velocity.x`; in back quotes where they are no Python names), numbers, `+ - * / ** %`,
comparisons, chains of them, `and`, `or`, `not`, and the functions below.
"""

from __future__ import annotations

import ast
import dataclasses
import functools
import itertools
import re
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Bool

from jaxsph.io.damage import DataError
from jaxsph.io.settle.matching import ids_of
from jaxsph.io.settle.quantities import quantity_named
from jaxsph.io.table import ParticleTable

MAX_LENGTH = 4096  # characters of a condition
FUNCTIONS: dict[str, tuple[Callable[..., Any], int]] = {
    "abs": (np.abs, 1), "sqrt": (np.sqrt, 1), "exp": (np.exp, 1), "log": (np.log, 1), "log10": (np.log10, 1),
    "min": (np.minimum, 2), "max": (np.maximum, 2), "hypot": (np.hypot, 2),
}  # fmt: skip
"""With how many arguments each is called."""
OPERATORS: dict[type[ast.AST], tuple[Callable[..., Any], bool]] = {
    ast.Add: (np.add, False), ast.Sub: (np.subtract, False), ast.Mult: (np.multiply, False), ast.Div: (np.divide, False),
    ast.Pow: (np.power, False), ast.Mod: (np.mod, False), ast.USub: (np.negative, False), ast.UAdd: (np.positive, False),
    ast.And: (np.logical_and, True), ast.BitAnd: (np.logical_and, True), ast.Or: (np.logical_or, True),
    ast.BitOr: (np.logical_or, True), ast.Not: (np.logical_not, True), ast.Invert: (np.logical_not, True),
}  # fmt: skip
"""And whether they are between conditions, not numbers."""
COMPARISONS: dict[type[ast.AST], Callable[..., Any]] = {
    ast.Lt: np.less, ast.LtE: np.less_equal, ast.Gt: np.greater, ast.GtE: np.greater_equal,
    ast.Eq: np.equal, ast.NotEq: np.not_equal,
}  # fmt: skip
HINTS = {"=": "compare by ==", "&": "write and", "|": "write or", "!": "write not"}
"""What is meant where a condition breaks off at such a character."""


class ConditionError(DataError):
    """A condition that is not understood; the message says where."""


def select(
    table: ParticleTable, where: str | None = None, share: float | None = None, *, density: Callable[[], Any] | None = None
) -> tuple[Bool[np.ndarray, " particles"], tuple[str, ...]]:
    """Who meets a condition, and of those a share, at random but always the same, by ids where there are some; and notes on each.

    Args:
        table: the particles.
        where: the condition; None for all.
        share: in (0, 1]: of how many of them; None for all. The field of fewer particles is another one.
        density: gives the summed density when the table holds none.

    Raises:
        ValueError: a condition that is not understood (`ConditionError`), names that the table does not have, a share that is
            not in (0, 1], or nothing left; the message says how many were left out by what.
    """
    kept, notes = np.ones(len(table), bool), []
    if where is not None:
        condition = Condition(where, table, density)
        parts = condition.parts()
        masks = [np.broadcast_to(condition.of_particles(part), len(table)) for part in parts]
        left_out = (f"{(~mask).sum():,} left out by {condition.source(part)}" for part, mask in zip(parts, masks, strict=True))
        kept, told = functools.reduce(np.logical_and, masks), ", ".join(left_out)
        notes.append(f"where {where}: {kept.sum():,} of {len(table):,} particles; {told}")
        if len(table) and not kept.any():
            raise DataError(f"no particle is left of {len(table):,} where {where}: {told}; `where` must leave some")
    if share is not None:
        if not 0 < share <= 1:
            raise ConditionError(f"`share` must be above 0 and at most 1, got {share:g}; 0.1 shows a tenth of the particles")
        some = np.flatnonzero(kept)
        number = min(max(round(share * len(some)), 1), len(some))
        chosen = some[_shuffled(table)[some].argsort(kind="stable")[:number]]
        notes.append(f"a share of {share:g}: {number:,} of {len(some):,} particles, for a quick look: their field is another one")
        kept = np.zeros(len(table), bool)
        kept[chosen] = True
    return kept, tuple(notes)


def evaluated(table: ParticleTable, text: str, name: str) -> np.ndarray:
    """The numbers, (N,) float64, of an expression such as `2*h`; those of its own supports are called `support`, too.

    Raises `ValueError`: an expression that is not understood (`ConditionError`), with the `name` of what it is for.
    """
    if table.support is not None:
        table = dataclasses.replace(table, columns={"support": table.support, **table.columns})
    try:
        return np.broadcast_to(Condition(text, table).numbers(), len(table))
    except ConditionError as error:
        raise ConditionError(f"`{name}`: {error}") from error


def _shuffled(table: ParticleTable) -> np.ndarray:
    """Numbers to draw by, one a particle: of ids, such that a share is of the same particles in each file of a sequence."""
    ids = ids_of(table)
    if isinstance(ids, str):
        return np.random.default_rng(0).random(len(table))
    mixed = ids.astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15)  # Steele, Lea & Flood 2014: splitmix64
    for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB)):
        mixed = (mixed ^ (mixed >> np.uint64(shift))) * np.uint64(factor)
    return np.asarray(mixed ^ (mixed >> np.uint64(31)))


class Condition:
    """A condition on the particles of a table, of which errors quote `text`, and where in it."""

    def __init__(self, text: str, table: ParticleTable, density: Callable[[], Any] | None = None):
        if len(text) > MAX_LENGTH:
            raise ConditionError(f"a condition may have {MAX_LENGTH} characters, this one has {len(text)}; shorten it")
        if not text.strip():
            raise ConditionError("a condition is empty; give one such as 'Temperature > 1e4', or leave it out")
        self.text, self._table, self._density = re.sub(r"\s", " ", text), table, density
        self._columns: dict[str, np.ndarray] = {}  # by name, as a density may take its time
        self._code = re.sub(r"`[^`]+`", lambda quoted: "_" * len(quoted[0]), self.text)  # a Python name that is as long
        self._indent = len(self._code) - len(self._code.lstrip())
        try:
            with warnings.catch_warnings(action="ignore"):  # of Python's, on what looks odd to it
                self._root = ast.parse(self._code.lstrip(), mode="eval").body
        except SyntaxError as error:
            place = min(error.offset - 1 + self._indent, len(self.text)) if error.lineno == 1 and error.offset else len(self.text)
            raise self._error(HINTS.get(self.text[place : place + 1], error.msg), place) from error
        except (ValueError, RecursionError, MemoryError) as error:
            raise ConditionError(f"the condition {text!r} cannot be read: {error or type(error).__name__}") from error

    def parts(self) -> list[ast.expr]:
        """What all has to be true: the terms of an outermost `and`."""
        both = isinstance(self._root, ast.BoolOp) and isinstance(self._root.op, ast.And)
        return self._root.values if both else [self._root]  # type: ignore[attr-defined]

    def numbers(self) -> np.ndarray:
        """What it gives, where it is an expression."""
        return self.of_particles(self._root, False)

    def of_particles(self, node: ast.expr, truth: bool = True) -> np.ndarray:
        """Whether particles meet a part of it."""
        try:
            with np.errstate(all="ignore"):
                return self._of_kind(node, truth)
        except RecursionError as error:
            raise ConditionError(f"the condition {self.text!r} is nested too deeply; take it apart") from error

    def source(self, node: Any) -> str:
        """The text of a part."""
        return self.text[self._start(node) : self._characters(node.end_col_offset)]

    def _start(self, node: Any) -> int:
        return self._characters(node.col_offset)

    def _characters(self, offset: int) -> int:
        """Where in the text an offset in bytes is, as a syntax tree has them."""
        return self._indent + len(self._code.lstrip().encode()[:offset].decode(errors="ignore"))

    def _error(self, why: str, start: int, node: ast.AST | None = None) -> ConditionError:
        there = self.text[start:] if node is None else self.source(node)
        what = f"at character {start + 1}, {there!r}" if there else "at its end"
        return ConditionError(f"the condition {self.text!r} is not understood {what}: {why}")

    def _value(self, node: ast.expr) -> np.ndarray:
        if isinstance(node, ast.Constant) and type(node.value) in (int, float):
            try:
                return np.asarray(float(node.value), np.float64)  # type: ignore[arg-type]
            except OverflowError:
                raise self._error("the number is too large", self._start(node), node) from None
        if isinstance(node, ast.Name | ast.Attribute):
            return self._column(node)
        if isinstance(node, ast.BoolOp | ast.UnaryOp | ast.BinOp):
            return self._operated(node)
        if isinstance(node, ast.Compare):
            if not all(type(operator) in COMPARISONS for operator in node.ops):
                raise self._error("numbers are compared by < <= > >= == !=", self._start(node), node)
            values = [self._of_kind(one, False) for one in (node.left, *node.comparators)]
            compared = (COMPARISONS[type(each)](*pair) for each, pair in zip(node.ops, itertools.pairwise(values), strict=True))
            return functools.reduce(np.logical_and, compared)
        if isinstance(node, ast.Call):
            return self._called(node)
        allowed = "names, numbers, + - * / ** %, comparisons, and, or, not, and the functions " + ", ".join(FUNCTIONS)
        raise self._error(f"there may be {allowed}", self._start(node), node)

    def _column(self, node: ast.Name | ast.Attribute) -> np.ndarray:
        name = self.source(node).replace("`", "")
        base: ast.expr = node
        while isinstance(base, ast.Attribute):
            base = base.value
        if not isinstance(base, ast.Name):
            raise self._error("a point stands between the name of a vector and a component", self._start(node), node)
        try:
            if name not in self._columns:
                self._columns[name] = quantity_named(self._table, name, density=self._density)
            return self._columns[name]
        except DataError as error:
            raise self._error(str(error), self._start(node), node) from error

    def _of_kind(self, node: ast.expr, truth: bool, why: str | None = None) -> np.ndarray:
        """The value of a part, which must be a condition, or a number."""
        found = self._value(node)
        if (found.dtype == bool) == truth:
            return found
        told = "this is a number, not a condition: compare it with something" if truth else "this is a condition, not a number"
        raise self._error(why or told, self._start(node), node)

    def _operated(self, node: ast.BoolOp | ast.UnaryOp | ast.BinOp) -> np.ndarray:
        operands, kind, why = [one for one in ast.iter_child_nodes(node) if isinstance(one, ast.expr)], type(node.op), None
        if kind in (ast.BitAnd, ast.BitOr):
            why = "& and | come before comparisons: put those in brackets, or write and, or"  # a > 1 & b < 2 is a > (1 & b) < 2
            while isinstance(operands[0], ast.BinOp) and type(operands[0].op) is kind:  # nests as deep as there are terms
                operands[:1] = operands[0].left, operands[0].right
        if kind not in OPERATORS:
            raise self._error("there may be + - * / ** % between numbers", self._start(node), node)
        function, truth = OPERATORS[kind]
        values = [self._of_kind(one, truth, why) for one in operands]
        return np.asarray(function(*values) if len(values) == 1 else functools.reduce(function, values))

    def _called(self, node: ast.Call) -> np.ndarray:
        name = node.func.id if isinstance(node.func, ast.Name) else ""
        if name not in FUNCTIONS:
            raise self._error(f"the functions are {', '.join(FUNCTIONS)}", self._start(node), node)
        function, number = FUNCTIONS[name]
        if len(node.args) != number or node.keywords:
            raise self._error(f"`{name}` is called with {number} number{'s' * (number > 1)}", self._start(node), node)
        return np.asarray(function(*(self._of_kind(one, False) for one in node.args)))
