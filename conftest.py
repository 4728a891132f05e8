"""What several tests share: renders are made once for all test processes, models once for each.

`cornell`
    16 x 16 pixels of the Cornell box at 64 spp, `Samples` in memory.
`stored`
    ``stored(scene="cornell-box", spp=64, size=(24, 16), **settings)`` returns the path of a store,
    rendered by the scalar backend on the first call with these settings. Open it with `chd.open`;
    a test that changes a store copies its folder first (`shutil.copytree`).
`model`
    The network of the paper, trained for a few iterations on ``stored()``: for tests of what is
    done with a model, not of how good it is.
`run`
    ``run("info", store)`` runs a command of chdstat in this process and returns its exit code, what
    it printed, and its errors.
`wavefront`, `backend`
    Names of backends that draw wavefronts, and of all. Tests run with each of them: with cuda where
    it works, and with llvm, where a test is skipped if that does not.
`scenes_folder`
    Folder of real scenes, named by the environment variable CHDSTAT_SCENES. Tests that need it are
    marked `external` and are skipped without it.

No test may change what these return.
"""

from __future__ import annotations

import functools
import gc
import os
from collections.abc import Callable, Generator, Iterator
from pathlib import Path
from typing import Any
from zlib import crc32

# One thread for each of several test processes, before a library that would start more is loaded.
if "PYTEST_XDIST_WORKER" in os.environ:
    for _library in ("OMP", "OPENBLAS", "MKL"):
        os.environ.setdefault(f"{_library}_NUM_THREADS", "1")

import pytest
from filelock import FileLock

import chdstat as chd
from chdstat._core.arrays import say_once
from chdstat.rendering.backend import probe

_SCENES = "CHDSTAT_SCENES"


def pytest_xdist_auto_num_workers(config: pytest.Config) -> int | None:
    """Use all cores for all tests, and one process for benchmarks and for files that are named."""
    whole = config.args_source is pytest.Config.ArgsSource.TESTPATHS
    return None if whole and not config.getoption("benchmark_only") else 0


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, Any, Any]:
    """Keep what all tests have in common out of garbage collections: it took a sixth of the time.

    Else, each goes through some million objects of imported libraries and of collected tests. What
    tests import later is left, so that full collections are fewer than usual, too.
    """
    gc.disable()
    try:
        return (yield)
    finally:
        gc.enable()
        gc.collect()
        gc.freeze()
        gc.set_threshold(700, 10, 50)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    if Path(os.environ.get(_SCENES, "")).is_dir() and os.environ.get(_SCENES):
        return
    skip = pytest.mark.skip(reason=f"{_SCENES} names no folder of scenes")
    for item in items:
        if "external" in item.keywords:
            item.add_marker(skip)


@pytest.fixture(autouse=True)
def nothing_said_before() -> None:
    """Let each test hear what is said once in a process."""
    say_once.cache_clear()


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


@pytest.fixture
def run(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Callable[..., tuple[int, str, str]]:
    """Return what runs a command: ``code, out, err = run("info", path)``."""
    from chdstat.cli import main

    monkeypatch.delenv("COLUMNS", raising=False)  # some runners of tests set it

    def call(*arguments: object) -> tuple[int, str, str]:
        monkeypatch.setattr("sys.argv", ["chdstat", *map(str, arguments)])
        with pytest.raises(SystemExit) as ended:
            main()
        out, err = capsys.readouterr()
        return int(ended.value.code or 0), out, err

    return call


@pytest.fixture(scope="session")
def cornell(stored: Callable[..., Path]) -> chd.Samples:
    """Return 16 x 16 pixels of the Cornell box at 64 spp, in memory."""
    return chd.open(stored(size=(16, 16))).load()


@pytest.fixture(scope="session")
def stored(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """Return what renders stores, each once: ``stored(scene, spp=, size=, **settings)``."""
    base = tmp_path_factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "stored"
    folder.mkdir(exist_ok=True)

    @functools.cache
    def render(
        scene: str = "cornell-box",
        *,
        spp: int = 64,
        size: tuple[int, int] = (24, 16),
        **settings: Any,
    ) -> Path:
        settings = {"spp": spp, "size": size, "backend": "scalar", **settings}
        path = folder / f"{crc32(repr((scene, *sorted(settings.items()))).encode()):08x}.zarr"
        with FileLock(f"{path}.lock"):
            if not path.exists():
                chd.render(scene, out=path, progress=False, **settings)
        return path

    return render


@pytest.fixture(scope="session")
def model(stored: Callable[..., Path]) -> Any:
    """Return the network of the paper, trained for a few iterations."""
    return chd.estimators.train_model(chd.open(stored()), iterations=20, progress=False)


_WAVEFRONTS = ("llvm", "cuda") if probe("cuda").works else ("llvm",)


@pytest.fixture(scope="session", params=_WAVEFRONTS)
def wavefront(request: pytest.FixtureRequest) -> str:
    """Return the name of a backend that draws wavefronts; skip where it does not work."""
    return _working(request.param)


@pytest.fixture(scope="session", params=("scalar", *_WAVEFRONTS))
def backend(request: pytest.FixtureRequest) -> str:
    """Return the name of a backend; skip where it does not work."""
    return _working(request.param)


def _working(backend: str) -> str:
    tried = probe(backend)
    if not tried.works:
        pytest.skip(f"no {backend} backend here: {tried.detail}")
    return backend
