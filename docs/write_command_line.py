"""Writes docs/command_line.md: what `jaxsph COMMAND --help` says, for all commands.

python docs/write_command_line.py
"""

from __future__ import annotations

import io
import pathlib
import re

from rich.console import Console

from jaxsph.cli.main import app
from jaxsph.cli.table import COMMANDS

PAGE = pathlib.Path(__file__).parent / "command_line.md"
EDGELESS = 10_000  # columns: no line is broken
INTRODUCTION = """# The command line
Made by `python docs/write_command_line.py` of what `jaxsph COMMAND --help` says. What is not said is chosen, and what was chosen
is said.

**Exit codes.** 0 done, 1 the work failed, 2 wrong usage, 130 interrupted (SIGINT), 143 asked to end (SIGTERM). Where it is not 0,
one line on stderr says what was given, what is allowed and what to do; `--verbose` shows where it comes from. A file is written
whole or not at all.

**Where results go.** Paths and numbers are on stdout, prose is on stderr; `--json` makes one object of it on stdout, `--quiet`
leaves the prose out.

**Where options come from.** The command line, else the file of `--config`. Options are never abbreviated; one that is misspelt
gets a suggestion. Numbers between commas may be words of their own, as in `--eye 0 0 9`.
"""


def told(command: str) -> list[str]:
    """Lines of a command's help, from its arguments on."""
    text = io.StringIO()
    app(command).help_print([command], console=Console(file=text, width=EDGELESS, highlight=False, color_system=None))
    lines = [line.rstrip() for line in text.getvalue().split("\n")]
    usage = next(number for number, line in enumerate(lines) if line.startswith("Usage:"))
    return lines[usage:]


def plain(text: str) -> str:
    """Text in which nothing is taken for markup, but for what stands in back quotes."""
    return "`".join(re.sub(r"([*<])", r"\\\1", part) if place % 2 == 0 else part for place, part in enumerate(text.split("`")))


def section(command: str, known: set[str]) -> str:
    """What the page says of a command; options that are `known`, as another command has explained them, are only named."""
    about = COMMANDS[command]
    usage, *lines = told(command)
    parts = [f"## {command}\n{about.sentence[:-1]}: `{usage.removeprefix('Usage: ').strip()}`", "```sh"]
    parts += [*about.examples, "```"]
    group, named = "", list[str]()
    for line in lines:
        if found := re.fullmatch(r"(\w[\w ]*):", line):
            group = f"\n**{found[1]}**\n"
        elif option := re.fullmatch(r"  (\S.*?): (.*)", line):
            if line in known:
                named.append(f"`{option[1].split()[0].rstrip(',')}`")
                continue
            known |= {line} if option[1].startswith("-") else set()
            parts += [group] if group else []
            parts.append(f"- `{option[1]}` {plain(option[2])}")
            group = ""
        elif line.startswith("  ") and parts[-1].startswith("- "):
            parts[-1] += f" {plain(line.strip())}"
    if named:
        parts.append(f"\n**As above** {', '.join(named)}")
    return "\n".join(parts) + "\n"


def page() -> str:
    """All of it."""
    known = set[str]()
    return "\n".join([INTRODUCTION, *(section(command, known) for command in COMMANDS)])


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
