"""Renderers of scene files under test: their scenes, and images that they render by themselves."""

from __future__ import annotations

import subprocess
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import chdstat as chd
from chdstat.errors import RenderError
from chdstat.inference.references import Reference
from chdstat.recording.cycles import CyclesSource
from chdstat.recording.luxcore import LuxCoreSource
from chdstat.recording.pass_sources import seed_of_pass
from chdstat.recording.scene_files import SceneFileSource

HERE = Path(__file__).parent
Sourced = Callable[..., SceneFileSource]


def samples_of(source: SceneFileSource, spp: int, seed: int = 1) -> np.ndarray:
    """Return samples as they are recorded, shape (y, x, channel, sample)."""
    return np.stack([source(seed_of_pass(seed, n)).image for n in range(spp)], axis=-1)


@dataclass(frozen=True)
class SceneRenderer:
    """A renderer with a script, which makes its scenes, and images of them without chdstat.

    Attributes
    ----------
    source
        What draws passes of its scenes.
    suffix, alone
        Suffixes of scenes that are recorded, and of those that it renders by itself.
    image
        Suffix of the images that it writes: .exr or .npy.
    script
        Name of the script beside this file: ``SCRIPT -- make FOLDER`` and ``SCRIPT -- images SCENE
        FOLDER WIDTH HEIGHT SPP COUNT``.
    """

    source: type[SceneFileSource]
    suffix: str
    alone: str
    image: str
    script: str

    def __str__(self) -> str:
        return self.source.renderer

    @property
    def why_not(self) -> str:
        """Why it cannot be tried here, or nothing."""
        try:
            self.source.command()
        except RenderError as error:
            return str(error)
        return ""

    def run(self, script: Path, *words: object) -> str:
        """Run a script where the renderer is, and return what it prints."""
        command = [*self.source.command(), str(script), "--", *map(str, words)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr[-2000:]
        return done.stdout

    def make(self, folder: Path) -> Path:
        """Make its scenes in a folder."""
        self.run(HERE / self.script, "make", folder)
        return folder

    def images(self, path: Path, size: tuple[int, int], spp: int, count: int) -> Reference:
        """Return what it renders of a scene by itself: the means of images are the batches."""
        path = path.with_suffix(self.alone)
        self.run(HERE / self.script, "images", path, path.parent, *size, spp, count)
        files = (path.parent / f"{path.stem}-{number}{self.image}" for number in range(count))
        read = np.load if self.image == ".npy" else lambda file: chd.io.read_exr(file).image
        batches = np.stack([read(file)[..., :3] for file in files], axis=-1)
        return Reference(batches.mean(-1), spp=spp * count, batches=batches, precision=1e-6)

    def sources(self, folder: Path, size: tuple[int, int]) -> Iterator[Sourced]:
        """Yield what returns the source of a scene by its name; equal ones are one process."""
        made: dict[str, SceneFileSource] = {}

        def found(name: str, **options: object) -> SceneFileSource:
            options = {"size": size, **options}
            key = f"{name} {options}"
            if key not in made:
                made[key] = self.source(folder / f"{name}{self.suffix}", **options)
            return made[key]

        yield found
        for one in made.values():
            one.close()


CYCLES = SceneRenderer(CyclesSource, ".blend", ".blend", ".exr", "blender_scenes.py")
LUXCORE = SceneRenderer(LuxCoreSource, ".cfg", ".scn", ".npy", "luxcore_scenes.py")
