"""A command of the command line, within this process."""

from jaxsph.cli import main as cli


def run(capsys, *arguments):
    """Exit code, stdout and the lines of stderr."""
    code = cli.main([str(argument) for argument in arguments])
    out, err = capsys.readouterr()
    return code, out, err.splitlines()
