"""EXR files: named channels and a header, whatever they stand for."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from chdstat._core.files import replacing
from chdstat.errors import StoreError

__all__ = ["OF_THE_FORMAT", "read_planes", "write_planes"]

Array = npt.NDArray[Any]

_MAGIC = b"\x76\x2f\x31\x01"
"""What every EXR file begins with."""
OF_THE_FORMAT = frozenset(
    (
        "channels",
        "chromaticities",
        "chunkCount",
        "compression",
        "dataWindow",
        "displayWindow",
        "lineOrder",
        "name",
        "pixelAspectRatio",
        "screenWindowCenter",
        "screenWindowWidth",
        "tiles",
        "type",
        "version",
        "view",
    )
)
"""Attributes that say how the file is laid out: nobody else's."""


def write_planes(path: Path, header: dict[str, Any], planes: dict[str, Array]) -> None:
    """Write channels, each of shape (y, x); an existing file is replaced as a whole or not at all.

    Raises
    ------
    StoreError
        If the file cannot be written.
    """
    import OpenEXR

    layout = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    try:
        with replacing(path) as partial, OpenEXR.File({**header, **layout}, planes) as file:
            file.write(str(partial))
    except (OSError, RuntimeError, ValueError) as error:
        message = f"cannot write an EXR file to {path}: {error}"
        raise StoreError(message) from error


def read_planes(path: Path) -> tuple[dict[str, str], dict[str, Array]]:
    """Return the text in the header and all channels, each of shape (y, x), float32 or uint32.

    Raises
    ------
    StoreError
        If there is no such file, it is damaged, or not of one part with plain channels.
    """
    import OpenEXR

    _check_is_exr(path)
    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            parts = len(file.parts)
            # Both are gone once the file is closed.
            header = dict(file.header())
            channels = dict(file.channels())
    except (OSError, RuntimeError, ValueError) as error:
        message = f"{path} is damaged or cut off; write or copy it again ({error})"
        raise StoreError(message) from error
    if parts != 1:
        message = f"{path} has {parts} parts, expected one; split it, as exrmultipart does"
        raise StoreError(message)
    planes = {name: channel.pixels for name, channel in channels.items()}
    _check_plain(path, header, channels)
    text = {
        name: value
        for name, value in header.items()
        if isinstance(value, str) and name not in OF_THE_FORMAT
    }
    return text, {
        name: plane.astype(np.float32, copy=False) if plane.dtype.kind == "f" else plane
        for name, plane in planes.items()
    }


def _check_plain(path: Path, header: dict[str, Any], channels: dict[str, Any]) -> None:
    """Refuse channels that do not hold one number for each pixel."""
    (left, top), (right, bottom) = header["dataWindow"]
    shape = (int(bottom) - int(top) + 1, int(right) - int(left) + 1)
    for name, channel in channels.items():
        full = (channel.xSampling, channel.ySampling) == (1, 1) and channel.pixels.shape == shape
        if not full or channel.pixels.dtype.kind not in "fu":
            message = (
                f"{path}: channel {name!r} is deep or of a resolution of its own; "
                f"expected one number for each of {shape} pixels"
            )
            raise StoreError(message)


def _check_is_exr(path: Path) -> None:
    if not path.is_file():
        message = f"no EXR file at {path}"
        raise StoreError(message)
    try:
        with path.open("rb") as file:
            start = file.read(len(_MAGIC))
    except OSError as error:
        message = f"cannot read {path}: {error.strerror or error}"
        raise StoreError(message) from error
    if start != _MAGIC:
        message = f"{path} is not an EXR file: it does not begin as one"
        raise StoreError(message)
