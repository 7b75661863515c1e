"""The commands that there are, and words as cyclopts reads them; of a file of options those that hold where nothing is said.

Flow: [table] -> main, help; words, `--config` -> [table] -> words -> cyclopts, pictures.
"""

from __future__ import annotations

import json
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

from cyclopts import Argument

from jaxsph.cli.voice import UsageError
from jaxsph.numerics.names import did_you_mean


class Command(NamedTuple):
    """A command: of which kind it is in the help, what it does, how it is called."""

    kind: str
    text: str
    examples: tuple[str, ...]

    @property
    def sentence(self) -> str:
        """What it does, as a sentence."""
        return f"{self.text[0].upper()}{self.text[1:]}."

    @property
    def shown(self) -> str:
        """Its examples, as help begins with them."""
        return "\n".join(["Examples:", *(f"  {example}" for example in self.examples)])


PICTURES, DATA, PARTS, QUALITY, SYSTEM = "Pictures", "Data", "Parts", "Quality", "System"
COMMANDS = {
    "render": Command(PICTURES, "make a picture; what you do not say is chosen, and said", (
        "jaxsph render snap_042.hdf5",
        "jaxsph render snap_042.hdf5 --color-by Temperature --opacity-by Density --annotate",
        "jaxsph render snap_042.hdf5 --center densest --width 30kpc --background white -o fig1.png",
    )),
    "project": Command(PICTURES, "integrate along rays: column densities, means", (
        "jaxsph project snap_042.hdf5 --view z -o column.png", "jaxsph project snap_042.hdf5 --of Temperature --weight mass",
    )),
    "slice": Command(PICTURES, "show a quantity on a plane", (
        "jaxsph slice snap_042.hdf5 -o slice.png", "jaxsph slice snap_042.hdf5 --plane 0,0,0,1,0,0 --color-by Density",
    )),
    "movie": Command(PICTURES, "make a movie of a file, or of a sequence of files", (
        "jaxsph movie snap_042.hdf5 --orbit 360", "jaxsph movie snap_*.hdf5 -o run.mp4",
    )),
    "view": Command(PICTURES, "look around in the browser, and change colours and opacity", (
        "jaxsph view snap_042.hdf5", "jaxsph view scene:mixer --size 800x600 --port 8765 --no-browser",
    )),
    "info": Command(DATA, "say what a file holds, and what `render` would show of it", ("jaxsph info snap_042.hdf5",)),
    "transfer": Command(DATA, "draw a transfer function over what rays meet", (
        "jaxsph transfer snap_042.hdf5 --save look.json", "jaxsph transfer look.json",
    )),
    "merge": Command(PARTS, "make a picture of the parts of `render --tile`", ("jaxsph merge part_*.exr -o whole.exr",)),
    "sweep": Command(QUALITY, "measure error against tolerance against time", ("jaxsph sweep scene:mixer -o sweep",)),
    "explain": Command(QUALITY, "explain a pixel: its error bound by source, and what its ray meets", (
        "jaxsph explain snap_042.hdf5 --pixel 120 200",
        "jaxsph explain scene:mixer --pixel 256 256 --tolerance 0.01 -o pixel.png",
    )),
    "demo": Command(QUALITY, "render a built-in scene and measure its error", ("jaxsph demo -o demo",)),
    "doctor": Command(SYSTEM, "say versions, devices, the cache", ("jaxsph doctor", 'eval "$(jaxsph doctor --completion bash)"')),
}  # fmt: skip
COMMAND = "jaxsph.command"  # metadata of a picture: the words of its command, as JSON
OF_THIS_RUN = ("--output", "--config", "--quiet", "--verbose", "--json", "--no-cache", "--tile")
"""Options that are of one run, and none of the picture."""
ALONE = {"--surface": "0.5"}  # values of options that may be given without one
Options = Mapping[str, Argument]
"""Options of a command, by each of their names."""


def completed(command: str, words: Sequence[str], options: Options) -> list[str]:
    """What is said on the command line, and what a file says of the options that are not; the last where one is said twice.

    Raises `UsageError`: a file that names what is no option of the command, or that is none; `OSError`: one that is not there.
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
    """An option, and its numbers, as in `--eye 0 0 9`, in one word by its full name; what is none stays a word, to be refused."""
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
    from jaxsph.io.damage import DataError, short_text

    try:
        content = tomllib.loads(short_text(file))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise UsageError(f"--config {file}: is no TOML: {error}") from error
    except RecursionError as error:
        raise UsageError(f"--config {file}: brackets are nested too deeply; write options one a line") from error
    except DataError as error:
        raise UsageError(f"--config {error}") from error
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
