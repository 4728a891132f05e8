"""Scenes of the benchmarks on real images: their references and renders, each made once and kept.

``CHDSTAT_SCENES``
    Folder of the real scenes in `REAL`.
``CHDSTAT_OTHERS``
    Folder of any further scenes: its XML files, and each of its folders with a ``scene.xml``.
``CHDSTAT_NAMES``
    Some of all these scenes, apart by semicolons.
``CHDSTAT_FILM``
    Edge of the images in pixels.
``CHDSTAT_REFERENCES``, ``CHDSTAT_RENDERS``
    Folders that keep references and renders; without them, a run makes its own.
``CHDSTAT_REFERENCE_SPP``
    Samples of a reference.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import chdstat as chd
from chdstat.comparison import Judge
from chdstat.comparison.judges import PARTS
from chdstat.rendering import render_batches

REAL = {
    "bathroom": "bathroom/scene.xml",
    "white room, day": "white-room/scene.xml",
    "white room, night": "white-room/scene_night.xml",
    "veach-bidir": "veach-bidir/scene.xml",
    "veach-mis": "veach-mis/scene.xml",
    "volumetric caustic": "volumetric-caustic/scene.xml",
}
BUILT_IN = ("bathroom", "fog", "many-lights", "night-room")
REFERENCE_SPP = int(os.environ.get("CHDSTAT_REFERENCE_SPP", "4096"))
SIZE = int(os.environ.get("CHDSTAT_FILM", "128"))
REFERENCE_SEED = 12
FIRST_SEED = 31


@dataclass(frozen=True)
class Rendered:
    """A scene with its reference and renders.

    Attributes
    ----------
    name
        Name in tables and of files.
    scene
        What `chdstat.render` takes.
    other
        Whether it comes from CHDSTAT_OTHERS.
    folders
        Where references and renders are kept.
    """

    name: str
    scene: str
    other: bool
    folders: tuple[Path, Path]

    def reference(self) -> Judge:
        """Return the judge of the scene, from samples of a seed that no estimate has."""
        path = self.folders[0] / f"{self.name}-{SIZE}-{REFERENCE_SPP}-parts.npz"
        if not path.exists():
            batches = render_batches(
                self.scene,
                spp=REFERENCE_SPP,
                batch=64,
                size=(SIZE, SIZE),
                seed=REFERENCE_SEED,
                progress=False,
            )
            means = np.stack([batch.mean(axis=-1, dtype=np.float64) for batch in batches])
            parts = np.stack([means[k::PARTS].mean(axis=0) for k in range(PARTS)])
            np.savez(path, parts=parts)
        parts = np.load(path)["parts"]
        error = parts.std(axis=0, ddof=1) / np.sqrt(PARTS)
        return Judge.of_image(parts, error, parts.mean(axis=(0, 1, 2)))

    def samples(self, number: int, spp: int, *, film: bool = False) -> chd.Samples:
        """Return a render by its number, from 0: each has its own seed."""
        seed = FIRST_SEED + number
        path = self.folders[1] / f"{self.name}-{seed}{'-film' * film}.zarr"
        if path.exists() and (kept := chd.open(path)).fewest >= spp:
            return kept
        options = {"size": (SIZE, SIZE), "out": path, "film": film, "progress": False}
        return chd.render(self.scene, spp=spp, seed=seed, **options)


def scenes(temporary: Path, built_in: Sequence[str] = BUILT_IN) -> list[Rendered]:
    """Return the scenes that there are; what is not kept elsewhere is put into a folder."""
    real, others = (os.environ.get(f"CHDSTAT_{name}") for name in ("SCENES", "OTHERS"))
    found = {} if real is None else {n: str(Path(real) / p) for n, p in REAL.items()}
    found |= {f"{name} (built in)": name for name in built_in}
    further = {}
    for path in sorted(Path(others).iterdir()) if others else ():
        if path.suffix == ".xml":
            further[path.stem] = str(path)
        elif (path / "scene.xml").exists():
            further[path.name] = str(path / "scene.xml")
    if twice := found.keys() & further.keys():
        message = f"expected other scenes by other names than {sorted(twice)}; rename them"
        raise ValueError(message)
    names = os.environ.get("CHDSTAT_NAMES")
    chosen = names.split(";") if names else [*found, *further]
    kept = (os.environ.get(f"CHDSTAT_{name}") for name in ("REFERENCES", "RENDERS"))
    references, renders = (temporary if folder is None else Path(folder) for folder in kept)
    every = found | further
    return [Rendered(n, every[n], n in further, (references, renders)) for n in chosen]
