"""Turn whatever a parser stumbles over into one `ValueError` that names the file, the trouble and the remedy.

Flow: file -> [damage] around every reader -> ParticleTable.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

UNENDED_NOTE = "its last line has no end: check that the file is complete"
"""Said of text whose last number may have lost digits, which nothing else would show."""


class DataError(ValueError):
    """A refusal whose message is already a sentence for the user: what is wrong, and what to do."""


class NoParticlesError(DataError):
    """A file, of several of a snapshot perhaps, has no particles of the type that is asked for."""


@contextlib.contextmanager
def explained(path: str | Path, source: str) -> Iterator[None]:
    """Re-raise every failure inside the block as a `ValueError` that begins with `path`.

    A `DataError` keeps its own words. What a library raises on bytes it did not expect (`struct.error`, `KeyError`,
    `OSError` of HDF5, ...) is quoted after the name of the format. Memory that runs out stays a `MemoryError`, with the
    name of the file. Files that are missing or may not be opened, and libraries that are missing, say so themselves and
    pass through.
    """
    try:
        yield
    except (FileNotFoundError, PermissionError, ImportError):
        raise
    except MemoryError as error:
        raise MemoryError(f"{path}: needs more memory than there is ({error})") from error
    except DataError as error:
        raise type(error)(f"{path}: {error}") from error
    except Exception as error:
        reason = " ".join(str(error).split()) or "no further reason given"
        raise ValueError(
            f"{path}: cannot be read as {source} ({type(error).__name__}: {reason}); the file is probably cut short, "
            f"damaged or of another format: copy it again, or write it again from its source"
        ) from error
