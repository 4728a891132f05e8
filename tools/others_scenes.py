r"""Render other people's scenes, each in a process of its own, and tell what becomes of them.

    python tools/others_scenes.py FOLDER... --backend scalar llvm --limit 120

Every XML file below the folders that holds a Mitsuba scene is rendered by the command line, at 16 x
16 pixels and 2 spp. A row for each scene and backend says which of these happened:

rendered
    A store was written.
refused
    The command ended with an error in words, which the row quotes.
traceback
    The command ended with an error that nobody foresaw.
signal
    The process was ended: by a memory fault, or by a library that aborts.
time
    The time limit was passed.

The exit code is 1 if there was a traceback or a signal. Files of the scenes that are missing can be
replaced by small ones with ``--stand-ins``, so that what else a scene holds is tried, too: a copy
of each folder is completed, with a cube for a mesh and four pixels for an image.
"""

from __future__ import annotations

import argparse
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import product
from pathlib import Path

_SCENE = re.compile(rb"<scene\b[^>]*\bversion\s*=")
_HEAD = 4096
"""Bytes of a file in which its root element begins."""
_WORDS = 300
BAD = ("traceback", "signal")


@dataclass(frozen=True)
class Row:
    """What became of a scene."""

    scene: Path
    backend: str
    outcome: str
    seconds: float
    words: str

    def __str__(self) -> str:
        return f"{self.outcome:10}{self.backend:8}{self.seconds:6.1f} s  {self.scene}  {self.words}"


def scenes(folders: list[Path]) -> Iterator[Path]:
    """Yield the XML files that hold a Mitsuba scene, each once; a folder may also be a file."""
    seen = set()
    for folder in folders:
        for path in [folder] if folder.is_file() else sorted(folder.rglob("*.xml")):
            with path.open("rb") as stream:
                is_scene = _SCENE.search(stream.read(_HEAD)) is not None
            if is_scene and path.resolve() not in seen:
                seen.add(path.resolve())
                yield path


def fate(scene: Path, backend: str, options: argparse.Namespace) -> Row:
    """Render a scene in a process of its own."""
    with tempfile.TemporaryDirectory() as folder:
        settings = {"spp": options.spp, "size": options.size, "backend": backend}
        command = [sys.executable, "-m", "chdstat", "render", str(scene), "-q"]
        command += [f"--{name}={value}" for name, value in settings.items()]
        command += [f"--integrator={options.integrator}"] if options.integrator else []
        begun = time.monotonic()
        try:
            done = subprocess.run(  # noqa: S603 - our own command
                [*command, "-o", f"{folder}/samples.zarr"],
                capture_output=True,
                text=True,
                errors="replace",
                timeout=options.limit,
                check=False,
            )
        except subprocess.TimeoutExpired:
            return Row(scene, backend, "time", options.limit, "")
    words = " ".join(done.stderr.split())
    outcome = "rendered" if done.returncode == 0 else "refused"
    if done.returncode < 0:
        outcome, words = "signal", f"{signal.Signals(-done.returncode).name} {words}"
    elif "Traceback (most recent call last)" in done.stderr:
        outcome = "traceback"
        words = words[-_WORDS:]
    elif outcome == "refused" and not words:
        outcome, words = "traceback", f"exit code {done.returncode} without a word"
    return Row(scene, backend, outcome, time.monotonic() - begun, words[:_WORDS])


# --- stand-ins for files that are missing -------------------------------------------------------

_CUBE = "\n".join(
    [f"v {x} {y} {z}" for x, y, z in product((-0.5, 0.5), repeat=3)]
    + ["vt 0 0", "vt 1 0", "vt 1 1", "vt 0 1"]
    + [
        f"f {a}/1 {b}/2 {c}/3 {d}/4"
        for a, b, c, d in ("1243", "5687", "1265", "3487", "1375", "2486")
    ]
)
_NAMED = re.compile(r'\bfilename"\s+value\s*=\s*"([^"$]+)"')


def stand_in(path: Path) -> None:
    """Write a small file of the kind that a name asks for, if that is known."""
    import mitsuba as mi
    import numpy as np

    mi.set_variant("scalar_rgb")
    kind = path.suffix.lower()
    if kind in (".obj", ".ply"):
        path.parent.mkdir(parents=True, exist_ok=True)
        cube = path.with_suffix(".obj")
        cube.write_text(_CUBE)
        if kind == ".ply":
            mi.load_dict({"type": "obj", "filename": str(cube)}).write_ply(str(path))
            cube.unlink()
    elif kind in (".png", ".jpg", ".jpeg", ".exr", ".hdr", ".tga", ".bmp", ".pfm"):
        path.parent.mkdir(parents=True, exist_ok=True)
        pixels = np.linspace(0.1, 0.9, 12, dtype=np.float32).reshape(2, 2, 3)
        image = mi.Bitmap(pixels)
        if kind not in (".exr", ".hdr", ".pfm"):
            image = image.convert(component_format=mi.Struct.Type.UInt8, srgb_gamma=True)
        image.write(str(path))


def completed(folder: Path, place: Path) -> Path:
    """Return a copy of a folder in which missing files have stand-ins."""
    copy = place / folder.name
    shutil.copytree(folder, copy)
    for scene in scenes([copy]):
        for name in _NAMED.findall(scene.read_text(errors="replace")):
            if not (file := scene.parent / name).exists():
                stand_in(file)
    return copy


def main() -> int:
    """Render all scenes, print the table and the counts, and return the exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folders", nargs="+", type=Path, help="folders of scenes, or XML files")
    parser.add_argument("--backend", nargs="+", default=["scalar", "llvm"])
    parser.add_argument("--integrator", help="one in place of the scenes' own")
    parser.add_argument("--size", default="16x16")
    parser.add_argument("--spp", type=int, default=2)
    parser.add_argument("--limit", type=float, default=300.0, help="seconds for each process")
    parser.add_argument("--jobs", type=int, default=1, help="processes at once")
    parser.add_argument("--stand-ins", action="store_true", help="replace missing files")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as place, ThreadPoolExecutor(options.jobs) as pool:
        folders = options.folders
        if options.stand_ins:
            folders = [completed(folder, Path(place)) for folder in folders]
        tasks = product(scenes(folders), options.backend)
        counts: Counter[tuple[str, str]] = Counter()
        for row in pool.map(lambda task: fate(*task, options), tasks):
            sys.stdout.write(f"{row}\n")
            sys.stdout.flush()
            counts[row.backend, row.outcome] += 1
    for (backend, outcome), count in sorted(counts.items()):
        sys.stdout.write(f"{backend:8}{outcome:10}{count:5}\n")
    return int(any(outcome in BAD for _, outcome in counts))


if __name__ == "__main__":
    sys.exit(main())
