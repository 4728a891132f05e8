"""Speed of stores, beside that of another version where CHDSTAT_BASE names its checkout."""

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

import chdstat as chd
from chdstat.samples import Samples, layout

CLICK = 50
"""Milliseconds in which a click in the explorer has its pixel."""
SLOWER = 1.1


def measured(package: Path, place: Path) -> dict[str, float]:
    script = Path(__file__).parent / "store_speed.py"
    environment = {**os.environ, "PYTHONPATH": str(package)}
    command = [sys.executable, script, place]
    found = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    return json.loads(found.stdout)


def test_speed_of_stores(as_benchmark, tmp_path):
    base = os.environ.get("CHDSTAT_BASE")
    # By turns, as a busy machine slows down whoever runs.
    places = [Path(__file__).parents[2], *([Path(base)] if base else [])] * 3
    runs = [measured(p, tmp_path / f"{i}.zarr") for i, p in enumerate(places)]
    step = 2 if base else 1
    here, there = (
        {k: min(r[k] for r in part) for k in part[0]}
        for part in (runs[::step], runs[step - 1 :: step])
    )
    print("\n128 x 128 pixels, 1024 and then 1280 spp; ms of processor time")
    for name, took in here.items():
        print(
            f"{name:8}{took:8.1f}"
            + (f"{there[name]:8.1f}{took / there[name]:6.2f}" if base else "")
        )
    assert here["click"] < CLICK
    for pair in (("open", "read"), ("write", "append")):
        assert sum(here[n] for n in pair) < SLOWER * sum(there[n] for n in pair)


CODECS = {
    "zstd 1": {"name": "zstd", "configuration": {"level": 1, "checksum": False}},
    "zstd 3": {"name": "zstd", "configuration": {"level": 3, "checksum": False}},
    "default": None,
    "blosc lz4, shuffled": {
        "name": "blosc",
        "configuration": {
            "cname": "lz4",
            "clevel": 5,
            "shuffle": "shuffle",
            "typesize": 4,
            "blocksize": 0,
        },
    },
}


def test_codecs(as_benchmark, tmp_path, monkeypatch):
    """Size, rates of writing and reading, and the share of a render that writing takes."""
    usual = layout.radiance_metadata
    columns = ("size / raw", "write MB/s", "read MB/s", "of render")
    print("\n" + f"{'':38}" + "".join(f"{column:>12}" for column in columns))
    for scene in ("bathroom", "cornell-box", "night-room"):
        start = time.process_time()
        x = chd.render(scene, spp=256, size=(128, 128), backend="scalar", progress=False).read()
        render = time.process_time() - start
        for name, codec in CODECS.items():

            def metadata(*arguments, codec=codec, **options):
                found = usual(*arguments, **options)
                if codec is not None:
                    found["codecs"][0]["configuration"]["codecs"][1] = codec
                return found

            monkeypatch.setattr(layout, "radiance_metadata", metadata)
            write, read, size = (
                min(times) for times in zip(*(once(tmp_path, x) for _ in range(3)), strict=False)
            )
            rates = [x.nbytes / 1e6 / taken for taken in (write, read)]
            print(
                f"{scene:16}{name:22}{size / x.nbytes:12.3f}{rates[0]:12.0f}{rates[1]:12.0f}"
                f"{write / render:12.1%}"
            )


def once(folder, x):
    """Return seconds of processor time to write and to read a store, and its size."""
    with tempfile.TemporaryDirectory(dir=folder) as place:
        path, start = Path(place) / "x.zarr", time.process_time()
        Samples.from_array(x).save(path, progress=False)
        written = time.process_time()
        assert np.array_equal(chd.open(path).read(), x)
        size = sum(f.stat().st_size for f in (path / "radiance").rglob("*") if f.is_file())
        return written - start, time.process_time() - written, size
