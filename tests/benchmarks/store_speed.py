"""Prints how long stores take, in ms of processor time, as JSON; `test_stores` runs it."""

import contextlib
import json
import shutil
import sys
import time
from pathlib import Path

import numpy as np

import chdstat as chd
from chdstat.samples.store import Store

EDGE, SPP, MORE, ROUNDS = 128, 1024, 1280, 3


def measured(place: Path) -> dict[str, float]:
    rng = np.random.default_rng(0)
    x = rng.gamma(0.5, size=(64, 64, 3, 64)) * (rng.random((64, 64, 1, 64)) < 0.5)
    block = x.astype(np.float32)
    attrs = {"scene": "made up", "spp": MORE, "size": [EDGE, EDGE]}

    def fill(store: Store) -> None:
        for chunk in store.pending():
            store.write(chunk, block)
        if hasattr(store, "close"):  # there was no lock
            store.close()

    def write() -> None:
        fill(Store.create(place, shape=(EDGE, EDGE, 3, SPP), attrs=attrs))

    def append() -> None:
        store = Store.open(place, writable=True)
        store.extend(MORE)
        fill(store)

    pixel = iter(range(EDGE))
    work = {
        "write": write,
        "append": append,
        "open": lambda: chd.open(place),
        "read": lambda: chd.open(place).read(),
        "click": lambda: chd.open(place)[next(pixel), 70],
    }
    taken: dict[str, list[float]] = {name: [] for name in work}
    for _ in range(ROUNDS):
        shutil.rmtree(place, ignore_errors=True)
        for name, act in work.items():
            start = time.process_time()
            act()
            taken[name].append(1e3 * (time.process_time() - start))
    return {name: min(times) for name, times in taken.items()}


if __name__ == "__main__":
    with contextlib.suppress(KeyboardInterrupt):
        print(json.dumps(measured(Path(sys.argv[1]))))
