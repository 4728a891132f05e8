"""The machine: its memory and disk, so that hopeless work is refused before it starts."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

__all__ = ["free_disk", "memory"]


def memory() -> int | None:
    """Return the memory of the machine, or of the container, in bytes; None where none tells."""
    try:
        total = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (ValueError, OSError, AttributeError):
        return None
    limit = _container_limit()
    return total if limit is None else min(limit, total)


def free_disk(path: Path) -> int | None:
    """Return the free bytes of the disk that a path, which need not exist yet, would be on.

    None where there is no disk, as in /proc: whoever writes there learns what is wrong.
    """
    existing = next(p for p in (path.absolute(), *path.absolute().parents) if p.exists())
    usage = shutil.disk_usage(existing)
    return usage.free if usage.total else None


def _container_limit() -> int | None:
    try:
        text = Path("/sys/fs/cgroup/memory.max").read_text().strip()
    except OSError:
        return None
    return int(text) if text.isdecimal() else None
