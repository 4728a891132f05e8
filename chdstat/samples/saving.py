"""Saving: samples that are not rendered here are written to a store, chunk by chunk.

`Samples.save` writes whatever samples there are; an import is samples that are read from the files
of another program, saved.
"""

from __future__ import annotations

import hashlib
import importlib.metadata
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from chdstat._core.arrays import Image
from chdstat._core.work import track
from chdstat.errors import InputError, StoreError
from chdstat.samples import layout
from chdstat.samples.access import is_store
from chdstat.samples.layout import Chunk
from chdstat.samples.samples import Samples
from chdstat.samples.store import Store
from chdstat.samples.tiles import check_sequences, sequence_of

__all__ = ["save"]

_OF_A_STORE = (
    *("scene_hash", "scene_code", "scene_files", "plugins"),
    *("appended", "manifest", "schema_version"),
)
"""Attributes of a store itself: by the first, samples of a scene are appended to a render."""


def save(samples: Samples, path: Path, *, append: bool, progress: bool | None) -> Samples:
    """Write samples to a new store, or behind those of an existing one; see `Samples.save`."""
    attrs = _described(samples)
    if not is_store(path):
        if append:
            message = f"there is no store at {path} to append to; leave append out to make one"
            raise StoreError(message)
        shape = samples.shape
        features = dict(samples.features)
        if samples.counts is not None:
            features[layout.COUNTS] = samples.counts.astype(np.float32)
        store = Store.create(path, shape=shape, attrs=attrs, features=features)
        first = 0
    elif append:
        store, first = _extended(samples, path, attrs)
    else:
        _check_interrupted(samples, path, attrs)
        store, first = Store.open(path, writable=True), 0
    with store:
        _fill(store, samples, first, progress)
        if append:
            return store.finish()
        parts = {
            which: save(part, path / layout.part_folder(which), append=False, progress=progress)
            for which, part in samples.parts.items()
        }
        return store.finish(parts)


def _described(samples: Samples) -> dict[str, Any]:
    """Return what a store says of samples: where they come from, and which they are."""
    check_sequences(samples)
    attrs = {k: v for k, v in samples.attrs.items() if k not in _OF_A_STORE}
    height, width, _, spp = samples.shape
    moved = any(r.start or r.step != 1 for r in samples.part)
    if moved or attrs.get("size", [width, height]) != [width, height]:
        # Of a pixel elsewhere, the random numbers are others.
        attrs = {k: v for k, v in attrs.items() if k not in ("seed", "streams")}
    return {
        "scene": samples.name,
        **attrs,
        "size": [width, height],
        "spp": spp,
        "chdstat_version": importlib.metadata.version("chdstat"),
        "content": _content(samples),
    }


def _content(samples: Samples) -> str:
    """Return a hash by which the same samples are known when their saving is repeated."""
    if samples.source is None:
        digest = hashlib.blake2b(digest_size=16)
        for *_, block in samples.blocks():
            digest.update(np.ascontiguousarray(block).data)
        return digest.hexdigest()
    about = [str(samples.source.path), samples.attrs, list(samples.shape), repr(samples.part)]
    return hashlib.blake2b(layout.canonical(about), digest_size=16).hexdigest()


def _check_interrupted(samples: Samples, path: Path, attrs: Mapping[str, Any]) -> None:
    """Refuse a store unless it is one of the same samples whose writing was stopped."""
    held = Store.open(path)
    same = held.attrs.get("content") == attrs["content"] and held.shape == samples.shape
    if not same or not held.pending():
        what = "these samples already" if same else "other samples"
        message = (
            f"{path} holds {what}; nothing was changed. Give another path, or append to add these "
            "to those that are there"
        )
        raise StoreError(message)


def _extended(samples: Samples, path: Path, attrs: Mapping[str, Any]) -> tuple[Store, int]:
    """Return a store with room for more samples, and where they begin."""
    layout.check_appendable(path)
    held = Store.open(path)
    appended = list(held.attrs.get("appended", []))
    begun = bool(appended) and bool(held.pending()) and appended[-1]["content"] == attrs["content"]
    if held.shape[:3] != samples.shape[:3]:
        message = (
            f"{path} holds samples of shape (y, x, channel) = {held.shape[:3]}, those to append "
            f"have {samples.shape[:3]}"
        )
        raise InputError(message)
    if held.pending() and not begun:
        message = f"{path} is not complete: repeat first what was interrupted"
        raise StoreError(message)
    if held.counts() is not None or samples.counts is not None:
        message = (
            "samples can be appended where each pixel has as many as the others; import those of "
            "different numbers together"
        )
        raise InputError(message)
    length = sequence_of(held.attrs)
    if length != sequence_of(samples.attrs) or held.shape[3] % length:
        message = (
            f"{path} holds {held.shape[3]} samples in sequences of {length}, those to append are "
            f"in sequences of {sequence_of(samples.attrs)} (1: independent); save them to a store "
            "of their own"
        )
        raise InputError(message)
    if not begun:
        _check_other(held.attrs, appended, attrs, path)
        named = {k: attrs[k] for k in ("content", "seed", "scene_source") if k in attrs}
        appended.append({**named, "first": held.shape[3]})
    first = int(appended[-1]["first"])
    store = Store.open(path, writable=True)
    store.extend(first + samples.spp)
    store.update(appended=appended)
    return store, first


def _check_other(
    held: Mapping[str, Any],
    appended: list[dict[str, Any]],
    attrs: Mapping[str, Any],
    path: Path,
) -> None:
    """Refuse samples that are in a store already, or repeat its random numbers."""
    before = [held, *appended]
    if attrs["content"] in {a.get("content") for a in before}:
        message = f"{path} holds these samples already; nothing was changed"
        raise InputError(message)
    seed = attrs.get("seed")
    if seed is not None and seed in [a.get("seed") for a in before]:
        message = (
            f"{path} holds samples of seed {seed} already: these would repeat them, and make "
            "errors look smaller than they are. Render with another seed"
        )
        raise InputError(message)


def _fill(store: Store, samples: Samples, first: int, progress: bool | None) -> None:
    """Write the chunks that are missing, with the samples that begin at number `first`."""
    chunks = store.pending()
    by_frame = samples.source is not None and samples.source.frames
    if not by_frame:  # all samples of a pixel lie together: go through them tile by tile
        chunks.sort(key=lambda c: (c.tile_y, c.tile_x, c.batch))
    description, size = f"writing {store.path.name}", sum(c.size for c in chunks)
    with track(description, size, unit="S", show=progress) as advance:
        for chunk in chunks:
            store.write(chunk, _block(store, samples, first, chunk))
            advance(chunk.size)


def _block(store: Store, samples: Samples, first: int, chunk: Chunk) -> Image:
    """Return the samples of a chunk, of which the first may be in the store already."""
    start, stop = chunk.ss.start, chunk.ss.stop
    new = samples.read(chunk.ys, chunk.xs, slice(max(0, start - first), stop - first))
    if start >= first:
        return new
    return np.concatenate([store.read(chunk.ys, chunk.xs, slice(start, first)), new], axis=-1)
