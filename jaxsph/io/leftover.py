"""Nothing may be left over: bytes behind the data that a header announces say that data or header are damaged.

Flow: file -> reader -> [leftover] -> ParticleTable or VolumeTable.
"""

from __future__ import annotations

from typing import IO

from .damage import DataError
from .unpack import CHUNK_BYTES


def refuse_leftover(left: int, what: str, unit: str = "bytes") -> None:
    """Refuse a file that goes on for `left` > 0 `unit` behind `what`, where its header lets nothing follow.

    Raises:
        ValueError: there is something left.
    """
    if left > 0:
        raise DataError(
            f"has {left} more {unit} than {what} and what its header announces: one of them is damaged, so that what is "
            f"read may be shifted; copy it again, or write it again from its source"
        )


def count_rest(stream: IO[bytes]) -> int:
    """How many bytes follow in a stream, none of which is kept: at its end, gzip compares its check sum."""
    left = 0
    while part := stream.read(CHUNK_BYTES):
        left += len(part)
    return left
