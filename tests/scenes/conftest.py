"""Rendering for tests of the scenes: Mitsuba itself, without `render`."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np
import pytest

from chdstat.scenes import Scene

Sampler = Callable[..., np.ndarray]


@pytest.fixture
def draw() -> Iterator[Sampler]:
    """Draw samples of a scene dict, shape (y, x, channel, sample), one render per sample."""
    import mitsuba as mi

    before = mi.variant()
    mi.set_variant("scalar_rgb")
    yield _draw
    if before is not None:
        mi.set_variant(before)


def _draw(
    description: Mapping[str, Any], *, size: int, spp: int, crop: tuple[int, ...] | None = None
) -> np.ndarray:
    import mitsuba as mi

    film = {**description["sensor"]["film"], "width": size, "height": size}
    if crop is not None:
        names = ("crop_offset_x", "crop_offset_y", "crop_width", "crop_height")
        left, top, right, bottom = crop
        film |= dict(zip(names, (left, top, right - left, bottom - top), strict=True))
    sensor = {**description["sensor"], "film": film}
    scene = Scene("test", {**description, "sensor": sensor}).load()
    passes = [np.array(mi.render(scene, seed=seed, spp=1)) for seed in range(spp)]
    return np.stack(passes, axis=-1)[:, :, :3]
