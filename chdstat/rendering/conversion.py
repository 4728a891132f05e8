"""Conversion: the samples of a store of an earlier schema, written into a new one."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from chdstat._core.files import place_of, replacing, unused
from chdstat.errors import StoreError
from chdstat.rendering.capture import render
from chdstat.samples import Samples
from chdstat.samples import open as open_samples
from chdstat.samples.layout import FIRST_SCHEMA, SCHEMA_VERSION, WriteError, part_folder
from chdstat.samples.store import Store
from chdstat.scenes import SceneLike

__all__ = ["convert"]

_PROOF = 16
"""Samples of each pixel by which a store is known to be of a scene."""
_OF_SCENE = ("scene_hash", "scene_files", "scene_code", "plugins", "sensor", "crop")
"""Attributes by which the same scene is known."""


def convert(
    old: str | Path,
    new: str | Path,
    *,
    scene: SceneLike | None = None,
    progress: bool | None = None,
) -> Samples:
    """Write the samples of a store of an earlier schema into a new one, with its direct part.

    Samples that only some pixels have are left out; a render that resumes draws them again.

    Parameters
    ----------
    old
        The store; it stays as it is.
    new
        Where to write; nothing may be there. It is there when it is complete.
    scene
        What `old` was rendered of, needed to append to `new` if that was an XML file: earlier
        versions told scenes apart by other files. The first samples of each pixel, 16 at most, are
        rendered again, and must be equal to the bit.
    progress
        Show a progress bar while they are; None shows it on a terminal.

    Returns
    -------
    Samples
        Those of the new store.

    Raises
    ------
    StoreError
        If `old` is damaged, of the present schema already or of another scene, or `new` is there
        or cannot be written.
    SceneError, RenderError
        If the scene cannot be read, or not be rendered as it was.
    """
    target = unused(new)
    told = {} if scene is None else _proved(open_samples(old), scene, progress)
    store = Store.open(place_of(old))
    if store.attrs["schema_version"] != FIRST_SCHEMA:
        message = f"{store.path} is of schema {SCHEMA_VERSION} already: there is nothing to convert"
        raise StoreError(message)
    parts = store.parts()
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        with (
            replacing(unused(target), folder=True) as partial,
            _converted(store, partial, told) as made,
        ):
            for which, part in parts.items():
                _converted(part, partial / part_folder(which), told).close()
            made.update(parts=parts)
    except (WriteError, OSError) as error:
        cause: Any = error.__cause__ if isinstance(error, WriteError) else error
        message = f"cannot write to {target}: {cause.strerror or cause}; nothing was kept of it"
        raise StoreError(message) from error
    return open_samples(target)


def _proved(samples: Samples, scene: SceneLike, progress: bool | None) -> dict[str, Any]:
    """Return what stores keep of a scene that gives these samples again, to the bit."""
    attrs = samples.attrs
    again = render(
        scene,
        spp=min(samples.spp, _PROOF),
        size=attrs["size"],
        seed=attrs.get("seed", 0),
        max_depth=attrs.get("integrator", {}).get("max_depth"),
        sensor=attrs.get("sensor", 0),
        backend=attrs.get("backend", "auto"),
        progress=progress,
    )
    if not np.array_equal(again.read(), samples.read(ss=slice(0, again.spp)), equal_nan=True):
        message = (
            f"{samples.path} holds other samples than {again.name!r} gives now; nothing was "
            "written. Give the scene as it was, or convert without one: what comes of it is read, "
            "but not appended to"
        )
        raise StoreError(message)
    return {name: again.attrs[name] for name in _OF_SCENE}


def _converted(old: Store, path: Path, told: Mapping[str, Any]) -> Store:
    """Return a new, open store with the samples of another that every pixel has."""
    spp = old.complete_spp()
    if spp == 0:
        message = f"{old.path} holds no sample that every pixel has: there is nothing to convert"
        raise StoreError(message)
    attrs, features = {**old.attrs, **told, "spp": spp}, old.read_features()
    new = Store.create(path, shape=(*old.shape[:3], spp), attrs=attrs, features=features)
    for chunk in new.pending():
        new.write(chunk, old.read(chunk.ys, chunk.xs, chunk.ss))
    return new
