"""Access to samples: open and inspect a store, and reduce an image tile by tile.

Use `Samples.map` where a function needs all samples of a pixel at once, `reduce_tiles` where it
does not: it walks each tile batch by batch, in constant memory.
"""

from __future__ import annotations

import functools
import hashlib
import json
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias, TypeGuard, Unpack, cast

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import LeftOut
from chdstat._core.files import exists, is_path, is_remote, place_of
from chdstat.errors import InputError, StoreError
from chdstat.samples.samples import Samples
from chdstat.samples.tiles import (
    DIRECT_DEPTH,
    Mapped,
    Part,
    Work,
    check_independent,
    check_single,
    over_tiles,
    tiles,
)
from chdstat.scenes.files import is_file

if TYPE_CHECKING:
    import xarray as xr

    from chdstat.samples.store import Store

__all__ = [
    "Blocks",
    "ImageLike",
    "cache_key",
    "check_equal_counts",
    "checkpoint_key",
    "inspect",
    "is_store",
    "of_store",
    "open",
    "opened",
    "reduce_tiles",
    "reopened",
    "samples_of",
]

Blocks = Iterator[npt.NDArray[np.float32]]
ImageLike: TypeAlias = Samples | str | Path
"""The samples of an image, or the path of the store that holds them."""


def is_store(source: object) -> TypeGuard[str | Path]:
    """Return whether something is the path of a store, damaged or not.

    Examples
    --------
    >>> is_store("cornell-box")
    False
    """
    if not is_path(source):
        return False
    manifests = [place_of(source) / name for name in ("zarr.json", "radiance/zarr.json")]
    return any(exists(file) if is_remote(file) else is_file(file) for file in manifests)


def open(path: str | Path) -> Samples:  # noqa: A001 - chdstat.open reads like open
    """Open a store of samples.

    A store that is still being rendered, or whose rendering was stopped, opens with the samples
    that every pixel has; ``attrs["spp"]`` says how many were asked for.

    Parameters
    ----------
    path
        The store, as written by `chdstat.render` or ``chdstat render``: a folder, or any URL that
        fsspec reaches, such as ``s3://bucket/room.zarr``.

    Raises
    ------
    StoreError
        If there is no store, it is damaged or of another schema, it holds no complete batch, or
        what lies in its folder ``direct`` is not of the same samples.
    """
    from chdstat.samples.store import Store

    store = Store.open(place_of(path))
    if not store.complete_spp():
        message = (
            f"{path} holds no sample that every pixel has: its rendering was stopped early. "
            "Run the same 'chdstat render' again to resume it"
        )
        raise StoreError(message)
    parts = store.parts().items()
    return of_store(store, {k: of_store(part) for k, part in parts if part.complete_spp()})


def of_store(store: Store, parts: Mapping[Part, Samples] | None = None) -> Samples:
    """Return the samples of an open store that every pixel has, and as many of their parts."""
    height, width, _, _ = store.shape
    part = range(height), range(width), range(store.complete_spp())
    spp = len(part[2])
    known = {
        which: found if found.spp <= spp else found.isel(sample=slice(spp))
        for which, found in (parts or {}).items()
    }
    return Samples(
        store,
        attrs=store.attrs,
        parts=known,
        part=part,
        path=store.path,
        counts=store.counts(),
    )


@functools.lru_cache(maxsize=8)
def reopened(path: Path, identity: str, complete: int, shape: tuple[int, ...]) -> Store:
    """Return a store in another process than that which sent its path; it is opened there once.

    Raises
    ------
    StoreError
        If this process does not see it, or sees another one.
    """
    from chdstat.samples.store import Store

    try:
        store = Store.open(path)
    except StoreError as error:
        message = f"a worker cannot read {path}, which all workers must see there: {error}"
        raise StoreError(message) from error
    _, own, done, size = store.place
    if own != identity or done < complete or size[3] < shape[3]:
        message = f"a worker sees another store at {path} than is read here"
        raise StoreError(message)
    return store


def cache_key(samples: Samples) -> str:
    """Return what identifies samples of a store, for a `Cache`; "" for samples in memory.

    All attributes of the store are in it: another render may take its place and name. The time that
    the render took is one of them.
    """
    if samples.path is None:
        return ""
    attrs = json.dumps(samples.attrs, sort_keys=True).encode()
    return f"{samples.path.stem}-{hashlib.sha256(attrs).hexdigest()[:12]}-{samples.spp}"


def checkpoint_key(samples: Samples) -> str:
    """Return what identifies any samples, those in memory by their content.

    Examples
    --------
    >>> one, two = (Samples.from_array(np.full((4, 4, 8), value)) for value in (1, 2))
    >>> checkpoint_key(one) == checkpoint_key(two), checkpoint_key(one) == checkpoint_key(one)
    (False, True)
    """
    source = samples.source
    known = [samples.attrs, samples.shape, str(samples.part), source and str(source.path)]
    digest = hashlib.sha256(json.dumps(known, sort_keys=True, default=str).encode())
    if source is None:
        digest.update(np.ascontiguousarray(samples.read()).data)
    return digest.hexdigest()[:16]


def inspect(path: str | Path, *, verify: bool = False) -> dict[str, Any]:
    """Return what a store holds, ready for JSON, whether it is finished or not.

    Parameters
    ----------
    path
        The store.
    verify
        Read everything and check its checksums; without it, that files are there and in their
        places. ``damaged`` lists those that fail.

    Raises
    ------
    StoreError
        If there is no store.
    """
    from chdstat.samples.store import Store

    store = Store.open(place_of(path))
    parts, counts = store.parts(), store.counts()
    height, width, channels, spp = store.shape
    files = [f for f in store.path.rglob("*") if f.is_file()]
    found = {
        **store.attrs,
        "path": str(store.path),
        "shape": {"y": height, "x": width, "channel": channels, "sample": spp},
        "complete_spp": store.complete_spp(),
        "pending_chunks": len(store.pending()),
        "direct_spp": parts[DIRECT_DEPTH].complete_spp() if DIRECT_DEPTH in parts else 0,
        "depths": {str(k): p.complete_spp() for k, p in parts.items() if isinstance(k, int)},
        "lights": {k: p.complete_spp() for k, p in parts.items() if isinstance(k, str)},
        "features": store.feature_names,
        "counts": None if counts is None else [int(counts.min()), int(counts.max())],
        "bytes": sum(f.stat().st_size for f in files),
    }
    damaged = store.damaged(content=verify)
    if verify or damaged:
        found["damaged"] = [str(file) for file in damaged]
    return found


def opened(x: ImageLike | npt.ArrayLike) -> Samples | npt.ArrayLike:
    """Return the samples of a store that is given by its path; everything else passes through."""
    return open(x) if is_path(x) else cast("Samples | npt.ArrayLike", x)


def samples_of(
    source: ImageLike | npt.ArrayLike, *, averages: bool = False, dependent: bool = False
) -> Samples:
    """Return the samples of an image, be they given as such, in an array or by a store's path.

    Raises
    ------
    InputError
        If it is none of these, or `Samples.from_array` refuses the array; or if it holds averages
        of batches, and the caller does not take `averages`, or samples that depend on each other,
        and it does not take `dependent` ones.
    StoreError
        If there is no store at the path, or `open` refuses it.
    """
    found = opened(source)
    if isinstance(found, Samples):
        if not averages:
            check_single(found)
        if not dependent:
            check_independent(found)
        return found
    if isinstance(found, np.ndarray) or type(found).__name__ == "DataArray":
        return Samples.from_array(found)
    message = (
        "expected Samples, an array (y, x, channel, sample) or the path of a store, "
        f"got {type(source).__name__}"
    )
    raise InputError(message)


def check_equal_counts(samples: Samples) -> None:
    """Refuse samples of which some pixels have more than others.

    Raises
    ------
    InputError
        If that is so; the message says how to go on.
    """
    if samples.counts is not None:
        fewest = int(samples.counts.min())
        message = (
            f"this needs as many samples in each pixel, {samples.name} has {fewest} to "
            f"{samples.spp}: use the first of each, samples.first({max(fewest, 1)}) or "
            f"--spp {max(fewest, 1)}"
        )
        raise InputError(message)


def reduce_tiles(
    samples: Samples,
    function: Callable[[Samples, Blocks], Mapped],
    *,
    description: str,
    **work: Unpack[Work],
) -> xr.Dataset:
    """Reduce the sample blocks of every tile and assemble the image.

    Parameters
    ----------
    samples
        The image.
    function
        Takes the samples of a tile and its blocks in stored order, each (y, x, channel, sample);
        returns, by variable name, the dims that follow (y, x) and an array (y, x, ...).
    description, **work
        As for `chdstat.samples.tiles.over_tiles`.

    Returns
    -------
    xarray.Dataset
        The variables over the whole image, with y, x and channel coordinates.
    """

    def of_tile(part: Samples, left_out: LeftOut) -> Mapped:
        def blocks() -> Blocks:
            for *place, block in part.blocks():
                left_out.see(block, channel_axis=-2, absent=part.absent(*place))
                yield block

        return function(part, blocks())

    places = tiles(samples.shape, streamed=True)
    return over_tiles(samples, of_tile, places, description=description, **work)
