r"""Arithmetic with quantities, as text: `Masses * Density`, `log10(u / Temperature)`, and conditions such as `rho > 2 and x < 0`.

Flow: text, what names mean -> [where: parse -> look up -> compute] -> quantities, matching.

It is parsed as a Python expression, of which only these are understood, and nothing is run: names of quantities as
`jaxsph.io.settle.quantities` has them (`velocity.x`; in back quotes where they are no Python names), numbers, `+ - * / ** %`,
comparisons, chains of them, `and`, `or`, `not`, and the functions below. Numbers are float64.
"""

from __future__ import annotations

import ast
import contextlib
import functools
import itertools
import re
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np

from jaxsph.io.damage import DataError

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
EXAMPLES = {"condition": "Temperature > 1e4", "expression": "Masses * Density"}
FIRST = 3  # particles that an error tells of


class ConditionError(DataError):
    """A condition or an expression that is not understood; the message says where."""


class Expression:
    """What particles are made to give, numbers or, of a condition, whether it is so; errors quote `text`, and where in it."""

    def __init__(self, text: str, look_up: Callable[[str], np.ndarray], what: str = "expression"):
        if len(text) > MAX_LENGTH:
            raise ConditionError(f"a {what} may have {MAX_LENGTH} characters, this one has {len(text)}; shorten it")
        if not text.strip():
            raise ConditionError(f"a {what} is empty; give one such as {EXAMPLES[what]!r}, or leave it out")
        self.text, self._look_up, self._what = re.sub(r"\s", " ", text), look_up, what
        self._columns: dict[str, np.ndarray] = {}  # by name, as a density may take its time
        self._code = re.sub(r"`[^`]+`", lambda quoted: "_" * len(quoted[0]), self.text)  # a Python name that is as long
        self._indent = len(self._code) - len(self._code.lstrip())
        try:
            with warnings.catch_warnings(action="ignore"):  # of Python's, on what looks odd to it
                self._root = ast.parse(self._code.lstrip(), mode="eval").body
        except SyntaxError as error:
            place = min(error.offset - 1 + self._indent, len(self.text)) if error.lineno == 1 and error.offset else len(self.text)
            raise self._error(HINTS.get(self.text[place : place + 1], error.msg), place=place) from error
        except (ValueError, RecursionError, MemoryError) as error:
            raise ConditionError(f"the {what} {text!r} cannot be read: {error or type(error).__name__}") from error

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
            raise ConditionError(f"the {self._what} {self.text!r} is nested too deeply; take it apart") from error

    def source(self, node: Any) -> str:
        """The text of a part."""
        return self.text[self._start(node) : self._characters(node.end_col_offset)]

    def _start(self, node: Any) -> int:
        return self._characters(node.col_offset)

    def _characters(self, offset: int) -> int:
        """Where in the text an offset in bytes is, as a syntax tree has them."""
        return self._indent + len(self._code.lstrip().encode()[:offset].decode(errors="ignore"))

    def _error(self, why: str, node: ast.AST | None = None, place: int = 0) -> ConditionError:
        start, there = (place, self.text[place:]) if node is None else (self._start(node), self.source(node))
        what = f"at character {start + 1}, {there!r}" if there else "at its end"
        return ConditionError(f"the {self._what} {self.text!r} is not understood {what}: {why}")

    def _value(self, node: ast.expr) -> np.ndarray:
        if isinstance(node, ast.Constant) and type(node.value) in (int, float):
            with contextlib.suppress(OverflowError):
                if np.isfinite(number := float(node.value)):  # type: ignore[arg-type]
                    return np.asarray(number, np.float64)
            raise self._error("the number is too large", node)
        if isinstance(node, ast.Name | ast.Attribute):
            return self._column(node)
        if isinstance(node, ast.BoolOp | ast.UnaryOp | ast.BinOp):
            return self._operated(node)
        if isinstance(node, ast.Compare):
            if not all(type(operator) in COMPARISONS for operator in node.ops):
                raise self._error("numbers are compared by < <= > >= == !=", node)
            values = [self._of_kind(one, False) for one in (node.left, *node.comparators)]
            compared = (COMPARISONS[type(each)](*pair) for each, pair in zip(node.ops, itertools.pairwise(values), strict=True))
            return functools.reduce(np.logical_and, compared)
        if isinstance(node, ast.Call):
            return self._called(node)
        allowed = "names, numbers, + - * / ** %, comparisons, and, or, not, and the functions " + ", ".join(FUNCTIONS)
        raise self._error(f"there may be {allowed}", node)

    def _column(self, node: ast.Name | ast.Attribute) -> np.ndarray:
        name = self.source(node).replace("`", "")
        base: ast.expr = node
        while isinstance(base, ast.Attribute):
            base = base.value
        if not isinstance(base, ast.Name):
            raise self._error("a point stands between the name of a vector and a component", node)
        try:
            if name not in self._columns:
                self._columns[name] = self._look_up(name)
            return self._columns[name]
        except DataError as error:
            raise self._error(str(error), node) from error

    def _of_kind(self, node: ast.expr, truth: bool, why: str | None = None) -> np.ndarray:
        """The value of a part, which must be a condition, or a number."""
        value = self._value(node)
        if (value.dtype == bool) == truth:
            return value
        told = "this is a number, not a condition: compare it with something" if truth else "this is a condition, not a number"
        raise self._error(why or told, node)

    def _operated(self, node: ast.BoolOp | ast.UnaryOp | ast.BinOp) -> np.ndarray:
        operands, kind, why = [one for one in ast.iter_child_nodes(node) if isinstance(one, ast.expr)], type(node.op), None
        if kind in (ast.BitAnd, ast.BitOr):
            why = "& and | come before comparisons: put those in brackets, or write and, or"  # a > 1 & b < 2 is a > (1 & b) < 2
            while isinstance(operands[0], ast.BinOp) and type(operands[0].op) is kind:  # nests as deep as there are terms
                operands[:1] = operands[0].left, operands[0].right
        if kind not in OPERATORS:
            raise self._error("there may be + - * / ** % between numbers", node)
        function, truth = OPERATORS[kind]
        values = [self._of_kind(one, truth, why) for one in operands]
        return self._finite(node, operands, values, function(*values) if len(values) == 1 else functools.reduce(function, values))

    def _called(self, node: ast.Call) -> np.ndarray:
        name = node.func.id if isinstance(node.func, ast.Name) else ""
        if name not in FUNCTIONS:
            raise self._error(f"the functions are {', '.join(FUNCTIONS)}", node)
        function, number = FUNCTIONS[name]
        if len(node.args) != number or node.keywords:
            raise self._error(f"`{name}` is called with {number} number{'s' * (number > 1)}", node)
        values = [self._of_kind(one, False) for one in node.args]
        return self._finite(node, node.args, values, function(*values))

    def _finite(self, node: ast.expr, parts: list[ast.expr], operands: list[np.ndarray], result: Any) -> np.ndarray:
        """What a part gives, which in an expression is a number wherever its operands are; nothing meets a condition else."""
        result = np.asarray(result)
        if result.dtype != bool and (self._what == "expression" or not result.ndim):
            wrong = functools.reduce(np.logical_and, map(np.isfinite, operands), ~np.isfinite(result))
            if wrong.any():
                each = zip(parts, operands, strict=True)
                named = [(self.source(one), value) for one, value in each if not isinstance(one, ast.Constant)]
                if not wrong.ndim:
                    raise DataError(f"{self.source(node)!r} in {self.text!r} is no finite number; correct it")
                rows = np.flatnonzero(wrong)[:FIRST]
                told = [[f"{one} = {np.broadcast_to(value, wrong.shape)[row]:.6g}" for one, value in named] for row in rows]
                where = "; ".join(", ".join([f"{row}", *said]) for row, said in zip(rows, told, strict=True))
                raise DataError(
                    f"{self.source(node)!r} in {self.text!r} is no finite number for {int(wrong.sum()):,} of {wrong.size:,} "
                    f"particles, the first at index {where}; leave them out by `where`"
                )
        return result
