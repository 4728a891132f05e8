"""Opening: from what a person names to the sources of an explorer."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from chdstat.errors import InputError
from chdstat.explorer.learned import learners
from chdstat.explorer.live import SceneSource
from chdstat.explorer.shared import Shared
from chdstat.explorer.sources import StoreSource
from chdstat.models import AnyModel
from chdstat.samples import Samples
from chdstat.samples import open as open_store
from chdstat.scenes import Scene, load_scene

__all__ = ["Explored", "opened"]

Explored = str | Path | dict[str, Any] | Scene | Samples
"""A store or its path, samples in memory, or a scene."""


def opened(
    source: Explored,
    other: str | Path | Samples | None,
    reference: str | Path | Samples | None,
    models: Sequence[AnyModel | str | Path] = (),
    **options: Any,
) -> Shared:
    """Open what is explored, what it is compared with, and trained estimators.

    Raises
    ------
    InputError
        If the stores do not fit each other.
    StoreError, SceneError, RenderError
        If something cannot be read or rendered.
    """
    trained = learners(models)
    first = _source(source, **options)
    second, truth = (None if s is None else _store(s) for s in (other, reference))
    for store in (second, truth):
        if store is not None and (store.size, store.channels) != (first.size, first.channels):
            message = (
                f"{store.name} must have the size and channels of {first.name}: expected "
                f"{_sized(first)}, got {_sized(store)}"
            )
            raise InputError(message)
    return Shared(first, second, truth, trained)


def _sized(source: StoreSource | SceneSource) -> str:
    height, width = source.size
    return f"{width} x {height} pixels and channels {', '.join(source.channels)}"


def _source(source: Explored, **options: Any) -> StoreSource | SceneSource:
    if isinstance(source, Samples) or _is_store(source):
        return _store(source)
    return SceneSource(load_scene(source), **options)


def _is_store(source: object) -> bool:
    return isinstance(source, str | Path) and (Path(source) / "zarr.json").is_file()


def _store(source: Any) -> StoreSource:
    samples = source if isinstance(source, Samples) else open_store(source)
    channels = samples.shape[2]
    if channels not in {1, 3}:
        message = f"the explorer shows 1 or 3 channels, got {channels}"
        raise InputError(message)
    return StoreSource(samples)
