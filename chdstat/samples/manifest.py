"""Manifest of a store: what it holds, signed, in two files, and the ways these are read.

The manifest is the attribute of that name: shape, identity, the samples that every pixel is
known to have, the checksum of each feature, whether there is a direct part, and a checksum of all
attributes. A chunk among the samples that every pixel has is damaged if it is not there; any other
is not rendered yet, or counts by its label: a render that is killed at any moment repeats at most
the chunks that were in flight. The metadata of arrays follows from the manifest and is never
believed. The manifest lies in two files, so that damage to one of them loses nothing.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import zarr.errors

from chdstat._core.files import checksum, replacing
from chdstat.errors import StoreError

__all__ = [
    "FIRST_SCHEMA",
    "FOREIGN",
    "LOCK",
    "SCHEMA_VERSION",
    "DamageError",
    "WriteError",
    "attributes_of",
    "brief",
    "canonical",
    "check_free",
    "check_schema",
    "content_of",
    "identity",
    "incomplete",
    "listed",
    "loaded",
    "occupied",
    "put",
    "signed",
    "store_exists",
    "writing",
]

SCHEMA_VERSION = 2
FIRST_SCHEMA = 1
LOCK = ".lock"
_GROWING = ("spp", "render_seconds")
"""Attributes that change while samples are added; all others are the identity of a store."""
FOREIGN = (
    ArithmeticError,
    AssertionError,
    AttributeError,
    LookupError,
    OSError,
    RuntimeError,
    TypeError,
    ValueError,
    zarr.errors.BaseZarrError,
)
"""What damaged bytes may raise in the libraries that read them."""


class WriteError(StoreError):
    """The system does not let a store be written to."""


class DamageError(ValueError):
    """What is wrong with a file."""


def identity(attrs: Mapping[str, Any], shape: Sequence[int]) -> str:
    """Return the hash by which samples are known, whatever their number."""
    told = {k: v for k, v in attrs.items() if k not in _GROWING}
    return hashlib.blake2b(canonical([told, list(shape[:3])]), digest_size=8).hexdigest()


def signed(attributes: Mapping[str, Any]) -> dict[str, Any]:
    """Return attributes with their checksum in the manifest."""
    manifest = {k: v for k, v in attributes["manifest"].items() if k != "checksum"}
    told = {**attributes, "manifest": manifest}
    return {**told, "manifest": {**manifest, "checksum": checksum(canonical(told))}}


def canonical(value: Any) -> bytes:
    """Return JSON as bytes that are the same for equal values."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False).encode()


def attributes_of(path: Path) -> dict[str, Any]:
    """Return the attributes of a store, from the first of its two manifests that is sound."""
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
    if version == FIRST_SCHEMA:
        return dict(found[0])
    if version not in (None, SCHEMA_VERSION):
        message = (
            f"{path} has schema version {version}, this chdstat reads "
            f"{FIRST_SCHEMA} and {SCHEMA_VERSION}"
        )
        raise StoreError(message)
    raise incomplete(path, "zarr.json and its copy radiance/zarr.json are damaged or of others")


def check_schema(path: Path) -> None:
    """Refuse to write to a store of schema 1.

    Raises
    ------
    StoreError
        If it is one; the message says how to convert it.
    """
    attributes = attributes_of(path)
    if attributes["schema_version"] == FIRST_SCHEMA:
        name, source = (attributes.get(key) for key in ("scene", "scene_source"))
        scene = name if source in (None, "chdstat") else source
        message = (
            f"{path} is of schema {FIRST_SCHEMA}, which is only read; to append, convert it "
            f"first: chdstat convert {path} -o NEW --scene {scene}"
        )
        raise StoreError(message)


# --- files --------------------------------------------------------------------------------------


def loaded(file: Path) -> dict[str, Any] | None:
    """Return the JSON in a file; None if it is damaged."""
    content = content_of(file)
    if content is None:
        return None
    try:
        found = json.loads(content, parse_constant=_refuse)
    except (ValueError, RecursionError):
        return None
    return found if isinstance(found, dict) else None


def _refuse(constant: str) -> None:
    message = f"{constant} is no JSON"
    raise ValueError(message)


def content_of(file: Path) -> bytes | None:
    """Return the bytes in a file; None if it cannot be read."""
    try:
        return file.read_bytes()
    except OSError:
        return None


def listed(folder: Path) -> list[str]:
    """Return the names in a folder; none if it cannot be read."""
    try:
        return os.listdir(folder)  # noqa: PTH208 - names alone
    except OSError:
        return []


def put(file: Path, content: bytes) -> None:
    """Replace a file of a store, or a folder without files in its place."""
    file.parent.mkdir(parents=True, exist_ok=True)
    if file.is_dir():
        for folder in (*sorted(file.rglob("*"), reverse=True), file):
            folder.rmdir()
    with replacing(file) as partial:
        partial.write_bytes(content)


def store_exists(path: Path) -> bool:
    """Return whether there is, or was, a store at a path."""
    return any((path / name).exists() for name in ("zarr.json", "radiance/zarr.json"))


def check_free(path: Path) -> None:
    """Refuse a folder with anything in it but what a killed maker of a store leaves."""
    if store_exists(path):
        message = f"{path} was made by another process just now; run the command again to go on"
        raise StoreError(message)
    for name in listed(path):
        if name != LOCK and not (name.startswith(".zarr.") and ".partial" in name):
            raise occupied(path)


def occupied(path: Path) -> StoreError:
    """Return the error for a folder that holds something else."""
    return StoreError(
        f"{path} exists and is not a chdstat store; nothing was overwritten. "
        "Give another path or move it away"
    )


def incomplete(path: Path, why: str) -> StoreError:
    """Return the error for a folder that is no whole store."""
    return StoreError(f"{path} is not a complete chdstat store ({why})")


@contextlib.contextmanager
def writing(path: Path) -> Iterator[None]:
    """Turn what the system says of a disk into what a user can do."""
    try:
        yield
    except OSError as error:
        message = (
            f"cannot write to {path}: {error.strerror or error}. "
            "What is stored is kept; run the same command again to resume"
        )
        raise WriteError(message) from error


def brief(error: BaseException) -> str:
    """Return in one line what is wrong."""
    said = str(error).splitlines()[0] if str(error) else "no detail"
    return said if isinstance(error, DamageError) else f"{type(error).__name__}: {said}"
