"""Import an optional library at the moment it is needed, or say how to install it."""

from __future__ import annotations

import importlib
from typing import Any


def require(module: str, purpose: str, extra: str = "io") -> Any:
    """The module called `module`.

    Raises:
        ImportError: when it is not installed; the message names `purpose` and the `extra` that brings the library.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        library = module.partition(".")[0]
        raise ImportError(f'the library `{library}` is needed for {purpose}: pip install "jaxsph[{extra}]"') from error
