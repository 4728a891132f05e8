"""The main job: render, analyse, train, compare and typeset, with no other input."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

from chdstat.analysis import analyze, overview
from chdstat.backend import Backend
from chdstat.capture import render
from chdstat.comparison import Comparison, compare
from chdstat.errors import InputError
from chdstat.recipes import Recipe, choose_regions, find_recipe, load_recipe
from chdstat.reporting.content import Study, document
from chdstat.reporting.typeset import typeset
from chdstat.samples import Samples
from chdstat.samples import open as open_samples
from chdstat.scenes import BUILTIN, Scene, load_scene

__all__ = ["report"]

_SIZE = 128
"""Longest edge of the image where neither the user nor a recipe says otherwise."""
_SPP = 512
_IN_MEMORY = 2**29
"""Samples up to this many bytes are read once and held; larger ones are walked on disk."""
_BATCH = 32
"""Samples of one estimate, as in Elek et al. 2019."""


def report(
    source: str | Path | dict[str, Any] | Scene | Samples,
    path: str | Path,
    *,
    spp: int | None = None,
    size: tuple[int, int] | None = None,
    seed: int | None = None,
    max_depth: int | None = None,
    recipe: str | Path | None = None,
    store: str | Path | None = None,
    backend: Backend = "auto",
    progress: bool | None = None,
) -> Path:
    """Write a PDF report on the sample distributions of a scene.

    Parameters
    ----------
    source
        What `chdstat.load_scene` takes, the path of a finished store, or `Samples`.
    path
        The PDF to write.
    spp, size, seed, max_depth, backend
        As for `chdstat.render`; None takes the recipe's, or 512 spp and 128 pixels along the
        longer edge. They do not apply to samples that are already there.
    recipe
        A recipe file; None takes the scene's own where there is one. Without a recipe, the library
        chooses a region for each pattern that it finds.
    store
        Where to keep the rendered samples, so that the next report resumes from them; None keeps
        them in memory.
    progress
        Show progress bars; None shows them on a terminal.

    Returns
    -------
    Path
        The PDF.

    Raises
    ------
    InputError
        If the output cannot be a PDF or an option is out of range.
    SceneError, RenderError, StoreError
        As for `chdstat.render` and `chdstat.open`.
    """
    target = _checked_target(Path(path))
    samples, found = _samples(source, spp, size, seed, max_depth, recipe, store, backend, progress)
    if samples.nbytes <= _IN_MEMORY:
        samples = samples.load()
    dataset = analyze(samples, progress=progress)
    regions = found.regions if found and found.regions else choose_regions(dataset)
    study = Study(
        samples=samples,
        dataset=dataset,
        overview=overview(dataset),
        regions=regions,
        chosen=not (found and found.regions),
        comparison=_compare(samples, progress),
    )
    with tempfile.TemporaryDirectory(prefix="chdstat-") as folder:
        return typeset(document(study), Path(folder), target)


def _checked_target(path: Path) -> Path:
    """Refuse early what could not be written after a minute of work."""
    if path.suffix.lower() != ".pdf":
        message = f"the report is a PDF: its path must end in .pdf, got {str(path)!r}"
        raise InputError(message)
    if not path.parent.is_dir():
        message = f"the folder {str(path.parent)!r} does not exist; create it first"
        raise InputError(message)
    return path


def _samples(
    source: str | Path | dict[str, Any] | Scene | Samples,
    spp: int | None,
    size: tuple[int, int] | None,
    seed: int | None,
    max_depth: int | None,
    recipe: str | Path | None,
    store: str | Path | None,
    backend: Backend,
    progress: bool | None,
) -> tuple[Samples, Recipe | None]:
    """Return the samples, opened or rendered, and the recipe that goes with them."""
    given = load_recipe(recipe) if recipe else None
    if isinstance(source, Samples):
        return source, given or _recipe_of(source)
    if isinstance(source, (str, Path)) and (Path(source) / "zarr.json").is_file():
        samples = open_samples(source)
        return samples, given or _recipe_of(samples)
    scene = load_scene(source)
    found = given or (find_recipe(scene.name) if scene.origin == "chdstat" else None)
    samples = render(
        scene,
        spp=spp or (found.spp if found else _SPP),
        size=size or (found.size if found else _default_size(scene)),
        seed=seed if seed is not None else (found.seed if found else 0),
        max_depth=max_depth or (found.max_depth if found else None),
        out=store,
        backend=backend,
        progress=progress,
    )
    return samples, found


def _recipe_of(samples: Samples) -> Recipe | None:
    """Return the recipe of a built-in scene, if the samples are of one."""
    builtin = samples.name in BUILTIN and samples.attrs.get("scene_source") == "chdstat"
    return find_recipe(samples.name) if builtin else None


def _default_size(scene: Scene) -> tuple[int, int]:
    """Return a small image of the scene's own proportions."""
    from chdstat.capture import scene_size

    width, height = scene_size(scene)
    scale = _SIZE / max(width, height)
    return max(1, round(width * scale)), max(1, round(height * scale))


def _compare(samples: Samples, progress: bool | None) -> Comparison | None:
    """Compare the estimators, or return None where there are too few samples to judge by."""
    try:
        return compare(samples, n=_BATCH, progress=progress)
    except InputError:
        return None
