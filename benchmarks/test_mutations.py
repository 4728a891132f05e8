"""Mutations of all files of a store and of a model: the right answer or an error, nothing else.

``--benchmark-only -s`` makes 2000 of them and prints the table. A mutation flips bits, cuts off,
empties, deletes, swaps or overwrites a file, puts a folder or the file of another store in its
place, or edits its JSON. Each is followed by `info`, `open` and a read of all that is there, some
by `analyze`, `estimate` and a render that repairs. CHDSTAT_MUTATIONS changes their number.
"""

from __future__ import annotations

import json
import os
import shutil
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import chdstat as chd
from chdstat.errors import ChdstatError
from chdstat.estimators.training import load_model, train_model
from chdstat.samples import inspect

SIZE, SPP, LONGEST = (66, 3), 66, 10
SCENE = {"scene": "cornell-box", "size": SIZE, "backend": "scalar", "progress": False}
COUNT = int(os.environ.get("CHDSTAT_MUTATIONS", "2000"))
HOSTILE = (
    10**9,
    2**63,
    -1,
    0,
    1e308,
    None,
    True,
    "x",
    "",
    [],
    {},
    [[[]]],
    [1] * 5,
    "float64",
    "big",
)

Random = np.random.Generator


# --- what is done to a file ---------------------------------------------------------------------


def flip(file: Path, rng: Random, _: list[Path]) -> None:
    data = bytearray(file.read_bytes())
    for place in rng.integers(len(data), size=rng.integers(1, 4)):
        data[place] ^= 1 << rng.integers(8)
    file.write_bytes(data)


def overwrite(file: Path, rng: Random, _: list[Path]) -> None:
    data = bytearray(file.read_bytes())
    start = rng.integers(len(data))
    stop = start + min(512, len(data) - start)
    data[start:stop] = rng.bytes(stop - start) if rng.random() < 0.5 else bytes(stop - start)
    file.write_bytes(data)


def truncate(file: Path, rng: Random, _: list[Path]) -> None:
    data = file.read_bytes()
    file.write_bytes(data[: rng.integers(len(data))] if rng.random() < 0.8 else b"")


def lengthen(file: Path, rng: Random, _: list[Path]) -> None:
    file.write_bytes(file.read_bytes() + rng.bytes(rng.integers(1, 300)))


def delete(file: Path, rng: Random, _: list[Path]) -> None:
    file.unlink()


def fold(file: Path, rng: Random, _: list[Path]) -> None:
    file.unlink()
    file.mkdir()
    if rng.random() < 0.3:
        (file / "c").mkdir()


def swap(file: Path, rng: Random, others: list[Path]) -> None:
    other = others[rng.integers(len(others))]
    mine, theirs = file.read_bytes(), other.read_bytes()
    file.write_bytes(theirs)
    if rng.random() < 0.7:  # else one is there twice
        other.write_bytes(mine)


def edit(file: Path, rng: Random, _: list[Path]) -> None:
    """Change or delete one entry of a JSON file, anywhere in it."""
    tree = json.loads(file.read_bytes())
    places = list(leaves(tree))
    held, key = places[rng.integers(len(places))]
    if rng.random() < 0.2:
        del held[key]
    else:
        held[key] = HOSTILE[rng.integers(len(HOSTILE))]
    file.write_text(json.dumps(tree))


def leaves(tree: Any) -> Iterator[tuple[Any, Any]]:
    for key in list(tree) if isinstance(tree, dict) else range(len(tree)):
        yield tree, key
        if isinstance(tree[key], dict | list):
            yield from leaves(tree[key])


def nest(file: Path, rng: Random, _: list[Path]) -> None:
    file.write_text("[" * 100_000)


PLAIN = (flip, flip, overwrite, truncate, lengthen, delete, fold, swap, swap)
STORE = ("info", "info --verify", "open, read", "analyze", "estimate")
MODEL = ("load", "estimate")
EDITS = (edit, edit, edit, edit, edit, nest)


# --- what is asked afterwards -------------------------------------------------------------------


def render(path: Path, **options: Any) -> chd.Samples:
    return chd.render(**SCENE | {"out": path, "direct": True, "spp": SPP} | options)


def told(path: Path, **options: Any) -> Any:
    """Return what `info` says; the files that it names are no other answer, but an error."""
    found = inspect(path, **options)
    if found.pop("damaged", []):
        message = "named"
        raise ChdstatError(message)
    return found | {"bytes": 0}


def read(path: Path) -> Any:
    samples = chd.open(path)
    parts = {"radiance": samples.read(), "direct": samples.direct.read()}
    pixel = {"pixel": samples[1, 65], "attrs": {**samples.attrs, "render_seconds": 0}}
    return parts | pixel | samples.features


def analysed(path: Path) -> Any:
    found = chd.analyze(chd.open(path), progress=False)
    return {name: found[name].values for name in found}


def same(one: Any, other: Any) -> bool:
    try:
        np.testing.assert_equal(one, other)
    except AssertionError:
        return False
    return True


@dataclass
class Campaign:
    """A store and a model, and the right answers."""

    folder: Path

    def __post_init__(self) -> None:
        self.store, self.model = self.folder / "box.zarr", self.folder / "box.safetensors"
        samples = render(self.store)
        chd.render(**SCENE | {"out": self.folder / "other.zarr", "spp": SPP, "seed": 1})
        train_model(samples, iterations=4, progress=False).save(self.model)
        self.asked: dict[str, Callable[[], Any]] = {
            "info": lambda: told(self.store),
            "info --verify": lambda: told(self.store, verify=True),
            "open, read": lambda: read(self.store),
            "analyze": lambda: analysed(self.store),
            "load": lambda: load_model(self.model).provenance,
            "estimate": lambda: (
                chd.estimate(chd.open(self.store), self.model, progress=False).radiance
            ),
        }
        self.right = {what: ask() for what, ask in self.asked.items()}
        self.files, self.foreign = (
            sorted(p for p in path.rglob("*") if p.is_file())
            for path in (self.store, self.folder / "other.zarr")
        )
        # Some files are few, and some are large: each kind has its share.
        self.kinds: dict[str, list[Path]] = {}
        for file in [*self.files, self.model]:
            self.kinds.setdefault(self.kind(file), []).append(file)

    def kind(self, file: Path) -> str:
        name = file.relative_to(self.folder).as_posix().removeprefix("box.zarr/")
        part = "direct " if name.startswith("direct/") else ""
        name = name.removeprefix("direct/")
        if file == self.model:
            return "model"
        if file.name == "zarr.json":
            where = name.split("/")[0]
            return f"{part}{'group' if where == 'zarr.json' else where} json"
        return f"{part}{'chunk' if name.startswith('radiance') else 'feature'}"

    def run(self, count: int, seed: int, *, costly: int) -> tuple[Counter[tuple[str, ...]], float]:
        """Return how often each kind of file met each fate, by question, and the longest time."""
        rng, fates, longest = np.random.default_rng(seed), Counter[tuple[str, ...]](), 0.0
        kinds = sorted(self.kinds)
        for number in range(count):
            kind = kinds[number % len(kinds)]
            file = self.kinds[kind][rng.integers(len(self.kinds[kind]))]
            ways = EDITS + PLAIN if file.name == "zarr.json" else PLAIN
            sound = {f: f.read_bytes() for f in [*self.files, *self.foreign, self.model]}
            near = [f for f in self.kinds[kind] if f != file] or self.files
            others = (near, self.files, self.foreign)[rng.choice(3, p=(0.6, 0.2, 0.2))]
            ways[rng.integers(len(ways))](file, rng, others)
            for what, ask in self.asked.items():
                if what in ("analyze", "estimate") and number % costly not in (0, 1):
                    continue
                if what not in (MODEL if kind == "model" else STORE):
                    continue
                start = time.process_time()
                fates[kind, what, self.fate(what, ask)] += 1
                longest = max(longest, time.process_time() - start)
            if kind != "model" and number % costly in (0, 1):
                fates[kind, "render", self.repaired(sound)] += 1
            self.restore(sound)
        return fates, longest

    def fate(self, what: str, ask: Callable[[], Any]) -> str:
        try:
            return "right" if same(ask(), self.right[what]) else "other"
        except ChdstatError:
            return "error"
        except Exception:  # noqa: BLE001 - what is counted
            print(traceback.format_exc())
            return "traceback"

    def repaired(self, sound: dict[Path, bytes]) -> str:
        """Render the same again: afterwards all files are what they were, but for the time."""
        try:
            render(self.store)
        except ChdstatError:
            return "error"
        timed = {self.store / "zarr.json", self.store / "direct/zarr.json", self.model}
        equal = all(f.read_bytes() == sound[f] for f in self.files if f not in timed)
        whole = not inspect(self.store, verify=True)["damaged"]
        return (
            "right"
            if equal and whole and same(read(self.store), self.right["open, read"])
            else "other"
        )

    def restore(self, sound: dict[Path, bytes]) -> None:
        for file, content in sound.items():
            if file.is_dir():
                shutil.rmtree(file)
            if not file.exists() or file.read_bytes() != content:
                file.write_bytes(content)


FATES = ("right", "error", "other", "traceback")


def table(fates: Counter[tuple[str, ...]]) -> str:
    rows = sorted({key[:2] for key in fates})
    lines = [f"{'file':22}{'question':16}" + "".join(f"{fate:>11}" for fate in FATES)]
    for kind, what in rows:
        counts = "".join(f"{fates[kind, what, fate]:11}" for fate in FATES)
        lines.append(f"{kind:22}{what:16}{counts}")
    sums = "".join(f"{sum(n for k, n in fates.items() if k[2] == fate):11}" for fate in FATES)
    return "\n".join([*lines, f"{'all':38}{sums}"])


def check(fates: Counter[tuple[str, ...]], longest: float) -> None:
    assert not [key for key in fates if key[2] in ("other", "traceback")]
    assert not [key for key in fates if key[1:] == ("render", "error")]
    assert longest < LONGEST


def test_all_mutations(as_benchmark, tmp_path):
    fates, longest = Campaign(tmp_path).run(COUNT, seed=0, costly=20)
    print(f"\n{COUNT} mutations; longest answer {longest:.1f} s of processor time")
    print(table(fates))
    check(fates, longest)
