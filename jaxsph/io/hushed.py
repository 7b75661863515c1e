"""What libraries of C and C++ print of their own accord, past Python: kept from the terminal, as their errors say it too.

Flow: [hushed] around a library's call.
"""

from __future__ import annotations

import contextlib
import io
import os
import threading
from collections.abc import Iterator

STDOUT, STDERR = 1, 2
_LOCK = threading.Lock()  # there is one of each in a process


@contextlib.contextmanager
def hushed() -> Iterator[None]:
    """Nothing that is written to the process's stdout or stderr inside the block is seen; where it has none, nothing changes."""
    with _LOCK, contextlib.ExitStack() as undone:
        undone.enter_context(contextlib.redirect_stdout(io.StringIO()))  # bindings print by way of Python
        for number in (STDOUT, STDERR):
            with contextlib.suppress(OSError):
                kept = os.dup(number)
                undone.callback(os.close, kept)
                nowhere = os.open(os.devnull, os.O_WRONLY)
                undone.callback(os.close, nowhere)
                os.dup2(nowhere, number)
                undone.callback(os.dup2, kept, number)
        yield
