"""Text tables: CSV (`,` `;` or tab), columns parted by spaces, and XYZ, with or without names.

Names come from a first line of words, or from a `#` comment right above the numbers; without names the first three
columns are x, y, z. Names may have blanks, where they stand in the fields of the numbers, as in SPLASH's ASCII, or in brackets.
An XYZ file begins with the number of particles and a comment, and each line with the name of an
element or its number; extended XYZ names its columns in the comment (`Properties=species:S:1:pos:R:3:...`).
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import re
from pathlib import Path

import numpy as np

from jaxsph.io.damage import UNENDED_NOTE, DataError, explained
from jaxsph.io.parsing import gather_vectors, is_of_positions
from jaxsph.io.table import GEOMETRY, LENGTH, ROLES, CodeUnit, FileUnits, ParticleTable, plain, table_from_columns
from jaxsph.io.units import LENGTHS

SOURCE = "text table"
DELIMITERS = (",", ";", "\t")
WHOLE = re.compile(r"[+-]?[0-9]{1,400}")  # of more digits than any float64 has
MAX_COLUMNS = 2**16  # columns that a comment of a few bytes may ask for
WITH_UNIT = re.compile(r"(.*)[xyzXYZ012]\]?\s[\[(]\s*(\w+)\s*[\])]")
NEEDED = {*map(plain, (*GEOMETRY, *ROLES["mass"], *ROLES["density"]))}  # whose absence would change supports or volumes
MAX_ABOVE = 32  # lines among which the names of columns are looked for
ELEMENT_NOTE = "whole numbers in the first column are taken for elements (XYZ convention); the next three are x, y, z"


def read(path: Path) -> ParticleTable:
    """Read a table of numbers; columns of words are left out, columns of large whole numbers are of 64 bits."""
    with explained(path, SOURCE):
        content = path.read_bytes()
        if b"\0" in content:
            raise DataError("is not text: it holds zero bytes; check its format, or rename it to its proper suffix")
        text = content.decode("utf-8-sig")
        lines = text.splitlines()
        if not text.strip():
            raise DataError("is empty; an empty set of particles needs a line of column names")
        ended = text.endswith(("\n", "\r"))
        lines, passed = _plain_lines(lines)
        names, rows, delimiter, unmatched = _names(lines)
        if not rows and not ended:
            raise DataError("is cut short: its first line has no end; copy it again")
        said = [*passed, *([] if ended else [UNENDED_NOTE])]
        first = rows[0].split() if rows and names is None and _is_counted(lines) else []
        if first and all(map(_is_number, first)) and all(map(_begins_with_element, rows)):
            said.append(ELEMENT_NOTE)
            names = ["element", "x", "y", "z", *(f"column{index}" for index in range(5, len(first) + 1))]
        if unmatched and not names:
            said.append(f"names could not be had: `{unmatched[:80]}` does not name each of the columns")
        fields, left_out = _fields(rows, names, delimiter)
        if left_out:
            said.append(f"left out {', '.join(left_out)}: not numbers")
        position, columns = gather_vectors(fields, others=left_out)
        source = "DualSPHysics table" if any(name.partition(" ")[0] == "Rhop" for name in fields) else SOURCE
        source = "ParaView table" if "Points:0" in fields and source == SOURCE else source  # what it writes may be a liquid
        table = table_from_columns(position, columns, source=source, conventions=said)
        matches = [match for name in fields if (match := WITH_UNIT.fullmatch(name))]
        units = {match[2] for match in matches if is_of_positions(match[1])}
        length = CodeUnit(LENGTHS[unit], LENGTH) if len(units) == 1 and (unit := units.pop()) in LENGTHS else None
        return dataclasses.replace(table, units=FileUnits(length))


def _plain_lines(lines: list[str]) -> tuple[list[str], list[str]]:
    """Lines as most tables have them, and a note: none above the names, which are told by their width; no separators at ends."""
    filled = [line for line in lines if line.strip()]
    said: list[str] = []
    if _is_counted(lines):
        return lines, said
    for above, line in enumerate(filled[:MAX_ABOVE]):
        mark, rows = _delimiter(line), filled[above:]
        names = [] if line.lstrip().startswith("#") or len(rows) < 2 else _split(line, mark)
        begins = above and len(names) >= 3 and len(_split(filled[0], mark)) != len(names) and not any(map(_is_number, names))
        if begins and {len(_split(row, mark)) for row in rows} <= {len(names), len(names) + (names[-1] != "")}:
            said, filled = [f"passed over {above} lines above the names of columns"], rows
            break
    head, *body = filled or [""]
    mark = _delimiter(head) or " "
    if body and all(line.rstrip().endswith(mark.strip() or "\0") for line in body):
        ended = head.rstrip().endswith(mark)
        if ended or head.count(mark) == body[0].count(mark) - 1:
            filled = [head.rstrip()[:-1] if ended else head, *(line.rstrip()[:-1] for line in body)]
    return filled, said


def _names(lines: list[str]) -> tuple[list[str] | None, list[str], str | None, str]:
    """Column names if there are any, the rows of data, the delimiter (`None` for spaces), and a comment above of other words."""
    if _is_counted(lines):
        count, comment = int(lines[0]), "".join(lines[1:2])
        rows = [line for line in lines[2:] if line.strip()]
        if len(rows) != count:
            raise DataError(f"announces {count} particles, but {len(rows)} lines follow; it is cut short or damaged")
        return _extended_names(comment), rows, None, ""
    rows = [line for line in lines if line.strip()]
    comments = 0
    while comments < len(rows) and rows[comments].lstrip().startswith("#"):
        comments += 1
    data = [row for row in rows[comments:] if not row.lstrip().startswith("#")]
    if not data:
        last = rows[comments - 1].lstrip("# ") if comments else ""
        delimiter = _delimiter(last)
        return (_split(last, delimiter) if last else ["x", "y", "z"]), [], delimiter, ""
    delimiter = _delimiter(data[0])
    first = _split(data[0], delimiter)
    if not any(_is_number(word) for word in first):
        if data[1:] and len(first) != len(_split(data[1], delimiter)):
            first = _matched(data[0], data[1], delimiter) or first
        return first, data[1:], delimiter, ""
    above = rows[comments - 1] if comments else ""
    words = above.lstrip("# ")
    return _matched(above, data[0], delimiter), data, delimiter, words if re.search("[A-Za-z]", words) else ""


def _matched(above: str, row: str, delimiter: str | None) -> list[str] | None:
    """Names of as many columns as a row has: parted as that is, by commas, in brackets, by two blanks, or in its fields."""
    words, fields = above.lstrip("# "), [match.span() for match in re.finditer(r"\S+", row)]
    ways = [_split(words, delimiter if delimiter and delimiter in words else None), _split(words, _delimiter(words))]
    ways += [re.findall(r"\[\s*\d*\s*([^\]]*?)\s*\]", words), re.split(r"\s{2,}", words.strip())]
    if delimiter is None:
        for shift in range(-1, 4):  # the mark of the comment may push names aside
            begins = [0, *(end + shift for _, end in fields)]
            begins[-1] = len(above)
            names = [above[begin:end].strip("# ") for begin, end in itertools.pairwise(begins)]
            ways += [names] if " ".join(names).split() == words.split() else []
    number = len(_split(row, delimiter))
    for names in ways:
        if len({*names} - {""}) == number == len(names) and not any(map(_is_number, names)):
            return names
    return None


def _is_counted(lines: list[str]) -> bool:
    """Whether the first line is a number of particles, as in XYZ files."""
    return lines[0].strip().isdecimal()


def _begins_with_element(row: str) -> bool:
    """Whether a row of four or more numbers begins with a whole one, written as such: XYZ has the element there."""
    first, *rest = row.split(maxsplit=4)
    return first.isdecimal() and len(rest) >= 3


def _fields(rows: list[str], names: list[str] | None, delimiter: str | None) -> tuple[dict[str, np.ndarray], list[str]]:
    """Columns of numbers by name, and the names of the columns that hold words; whole numbers keep all their digits."""
    if not rows:
        return {name: np.zeros(0) for name in names or ("x", "y", "z")}, []
    first = _split(rows[0], delimiter)
    numeric = [index for index, word in enumerate(first) if _is_number(word)]
    if names is None:
        labels = ["x", "y", "z"] + [f"column{index}" for index in range(4, len(numeric) + 1)]
        names = [f"column{index + 1}" for index in range(len(first))]
        for index, label in zip(numeric, labels, strict=False):
            names[index] = label
    if len(names) != len(first):
        raise DataError(f"names {len(names)} columns, but its first row has {len(first)}; name each column once")
    if len(set(names)) != len(names):
        raise DataError(f"has columns of the same name among {', '.join(names)}; name each column once")
    widths = {len(_split(row, delimiter)) for row in rows}
    if len(widths) > 1:
        raise DataError(f"has rows of {' and '.join(map(str, sorted(widths)))} columns; all must have the same number")
    clean = [row.replace('"', "") for row in rows] if '"' in rows[0] else rows
    values, numeric = _values(clean, delimiter, numeric, names)
    fields = {names[index]: values[:, column] for column, index in enumerate(numeric)}
    for column, index in enumerate(numeric):
        if (abs(values[:, column]) >= 2.0**53).any():
            fields[names[index]] = _exact([_split(row, delimiter)[index] for row in clean], values[:, column], names[index])
    return fields, [name for index, name in enumerate(names) if index not in numeric]


def _values(rows: list[str], delimiter: str | None, numeric: list[int], names: list[str]) -> tuple[np.ndarray, list[int]]:
    """Numbers of columns, and which they are: those with a word further down are not, unless particles have no place without."""
    read = functools.partial(np.loadtxt, rows, delimiter=delimiter, comments=None)
    try:
        return read(usecols=numeric, ndmin=2), numeric
    except ValueError:
        columns = {}
        for index in numeric:
            try:
                columns[index] = read(usecols=index, ndmin=1)
            except ValueError:
                if is_of_positions(names[index].partition(" ")[0][:-1]) or plain(names[index]) in NEEDED:
                    raise
        return np.stack([*columns.values()], 1), [*columns]


def _exact(words: list[str], values: np.ndarray, name: str) -> np.ndarray:
    """The numbers of a column where some are too large for float64 to hold every whole number: whole ones keep their digits."""
    whole = [int(word) if WHOLE.fullmatch(word) else None for word in words]
    numbers = [number for number in whole if number is not None]
    for kind in (np.int64, np.uint64) if len(numbers) == len(words) else ():
        if np.iinfo(kind).min <= min(numbers) and max(numbers) <= np.iinfo(kind).max:
            return np.array(numbers, kind)
    kept = [value.is_integer() and int(value) == number for number, value in zip(whole, values.tolist(), strict=True)]
    lost = next((words[row] for row, number in enumerate(whole) if number is not None and not kept[row]), None)
    if lost is not None:
        wrong = f"has the whole number {lost[:40]} in the column `{name}`, which float64 cannot hold and 64 bits only"
        raise DataError(f"{wrong} in a column of whole numbers: write ids as such, and quantities with a decimal point")
    return values


def _extended_names(comment: str) -> list[str] | None:
    """Column names from an extended XYZ comment."""
    match = re.search(r"Properties=([\w:]+)", comment)
    if match is None:
        return None
    parts = match[1].split(":")
    if len(parts) % 3 or not all(width.isdecimal() for width in parts[2::3]):
        raise DataError(f"has `{match[0][:80]}`, which is not a sequence of name:type:width; write its comment again")
    widths = [int(width) for width in parts[2::3]]
    if sum(widths) > MAX_COLUMNS:
        raise DataError(f"names {sum(widths)} columns in its comment, at most {MAX_COLUMNS} are read; write it again")
    names = []
    for name, width in zip(parts[0::3], widths, strict=True):
        suffixes = [""] if width == 1 else [f"_{c}" for c in ("xyz" if width == 3 else map(str, range(width)))]
        names += [name + suffix for suffix in suffixes]
    return names


def _delimiter(line: str) -> str | None:
    return next((mark for mark in DELIMITERS if mark in line), None)


def _split(line: str, delimiter: str | None) -> list[str]:
    return [word.strip().strip('"').strip() for word in line.split(delimiter)]


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True
