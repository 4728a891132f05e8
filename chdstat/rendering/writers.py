"""Writers of rendered samples, to memory or to a store, and the provenance that goes with them."""

from __future__ import annotations

import importlib.metadata
import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from chdstat._core.arrays import Image
from chdstat._core.files import free_disk, place_of
from chdstat._core.work import check_memory
from chdstat.errors import InputError, StoreError
from chdstat.rendering.job import Job
from chdstat.rendering.renderer import Renderer
from chdstat.rendering.seeds import STREAMS, check_spp
from chdstat.samples import Samples, is_store
from chdstat.samples.layout import differing
from chdstat.samples.store import Store
from chdstat.samples.tiles import Chunk, LightPart, chunk_grid

__all__ = ["MemoryWriter", "Writer", "check_room", "opened_store", "provenance", "renderer_of"]

_MOST_COMPRESSION = 10
"""Stores shrink to between a third and nine tenths; a tenth leaves room for darker scenes."""


def provenance(job: Job, renderer: Renderer, spp: int) -> dict[str, Any]:
    """Return where the samples of a job come from, ready for JSON."""
    return {
        "scene": job.scene.name,
        **renderer.identity,
        "scene_source": job.scene.origin,
        "scene_parameters": dict(job.scene.parameters),
        "integrator": renderer.integrator,
        "sensor": job.sensor,
        "size": list(renderer.size),
        "crop": renderer.film.crop,
        "light": job.light,
        "spp": spp,
        "seed": job.seed,
        "backend": job.verdict.backend,
        "color": job.verdict.color,
        "mitsuba_version": importlib.metadata.version("mitsuba"),
        "chdstat_version": importlib.metadata.version("chdstat"),
        "filter": "box",
        "sampler": job.sampler,
        **({"sequence": job.sequences.length} if job.sequences else {}),
        "streams": STREAMS,
        "units": "linear radiance",
        "notes": renderer.notes,
        "render_seconds": 0.0,
    }


_log = logging.getLogger("chdstat")

_IDENTITY: dict[str, Any] = {
    "scene_hash": None,
    "scene_code": {},
    "plugins": {},
    "integrator": None,
    "sensor": 0,
    "size": None,
    "crop": None,
    "light": None,
    "seed": None,
    "backend": None,
    "color": "rgb",
    "mitsuba_version": None,
    "streams": None,
    "sampler": "independent",
    "sequence": None,
}
"""Attributes that must agree before samples are added to a store, with what older stores mean that
lack them."""


def check_room(size: tuple[int, int], spp: int, out: str | Path | None) -> None:
    """Refuse samples that could never be kept, however well they compress."""
    needed = 12 * size[0] * size[1] * spp
    what = f"{spp} samples for each of {size[0]} x {size[1]} pixels"
    if out is None:
        check_memory(needed, what, "use fewer samples or pixels, or give a store to write to")
    elif (free := free_disk(place_of(out))) is not None and needed > _MOST_COMPRESSION * free:
        message = (
            f"{what} take {needed / 1e9:.3g} GB, more than the disk can hold; use fewer samples "
            "or pixels, or free some space"
        )
        raise InputError(message)


def renderer_of(job: Job, spp: int, *, kept: int, out: str | Path | None) -> Renderer:
    """Return the renderer of a job, if so many samples can be drawn, and those kept be held."""
    renderer = Renderer(job)
    check_spp(job.verdict.backend, *renderer.size, spp, job.sequences)
    check_room(renderer.size, kept, out)
    if renderer.notes:
        _log.warning("%s: %s", job.scene.name, "; ".join(renderer.notes))
    return renderer


class MemoryWriter:
    """Keeps rendered samples in memory."""

    def __init__(self, attrs: dict[str, Any], size: tuple[int, int], spp: int) -> None:
        width, height = size
        self._attrs, self._features = attrs, dict[str, Image]()
        self._array = np.full((height, width, 3, spp), np.nan, np.float32)

    def pending(self) -> list[Chunk]:
        """Return the chunks that are not there yet."""
        height, width, _, spp = self._array.shape
        return list(chunk_grid(height, width, spp))

    def write(self, chunk: Chunk, block: Image) -> None:
        """Keep the samples of a chunk."""
        self._array[chunk.ys, chunk.xs, :, chunk.ss] = block

    @property
    def lacks_features(self) -> bool:
        """Whether there are no first-hit features yet."""
        return not self._features

    def restore(self, features: Mapping[str, Image], why_none: str = "") -> None:
        """Keep first-hit features, or why there are none."""
        self._features = dict(features)
        if why_none:
            self._attrs["why_no_features"] = why_none

    def spent(self, seconds: float) -> None:
        """Record how long rendering took."""
        self._attrs["render_seconds"] = round(seconds, 3)

    def finish(self, parts: Mapping[LightPart, Samples] | None = None) -> Samples:
        """Return the samples, with the parts of their light."""
        return Samples(self._array, attrs=self._attrs, features=self._features, parts=parts)


Writer = MemoryWriter | Store
"""What keeps rendered samples."""


def opened_store(out: Path, attrs: dict[str, Any], size: tuple[int, int], spp: int) -> Store:
    """Open or create a store that is written to, with room for the samples asked for."""
    if not is_store(out):
        width, height = size
        return Store.create(out, shape=(height, width, 3, spp), attrs=attrs)
    _check_identity(Store.open(out), attrs)
    store = Store.open(out, writable=True)
    store.extend(spp)
    return store


def _check_identity(store: Store, attrs: dict[str, Any]) -> None:
    """Refuse to mix samples of two scenes, seeds or settings in one store."""
    held = store.attrs
    stored = {name: held.get(name, default) for name, default in _IDENTITY.items()}
    if names := differing(stored, {name: attrs.get(name) for name in _IDENTITY}):
        why = _changed(held, attrs)
        why += [
            f"{n}: stored {stored[n]}, asked for {attrs.get(n)}"
            for n in names
            if n not in _CHANGES or held.get(n) is None
        ]
        message = (
            f"{store.path} holds other samples ({'; '.join(why)}). Nothing was "
            "changed; give another output path, or the same settings to resume or append"
        )
        raise StoreError(message)


_CHANGES = {"scene_files": "files", "scene_code": "code of plugins", "plugins": "plugins"}
"""Attributes of which the names that differ are told, and what they are the names of."""


def _changed(held: Mapping[str, Any], attrs: Mapping[str, Any]) -> list[str]:
    """Return which files and plugins of a scene differ from those of a store."""
    parts = []
    for key, word in _CHANGES.items():
        if held.get(key) is not None and (names := sorted(differing(held[key], attrs[key]))):
            more = f" and {len(names) - 5} more" if len(names) > 5 else ""
            parts.append(f"changed {word}: {', '.join(names[:5])}{more}")
    return parts
