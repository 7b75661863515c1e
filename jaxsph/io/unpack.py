"""Unpack compressed data, but never more of it than is needed: a kilobyte may unpack to a megabyte, or say that it does.

Flow: file -> [unpack] -> reader -> ParticleTable.
"""

from __future__ import annotations

import lzma
import zlib
from collections.abc import Callable, Iterable
from typing import IO, Any

from .damage import DataError

DEFLATE_RATIO = 1032
"""The most that a byte of deflate (zlib, gzip, zip) unpacks to: 258 bytes of a match take two bits."""
LZMA_RATIO = 2**13
"""The same of LZMA: zeros, by far the best case, shrink 7000 times."""
LZMA_MEMORY = 2**27
"""Bytes that a stream may ask for its dictionary: twice those of the strongest preset."""
CHUNK_BYTES = 2**18

Decompressor = Callable[[], Any]


def inflating() -> Any:
    """A decompressor of one zlib stream."""
    return zlib.decompressobj()


def unlzma() -> Any:
    """A decompressor of one LZMA stream."""
    return lzma.LZMADecompressor(memlimit=LZMA_MEMORY)


def unpack_blocks(blocks: Iterable[bytes | memoryview], decompressor: Decompressor, need: int, what: str) -> bytes:
    """All blocks unpacked, each a whole stream.

    Raises:
        ValueError: a block that does not end, or more than the `need` bytes of `what`; unpacking stops there.
    """
    parts, left = [], need
    for block in blocks:
        stream = decompressor()
        part = stream.decompress(block, left + 1)  # one more than may come: at exactly `left` its end would not be seen
        if len(part) > left:
            raise DataError(f"unpacks to more than the {need} bytes that {what} need, so it is damaged; write it again")
        if not stream.eof:
            raise DataError(f"is cut short inside {what}: a compressed block does not end; copy it again")
        parts.append(part)
        left -= len(part)
    return b"".join(parts)


def read_up_to(stream: IO[bytes], size: int, begin: bytes = b"") -> bytearray:
    """`begin` and what follows it, `size` bytes or all there are: memory is taken as bytes come, not as announced."""
    content = bytearray(begin)
    while len(content) < size and (part := stream.read(min(size - len(content), CHUNK_BYTES))):
        content += part
    return content
