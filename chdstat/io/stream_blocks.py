"""Blocks of a stream: the bytes that ``chdstat_writer.h`` writes, and whether they are sound.

What each of them means is on the page "Format of a stream" of the reference.
"""

from __future__ import annotations

import enum
import struct
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np
import numpy.typing as npt

from chdstat._core.files import checksum
from chdstat.errors import StoreError

__all__ = [
    "COMPONENTS",
    "EDGE",
    "PIXELS",
    "Block",
    "Header",
    "Indices",
    "Kind",
    "damaged",
    "opened",
    "read_block",
    "read_body",
    "read_header",
    "text",
]

VERSION = 1
EDGE = 64
"""Edge of the tiles of a stream, in pixels."""
PIXELS = EDGE * EDGE
COMPONENTS = {"albedo": 3, "normal": 3, "position": 3, "depth": 1}
"""Features that a stream may have, and how many numbers each has."""
_MAGIC, _LITTLE = b"\x89CHDS\r\n\x1a", b"\x04\x03\x02\x01"
_HEADER = struct.Struct("<8sI4s4I")
_BLOCK = struct.Struct("<4s7I")
_HEAD = 4 * PIXELS
"""Bytes of a head at most."""
_MOST_PIXELS = 2**28
_LONGEST = 64
"""Bytes of the names of features, and of the checksum behind them, at most."""

Indices = npt.NDArray[np.intp]


class Kind(enum.IntEnum):
    """What a block holds."""

    SAMPLES = 1
    FEATURES = 2
    ATTRIBUTE = 3
    END = 4


class Header(NamedTuple):
    """What all blocks of a stream have in common."""

    width: int
    height: int
    channels: int
    features: tuple[str, ...]


class Block(NamedTuple):
    """A block without its body, and where that lies in the file."""

    kind: int
    x: int
    y: int
    head: bytes
    body: int
    size: int
    checksum: int

    def pixels(self) -> tuple[Indices, Indices]:
        """Return pixels within the tile, and how many samples each has."""
        pairs = np.frombuffer(self.head, "<u2").reshape(-1, 2).astype(np.intp)
        return pairs[:, 0], pairs[:, 1]


def opened(path: Path) -> BinaryIO:
    """Open a file, or say why it cannot be."""
    try:
        return path.open("rb", buffering=0)
    except OSError as error:
        message = f"cannot read {path}: {error.strerror or error}"
        raise StoreError(message) from error


def read_header(file: BinaryIO, path: Path) -> tuple[Header, int]:
    """Return the header of a file, and where its blocks begin."""
    start = file.read(_HEADER.size + _LONGEST)
    if len(start) < _HEADER.size + 4 or not start.startswith(_MAGIC):
        message = f"{path} is no stream of samples, as chdstat_writer.h writes it"
        raise StoreError(message)
    _, version, order, width, height, channels, length = _HEADER.unpack_from(start)
    if order != _LITTLE:
        message = f"{path} was written with another order of bytes than little-endian"
        raise StoreError(message)
    if version != VERSION:
        message = f"{path} has version {version}, this chdstat reads {VERSION}"
        raise StoreError(message)
    end = _HEADER.size + length
    held = start[end : end + 4]
    if len(held) < 4 or int.from_bytes(held, "little") != checksum(start[:end]):
        raise damaged(path, 0, "its header is not what was written")
    features = tuple(text(start[_HEADER.size : end]).split())
    sizes = (1 <= size <= 2**16 for size in (width, height, channels * 2**10))
    if (
        not all(sizes)
        or width * height > _MOST_PIXELS
        or set(features) - set(COMPONENTS)
        or len(set(features)) < len(features)
    ):
        raise damaged(path, 0, "its header describes no image")
    return Header(width, height, channels, features), end + 4


def read_block(file: BinaryIO, begin: int, size: int, path: Path) -> Block | None:
    """Return the block at a place, without its body; None where the file ends before it does."""
    file.seek(begin)
    start = file.read(_BLOCK.size + _HEAD)
    if len(start) < _BLOCK.size:
        return None
    mark, kind, x, y, head, body, of_head, of_body = _BLOCK.unpack_from(start)
    end = _BLOCK.size + head
    if mark != b"CHDB" or head > _HEAD:
        raise damaged(path, begin, "there is no block")
    if len(start) < end:
        return None
    if checksum(start[: _BLOCK.size - 8] + start[_BLOCK.size : end]) != of_head:
        raise damaged(path, begin, "a block is not what was written")
    found = Block(kind, x, y, start[_BLOCK.size : end], begin + end, body, of_body)
    return found if found.body + body <= size else None


def read_body(file: BinaryIO, block: Block, path: Path) -> bytes:
    """Return the body of a block."""
    file.seek(block.body)
    found = file.read(block.size)
    if len(found) != block.size or checksum(found) != block.checksum:
        raise damaged(path, block.body, "samples are not what was written")
    return found


def text(found: bytes) -> str:
    """Return what should be UTF-8, with a mark for each byte that is not."""
    return found.decode("utf-8", errors="replace")


def damaged(path: Path, begin: int, what: str) -> StoreError:
    """Return the error for a file that is not as it was written."""
    return StoreError(f"{path} is damaged at byte {begin}: {what}")
