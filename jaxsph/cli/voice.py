"""What the command line says, and where: results on stdout, prose on stderr, or all of it in one JSON object.

Flow: commands -> [voice] -> stdout, stderr.

Nothing here needs an import that takes time: `jaxsph --help` goes through it.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import math
import os
import re
import sys
from collections.abc import Collection, Iterable, Iterator
from typing import Any

OPTIONS = {
    "values": "--range",
    "low": "the low end of --range",
    "fov_degrees": "--fov",
    "box": "--box-size",
    "clips": "--clip",
    "frame_all": "--width all",
    "look": "--part-type TYPE:LOOK",
    "looks": "--part-type TYPE:LOOK",
}
"""Options whose names in the library differ."""
NAMED = re.compile(r"`(\w+)`")


class UsageError(Exception):
    """The command line asks for something that makes no sense."""


def name_of(option: str) -> str:
    """How an option is said that is kept under this name."""
    return OPTIONS.get(option, f"--{option.replace('_', '-')}")


def by_option(message: str, known: Collection[str]) -> str:
    """A message of the library, with the names of options, of those that are `known`, in place of those of arguments."""
    if message.startswith("`name`"):
        message = "scene:NAME" + message.removeprefix("`name`")

    def named(found: re.Match[str]) -> str:
        return name_of(found[1]) if found[1] in OPTIONS or name_of(found[1]) in known else found[0]

    return NAMED.sub(named, message)


@dataclasses.dataclass
class Voice:
    """How a command speaks.

    Attributes:
        quiet: say nothing but results and what is wrong.
        as_json: say results as one JSON object, when the command is done.
        aloud: what is said is the result, as that of `jaxsph info` is.
        held: lines that wait for the command to be done, as one that fails says one line; None where a person watches.
        said: pairs of a word and a sentence.
        results: of the JSON object.
    """

    quiet: bool = False
    as_json: bool = False
    aloud: bool = False
    held: list[str] | None = None
    said: list[tuple[str, str]] = dataclasses.field(default_factory=list)
    results: dict[str, Any] = dataclasses.field(default_factory=dict)


_VOICE = [Voice()]


def begin(*, quiet: bool = False, verbose: bool = False, as_json: bool = False, aloud: bool = False) -> None:
    """Begin a command."""
    watched = verbose or sys.stderr.isatty()
    _VOICE[0] = Voice(quiet, as_json, aloud, None if watched else [])


@contextlib.contextmanager
def hushed() -> Iterator[None]:
    """Nothing is said in the block, nor reported."""
    own, _VOICE[0] = _VOICE[0], Voice(quiet=True)
    yield
    _VOICE[0] = own


def say(what: str, text: str) -> None:
    """Say a line with its subject in front."""
    voice = _VOICE[0]
    voice.said.append((what, text))
    line = f"{what:<10}{text}"
    if voice.aloud:
        result(line)
    elif not voice.quiet:
        _prose(line)


def say_all(pairs: Iterable[tuple[str, str]]) -> None:
    """Say pairs of a subject and a sentence."""
    for what, text in pairs:
        say(what, text)


def _prose(line: str) -> None:
    held = _VOICE[0].held
    if held is None:
        print(line, file=sys.stderr, flush=True)
    else:
        held.append(line)


def notice(text: str) -> None:
    """A line on stderr, at once where a person waits."""
    if not _VOICE[0].quiet:
        _prose(text)


def release() -> None:
    """Say what was held back: the work has begun that may take long, or it is done."""
    voice = _VOICE[0]
    held, voice.held = voice.held or [], None
    for line in held:
        print(line, file=sys.stderr, flush=True)


def result(text: str) -> None:
    """A line on stdout for a person or a program; in JSON, `report` says it."""
    if not _VOICE[0].as_json:
        print(text)


def report(**values: Any) -> None:
    """Values of the JSON object."""
    _VOICE[0].results.update(values)


def written(path: Any, **values: Any) -> None:
    """A file that the command made: its path on stdout."""
    files = _VOICE[0].results.setdefault("files", [])
    files.append(str(path))
    report(file=files[0], **values)
    result(str(path))


def end(command: str) -> None:
    """The command is done."""
    release()
    voice = _VOICE[0]
    if voice.as_json:
        chosen = [{"what": what, "text": text} for what, text in voice.said]
        print(json.dumps(_finite({"command": command, **voice.results, "said": chosen}), default=plain, allow_nan=False))


def plain(value: Any) -> Any:
    """What JSON has for arrays, paths, and numbers of NumPy."""
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    return _finite(value.tolist()) if hasattr(value, "tolist") else str(value)


def _finite(value: Any) -> Any:
    """The same with null for numbers that JSON does not have."""
    if isinstance(value, dict):
        return {str(key): _finite(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def tell(command: str, text: str) -> None:
    """Print a line on stderr that a command's user should see."""
    print(f"jaxsph {command}: {' '.join(text.split())}", file=sys.stderr)
