"""What a click in the explorer costs: time until the last panel, and memory.

Two hundred clicks in a headless Chromium on a store of 256 x 256 pixels and 2048 spp (design: 95th
percentile at most 150 ms). The clock is the page's: it runs from the event of the mouse to the
second frame after the last panel was drawn. Run with ``--benchmark-only -s``; a busy machine slows
it.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import psutil
import pytest

import chdstat as chd
from chdstat.samples.store import Store
from chdstat.samples.tiles import BATCH, TILE, chunk_grid

SERVE = (
    "import sys\nfrom chdstat.explorer import explore\nexplorer = explore(sys.argv[1])\n"
    "print(explorer.url, flush=True)\nexplorer.wait()\n"
)
CLICKS = 200


@pytest.fixture(scope="module")
def tile() -> np.ndarray:
    """Return the samples of one tile of the bathroom, shape (y, x, channel, sample)."""
    return chd.render("bathroom", spp=256, size=(TILE, TILE), backend="scalar").read()


@pytest.fixture(scope="module")
def page() -> Iterator[object]:
    api = pytest.importorskip("playwright.sync_api", reason="no playwright: no benchmark of clicks")
    chromium = shutil.which("chromium")
    if chromium is None:
        pytest.skip("no chromium: no benchmark of clicks")
    with api.sync_playwright() as playwright:
        arguments = ["--no-sandbox", "--disable-dev-shm-usage"]
        browser = playwright.chromium.launch(executable_path=chromium, args=arguments)
        yield browser.new_page(viewport={"width": 1280, "height": 900})
        browser.close()


def write(path: Path, tile: np.ndarray, size: int, spp: int) -> Path:
    """Write a store of tiles that differ by factors."""
    attrs = {"scene": "bathroom", "spp": spp, "size": [size, size], "integrator": {"type": "path"}}
    rng = np.random.default_rng(1)
    with Store.create(path, shape=(size, size, 3, spp), attrs=attrs) as store:
        for chunk in chunk_grid(size, size, spp):
            start = chunk.ss.start % tile.shape[-1]
            scale = rng.uniform(0.5, 2, (TILE, TILE, 1, BATCH)).astype(np.float32)
            store.write(chunk, tile[..., start : start + BATCH] * scale)
    return path


def test_click_on_a_store(as_benchmark, page, tile, tmp_path):
    path = write(tmp_path / "bathroom.zarr", tile, 256, 2048)
    command = [sys.executable, "-c", SERVE, str(path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as child:
        page.goto(child.stdout.readline().strip())
        page.wait_for_selector("body[data-shown]", timeout=60000)
        page.wait_for_function(
            "document.querySelector('#working').innerText === ''", timeout=300000
        )
        process = psutil.Process(child.pid)
        before = sum(process.cpu_times()[:2])
        for clicks, (y, x) in enumerate(np.random.default_rng(1).uniform(0.01, 0.99, (CLICKS, 2))):
            box = page.locator(".image").bounding_box()
            page.mouse.click(box["x"] + x * box["width"], box["y"] + y * box["height"])
            page.wait_for_function(
                "(i) => window.chdstat.timings.length > i && window.chdstat.timings[i].end",
                arg=clicks,
                polling=20,  # not at each frame, which would make the browser paint
            )
        spent = sum(process.cpu_times()[:2]) - before
        found, memory = page.evaluate("window.chdstat.timings"), process.memory_info().rss / 2**20
        child.terminate()
    shown, server = [t["end"] - t["start"] for t in found], [1000 * t["server"] for t in found]
    (median, p95), (m, p) = (np.percentile(times, (50, 95)) for times in (shown, server))
    print(
        f"\n256 x 256 x 2048: median {median:.0f} ms, 95th percentile {p95:.0f} ms of {CLICKS} "
        f"clicks (target 150 ms); of that in the server {m:.0f} and {p:.0f} ms, "
        f"{1000 * spent / CLICKS:.0f} ms of processor time a click, {memory:.0f} MiB; "
        f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores"
    )
