"""Writers of rendered samples, to memory or to a store, and the provenance that goes with them."""

from __future__ import annotations

import contextlib
import importlib.metadata
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from chdstat._core.executor import memory
from chdstat._core.files import free_disk
from chdstat.errors import InputError, StoreError
from chdstat.rendering.renderer import Job, Renderer
from chdstat.rendering.seeds import STREAMS
from chdstat.samples import Samples, is_store
from chdstat.samples.access import of_store
from chdstat.samples.layout import Chunk, check_appendable, chunk_grid
from chdstat.samples.store import Store

__all__ = ["MemoryWriter", "StoreWriter", "Writer", "check_room", "provenance"]

_MOST_COMPRESSION = 10
"""Stores shrink to between a third and nine tenths; a tenth leaves room for darker scenes."""

Image = npt.NDArray[np.float32]


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
        "spp": spp,
        "seed": job.seed,
        "backend": job.verdict.backend,
        "mitsuba_version": importlib.metadata.version("mitsuba"),
        "chdstat_version": importlib.metadata.version("chdstat"),
        "filter": "box",
        "sampler": "independent",
        "streams": STREAMS,
        "units": "linear radiance",
        "notes": renderer.notes,
        "render_seconds": 0.0,
    }


_IDENTITY: dict[str, Any] = {
    "scene_hash": None,
    "scene_code": {},
    "integrator": None,
    "sensor": 0,
    "size": None,
    "crop": None,
    "seed": None,
    "backend": None,
    "mitsuba_version": None,
    "streams": None,
}
"""Attributes that must agree before samples are added to a store, with what older stores mean that
lack them."""


def check_room(size: tuple[int, int], spp: int, out: str | Path | None) -> None:
    """Refuse samples that could never be kept, however well they compress."""
    needed = 12 * size[0] * size[1] * spp
    if out is None:
        there, where, advice = memory() or needed, "memory", "give a store to write to"
    else:
        free = free_disk(Path(out))
        there = needed if free is None else _MOST_COMPRESSION * free
        where, advice = "disk", "free some space"
    if needed > there:
        message = (
            f"{spp} samples for each of {size[0]} x {size[1]} pixels take {needed / 1e9:.3g} GB, "
            f"more than the {where} can hold; use fewer samples or pixels, or {advice}"
        )
        raise InputError(message)


class MemoryWriter:
    """Keeps rendered samples in memory."""

    def __init__(
        self, attrs: dict[str, Any], renderer: Renderer, spp: int, *, features: bool = True
    ) -> None:
        width, height = renderer.size
        self._attrs, self._features = attrs, renderer.features() if features else {}
        self._array = np.full((height, width, 3, spp), np.nan, np.float32)

    def pending(self) -> list[Chunk]:
        """Return the chunks that are not there yet."""
        height, width, _, spp = self._array.shape
        return list(chunk_grid(height, width, spp))

    def write(self, chunk: Chunk, block: Image) -> None:
        """Keep the samples of a chunk."""
        self._array[chunk.ys, chunk.xs, :, chunk.ss] = block

    def spent(self, seconds: float) -> None:
        """Record how long rendering took."""
        self._attrs["render_seconds"] = round(seconds, 3)

    def finish(self, direct: Samples | None = None) -> Samples:
        """Return the samples."""
        return Samples(self._array, attrs=self._attrs, features=self._features, direct=direct)


class StoreWriter:
    """Writes rendered samples to a store on disk."""

    def __init__(self, store: Store) -> None:
        self._store = store

    @classmethod
    def open(
        cls,
        out: Path,
        attrs: dict[str, Any],
        renderer: Renderer,
        spp: int,
        *,
        features: bool = True,
    ) -> StoreWriter:
        """Open or create the store and make room for the samples asked for."""
        width, height = renderer.size
        if not is_store(out):
            store = Store.create(
                out,
                height=height,
                width=width,
                channels=3,
                spp=spp,
                attrs=attrs,
                features=renderer.features() if features else {},
            )
            return cls(store)
        check_appendable(out)
        _check_identity(Store.open(out), attrs)
        store = Store.open(out, writable=True)
        if features:
            store.restore(renderer.features)
        store.extend(spp)
        return cls(store)

    def pending(self) -> list[Chunk]:
        """Return the chunks that are not there yet."""
        return self._store.pending()

    def write(self, chunk: Chunk, block: Image) -> None:
        """Keep the samples of a chunk."""
        self._store.write(chunk, block)

    def spent(self, seconds: float) -> None:
        """Record how long rendering took."""
        before = float(self._store.attrs.get("render_seconds", 0.0))
        # A full disk has been reported by `write`; the time spent is not worth another error.
        with contextlib.suppress(StoreError):
            self._store.update(render_seconds=round(before + seconds, 3))

    def close(self) -> None:
        """Let others write to the store."""
        self._store.close()

    def finish(self, direct: Samples | None = None) -> Samples:
        """Return the samples."""
        store = self._store
        store.update(direct=True if direct else None)
        return of_store(store, direct)


def _check_identity(store: Store, attrs: dict[str, Any]) -> None:
    """Refuse to mix samples of two scenes, seeds or settings in one store."""
    held = store.attrs
    stored = {name: held.get(name, default) for name, default in _IDENTITY.items()}
    differing = [name for name in _IDENTITY if stored[name] != attrs[name]]
    if differing:
        detail = "; ".join(f"{n}: stored {stored[n]}, asked for {attrs[n]}" for n in differing)
        message = (
            f"{store.path} holds other samples ({_changed(held, attrs)}{detail}). Nothing was "
            "changed; give another output path, or the same settings to resume or append"
        )
        raise StoreError(message)


def _changed(held: Mapping[str, Any], attrs: Mapping[str, Any]) -> str:
    """Return which files and plugins of a scene differ from those that a store was rendered with.

    Stores of earlier versions do not say which files they were rendered with.
    """
    parts = []
    if "scene_files" not in held and held.get("scene_hash") != attrs["scene_hash"]:
        parts.append(
            "rendered by an earlier version, which tells scenes apart by other files: "
            "'chdstat convert --scene' shows whether they are of this scene; "
        )
    for key, word in (("scene_files", "files"), ("scene_code", "code of plugins")):
        before, now = held.get(key), attrs[key]
        if before is not None and before != now:
            names = sorted(n for n in before.keys() | now.keys() if before.get(n) != now.get(n))
            more = f" and {len(names) - 5} more" if len(names) > 5 else ""
            parts.append(f"changed {word}: {', '.join(names[:5])}{more}; ")
    return "".join(parts)


Writer = MemoryWriter | StoreWriter
