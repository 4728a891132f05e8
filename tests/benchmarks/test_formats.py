"""What an import costs: each format against reading the bytes of its files, and its memory.

With ``--benchmark-only -s``. Decoding (everything read through the source, in the chunks of a
store) and writing (the same samples, from memory) are timed apart, by processor time: decompression
in EXR and zip files, and compression in a store, cost many times what reading bytes does. So
decoding is also set against what the format's own library takes for it.
"""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import chdstat as chd

SHAPE = (256, 256, 3, 128)
NAMES = ("x.npy", "x.npz", "x.nc", "exr", "half")
STATUS = Path("/proc/self/status")
PEAK = r"""
import re, sys
from pathlib import Path
import chdstat as chd
def peak():
    return int(re.search(r"VmHWM:\s+(\d+)", Path("/proc/self/status").read_text())[1]) / 1024
chd.io.read(sys.argv[1]).save(sys.argv[3] + "-small.zarr", progress=False)
before = peak()
chd.io.read(sys.argv[2]).save(sys.argv[3], progress=False)
print(peak() - before)
"""


# --- files --------------------------------------------------------------------------------------


def _each(
    folder: Path, x: np.ndarray, suffix: str, make: Callable[[Path, np.ndarray], Any]
) -> None:
    folder.mkdir()
    for number in range(x.shape[3]):
        make(folder / f"{number:04}{suffix}", x[..., number])


def _half(path: Path, image: np.ndarray) -> None:
    chd.io.write_exr(path, image, pixel_type="half")


def write(folder: Path, name: str, x: np.ndarray) -> Path:
    """Write samples in a format, and return where."""
    import xarray as xr

    folder.mkdir(exist_ok=True)
    dataset = xr.Dataset({"radiance": (("y", "x", "channel", "sample"), x)})
    makers: dict[str, Callable[[Path], Any]] = {
        "x.npy": lambda p: np.save(p, x),
        "x.npz": lambda p: np.savez_compressed(p, x),
        "x.nc": lambda p: dataset.to_netcdf(p, engine="scipy"),
        "exr": lambda p: _each(p, x, ".exr", chd.io.write_exr),
        "half": lambda p: _each(p, x, ".exr", _half),
    }
    makers[name](folder / name)
    return folder / name


def read_bytes(place: Path) -> None:
    for file in sorted(place.iterdir()) if place.is_dir() else [place]:
        file.read_bytes()


def library(place: Path) -> None:
    """Decode files as the library of their format does, without anything of ours."""
    import OpenEXR
    import xarray as xr

    for file in sorted(place.iterdir()) if place.is_dir() else [place]:
        if file.suffix == ".exr":
            with OpenEXR.File(str(file), separate_channels=True) as held:
                _ = [channel.pixels for channel in held.channels().values()]
        elif file.suffix == ".npz":
            with np.load(file) as archive:
                _ = [archive[name] for name in archive]
        elif file.suffix == ".nc":
            with xr.open_dataset(file) as dataset:
                dataset.load()
        else:
            np.fromfile(file, np.uint8)


# --- time and memory ----------------------------------------------------------------------------


def walk(samples: chd.Samples) -> None:
    """Read all that an import reads, in its order."""
    for start in range(0, samples.spp, 64):
        for y in range(0, samples.shape[0], 64):
            for x in range(0, samples.shape[1], 64):
                samples.read(slice(y, y + 64), slice(x, x + 64), slice(start, start + 64))


def seconds(work: Callable[[], Any]) -> float:
    """Return the processor time of the faster of two runs."""
    times = []
    for _ in range(2):
        start = time.process_time()
        work()
        times.append(time.process_time() - start)
    return min(times)


@pytest.mark.parametrize("name", NAMES)
def test_an_import_against_reading_bytes(as_benchmark, tmp_path, name):
    x = np.random.default_rng(0).gamma(0.3, size=SHAPE).astype(np.float32)
    x[np.random.default_rng(1).random(SHAPE[:2]) < 0.3] = 0
    place = write(tmp_path / "files", name, x)
    stores = iter(tmp_path / f"{number}.zarr" for number in range(9))
    part = chd.Samples.from_array(x).isel(sample=slice(chd.io.read(place).spp))
    raw, own = seconds(lambda: read_bytes(place)), seconds(lambda: library(place))
    decoded = seconds(lambda: walk(chd.io.read(place)))
    stored = seconds(lambda: part.save(next(stores), progress=False))
    both = seconds(lambda: chd.io.read(place).save(next(stores), progress=False))
    print(
        f"\n{name}: bytes {raw:.3f} s, library {own:.3f} s, decoded {decoded:.3f} s "
        f"({decoded / raw:.1f} of bytes, {decoded / own:.1f} of library), written {stored:.3f} s, "
        f"import {both:.3f} s ({both / raw:.0f} of bytes)"
    )
    # Measured .4 to 2.2, against a file that is mapped into memory and one that is spooled.
    assert decoded < 3 * own


@pytest.mark.skipif(not STATUS.exists(), reason="reads the peak from /proc")
@pytest.mark.parametrize("name", ["exr", "x.npy"])
def test_the_memory_of_an_import(as_benchmark, tmp_path, name):
    """Print what an import of one batch needs, and one of four."""
    x = np.random.default_rng(0).gamma(0.3, size=(256, 256, 3, 256)).astype(np.float32)
    small, peaks = write(tmp_path / "small", name, x[:16, :16, :, :4]), []
    for spp in (64, 256):
        place = write(tmp_path / str(spp), name, x[..., :spp])
        code = [sys.executable, "-c", PEAK, small, place, tmp_path / f"{spp}.zarr"]
        done = subprocess.run(list(map(str, code)), capture_output=True, text=True, check=True)
        peaks.append(float(done.stdout))
    print(f"\n{name}: 64 spp (48 MiB) {peaks[0]:.0f} MiB, 256 spp (192 MiB) {peaks[1]:.0f} MiB")
