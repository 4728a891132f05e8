"""Layout of a store: where a chunk lies in the zarr v3 group, and what its file holds.

The group::

    zarr.json           provenance, and the manifest of everything below
    radiance/zarr.json  (y, x, channel, sample), float32; once more the manifest
    radiance/c/Y/X/0/B  a chunk: the tile of pixels in row Y and column X, the batch B of samples
    features/           albedo, normal, position (y, x, component); depth (y, x); and, where the
                        pixels have different numbers of samples, counts (y, x), or density (y, x)
                        from which these follow: what lies beyond them in radiance is NaN; and,
                        where samples were timed, costs (y, x, 3): how many, mean, sum of squares
    direct/             a store of its own: emission and direct light of the same samples
    depth-3/            likewise the same samples, their paths cut after three segments; and so on
    film/               likewise where in its pixel each sample fell, (y, x, 2, sample), uint8: 16
                        steps across and 16 down; 255 where there is no sample
    .lock               while a process writes

A chunk is a tile of 64 x 64 pixels times a batch of 64 samples: one file, which is always replaced
as a whole. It is a shard of zarr, with blocks of 16 x 16 pixels that are compressed separately,
each with a checksum. Zarr thus reads a single pixel without its tile (1024 spp in 19 ms of
processor time). The file ends in a *label*, which zarr ignores. The label holds the identity of the
store, the place of the chunk, its number of samples of each pixel (in an adaptive render, of all
its pixels together), and the checksum of everything before it. A reader checks the label first. A
file in the wrong place, or an older file in place of a newer one, is thus refused. Two stores with
one identity hold equal chunks, since samples depend on nothing else.

A store may lie behind a URL. All it needs there is to replace, read and list small files by name.
Only `replacing` renames, no folder is moved, and nothing is appended. Behind a URL, one request
writes a chunk, and there is no lock.

The *manifest* is the attribute of that name. It holds the shape, the identity, the number of
samples that every pixel is known to have, the checksum of each feature, whether there is a direct
part, and a checksum of all attributes. A chunk of samples that every pixel has is damaged if it is
missing. Any other chunk is not rendered yet, or counts by its label. A render that is killed at any
moment thus repeats at most the chunks in flight. The metadata of arrays follows from the manifest;
the content of their files is not used. The manifest lies in two files, so that damage to one of
them loses nothing.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import re
import struct
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeGuard

from chdstat._core.files import (
    checksum,
    exists,
    is_file,
    is_path,
    is_remote,
    place_of,
    replacing,
    tail,
)
from chdstat.errors import StoreError
from chdstat.samples.film_steps import NO_STEP
from chdstat.samples.tiles import BATCH, DIRECT_DEPTH, FILM, TILE, Chunk, LightPart

BLOCK = 16
"""Edge in pixels of the blocks that are compressed separately within a chunk."""
COUNTS = "counts"
"""Feature with the number of samples of each pixel, if they differ."""
DENSITY = "density"
"""Feature of an adaptive render: samples of each pixel over the mean; counts follow from it."""
GUIDE = ("guide-cells", "guide-chances")
"""Features that hold the guide by which directions were drawn."""
FORMER_GUIDE = "guide-leaves"
"""Feature of the guide of earlier versions, by which no directions can be drawn any more."""
SCHEMA_VERSION = 2
LOCK = ".lock"
FOREIGN = (
    ArithmeticError,
    AssertionError,
    AttributeError,
    LookupError,
    OSError,
    RuntimeError,
    TypeError,
    ValueError,
)
"""Errors that damaged bytes may raise in the libraries that read them."""
_FILM, _DIRECT, _DEPTH, _LIGHT = "film", "direct", "depth-", "light-"
_GROWING = ("spp", "noise", "error", "render_seconds", "appended", "why_no_features")
"""Attributes that change while samples are added; all others identify the store."""
_LABEL = struct.Struct("<8s8s4IQII")
"""Mark, identity, tile_y, tile_x, batch, samples, length and checksum of the bytes before it, and
the checksum of the label itself."""
_MARK = b"chdstat2"
_LITTLE = {"name": "bytes", "configuration": {"endian": "little"}}
_CRC = {"name": "crc32c"}


class DamageError(ValueError):
    """Describes what is wrong with a file."""


def is_store(source: object) -> TypeGuard[str | Path]:
    """Return whether a source is the path of a store, damaged or not.

    Examples
    --------
    >>> is_store("cornell-box")
    False
    """
    if not is_path(source):
        return False
    manifests = [place_of(source) / name for name in ("zarr.json", "radiance/zarr.json")]
    return any(exists(file) if is_remote(file) else is_file(file) for file in manifests)


def differing(one: Mapping[str, Any], two: Mapping[str, Any]) -> list[str]:
    """Return the names whose values differ.

    Examples
    --------
    >>> differing({"seed": 1, "size": 8}, {"seed": 2, "size": 8})
    ['seed']
    """
    return [name for name in {**one, **two} if one.get(name) != two.get(name)]


def part_folder(part: LightPart) -> str:
    """Return the folder of a part of the light, within its store."""
    if isinstance(part, int):
        return {FILM: _FILM, DIRECT_DEPTH: _DIRECT}.get(part, f"{_DEPTH}{part}")
    plain, digest = re.sub(r"[^\w-]+", "_", part)[:32], hashlib.sha256(part.encode()).hexdigest()
    return f"{_LIGHT}{plain}-{digest[:8]}"


def parts_in(path: Path, manifest: Mapping[str, Any]) -> list[LightPart]:
    """Return the parts that a store has, or should have by its manifest, depths first."""
    depths = {FILM} if manifest.get("film") or is_store(path / _FILM) else set()
    depths |= {DIRECT_DEPTH} if manifest["direct"] or is_store(path / _DIRECT) else set()
    for folder in path.glob(f"{_DEPTH}*"):
        number = folder.name.removeprefix(_DEPTH)
        depths |= {int(number)} if number.isdecimal() and is_store(folder) else set()
    lights = {attributes_of(f).get("light") for f in path.glob(f"{_LIGHT}*") if is_store(f)}
    return [
        *sorted(depths | set(manifest.get("depths", []))),
        *sorted(map(str, (lights - {None}) | set(manifest.get("lights", [])))),
    ]


def with_parts(manifest: Mapping[str, Any], parts: Iterable[LightPart]) -> dict[str, Any]:
    """Return a manifest that also lists parts."""
    made = dict(manifest)
    for part in parts:
        if part in (FILM, DIRECT_DEPTH):
            made["film" if part == FILM else "direct"] = True
        else:
            kind = "depths" if isinstance(part, int) else "lights"
            made[kind] = sorted({*made.get(kind, []), part})
    return made


def feature_file(name: str, shape: Sequence[int]) -> str:
    """Return the file that holds a first-hit feature, within the store."""
    return f"features/{name}/c" + "/0" * len(shape)


# --- labels -------------------------------------------------------------------------------------


def labelled(content: bytes, identity: str, chunk: Chunk, samples: int) -> bytes:
    """Return the content of a chunk's file: the encoded samples, followed by their label."""
    about = *chunk.index, samples, len(content), checksum(content)
    label = _LABEL.pack(_MARK, bytes.fromhex(identity), *about, 0)[:-4]
    return content + label + checksum(label).to_bytes(4, "little")


def read_label(file: Path, identity: str, chunk: Chunk) -> tuple[int, int, int]:
    """Return the number of samples, the length and the checksum in the label of a chunk's file."""
    try:
        label, length = tail(file, _LABEL.size)
    except OSError as error:
        raise DamageError(brief(error)) from error
    mark, held, y, x, batch, samples, told, content, own = _LABEL.unpack(label)
    if mark != _MARK or own != checksum(label[:-4]) or told != length:
        message = "it is cut off or overwritten"
        raise DamageError(message)
    if held.hex() != identity:
        message = "it is of other samples"
        raise DamageError(message)
    if (y, x, batch) != chunk.index:
        message = f"it is the chunk of tile ({y}, {x}), batch {batch}"
        raise DamageError(message)
    return samples, length, content


# --- metadata of zarr ---------------------------------------------------------------------------


def group_metadata(attributes: Mapping[str, Any]) -> dict[str, Any]:
    """Return the metadata of a group."""
    return {"zarr_format": 3, "node_type": "group", "attributes": dict(attributes)}


def radiance_metadata(shape: Sequence[int], attributes: Mapping[str, Any]) -> dict[str, Any]:
    """Return the metadata of the samples."""
    # Paths that end alike give equal numbers: unshuffled, zstd finds them (a fifth smaller).
    blosc = {"cname": "zstd", "clevel": 1, "shuffle": "noshuffle", "typesize": 4, "blocksize": 0}
    shard = {
        "chunk_shape": [BLOCK, BLOCK, shape[2], BATCH],
        "codecs": [_LITTLE, {"name": "blosc", "configuration": blosc}, _CRC],
        "index_codecs": [_LITTLE, _CRC],
        "index_location": "start",
    }
    codecs = [{"name": "sharding_indexed", "configuration": shard}]
    names = ["y", "x", "channel", "sample"]
    return _array_metadata(shape, [TILE, TILE, shape[2], BATCH], codecs, names, attributes)


def film_metadata(shape: Sequence[int], attributes: Mapping[str, Any]) -> dict[str, Any]:
    """Return the metadata of the places in their pixels where samples fell.

    They are random numbers, which zstd packs without their unused bits, fastest in large blocks.
    """
    made = radiance_metadata(shape, attributes)
    shard = made["codecs"][0]["configuration"]
    blosc = {**shard["codecs"][1]["configuration"], "typesize": 1}
    shard["chunk_shape"] = [TILE, TILE, shape[2], BATCH]
    shard["codecs"] = [{"name": "bytes"}, {"name": "blosc", "configuration": blosc}, _CRC]
    return {**made, "data_type": "uint8", "fill_value": NO_STEP}


def feature_metadata(shape: Sequence[int]) -> dict[str, Any]:
    """Return the metadata of a first-hit feature."""
    zstd = {"name": "zstd", "configuration": {"level": 0, "checksum": False}}
    names = ["y", "x", "component"][: len(shape)]
    return _array_metadata(shape, list(shape), [_LITTLE, zstd], names, {})


def _array_metadata(
    shape: Sequence[int],
    chunk: Sequence[int],
    codecs: list[dict[str, Any]],
    names: list[str],
    attributes: Mapping[str, Any],
) -> dict[str, Any]:
    """Return the content of an array's zarr.json; see https://zarr-specs.readthedocs.io v3."""
    return {
        "zarr_format": 3,
        "node_type": "array",
        "shape": list(shape),
        "data_type": "float32",
        "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": list(chunk)}},
        "chunk_key_encoding": {"name": "default", "configuration": {"separator": "/"}},
        "fill_value": "NaN",
        "codecs": codecs,
        "attributes": dict(attributes),
        "dimension_names": names,
        "storage_transformers": [],
    }


def array(store: Any, name: str, metadata: Any) -> Any:
    """Return an array with known metadata, without reading its own metadata file."""
    import zarr
    from zarr.storage import StorePath

    # A chunk of NaN only is a result; unless told so at each opening, zarr drops it.
    with zarr.config.set({"array.write_empty_chunks": True}):
        return zarr.Array(zarr.AsyncArray(metadata, StorePath(store, name)))


# --- manifest -----------------------------------------------------------------------------------


def identity(attrs: Mapping[str, Any], shape: Sequence[int]) -> str:
    """Return the hash that identifies samples, whatever their number."""
    told = {k: v for k, v in attrs.items() if k not in _GROWING}
    return hashlib.blake2b(canonical([told, list(shape[:3])]), digest_size=8).hexdigest()


_FREE = (
    *(*_GROWING, "scene", "scene_source", "notes", "chdstat_version", "schema_version"),
    *("repeats", "code", "feature_passes"),
)
"""Attributes that need not agree before samples are added to a store; all others must."""


def check_same(path: Path, held: Mapping[str, Any], attrs: Mapping[str, Any]) -> None:
    """Refuse to mix samples of two scenes, seeds or settings in one store.

    Parameters
    ----------
    path, held
        The store, and its attributes.
    attrs
        Attributes of the samples to be added.

    Raises
    ------
    StoreError
        If the samples differ in more than their number; the message says in what.
    """
    stored, asked = ({n: v for n, v in of.items() if n not in _FREE} for of in (held, attrs))
    if names := differing(stored, asked):
        why = _changed(held, attrs)
        why += [
            f"{name}: stored {stored.get(name)}, asked for {asked.get(name)}"
            for name in names
            if name != "scene_hash" and name not in _CHANGES
        ]
        one, other = held.get("scene"), attrs.get("scene")
        if one != other:
            why = [f"of the scene {one}, not {other}"]
        elif not why:
            why = [f"of another version of the scene {one}"]
        message = (
            f"{path} holds other samples ({'; '.join(why)}). Nothing was "
            "changed; give another output path, or the same settings to resume or append"
        )
        raise StoreError(message)


_CHANGES = {"scene_files": "files", "scene_code": "code of plugins", "plugins": "plugins"}
"""Attributes that hold names: a message lists the names that differ, under this heading."""


def _changed(held: Mapping[str, Any], attrs: Mapping[str, Any]) -> list[str]:
    """Return which files and plugins of a scene differ from those of a store."""
    parts = []
    for key, word in _CHANGES.items():
        if names := sorted(differing(held.get(key) or {}, attrs.get(key) or {})):
            more = f" and {len(names) - 5} more" if len(names) > 5 else ""
            parts.append(f"changed {word}: {', '.join(names[:5])}{more}")
    return parts


def signed(attributes: Mapping[str, Any]) -> dict[str, Any]:
    """Return attributes with their checksum in the manifest."""
    manifest = {k: v for k, v in attributes["manifest"].items() if k != "checksum"}
    told = {**attributes, "manifest": manifest}
    return {**told, "manifest": {**manifest, "checksum": checksum(canonical(told))}}


def canonical(value: Any) -> bytes:
    """Return JSON as bytes; equal values give equal bytes."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False).encode()


def attributes_of(path: Path) -> dict[str, Any]:
    """Return the attributes of a store, from the first sound one of its two manifests."""
    if path.is_file():
        message = (
            f"{path} is a file; a store is a folder, as 'chdstat render' writes it. Make one of "
            f"samples of another renderer with: chdstat import {path} -o {path.stem}.zarr"
        )
        raise StoreError(message)
    found = []
    for name in ("zarr.json", "radiance/zarr.json"):
        attributes: Any = (loaded(path / name) or {}).get("attributes")
        try:
            if attributes["schema_version"] == SCHEMA_VERSION and signed(attributes) == attributes:
                return dict(attributes)
        except FOREIGN:
            pass
        found.append(attributes)
    version = found[0].get("schema_version") if isinstance(found[0], dict) else None
    if version in (None, SCHEMA_VERSION):
        why = "both zarr.json and its copy radiance/zarr.json are damaged"
        if not exists(path / "radiance"):
            why = (
                f"it holds no samples; 'chdstat explore STORE --maps {path}' shows maps, and "
                f"'chdstat import {path} -o OUT' takes arrays of samples"
            )
        raise incomplete(path, why)
    message = f"{path} has schema version {version}, this chdstat reads {SCHEMA_VERSION}"
    raise StoreError(message)


# --- files --------------------------------------------------------------------------------------


def loaded(file: Path) -> dict[str, Any] | None:
    """Return the JSON in a file; None if it is damaged."""
    try:
        found = json.loads(file.read_bytes(), parse_constant=_refuse)
    except (OSError, ValueError, RecursionError):
        return None
    return found if isinstance(found, dict) else None


def _refuse(constant: str) -> None:
    message = f"{constant} is no JSON"
    raise ValueError(message)


def put(file: Path, content: bytes) -> None:
    """Replace a file of a store, or an empty folder in its place."""
    if not is_remote(file):
        file.parent.mkdir(parents=True, exist_ok=True)
        if file.is_dir():
            for folder in (*sorted(file.rglob("*"), reverse=True), file):
                folder.rmdir()
    with replacing(file) as partial:
        partial.write_bytes(content)


def check_free(path: Path) -> None:
    """Refuse a folder with other content than a killed maker of a store leaves."""
    if is_store(path):
        message = f"{path} was made by another process just now; run the command again to go on"
        raise StoreError(message)
    for name in [file.name for file in path.iterdir()] if path.is_dir() else []:
        if name != LOCK and not (name.startswith(".zarr.") and ".partial" in name):
            raise occupied(path)


def occupied(path: Path) -> StoreError:
    """Return the error for a folder that holds something else."""
    return StoreError(
        f"{path} exists and is not a chdstat store; nothing was overwritten. "
        "Give another path or move it away"
    )


def incomplete(path: Path, why: str) -> StoreError:
    """Return the error for a folder that is not a whole store."""
    return StoreError(f"{path} is not a complete chdstat store ({why})")


@contextlib.contextmanager
def disk_errors(path: Path) -> Iterator[None]:
    """Turn the system's errors about a disk into advice for the user."""
    try:
        yield
    except NotImplementedError as error:
        message = f"cannot write to {path}: stores behind such URLs can only be read"
        raise StoreError(message) from error
    except OSError as error:
        message = f"cannot write to {path}: {error.strerror or error}"
        if is_store(path):
            message += ". What is stored is kept; run the same command again to resume"
        raise StoreError(message) from error


def brief(error: BaseException) -> str:
    """Return in one line what is wrong."""
    said = str(error).splitlines()[0] if str(error) else "no detail"
    return said if isinstance(error, DamageError) else f"{type(error).__name__}: {said}"
