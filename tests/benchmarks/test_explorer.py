"""What the explorer costs: from click to the last panel, and the memory of its server.

Two hundred clicks in a headless Chromium on a store of 256 x 256 pixels and 2048 spp (design: 95th
percentile at most 150 ms), sixty on a scene without a store (at most 1 s), and the memory of a
server whose store has 10 GB (under 1 GB). The clock is the page's: it runs from the event of the
mouse to the second frame after the last panel was drawn. The seconds until the coarse image of a
scene is there count from when its page can be opened, and from the start of ``chdstat explore``;
beside them stands what the same costs bare: Mitsuba imported, the scene loaded, one sample of each
pixel. Run with ``--benchmark-only -s``; a busy machine slows all of it.
"""

from __future__ import annotations

import json
import os
import shutil
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
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
CLICKS, CLICKS_ON_DEMAND = 200, 60
PAGES, CLICKS_EACH = 20, 5


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


def write(path: Path, tile: np.ndarray, size: int, spp: int, *, plain: bool = False) -> Path:
    """Write a store of tiles that differ by factors; of plain ones all but the first are black."""
    attrs = {"scene": "bathroom", "spp": spp, "size": [size, size], "integrator": {"type": "path"}}
    rng = np.random.default_rng(1)
    with Store.create(path, shape=(size, size, 3, spp), attrs=attrs) as store:
        for chunk in chunk_grid(size, size, spp):
            start = chunk.ss.start % tile.shape[-1]
            scale = rng.uniform(0.5, 2, (TILE, TILE, 1, BATCH)).astype(np.float32)
            if plain and (chunk.tile_y, chunk.tile_x) != (0, 0):
                scale[...] = 0
            store.write(chunk, tile[..., start : start + BATCH] * scale)
    return path


@contextmanager
def served(source: str) -> Iterator[tuple[str, psutil.Process]]:
    """Serve in a process of its own, as the command line does."""
    command = [sys.executable, "-c", SERVE, source]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            yield process.stdout.readline().strip(), psutil.Process(process.pid)
        finally:
            process.terminate()


def clicked(
    page, url: str, count: int, process: psutil.Process
) -> tuple[np.ndarray, np.ndarray, float]:
    """Click pixels at random.

    Returns milliseconds to the last panel, those until the server had its answer, and those of
    processor time that the server took per click.
    """
    opened(page, url)
    before = sum(process.cpu_times()[:2])
    for place in np.random.default_rng(1).uniform(0.01, 0.99, (count, 2)):
        click(page, *place)
    spent = sum(process.cpu_times()[:2]) - before
    return *timings(page), 1000 * spent / count


def opened(page, url: str) -> None:
    """Open a page and wait until it has drawn all that it draws by itself."""
    page.goto(url)
    page.wait_for_selector("body[data-shown]", timeout=60000)
    page.wait_for_function("document.querySelector('#working').innerText === ''", timeout=300000)


def click(page, y: float, x: float) -> None:
    """Click a place of the image, and wait for the last panel."""
    box = page.locator(".image").bounding_box()
    clicks = page.evaluate("window.chdstat.timings.length")
    page.mouse.click(box["x"] + x * box["width"], box["y"] + y * box["height"])
    page.wait_for_function(
        "(i) => window.chdstat.timings.length > i && window.chdstat.timings[i].end",
        arg=clicks,
        polling=20,  # not at each frame, which would make the browser paint
    )


def timings(page) -> tuple[np.ndarray, np.ndarray]:
    """Return milliseconds of each click to the last panel, and until the server had its answer."""
    found = page.evaluate("window.chdstat.timings")
    shown = np.array([t["end"] - t["start"] for t in found])
    return shown, 1000 * np.array([t["server"] for t in found])


def report(what: str, shown: np.ndarray, server: np.ndarray, cpu: float, target: float) -> None:
    (median, p95), (m, p) = (np.percentile(times, (50, 95)) for times in (shown, server))
    print(
        f"\n{what}: median {median:.0f} ms, 95th percentile {p95:.0f} ms of {len(shown)} clicks "
        f"(target {target:.0f} ms); of that in the server {m:.0f} and {p:.0f} ms, "
        f"{cpu:.0f} ms of processor time a click; "
        f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores"
    )


SCENES = ["cornell-box", "bathroom"]
if folder := os.environ.get("CHDSTAT_SCENES"):
    SCENES.append(str(Path(folder) / "white-room" / "scene_night.xml"))
BARE = """
import sys
import mitsuba as mi
mi.set_variant("scalar_rgb")
mi.set_log_level(mi.LogLevel.Error)
if sys.argv[1].endswith(".xml"):
    scene = mi.load_file(sys.argv[1])
else:
    import chdstat as chd
    described = chd.load_scene(sys.argv[1])
    scene = described.load()
sensor = mi.traverse(scene.sensors()[0])
width, height = sensor["film.size"]
scale = 128 / max(width, height)
sensor["film.size"] = [max(1, round(scale * width)), max(1, round(scale * height))]
sensor.update()
mi.render(scene, sensor=scene.sensors()[0], spp=1)
"""


@pytest.mark.parametrize("scene", SCENES)
def test_first_image_of_a_scene(benchmark, scene):
    def bare() -> float:
        start = time.perf_counter()
        subprocess.run([sys.executable, "-c", BARE, scene], check=True)
        return time.perf_counter() - start

    def opened() -> tuple[float, float, float]:
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            port = probe.getsockname()[1]
        command = [sys.executable, "-m", "chdstat", "explore", scene, "--no-browser"]
        start, seconds = time.perf_counter(), []
        with subprocess.Popen([*command, f"--port={port}"], stdout=subprocess.DEVNULL) as process:
            try:
                for key in ("text", "drawn", "done"):
                    while not told(port).get(key):
                        assert process.poll() is None
                        time.sleep(0.01)
                    seconds.append(time.perf_counter() - start)
            finally:
                process.terminate()
        return tuple(seconds)

    alone = bare()
    page, image, done = benchmark.pedantic(opened, rounds=1)
    alone = (alone + bare()) / 2
    print(
        f"\nfirst image of {Path(scene).stem}: {image - page:.1f} s after the page can be opened "
        f"(target 2), {image:.1f} s after the start, {alone:.1f} s bare; all of the page after "
        f"{done:.1f} s; load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores"
    )


def told(port: int) -> dict[str, object]:
    """Return what a starting explorer tells of its progress; nothing where none is there yet."""
    try:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/progress", timeout=60) as answer:
            return json.load(answer)
    except OSError:
        return {}


def test_click_on_a_store(benchmark, page, tile, tmp_path):
    path = write(tmp_path / "bathroom.zarr", tile, 256, 2048)
    with served(str(path)) as (url, process):
        found = benchmark.pedantic(lambda: clicked(page, url, CLICKS, process), rounds=1)
        memory = process.memory_info().rss / 2**20
    report("click on a store of 256 x 256 x 2048", *found, 150)
    print(f"memory of the server: {memory:.0f} MiB")


def test_twenty_pages_at_once(benchmark, page, tile, tmp_path):
    path = write(tmp_path / "bathroom.zarr", tile, 256, 2048)
    places = np.random.default_rng(2).uniform(0.01, 0.99, (PAGES, CLICKS_EACH, 2))

    def all_pages() -> tuple[np.ndarray, np.ndarray]:
        context = page.context.browser.new_context()
        pages = [context.new_page() for _ in range(PAGES)]
        for one in pages:
            opened(one, url)
        for i in range(CLICKS_EACH):
            for one, there in zip(pages, places, strict=True):
                one.bring_to_front()
                click(one, *there[i])
        found = [timings(one) for one in pages]
        context.close()
        return tuple(np.concatenate(part) for part in zip(*found, strict=True))

    with served(str(path)) as (url, process):
        before = sum(process.cpu_times()[:2])
        shown, server = benchmark.pedantic(all_pages, rounds=1)
        spent = sum(process.cpu_times()[:2]) - before
        memory = process.memory_info().rss / 2**20
    report(f"click with {PAGES} pages open", shown, server, 1000 * spent / shown.size, 150)
    print(f"memory of the server: {memory:.0f} MiB")


def test_click_on_a_scene(benchmark, page):
    with served("bathroom") as (url, process):
        found = benchmark.pedantic(lambda: clicked(page, url, CLICKS_ON_DEMAND, process), rounds=1)
    report("click on the bathroom, sampled on demand", *found, 1000)


def test_memory_on_ten_gigabytes(benchmark, page, tile, tmp_path):
    path = write(tmp_path / "large.zarr", tile, 640, 2048, plain=True)
    with served(str(path)) as (url, process):
        benchmark.pedantic(lambda: clicked(page, url, 20, process), rounds=1)
        memory = process.memory_info().rss / 2**20
        peak = most_memory(process) or memory
    print(f"\nserver with a store of 10 GB: {memory:.0f} MiB, at most {peak:.0f} (target 1024)")
    assert peak < 1024


def most_memory(process: psutil.Process) -> float | None:
    """Return the MiB that a process had at most, where Linux tells."""
    file = Path(f"/proc/{process.pid}/status")
    lines = file.read_text().splitlines() if file.exists() else []
    high = [line for line in lines if line.startswith("VmHWM")]
    return int(high[0].split()[1]) / 1024 if high else None
