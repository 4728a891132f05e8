"""Memory of a stage on simulated samples that no disk holds.

``huge.py STAGE WxHxSPP TILES FOLDER`` ends after so many tiles (0: all), and prints the memory in
use in MB after each of them, and the most.
"""

from __future__ import annotations

import os
import sys
import threading
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import chdstat as chd
from chdstat.samples import Samples
from chdstat.samples.tiles import chunk_grid


@dataclass(frozen=True)
class Simulated:
    """Gamma samples, half of them null, the same whenever they are read."""

    shape: tuple[int, int, int, int]
    path: Path
    frames = False

    def read(self, ys: slice, xs: slice, ss: slice) -> np.ndarray:
        """Return a part of the samples."""
        height, width, _, spp = self.shape
        rows, columns, samples = (range(n)[s] for n, s in ((height, ys), (width, xs), (spp, ss)))
        made = np.empty((len(rows), len(columns), 3, len(samples)), np.float32)
        for chunk in chunk_grid(height, width, spp, ys=ys, xs=xs, ss=ss):
            for y in range(max(rows.start, chunk.ys.start), min(rows.stop, chunk.ys.stop)):
                rng = np.random.default_rng([y, chunk.tile_x, chunk.batch])
                grey = rng.standard_gamma(0.5, size=chunk.shape[1:], dtype=np.float32)
                grey *= rng.random(chunk.shape[1:], dtype=np.float32) < 0.5
                x = slice(max(columns.start, chunk.xs.start), min(columns.stop, chunk.xs.stop))
                s = slice(max(samples.start, chunk.ss.start), min(samples.stop, chunk.ss.stop))
                inside = grey[
                    x.start - chunk.xs.start : x.stop - chunk.xs.start,
                    np.newaxis,
                    s.start - chunk.ss.start : s.stop - chunk.ss.start,
                ]
                out = made[y - rows.start, x.start - columns.start : x.stop - columns.start]
                out[..., s.start - samples.start : s.stop - samples.start] = inside
        return made * np.float32([1, 0.5, 0.2])[:, np.newaxis]

    def read_features(self) -> dict[str, np.ndarray]:
        """Return no features."""
        return {}


def memory(kind: str) -> float:
    """Return a kind of memory of this process in MB."""
    lines = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    return int(lines[kind].split()[0]) / 1024


def main() -> None:
    """Run a stage under a watch."""
    stage, size, most, folder = sys.argv[1], sys.argv[2], int(sys.argv[3]), Path(sys.argv[4])
    width, height, spp = map(int, size.split("x"))
    source = Simulated((height, width, 3, spp), folder / "simulated")
    attrs = {"scene": "simulated", "seed": 0, "spp": spp, "size": [width, height]}
    samples = Samples(source, attrs=attrs)
    kept = folder / "checkpoint"
    seen: list[tuple[int, float]] = []

    def finish() -> None:
        done, held = zip(*seen, strict=True)
        start = next((i for i, n in enumerate(done) if n >= 10), 0)
        print(
            f"{stage} of {size}: {done[-1]} tiles, {held[start]:.0f} MB after {done[start]}, "
            f"{held[-1]:.0f} MB at the end, at most {memory('VmHWM'):.0f} MB",
            flush=True,
        )
        os._exit(0)

    def watch() -> None:
        while True:
            done = sum(1 for _ in kept.rglob("*.npz"))
            if done and (not seen or done > seen[-1][0]):
                seen.append((done, memory("VmRSS")))
                print(done, round(seen[-1][1]), file=sys.stderr, flush=True)
            if most and done >= most:
                finish()
            time.sleep(0.5)

    threading.Thread(target=watch, daemon=True).start()
    getattr(chd, stage)(samples, checkpoint=kept, progress=False)
    finish()


if __name__ == "__main__":
    main()
