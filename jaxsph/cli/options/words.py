"""The words of a command line as cyclopts reads them, and those of a file of options, which hold where nothing else is said.

Flow: words, `--config` -> [words] -> words -> cyclopts; words -> pictures.
"""

from __future__ import annotations

import json
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from cyclopts import Argument

from jaxsph.cli.options.table import COMMANDS
from jaxsph.cli.voice import UsageError
from jaxsph.numerics.names import did_you_mean

COMMAND = "jaxsph.command"
"""Metadata of a picture: the words of its command, as JSON."""
OF_THIS_RUN = ("--output", "--config", "--quiet", "--verbose", "--json", "--no-cache", "--tile")
"""Options that are of one run, and none of the picture."""
ALONE = {"--surface": "0.5"}
"""Values of options that may be given without one."""
Options = Mapping[str, Argument]
"""Options of a command, by each of their names."""


def completed(command: str, words: Sequence[str], options: Options) -> list[str]:
    """What is said on the command line, and what a file says of the options that are not; the last where one is said twice.

    Raises:
        UsageError: a file that names what is no option of the command.
        OSError: a file that cannot be read.
    """
    given = list(_spelled(words, options))
    last = {_name(word): word for word in given}
    if "--config" in last:
        found = _of_file(last["--config"].partition("=")[2], command, options)
        given = [*(word for word in found if _name(word) not in last), *given]
    at = {_name(word): place for place, word in enumerate(given)}
    once = {option.name for option in options.values() if not option.parameter.allow_repeating}
    return [word for place, word in enumerate(given) if _name(word) not in once or at[_name(word)] == place]


def _name(word: str) -> str:
    """The option that a word is of; of a file, nothing that is one."""
    return word.partition("=")[0]


def _spelled(words: Sequence[str], options: Options) -> Iterator[str]:
    """An option in one word, by its full name and with its value; its numbers may be words of their own, as in `--eye 0 0 9`.

    What is not understood stays a word, for cyclopts to refuse.
    """
    left = list(words)
    while left:
        word = left.pop(0)
        name, equals, value = word.partition("=")
        option = options.get(name)
        if word == "--":
            yield from (word, *left)
            return
        if option is None or (option.hint is bool and equals):
            yield word
        elif option.hint is bool:
            yield option.name
        elif equals:
            yield f"{option.name}={value}"
        elif option.name in ALONE and not (left and (left[0] == "none" or _is_number(left[0]))):
            yield f"{option.name}={ALONE[option.name]}"
        elif left and (not left[0].startswith("-") or left[0][1:2] in tuple("0123456789.in")):
            taken = [left.pop(0)]
            most = str(option.parameter.metavar).count(",") + 1
            while left and len(taken) < most and _is_number(taken[0]) and _is_number(left[0]):
                taken.append(left.pop(0))
            yield f"{option.name}={','.join(taken)}"
        else:
            yield word


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _of_file(file: str, command: str, options: Options) -> Iterator[str]:
    """Options of a TOML file: keys are their names, tables are for people, but one with the name of a command is for it alone."""
    try:
        content = tomllib.loads(Path(file).read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise UsageError(f"--config {file}: is no TOML: {error}") from error
    return _of_table(content, f"--config {file}", command, options)


def _of_table(content: Mapping[str, Any], where: str, command: str, options: Options) -> Iterator[str]:
    for key, value in content.items():
        name = f"--{key.replace('_', '-')}"
        option = options.get(name)
        if isinstance(value, dict) and option is None:
            if key == command or key not in COMMANDS:
                yield from _of_table(value, f"{where}, [{key}]", command, options)
        elif option is None or name == "--config":
            known = [one.removeprefix("--") for one in options]
            raise UsageError(f"{where}: {key!r} is no option of `jaxsph {command}`{did_you_mean(key, known)}")
        elif option.hint is bool:
            if not isinstance(value, bool):
                raise UsageError(f"{where}: {key} must be true or false, got {value!r}")
            if value:
                yield option.name
        elif option.parameter.allow_repeating and isinstance(value, list):
            yield from (f"{option.name}={_text(one)}" for one in value)
        else:
            yield f"{option.name}={_text(value)}"


def _text(value: Any) -> str:
    return ",".join(map(_text, value)) if isinstance(value, list) else str(value)


def header(command: str, given: Sequence[str], *, part: bool) -> tuple[str, str]:
    """Metadata of a picture: its command; of a `part`, what all parts of a picture have in common."""
    words = [word for word in given if not (part and _name(word) in OF_THIS_RUN)]
    return COMMAND, json.dumps([command, *words])
