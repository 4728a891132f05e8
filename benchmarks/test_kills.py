"""Kills: what is run again after one gives the same files to the bit, and nothing is left over.

``--benchmark-only -s`` kills commands at 100 random moments between the first sign of progress and
the end of the work, and before 50 random accesses to files, and prints the table; a render is
killed with the other tests, too. CHDSTAT_KILLS changes their number, CHDSTAT_KILLED, such as
``analyze,estimate``, which commands are killed.
"""

from __future__ import annotations

import hashlib
import os
import select
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

COUNT = int(os.environ.get("CHDSTAT_KILLS", "100"))
BOX = ("cornell-box", "--size", "66x5", "--backend", "scalar")
COMMANDS = {
    "render": ("render", *BOX, "--direct", "--spp", "300", "-o", "new.zarr"),
    "append": ("render", *BOX, "--direct", "--spp", "400", "-o", "box.zarr"),
    "analyze": ("analyze", "box.zarr", "-o", "maps.zarr"),
    "estimate": ("estimate", "box.zarr", "-o", "box.exr"),
    "train": ("train", "small.zarr", "-o", "b.safetensors", "--features", "--iterations", "200"),
    "study": (
        *("study", "cornell-box", "--store", "kept", "-o", "found.pdf", "--spp", "64"),
        *("--size", "8x6", "--backend", "scalar", "-e", "mean", "-e", "elek2019"),
    ),
}
SETUP = (
    ("render", *BOX, "--direct", "--spp", "70", "-o", "box.zarr"),
    ("render", *BOX, "--size", "7x5", "--spp", "70", "-o", "small.zarr"),
)
"""What others read, beside each of them."""
LONGEST = 300


@dataclass
class Ended:
    """How a run went: its exit status, and seconds from the first sign of progress to its end."""

    status: int
    seconds: float


def run(
    arguments: tuple[str, ...], folder: Path, *, events: int = -1, after: float = LONGEST
) -> Ended:
    """Run a command; kill it so many seconds after it has shown that it works."""
    (folder / "tmp").mkdir(exist_ok=True)
    screen, tty = os.openpty()
    command = [sys.executable, Path(__file__).with_name("killed.py"), str(events), *arguments]
    own = {"TMPDIR": f"{folder}/tmp", "XDG_CACHE_HOME": f"{folder}/cache"}
    own["MPLCONFIGDIR"] = str(folder.parent)  # which lists fonts in any order
    shown, start, first = b"", time.monotonic(), None
    with subprocess.Popen(
        command, cwd=folder, env=os.environ | own, stdout=subprocess.DEVNULL, stderr=tty
    ) as process:
        while process.poll() is None:
            now = time.monotonic()
            if select.select([screen], [], [], 0.002)[0]:
                shown += os.read(screen, 65536)
                first = now if first is None and b"%" in shown else first
            if now - start > LONGEST or (first and now - first >= after):
                process.kill()
    os.close(screen)
    os.close(tty)
    if process.returncode not in (0, -signal.SIGKILL):
        print(shown.decode(errors="replace"))
    return Ended(process.returncode, time.monotonic() - (first or start))


def tree(folder: Path) -> dict[str, str]:
    """Return the checksums of all files, by name; folders have none."""
    return {
        path.relative_to(folder).as_posix(): ""
        if path.is_dir()
        else hashlib.sha256(path.read_bytes()).hexdigest()
        for path in folder.rglob("*")
    }


class Campaign:
    """Undisturbed runs, and killed ones to compare with them."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.start = folder, folder / "start"
        self.start.mkdir()
        for command in SETUP:
            assert run(command, self.start).status == 0
        self.right: dict[str, dict[str, str]] = {}
        self.seconds: dict[str, float] = {}
        self.events: dict[str, int] = {}

    def place(self) -> Path:
        """Return the folder to run in, with what is there at the start."""
        place = self.folder / "run"
        shutil.rmtree(place, ignore_errors=True)
        return Path(shutil.copytree(self.start, place))

    def learn(self, name: str) -> None:
        """Run a command undisturbed, on what it reads."""
        place = self.place()
        ended = run(COMMANDS[name], place, events=0)
        assert ended.status == 0
        self.right[name], self.seconds[name] = tree(place), ended.seconds
        self.events[name] = int(place.with_name("events").read_text())

    def killed(self, name: str, rng: np.random.Generator, *, at: str) -> str:
        """Kill a command at a random moment or access to a file, run it again, and look."""
        if name not in self.right:
            self.learn(name)
        while True:
            place = self.place()
            moment = (
                {"after": rng.uniform(0, self.seconds[name])}
                if at == "moment"
                else {"events": int(rng.integers(1, self.events[name] + 1))}
            )
            status = run(COMMANDS[name], place, **moment).status
            missing = self.right[name].items() - tree(place).items()
            if status == -signal.SIGKILL and any(not f.startswith("cache") for f, _ in missing):
                break  # in time: once its results are in place, it has done its work
        status = run(COMMANDS[name], place).status
        if status:
            return "refused"
        found, right = tree(place), self.right[name]
        differing = sorted(name for name, _ in found.items() ^ right.items())
        if differing:
            print(f"{name}, killed {moment}: {', '.join(differing[:6])}")
        return (
            "left over" if found.keys() - right.keys() else "other files" if differing else "same"
        )


FATES = ("same", "other files", "left over", "refused")


def table(fates: Counter[tuple[str, str, str]]) -> str:
    lines = [f"{'killed at a random':20}{'command':12}" + "".join(f"{f:>13}" for f in FATES)]
    for at, name in sorted({key[:2] for key in fates}):
        counts = "".join(f"{fates[at, name, fate]:13}" for fate in FATES)
        lines.append(f"{at:20}{name:12}{counts}")
    return "\n".join(lines)


@pytest.fixture
def campaign(tmp_path):
    return Campaign(tmp_path)


def kill(
    campaign: Campaign, names: list[str], count: int, at: str, seed: int
) -> Counter[tuple[str, str, str]]:
    rng, fates = np.random.default_rng(seed), Counter[tuple[str, str, str]]()
    for number in range(count):
        name = names[number % len(names)]
        fates[at, name, campaign.killed(name, rng, at=at)] += 1
    return fates


def test_all_kills(as_benchmark, campaign):
    # A study takes longest, and is what the others are.
    names = [name for name in COMMANDS if name != "study"] * 2 + ["study"]
    if chosen := os.environ.get("CHDSTAT_KILLED"):
        names = chosen.split(",")
    start = time.monotonic()
    fates = kill(campaign, names, COUNT, "moment", 0) + kill(
        campaign, names, COUNT // 2, "access", 1
    )
    print(f"\n{sum(fates.values())} kills in {time.monotonic() - start:.0f} s")
    print(table(fates))
    assert {key[2] for key in fates} == {"same"}
