"""A command of the command line, within this process."""

import re

from jaxsph.cli import main as cli

PROSE = re.compile(r"(?=.{10}\S)[a-z0-9][a-z0-9 ]{8} \S| {10}\S")
"""Lines of stderr that say what was chosen and done: a word, and a sentence from the eleventh place on."""


def run(capsys, *arguments):
    """Exit code, what was said (results on stdout, then prose), and the lines of stderr that say what is wrong."""
    code, out, prose, wrong = apart(capsys, *arguments)
    return code, "\n".join([out, *prose]), wrong


def apart(capsys, *arguments):
    """Exit code, stdout, and the lines of stderr: prose, and what is wrong."""
    code = cli.main([str(argument) for argument in arguments])
    out, err = capsys.readouterr()
    lines = err.splitlines()
    prose = [line for line in lines if PROSE.match(line)]
    return code, out, prose, [line for line in lines if not PROSE.match(line)]
