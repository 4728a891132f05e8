"""What several tests share: small rendered samples, and guards around them.

Tests marked `external` need real scenes: a folder named by the environment variable CHDSTAT_SCENES.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

# One thread for each of several test processes, before a library that would start more is loaded.
if "PYTEST_XDIST_WORKER" in os.environ:
    for _library in ("OMP", "OPENBLAS", "MKL"):
        os.environ.setdefault(f"{_library}_NUM_THREADS", "1")

import pytest

import chdstat as chd
from chdstat.rendering.backend import probe

_SCENES = "CHDSTAT_SCENES"


def pytest_xdist_auto_num_workers(config: pytest.Config) -> int | None:
    """Use all cores for all tests, and one process for benchmarks and for files that are named."""
    whole = config.args_source is pytest.Config.ArgsSource.TESTPATHS
    return None if whole and not config.getoption("benchmark_only") else 0


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    if Path(os.environ.get(_SCENES, "")).is_dir() and os.environ.get(_SCENES):
        return
    skip = pytest.mark.skip(reason=f"{_SCENES} names no folder of scenes")
    for item in items:
        if "external" in item.keywords:
            item.add_marker(skip)


@pytest.fixture(scope="session", autouse=True)
def own_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Keep what backends answer in these tests out of the user's cache, and the reverse."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(scope="session")
def scenes_folder() -> Path:
    """Folder of real scenes, for tests marked `external`."""
    return Path(os.environ[_SCENES])


@pytest.fixture(scope="session")
def cornell() -> chd.Samples:
    """Return 16 x 16 pixels of the Cornell box at 64 spp, in memory."""
    return chd.render("cornell-box", spp=64, size=(16, 16), backend="scalar")


@pytest.fixture(scope="session")
def llvm() -> str:
    """Return the name of the LLVM backend; skip where it does not work."""
    verdict = probe("llvm")
    if not verdict.works:
        pytest.skip(f"no LLVM backend here: {verdict.detail}")
    return verdict.backend
