"""Pools of right renders: many independent batches of a scene, from which tests are drawn.

``CHDSTAT_POOLS``
    Folder that keeps the pools; without it, nothing runs. Make them with ``python -m
    benchmarks.render_pools``, which goes on where it was stopped. It takes an hour of two cores.
``CHDSTAT_MITSUBA_DATA``
    A clone of https://github.com/mitsuba-renderer/mitsuba-data: its test scenes are pools, too.
``CHDSTAT_PARTS``
    Parts of each pool, 2 by default. A part has a seed of its own, and holds 6 budgets.

A test has the budget of Mitsuba's own tests, 2e6 samples of an image, in 16 batches. Its reference
has 48 such batches. A file is named ``SCENE@SEED.npy``, and holds the means of batches, float32,
shape (y, x, channel, batch).
"""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from chdstat.rendering import render_batches
from chdstat.scenes import Scene, load_scene

BUDGET = 2_000_000
TEST, REFERENCE = 16, 48
"""Batches of a test, and of its reference."""
BUDGETS = 6
"""Tests in a part of a pool."""
EDGE = 48
BUILT_IN = (
    "cornell-box",
    "bathroom",
    "night-room",
    "many-lights",
    "fog",
    "caustic",
    "gallery",
    "day-room",
)
INSTEAD = {"ptracer": "path"}
"""Integrators for those that cannot sample one pixel after the other."""
ROULETTE = ("cornell-box", "bathroom", "night-room", "many-lights", "gallery", "day-room")
"""Scenes that are also rendered with Russian roulette from the first segment of a path on."""
OTHER_INTEGRATORS = {
    "volpath": "volpathmis",
    "volpathmis": "volpath",
    "direct": "path",
}
"""Integrators that have the means of those in the names of Mitsuba's scenes, and other samples."""
_UNLIKE = "+"
"""Between the name of a scene and how it is rendered otherwise."""


def sources() -> dict[str, str]:
    """Return the scenes that there are, by name: built in, and Mitsuba's."""
    found = {name: name for name in BUILT_IN}
    if folder := os.environ.get("CHDSTAT_MITSUBA_DATA"):
        for path in sorted(Path(folder).glob("tests/scenes/*/*_*.xml")):
            found[path.stem.removeprefix("test_")] = str(path)
    return found


def unlike() -> list[str]:
    """Return the names of renders with the means of other scenes' pools and other samples."""
    found = [f"{name}{_UNLIKE}roulette" for name in ROULETTE]
    for name, source in sources().items():
        if name != source and (other := OTHER_INTEGRATORS.get(name.rpartition("_")[2])):
            found.append(f"{name}{_UNLIKE}{other}")
    return found


def like(name: str) -> str:
    """Return the scene of a render."""
    return name.partition(_UNLIKE)[0]


def batch_size(height: int, width: int) -> int:
    """Return the samples of a batch of a pixel."""
    return max(1, round(BUDGET / (height * width) / TEST))


def _scene(name: str) -> Scene:
    own, _, otherwise = name.partition(_UNLIKE)
    source = sources()[own]
    if own != source:
        integrator = otherwise or own.rpartition("_")[2]
        return load_scene(source, integrator=INSTEAD.get(integrator, integrator))
    scene = load_scene(source)
    if otherwise:
        integrator = {**scene.source["integrator"], "rr_depth": 1}
        scene = replace(scene, source={**scene.source, "integrator": integrator})
    return scene


def render_part(name: str, seed: int, path: Path) -> None:
    """Render a part of a pool."""
    scene = _scene(name)
    options: dict[str, Any] = {"size": (EDGE, EDGE)} if like(name) in BUILT_IN else {}
    if name.endswith(f"_direct{_UNLIKE}path"):
        options["max_depth"] = 2  # as direct
    probe = next(iter(render_batches(scene, spp=1, progress=False, backend="llvm", **options)))
    each = batch_size(*probe.shape[:2])
    batches = render_batches(
        scene,
        spp=each * TEST * BUDGETS,
        batch=each,
        seed=seed,
        backend="llvm",
        progress=False,
        **options,
    )
    means = [x.mean(axis=-1, dtype=np.float64).astype(np.float32) for x in batches]
    part = path.with_suffix(".part.npy")
    np.save(part, np.stack(means, axis=-1))
    part.rename(path)


def pools() -> dict[str, list[Path]]:
    """Return the parts of each pool that is kept."""
    found: dict[str, list[Path]] = {}
    if folder := os.environ.get("CHDSTAT_POOLS"):
        for path in sorted(Path(folder).glob("*@*.npy")):
            if not path.name.endswith(".part.npy"):
                found.setdefault(path.name.partition("@")[0], []).append(path)
    return found


def main() -> None:
    """Render what is missing, each scene in a process of its own."""
    folder = Path(os.environ["CHDSTAT_POOLS"])
    if len(sys.argv) == 3:
        name, seed = sys.argv[1:]
        render_part(name, int(seed), folder / f"{name}@{seed}.npy")
        return
    parts = range(int(os.environ.get("CHDSTAT_PARTS", "2")))
    wanted = [(name, seed) for seed in parts for name in sources()]
    for name, seed in [*wanted, *((name, parts[-1] + 1) for name in unlike())]:
        if not (folder / f"{name}@{seed}.npy").exists():
            command = [sys.executable, "-m", "benchmarks.render_pools", name, str(seed)]
            code = subprocess.run(command, check=False).returncode
            sys.stdout.write(f"{name} {seed}: {'made' if code == 0 else 'failed'}\n")
            sys.stdout.flush()


if __name__ == "__main__":
    main()
