"""Small stores and a browser for the tests of the explorer."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from chdstat.explorer import Explorer, explore

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")


@pytest.fixture(scope="session")
def store_path(stored: Callable[..., Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """32 x 32 pixels of the Cornell box at 64 spp, on disk; no test may change it."""
    path = tmp_path_factory.mktemp("stores") / "box.zarr"
    return Path(shutil.copytree(stored(size=(32, 32)), path))


@pytest.fixture
def own_store(store_path: Path, tmp_path: Path) -> Path:
    """Return a copy of the store that a test may destroy."""
    return Path(shutil.copytree(store_path, tmp_path / "own.zarr"))


@pytest.fixture(scope="session")
def served(store_path: Path) -> Iterator[Explorer]:
    """Return an explorer of the store that no test changes."""
    with explore(store_path) as explorer:
        yield explorer


@pytest.fixture
def explored() -> Iterator[Callable[..., Explorer]]:
    """Start explorers that end with the test."""
    started: list[Explorer] = []

    def start(source: Any, **options: Any) -> Explorer:
        started.append(explore(source, **options))
        return started[-1]

    yield start
    for explorer in started:
        explorer.stop()


@pytest.fixture(scope="session")
def browser() -> Iterator[Any]:
    """Headless Chromium; skip where it or playwright is not installed."""
    api = pytest.importorskip("playwright.sync_api", reason="no playwright: no test in a browser")
    if CHROMIUM is None:
        pytest.skip("no chromium: no test in a browser")
    with api.sync_playwright() as playwright:
        # A container has neither the sandbox's privileges nor much shared memory. Pages are drawn
        # without a graphics processor, which would be imitated, at half the browser's time.
        arguments = ["--no-sandbox", "--disable-dev-shm-usage"]
        arguments += ["--disable-gpu", "--disable-software-rasterizer"]
        browser = playwright.chromium.launch(
            executable_path=CHROMIUM, args=arguments, timeout=600_000
        )
        yield browser
        browser.close()
