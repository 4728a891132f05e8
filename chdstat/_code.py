"""Code: what tells this code and its libraries from others, as what they found is kept."""

from __future__ import annotations

import functools
import hashlib
import importlib.metadata
from pathlib import Path

__all__ = ["code_digest"]

_LIBRARIES = ("numpy", "scipy", "scikit-learn", "statsmodels", "diptest", "torch", "pyoidn")
"""Whose numbers are kept; without the last one, a denoiser, some are missing."""


@functools.cache
def code_digest() -> str:
    """Return a digest of all code that numbers rest on: what other code computed is not read."""
    digest = hashlib.sha256(repr([_version(name) for name in _LIBRARIES]).encode())
    package = Path(__file__).parent
    for path in sorted(package.rglob("*.py")):
        digest.update(path.relative_to(package).as_posix().encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()[:12]


def _version(library: str) -> str:
    try:
        return importlib.metadata.version(library)
    except importlib.metadata.PackageNotFoundError:
        return ""
