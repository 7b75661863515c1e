"""The command `completion`: a script by which a shell completes commands, options and names.

Flow: commands -> cyclopts -> [completion] -> stdout.
"""

from __future__ import annotations

from typing import Annotated

from cyclopts import Parameter

from jaxsph.cli import voice
from jaxsph.cli.console import UsageError
from jaxsph.cli.options import groups
from jaxsph.cli.options.table import app
from jaxsph.numerics.nearest import did_you_mean

SHELLS = ("bash", "zsh", "fish")
OPTIONS = groups.Options()


def completion(shell: Annotated[str, Parameter(help=", ".join(SHELLS))], /, *, asked: groups.Options = OPTIONS) -> None:
    """Print what completes commands in a shell."""
    if shell not in SHELLS:
        raise UsageError(f"there is no completion for {shell!r}, but for {', '.join(SHELLS)}{did_you_mean(shell, SHELLS)}")
    script = app().generate_completion(shell=shell)  # type: ignore[arg-type]
    voice.result(script)
    voice.report(shell=shell, script=script)
