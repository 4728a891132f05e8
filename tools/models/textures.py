"""Image textures for the built-in scenes, in NumPy alone.

Every texture is linear RGB, shape (height, width, 3), float32, and the same on every call; all but
`panes` and `gradient` repeat seamlessly.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Image = npt.NDArray[np.float32]
Color = Sequence[float]


def wood(
    dark: Color, light: Color, *, size: tuple[int, int] = (256, 512), rings: int = 9, seed: int = 0
) -> Image:
    """Return wood between two colours, its grain along the width.

    Parameters
    ----------
    dark, light
        Linear RGB of late and early wood.
    size
        Height and width in pixels.
    rings
        How many year rings the height crosses.
    seed
        Which board.
    """
    rng = np.random.default_rng(seed)
    height = np.arange(size[0])[:, None] / size[0]
    wave = _noise(rng, size, (3, 2)) + 0.35 * _noise(rng, size, (8, 5))
    phase = rings * height + 1.3 * wave
    ring = (phase - np.floor(phase)) ** 1.6
    # The sharp jump from one ring to the next, softened over a tenth of a ring.
    ring = ring * np.clip((1 - (phase - np.floor(phase))) / 0.1, 0, 1)
    fibre = _noise(rng, size, (128, 4)) + 0.5 * _noise(rng, size, (64, 16))
    tone = np.clip(0.75 - 0.55 * ring + 0.22 * fibre, 0, 1)
    return _mix(dark, light, tone)


def planks(
    dark: Color, light: Color, *, rows: int = 6, size: tuple[int, int] = (512, 512), seed: int = 0
) -> Image:
    """Return floor boards of `wood` along the width, `rows` of them over the height."""
    rng = np.random.default_rng(seed)
    edges = np.linspace(0, size[0], rows + 1).astype(int)
    boards = []
    for row, high in enumerate(np.diff(edges).tolist()):
        grain = wood(dark, light, size=(high, size[1]), rings=3, seed=seed + row + 1)
        along = np.arange(size[1]) + int(rng.random() * size[1])
        tint = (0.78 + 0.36 * rng.random(2))[along // (size[1] // 2) % 2]
        joint = np.where((np.arange(high)[:, None] < 2) | (along % (size[1] // 2) < 2), 0.35, 1.0)
        boards.append(grain * (tint * joint)[..., None])
    return _stored(np.concatenate(boards))


def tile_colors(
    rows: Sequence[Color], *, columns: int, spread: float = 0.06, seed: int = 0
) -> Image:
    """Return one pixel per tile: a colour per row, each tile a little lighter or darker."""
    rng = np.random.default_rng(seed)
    base = np.repeat(np.asarray(rows, dtype=float)[:, None], columns, axis=1)
    return _stored(base * (1 + spread * (2 * rng.random((len(rows), columns, 1)) - 1)))


def bands(ground: Color, stripe: Color, *, edges: Sequence[tuple[float, float]]) -> Image:
    """Return a cloth with stripes between the given fractions of its height."""
    height = (np.arange(128) + 0.5) / 128
    inside = np.any([(height >= low) & (height < high) for low, high in edges], axis=0)
    weave = 1 - 0.12 * (np.indices((128, 32)).sum(axis=0) % 2)
    return _stored(_mix(ground, stripe, inside[:, None] * np.ones((1, 32))) * weave[..., None])


def panes(colors: Sequence[Sequence[Color]]) -> Image:
    """Return one pixel per pane of a grid of colours, the first row at v = 0."""
    return _stored(np.asarray(colors, dtype=float))


def checks(dark: Color, light: Color, *, rows: int, columns: int) -> Image:
    """Return a chessboard of one pixel per field that starts with a dark one."""
    odd = np.indices((rows, columns)).sum(axis=0) % 2
    return _mix(dark, light, odd.astype(float))


def gradient(stops: Sequence[tuple[float, Color]], *, rows: int = 64) -> Image:
    """Return a column of colours between (position, colour) stops, the first row at v = 0."""
    place = (np.arange(rows) + 0.5) / rows
    at = [position for position, _ in stops]
    channels = np.asarray([color for _, color in stops], dtype=float).T
    column = np.stack([np.interp(place, at, channel) for channel in channels], axis=-1)
    return _stored(np.repeat(column[:, None], 2, axis=1))


def _mix(first: Color, second: Color, share: Array) -> Image:
    a, b = np.asarray(first, dtype=float), np.asarray(second, dtype=float)
    return _stored(a + (b - a) * share[..., None])


def _stored(image: npt.NDArray[np.floating[Any]]) -> Image:
    """Round to a grid far finer than can be seen.

    A last-bit difference between two machines' mathematics then does not change the identity of
    the scene.
    """
    return np.asarray(np.round(np.clip(image, 0, 1) * 4096) / 4096, dtype=np.float32)


def _noise(rng: np.random.Generator, size: tuple[int, int], cells: tuple[int, int]) -> Array:
    """Return seamless value noise in [-1, 1]: a lattice of random numbers, smoothly joined."""
    lattice = 2 * rng.random(cells) - 1
    rows, columns = (_along(n, c) for n, c in zip(size, cells, strict=True))
    return np.asarray(rows @ lattice @ columns.T)


def _along(length: int, cells: int) -> Array:
    """Return the weights of `cells` lattice points at `length` pixels, shape (length, cells)."""
    position = np.arange(length) * cells / length
    low = np.floor(position).astype(int)
    t = position - low
    t = t * t * (3 - 2 * t)
    weights = np.zeros((length, cells))
    weights[np.arange(length), low % cells] += 1 - t
    weights[np.arange(length), (low + 1) % cells] += t
    return weights
