"""Settings of a render: a job made of them, checked before any work is done."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from chdstat._core.arrays import Seed, seed_number, whole
from chdstat._core.executor import memory
from chdstat._core.files import free_disk
from chdstat.errors import InputError
from chdstat.rendering.backend import Backend, resolve
from chdstat.rendering.renderer import Job, Renderer, film_size, integrator_type
from chdstat.rendering.seeds import SEEDS, max_spp
from chdstat.scenes import Scene, load_scene
from chdstat.scenes.settings import LONGEST

__all__ = [
    "check_room",
    "check_streams",
    "job_of",
    "refuse_render",
    "scene_integrator",
    "scene_size",
]

_MOST_COMPRESSION = 10
"""Stores shrink to between a third and nine tenths; a tenth leaves room for darker scenes."""


def job_of(
    scene: str | Path | dict[str, Any] | Scene,
    backend: Backend,
    size: tuple[int, int] | None,
    seed: Seed,
    max_depth: int | None,
    sensor: int = 0,
) -> Job:
    """Return a job whose settings are checked, so that no work is done for wrong ones."""
    if size is not None:
        pair = isinstance(size, Sequence) and len(size) == 2
        if not pair:
            message = f"size must be (width, height) in pixels, got {size!r}"
            raise InputError(message)
        size = whole("width", size[0], least=1), whole("height", size[1], least=1)
        if max(size) > LONGEST:
            message = f"width and height must be at most {LONGEST} pixels, got {max(size):.4g}"
            raise InputError(message)
    if max_depth is not None:
        max_depth = whole("max_depth", max_depth, least=-1)
        if max_depth == 0:
            message = "max_depth must be at least 1 segment, or -1 for no limit, got 0"
            raise InputError(message)
    seed = seed_number(seed, span=SEEDS)
    if seed >= SEEDS:
        message = f"seed must be below 2^31, the most that give samples of their own, got {seed}"
        raise InputError(message)
    sensor = whole("sensor", sensor, least=0)
    return Job(load_scene(scene), resolve(backend), size, seed, max_depth, sensor)


def check_streams(job: Job, renderer: Renderer, spp: int) -> None:
    """Refuse more samples than there are independent random streams for."""
    backend = job.verdict.backend
    most = max_spp(backend, *renderer.size)
    if spp <= most:
        return
    width, height = renderer.size
    message = (
        f"spp must be at most {most} for {width} x {height} pixels with the {backend} backend "
        f"(then its random streams repeat), got {spp}"
        if most
        else f"{width} x {height} pixels are more than the {backend} backend has random streams"
    )
    if backend == "scalar":
        more = max_spp("llvm", width, height)
        message += f"; the llvm and cuda backends draw up to {more}, see: chdstat doctor"
    raise InputError(message)


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


def scene_size(scene: str | Path | dict[str, Any] | Scene) -> tuple[int, int]:
    """Return the (width, height) in pixels that a scene's own film has.

    Examples
    --------
    >>> from chdstat.rendering.jobs import scene_size
    >>> scene_size("cornell-box")
    (256, 256)
    """
    return film_size(Job(load_scene(scene), resolve("scalar")))


def scene_integrator(scene: str | Path | dict[str, Any] | Scene) -> str:
    """Return Mitsuba's name of the integrator that a scene asks for.

    Examples
    --------
    >>> from chdstat.rendering.jobs import scene_integrator
    >>> scene_integrator("fog")
    'volpath'
    """
    return integrator_type(Job(load_scene(scene), resolve("scalar")))


def refuse_render(source: object, settings: Mapping[str, Any]) -> None:
    """Refuse settings of a render, by name, where samples are there already.

    What is None, and the backend "auto", was not asked for.

    Raises
    ------
    InputError
        If any was.
    """
    asked = [name for name, value in settings.items() if value not in (None, "auto")]
    if asked:
        message = (
            f"{', '.join(asked)}: a setting of a render, but {source} holds finished samples; "
            "leave it out, or give the scene"
        )
        raise InputError(message)
