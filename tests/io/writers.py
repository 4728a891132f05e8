"""Files as other programs write them, for tests of the readers."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import OpenEXR
import xarray as xr
from google_crc32c import value as checksum

# --- EXR ------------------------------------------------------------------------------------------


def window(left, top, right, bottom):
    return np.array([left, top], np.int32), np.array([right, bottom], np.int32)


def planes_of(image, names="RGB", prefix=""):
    return {f"{prefix}{n}": np.ascontiguousarray(image[..., i]) for i, n in enumerate(names)}


def exr(path, planes, *more, kind=OpenEXR.scanlineimage, compression=None, **header):
    """Write a file of parts: the channels and attributes of the first, then pairs of these."""
    made = []
    for number, (channels, about) in enumerate(((planes, header), *more)):
        layout = {"type": kind, "compression": compression or OpenEXR.ZIP_COMPRESSION}
        if kind == OpenEXR.tiledimage:
            layout["tiles"] = OpenEXR.TileDescription()
        found = {n: np.ascontiguousarray(p) if isinstance(p, np.ndarray) else p
                 for n, p in channels.items()}  # fmt: skip
        made.append(OpenEXR.Part(layout | about, found, about.get("name", f"part{number}")))
    OpenEXR.File(made).write(str(path))
    return path


def deep(shape):
    """Return a channel of one to three values in each pixel."""
    held = np.empty(shape, object)
    for i in range(held.size):
        held.flat[i] = np.ones(i % 3 + 1, np.float32)
    return held


# --- samples (y, x, channel, sample) ------------------------------------------------------------


def netcdf(path, radiance):
    data = xr.Dataset({"light": (("y", "x", "channel", "sample"), radiance)})
    data.to_netcdf(path, engine="scipy", format="NETCDF3_64BIT")
    return path


# --- streams, after the documentation -------------------------------------------------------------


def start(width, height, channels=3, features=b"", version=1, order=0x01020304):
    head = b"\x89CHDS\r\n\x1a" + struct.pack("<2I", version, order)
    head += struct.pack("<4I", width, height, channels, len(features)) + features
    return head + struct.pack("<I", checksum(head))


def block(kind, head=b"", body=b"", x=0, y=0):
    about = struct.pack("<4s5I", b"CHDB", kind, x, y, len(head), len(body))
    return about + struct.pack("<2I", checksum(about + head), checksum(body)) + head + body


def entries(pixels, numbers):
    return np.stack([pixels, numbers], axis=-1).astype("<u2").tobytes()


def samples_block(x, y, samples):
    """Return a block of samples by pixel (row, column) of a tile: arrays (sample, channel)."""
    found = sorted((64 * row + column, of) for (row, column), of in samples.items())
    head = entries([place for place, _ in found], [len(of) for _, of in found])
    return block(1, head, b"".join(np.asarray(of, "<f4").T.tobytes() for _, of in found), x, y)


def end(count):
    return block(4, struct.pack("<Q", count))


def dense(radiance):
    """Return a block for each tile of samples (y, x, sample, channel)."""
    height, width = radiance.shape[:2]
    for y in range(0, height, 64):
        for x in range(0, width, 64):
            tile = radiance[y : y + 64, x : x + 64]
            yield samples_block(x, y, {p: tile[p] for p in np.ndindex(tile.shape[:2])})


def stream(path, radiance):
    """Write samples (y, x, channel, sample), in two passes if there are more than one."""
    moved = np.moveaxis(radiance, 2, 3)
    half = moved.shape[2] // 2
    blocks = b"".join([*(dense(moved[:, :, :half]) if half else ()), *dense(moved[:, :, half:])])
    height, width, spp, channels = moved.shape
    begin = start(width, height, channels) + block(3, b"seed", b"7")
    path.write_bytes(begin + blocks + end(height * width * spp))
    return path


# --- one image of samples in every format -------------------------------------------------------


def npz(path, radiance):
    np.savez_compressed(path, radiance=radiance, other=np.zeros(3))
    return path


def each(write, suffix):
    """Return a writer of one file for each sample."""

    def written(path: Path, radiance: np.ndarray) -> Path:
        path.mkdir()
        for number in range(radiance.shape[3]):
            write(path / f"{number:04}{suffix}", np.ascontiguousarray(radiance[..., number]))
        return path

    return written


WRITERS = {
    "npy": (".npy", lambda path, x: np.save(path, x)),
    "npz": (".npz", npz),
    "xarray": (".nc", netcdf),
    "exr": ("", each(lambda path, image: exr(path, planes_of(image)), ".exr")),
    "stream": (".chds", stream),
}
"""Suffix and writer of each format that is read."""
