"""Configuration of a study: which scenes it looks at, how each is rendered, and where to look."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from chdstat.errors import InputError
from chdstat.rendering.jobs import scene_size
from chdstat.rendering.recipes import (
    Recipe,
    Region,
    check_integrator,
    find_recipe,
    load_recipe,
    own_recipe,
    regions_of,
)
from chdstat.samples import Samples, is_store
from chdstat.samples import open as open_samples
from chdstat.scenes import BUILTIN, Scene, load_scene

__all__ = ["Source", "Subject", "subjects_of"]

_EDGE = 128
"""Longest edge of the image where no recipe says otherwise."""
_SPP = 1024

Source = str | Path | Mapping[str, Any] | Scene | Samples


@dataclass(frozen=True)
class Subject:
    """One scene of a study.

    Attributes
    ----------
    name
        Of the scene; no two of a study have the same.
    scene
        What to render; None where there are only samples.
    samples
        What is rendered already; None to render it.
    settings
        Arguments of `chdstat.render`.
    regions
        Where to look; none for those that the library chooses.
    """

    name: str
    scene: Scene | None
    samples: Samples | None
    settings: Mapping[str, Any]
    regions: tuple[Region, ...]


def subjects_of(
    sources: Source | Sequence[Source] | None,
    *,
    given: Mapping[str, Any],
) -> tuple[Subject, ...]:
    """Return the scenes of a study.

    Parameters
    ----------
    sources
        Built-in names, Mitsuba XML files, recipes (``*.toml``), finished stores, scenes or samples,
        one or several; None takes every built-in scene that has a recipe.
    given
        Arguments of `chdstat.render` that go before those of recipes.

    Raises
    ------
    InputError
        If there is none, one comes twice, or a recipe is wrong; the message names file and key.
    SceneError, StoreError
        If a scene or a store cannot be read.
    """
    if sources is None:
        sources = [name for name in BUILTIN if find_recipe(name)]
    elif isinstance(sources, (str, Path, Mapping, Scene, Samples)):
        sources = [sources]
    found = [_subject(source, given) for source in sources]
    if not found:
        message = "a study needs at least one scene, got none"
        raise InputError(message)
    _check_distinct(found)
    return tuple(_distinct_names(found))


def _subject(source: Source, given: Mapping[str, Any]) -> Subject:
    if isinstance(source, Samples):
        return _of_samples(source)
    if isinstance(source, (str, Path)):
        if is_store(source):
            return _of_samples(open_samples(source))
        if Path(source).suffix.lower() == ".toml":
            recipe = load_recipe(source)
            scene = load_scene(recipe.scene)
            check_integrator(recipe, scene)
            return _of_scene(scene, recipe, given)
    scene = load_scene(source)
    return _of_scene(scene, own_recipe(scene.name, scene.origin), given)


def _of_samples(samples: Samples) -> Subject:
    return Subject(samples.name, None, samples, {}, regions_of(samples))


def _of_scene(scene: Scene, recipe: Recipe | None, given: Mapping[str, Any]) -> Subject:
    settings = {**(recipe.settings() if recipe else _defaults(scene)), **given}
    size = settings["size"]
    # What is no size, rendering refuses with a message of its own.
    seen = recipe is not None and len(size) == 2 and recipe.shows(size[1], size[0])
    return Subject(scene.name, scene, None, settings, recipe.regions if recipe and seen else ())


def _defaults(scene: Scene) -> dict[str, Any]:
    """Return settings for a scene without a recipe: a small image of its own proportions."""
    width, height = scene_size(scene)
    scale = _EDGE / max(width, height)
    size = max(1, round(width * scale)), max(1, round(height * scale))
    return {"spp": _SPP, "size": size, "seed": 1, "max_depth": None}


def _check_distinct(subjects: Sequence[Subject]) -> None:
    """Refuse a scene that comes twice: it would count twice in what is said of all scenes."""
    seen = [s.scene.hash if s.scene else s.samples.attrs.get("scene_hash", s) for s in subjects]  # type: ignore[union-attr]
    for i, subject in enumerate(subjects):
        if seen[i] in seen[:i]:
            message = f"expected different scenes, got {subject.name!r} twice"
            raise InputError(message)


def _distinct_names(subjects: Sequence[Subject]) -> Iterator[Subject]:
    """Yield subjects, a further one of the same name with its number."""
    names: list[str] = []
    for subject in subjects:
        names.append(subject.name)
        count = names.count(subject.name)
        yield subject if count == 1 else replace(subject, name=f"{subject.name} ({count})")
