"""Commands that begin with settings of their process which a test may not make for its own: limits, how signals are heard."""

from __future__ import annotations

import sys

HEARS_INTERRUPTS = "import signal; signal.signal(signal.SIGINT, signal.SIG_DFL)"  # in the background a shell has SIGINT ignored


def exec_after(statements: str, *arguments: object) -> list[str]:
    """`python -m jaxsph` with arguments, in a process that runs statements of Python first.

    For `preexec_fn` of `subprocess`, which runs Python between fork and exec: with JAX's threads that may lock up for ever.
    """
    program = f"import os, sys\n{statements}\nos.execv(sys.executable, [sys.executable, '-m', 'jaxsph', *sys.argv[1:]])"
    return [sys.executable, "-c", program, *map(str, arguments)]
