"""Mutations of scenes, recipes, images and samples: each is read, or refused in words, in time.

``--benchmark-only -s`` reads some hundred of each in processes of their own, which may crash or
hang, and prints the table; `tests/test_hostile.py` reads a few with the other tests. What is read
may be another scene or image: neither text nor EXR has a checksum.
CHDSTAT_MUTATIONS changes their number.
"""

from __future__ import annotations

import importlib.util
import os
import select
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

COUNT = int(os.environ.get("CHDSTAT_MUTATIONS", "400"))
LONGEST, PATIENCE = 10, 180
"""Seconds of processor time that an answer may take; of any time, after which it hangs."""
FATES = ("read", "error", "traceback", "crash", "hang")

# --- the process that may crash -----------------------------------------------------------------


def render(path: str) -> None:
    import chdstat as chd

    assert chd.render(path, spp=1, size=(3, 2), backend="scalar").shape == (2, 3, 3, 1)


def recipe(path: str) -> None:
    import chdstat as chd
    from chdstat.rendering.recipes import load_recipe

    chd.load_scene(load_recipe(path).scene)


def image(path: str) -> None:
    import chdstat as chd

    assert chd.io.read_exr(path).image.ndim == 3


def samples(path: str) -> None:
    import chdstat as chd

    found = chd.io.read(path)
    assert found.read(slice(0, 8), slice(0, 8), slice(0, 8)).ndim == 4


READERS: dict[str, Callable[[str], None]] = {
    "scene": render,
    "recipe": recipe,
    "exr": image,
    **dict.fromkeys(("npy", "npz", "netcdf", "stack"), samples),
}


def serve() -> None:
    """Read the files that lines of the input name, and say of each what came of it."""
    import warnings

    from chdstat.errors import ChdstatError

    warnings.simplefilter("ignore")
    # Libraries in C print to the standard output.
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    print("ready", file=answers, flush=True)
    for line in sys.stdin:
        kind, path = line.rstrip("\n").split(" ", 1)
        start = time.process_time()
        try:
            READERS[kind](path)
            fate = "read"
        except ChdstatError:
            fate = "error"
        except BaseException as error:  # noqa: BLE001 - what is counted
            fate = f"traceback {type(error).__name__}: {str(error)[:200]!r}"
        if time.process_time() - start > LONGEST:
            fate = "hang"
        print(fate, file=answers, flush=True)


class Reader:
    """A process that reads files, started anew after a crash or a hang."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[str] | None = None

    def fate(self, kind: str, path: Path) -> str:
        """Return what comes of a file, and print what should not."""
        process = self._process or self._start()
        assert process.stdin is not None
        process.stdin.write(f"{kind} {path}\n")
        process.stdin.flush()
        answer = self._answer(process)
        if answer in ("crash", "hang"):
            self.stop()
        if answer not in ("read", "error"):
            print(kind, answer, path.read_bytes()[:2000])
        return answer.split(" ")[0]

    def stop(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.communicate()
            self._process = None

    def _start(self) -> subprocess.Popen[str]:
        self._process = process = subprocess.Popen(
            [sys.executable, __file__],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
            bufsize=1,
        )
        assert self._answer(process) == "ready"
        return process

    @staticmethod
    def _answer(process: subprocess.Popen[str]) -> str:
        assert process.stdout is not None
        ready, _, _ = select.select([process.stdout], [], [], PATIENCE)
        return (process.stdout.readline().strip() or "crash") if ready else "hang"


# --- the campaign -------------------------------------------------------------------------------


def _imported(name: str) -> Any:
    """Import what lies among the tests: they are no package."""
    path = Path(__file__).parents[1] / f"{name}.py"
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def _files(count: int, folder: Path) -> Iterator[tuple[str, str, bytes]]:
    """Yield the kind of a file, what was done to it, and its content."""
    hostile = _imported("hostile")
    good = {"scene": hostile.SCENE, "recipe": hostile.RECIPE, **_binary(folder)}
    for kind, content in good.items():
        yield kind, "nothing", content
        for what, data in hostile.mutations(content, count, seed=2):
            yield kind, what, data
    for kind, cases in (("scene", hostile.scenes()), ("recipe", hostile.recipes())):
        yield from ((kind, "known cases", data) for _, data in cases)


NAMES = {
    "scene": "scene.xml",
    "recipe": "recipe.toml",
    "exr": "image.exr",
    "npy": "x.npy",
    "npz": "x.npz",
    "netcdf": "x.nc",
    "stack": "x.exr",
}


def _binary(folder: Path) -> dict[str, bytes]:
    """Return good files of images and samples, by the names of their readers."""
    import xarray as xr

    from chdstat.io import write_exr

    x = np.random.default_rng(0).gamma(0.5, size=(9, 7, 3, 8)).astype(np.float32)
    layers = {"albedo": x[..., 1]}
    makers: dict[str, Callable[[Path], object]] = {
        "exr": lambda path: write_exr(path, x[..., 0]),
        "npy": lambda path: np.save(path, x),
        "npz": lambda path: np.savez_compressed(path, x),
        "netcdf": lambda path: xr.Dataset(
            {"radiance": (("y", "x", "channel", "sample"), x)}
        ).to_netcdf(path, engine="scipy"),
        "stack": lambda path: write_exr(path, x[..., 0], extra=layers),
    }
    for kind, make in makers.items():
        make(folder / f"good-{NAMES[kind]}")
    return {kind: (folder / f"good-{NAMES[kind]}").read_bytes() for kind in makers}


def campaign(count: int, folder: Path) -> Counter[tuple[str, str, str]]:
    """Return how many files of a kind, with a mutation, ended in what."""
    reader, fates = Reader(), Counter[tuple[str, str, str]]()
    try:
        for kind, what, data in _files(count, folder):
            path = folder / NAMES[kind]
            path.write_bytes(data)
            fates[kind, what, reader.fate(kind, path)] += 1
    finally:
        reader.stop()
    return fates


def table(fates: Counter[tuple[str, str, str]]) -> str:
    lines = [f"{'file':10}{'mutation':14}" + "".join(f"{fate:>11}" for fate in FATES)]
    for kind, what in dict.fromkeys(key[:2] for key in fates):
        counts = "".join(f"{fates[kind, what, fate]:11}" for fate in FATES)
        lines.append(f"{kind:10}{what:14}{counts}")
    sums = "".join(f"{sum(n for k, n in fates.items() if k[2] == fate):11}" for fate in FATES)
    return "\n".join([*lines, f"{'all':24}{sums}"])


def test_hostile_files_are_read_or_refused_in_words(as_benchmark, tmp_path):
    fates = campaign(COUNT, tmp_path)
    print(f"\n{table(fates)}")
    assert {fates[kind, "nothing", "read"] for kind in READERS} == {1}
    assert not [key for key in fates if key[2] in ("traceback", "crash", "hang")]


def test_a_crash_and_a_hang_are_counted(tmp_path, monkeypatch):
    """A negative control, of a process that is no reader."""
    path = tmp_path / "x"
    path.write_bytes(b"")
    for does, fate in (("raise SystemExit", "crash"), ("import time; time.sleep(60)", "hang")):
        program = tmp_path / "reader.py"
        program.write_text(f"print('ready', flush=True)\ninput()\n{does}\n")
        monkeypatch.setitem(globals(), "__file__", str(program))
        monkeypatch.setitem(globals(), "PATIENCE", 180 if fate == "crash" else 5)
        reader = Reader()
        assert reader.fate("scene", path) == fate
        reader.stop()


if __name__ == "__main__":
    serve()
