"""Optional libraries: imported at the moment they are needed, and kept from printing to the terminal."""

from __future__ import annotations

import contextlib
import importlib
import io
import os
import threading
from collections.abc import Iterator
from typing import Any

STDOUT, STDERR = 1, 2
_LOCK = threading.Lock()  # there is one of each in a process


def require(module: str, purpose: str, extra: str = "io") -> Any:
    """The module called `module`.

    Raises `ImportError`: when it is not installed; the message names `purpose` and the `extra` that brings the library.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        library = module.partition(".")[0]
        raise ImportError(f'the library `{library}` is needed for {purpose}: pip install "jaxsph[{extra}]"') from error


@contextlib.contextmanager
def hushed() -> Iterator[None]:
    """Nothing that is written to the process's stdout or stderr inside the block is seen; where it has none, nothing changes.

    Libraries of C and C++ print past Python what their errors say too.
    """
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
