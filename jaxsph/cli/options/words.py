"""The words of a command line, with those of files and of the environment: what is said there holds where nothing else is said.

Flow: words, `--like`, `--config`, JAXSPH_* -> [words] -> words -> cyclopts; words -> pictures, `--save-config`.

An option on the command line wins over one of a picture (`--like`), that over the environment, that over a file (`--config`).
"""

from __future__ import annotations

import dataclasses
import json
import os
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from jaxsph.cli.options.table import COMMANDS
from jaxsph.cli.voice import UsageError
from jaxsph.numerics.nearest import did_you_mean

PREFIX = "JAXSPH_"
COMMAND = "jaxsph.command"
"""Metadata of a picture: the words of its command, as JSON."""
OF_THIS_RUN = ("--output", "--config", "--save-config", "--like", "--quiet", "--verbose", "--json", "--no-cache", "--tile")
"""Options that are of one run, and none of the picture."""
OF_THE_FILE = ("--annotate", "--background", "--unit", "--length-unit", "--devices", "--memory")
"""Options that change no pixel of a picture but how it is written, or by what means it is made."""
ADOPTED = {"explain": "render"}
"""Commands that take the options of pictures of another one."""
Entry = tuple[str | None, str | None]
"""An option and its value; None is the option of a file, or the value of a flag."""


@dataclasses.dataclass(frozen=True)
class Declared:
    """Options of a command.

    Attributes:
        flags: names of options without a value.
        valued: names of those with one.
        several: names of those that may be repeated.
        full: full names by short ones.
    """

    flags: frozenset[str]
    valued: frozenset[str]
    several: frozenset[str]
    full: Mapping[str, str]

    @property
    def names(self) -> frozenset[str]:
        """All full names."""
        return self.flags | self.valued


def entries(words: Sequence[str], declared: Declared) -> list[Entry]:
    """Options with their values, and files, in their order; what is not understood stays a word, for cyclopts to refuse."""
    made: list[Entry] = []
    left = list(words)
    while left:
        word = left.pop(0)
        name, equals, value = word.partition("=")
        name = declared.full.get(name, name)
        if word == "--":
            made += [(None, one) for one in left]
            break
        if name in declared.valued and (equals or (left and _is_value(left[0]))):
            made.append((name, value if equals else left.pop(0)))
        elif name in declared.flags and not equals:
            made.append((name, None))
        else:
            made.append((None, word))
    return made


def _is_value(word: str) -> bool:
    """Whether a word is no option: a number or a place may begin with a sign."""
    return not word.startswith("-") or (len(word) > 1 and (word[1].isdecimal() or word[1] in ".in"))


def joined(given: Sequence[Entry]) -> list[str]:
    """The words of options and files."""
    return [value or "" if name is None else name if value is None else f"{name}={value}" for name, value in given]


def completed(command: str, words: Sequence[str], declared: Declared) -> list[Entry]:
    """What is said on the command line, and what files and the environment say of the options that are not.

    Raises:
        UsageError: a file that names what is no option of the command, or a picture that holds no command.
        OSError: a file that cannot be read.
    """
    given = _last(entries(words, declared), declared)
    said = {name for name, _ in given}
    more: list[Entry] = []
    for name, read in (("--like", _like), ("JAXSPH_*", None), ("--config", _config)):
        if read is None:
            found = _environment(declared)
        else:
            file = next((value for one, value in given if one == name), None)
            found = [] if file is None else read(file, command, declared)
        more += [entry for entry in found if entry[0] not in said]
        said |= {entry[0] for entry in found}
    return [*given, *more]


def _last(given: list[Entry], declared: Declared) -> list[Entry]:
    """Of an option that is said more than once, the last, unless it may be repeated."""
    once = {name: at for at, (name, _) in enumerate(given) if name is not None and name not in declared.several}
    return [entry for at, entry in enumerate(given) if once.get(entry[0] or "", at) == at]


def _environment(declared: Declared) -> list[Entry]:
    """Options by variables such as JAXSPH_COLORMAP."""
    found: list[Entry] = []
    for name in sorted(declared.names - {"--help"}):
        value = os.environ.get(PREFIX + name.removeprefix("--").replace("-", "_").upper())
        if value is None:
            continue
        if name in declared.valued:
            found.append((name, value))
        elif value.lower() in ("1", "true", "yes"):
            found.append((name, None))
    return found


def _config(file: str, command: str, declared: Declared) -> list[Entry]:
    """Options of a TOML file: keys are their names, tables are for people, but one with the name of a command is for it alone."""
    try:
        text = Path(file).read_text(encoding="utf-8")
        content = tomllib.loads(text)
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise UsageError(f"--config {file}: is no TOML: {error}") from error
    return _entries_of(content, f"--config {file}", command, declared)


def _entries_of(content: Mapping[str, Any], where: str, command: str, declared: Declared) -> list[Entry]:
    found: list[Entry] = []
    for key, value in content.items():
        name = f"--{key.replace('_', '-')}"
        if isinstance(value, dict) and name not in declared.names:
            if key == command or key not in COMMANDS:
                found += _entries_of(value, f"{where}, [{key}]", command, declared)
        elif name not in declared.names or name in ("--config", "--save-config"):
            known = [one.removeprefix("--") for one in declared.names]
            raise UsageError(f"{where}: {key!r} is no option of `jaxsph {command}`{did_you_mean(key, known)}")
        elif name in declared.flags:
            if not isinstance(value, bool):
                raise UsageError(f"{where}: {key} must be true or false, got {value!r}")
            found += [(name, None)] if value else []
        elif name in declared.several and isinstance(value, list):
            found += [(name, _text(one)) for one in value]
        else:
            found.append((name, _text(value)))
    return found


def _text(value: Any) -> str:
    return ",".join(map(_text, value)) if isinstance(value, list) else str(value)


def _like(file: str, command: str, declared: Declared) -> list[Entry]:
    """Options by which a picture was made."""
    from jaxsph.io import read_image

    try:
        text = dict(read_image(file).metadata).get(COMMAND)
    except ValueError as error:
        raise UsageError(f"--like {file}: {error}") from error
    if text is None:
        raise UsageError(f"--like {file}: it does not say by which command it was made; only pictures of `jaxsph render` do")
    own, *words = json.loads(str(text))
    if own not in (command, ADOPTED.get(command)):
        raise UsageError(f"--like {file}: it was made by `jaxsph {own}`, not by `jaxsph {ADOPTED.get(command, command)}`")
    found = entries(words, declared)
    unknown = [str(word).partition("=")[0] for name, word in found if name is None and str(word).startswith("--")]
    for name in unknown:
        if name not in OF_THIS_RUN + OF_THE_FILE:
            raise UsageError(f"--like {file}: it was made with {name}, which `jaxsph {command}` does not know")
    return [(name, value) for name, value in found if name is not None and name not in OF_THIS_RUN]


def saved(given: Sequence[Entry]) -> str:
    """Options as TOML, for `--config`."""
    values: dict[str, list[str | None]] = {}
    for name, value in given:
        if name is not None and name not in OF_THIS_RUN:
            values.setdefault(name.removeprefix("--"), []).append(value)
    lines = []
    for key, all_of in values.items():
        written = ["true" if value is None else json.dumps(value, ensure_ascii=False) for value in all_of]
        lines.append(f"{key} = {written[0] if len(written) == 1 else '[' + ', '.join(written) + ']'}\n")
    return "".join(lines)


def header(command: str, given: Sequence[str], *, part: bool) -> tuple[str, str]:
    """Metadata of a picture: its command; of a `part`, what all parts of a picture have in common."""
    words = [word for word in given if not (part and word.partition("=")[0] in OF_THIS_RUN)]
    return COMMAND, json.dumps([command, *words])
