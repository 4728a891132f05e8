"""Dependence: samples that are not independent of each other, in sequences or repeated.

Samplers that spread the samples of a pixel draw them in sequences. Samples of one sequence depend
on each other; averages of sequences are independent. A renderer that ignores its seed repeats
samples.

**How repeats are found.** Passes are compared in tiles of 16 x 16 pixels. Two tiles that are equal
to the bit are suspicious if independent passes would hardly ever be equal. If a share p of all
passes has the value of a pixel, chance repeats a tile with a probability of the product of p over
its pixels. Pixels that are black or the same in every pass, such as those of lamps, thus count for
nothing. A tile that is the same in every pass is suspicious if its neighbouring pixels differ as
noise does. In large images, all tiles are compared for a few passes, and some tiles for all passes.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Image, spans, warn_caller
from chdstat.errors import InputError
from chdstat.samples.tiles import TILE


def sequence_of(attrs: Mapping[str, Any]) -> int:
    """Return how many samples of a pixel depend on each other; 1 if they are independent.

    Examples
    --------
    >>> sequence_of({"sampler": "stratified", "sequence": 16}), sequence_of({})
    (16, 1)
    """
    return int(attrs.get("sequence") or 1)


def check_single(attrs: Mapping[str, Any]) -> None:
    """Raise InputError if these are averages of batches where single samples are needed."""
    averaged = int(attrs.get("averaged", 1))
    if averaged > 1:
        message = (
            f"expected single samples, got averages of {averaged}, which have another "
            "distribution; summarize and contrast take them"
        )
        raise InputError(message)


def check_distribution(spp: int) -> None:
    """Raise InputError if no pixel has two samples, which is the least that can differ."""
    if spp < 2:
        message = (
            f"expected at least 2 samples per pixel, got {spp}: one sample tells nothing "
            "about a distribution; render more, or import the single samples of a pixel, such as "
            "one file for each pass"
        )
        raise InputError(message)


def check_independent(attrs: Mapping[str, Any]) -> None:
    """Raise InputError if samples depend on each other; the message says how to go on."""
    length = sequence_of(attrs)
    if length > 1:
        named = f"the {attrs['sampler']} sampler" if "sampler" in attrs else "a sampler"
        message = (
            f"expected independent samples, got those of {named}, which spreads {length} at a time "
            "over a pixel: summarize and contrast take them, by the averages of these sequences, "
            "which samples.sequence_means() returns; for anything else, render with the "
            "independent sampler"
        )
        raise InputError(message)


def check_sequences(attrs: Mapping[str, Any], places: range) -> None:
    """Raise InputError if dependent samples begin within a sequence, or some are left out."""
    length = sequence_of(attrs)
    if length > 1 and (places.start % length or places.step != 1):
        message = (
            f"expected whole sequences of {length} samples, got each {places.step} from number "
            f"{places.start} on: begin at a multiple of {length}, without a step"
        )
        raise InputError(message)


# --- repeats ------------------------------------------------------------------------------------

_EDGE, _STEP = 16, 4
"""Edge in pixels of the tiles that are compared, and distance of the pixels compared first."""
_MOST = 2**23
"""Most values that are read: once for few passes and once for all."""
_FEW, _GROUPS = 8, 64
"""Passes compared in all tiles, and most groups of equal passes that are judged in each."""
_SURPRISE = 20.0
"""Equal passes are no accident if the log probability, corrected for all pairs and tiles, is below
minus this."""
_NEIGHBOURS, _ROUGH = 8, 0.5
"""Fewest pairs of neighbours that tell how much neighbours differ; and the least share of the
difference between passes elsewhere that is like noise."""
_ENOUGH, _NAMED = 256, 4
"""Tiles that tell how much passes differ, and most passes that a message names."""
_ODD = np.uint64(0x9E3779B97F4A7C15)

Read = Callable[[slice, slice, slice], Image]
_Hashes = npt.NDArray[np.uint64]


class _Tile(NamedTuple):
    """Equal passes in a tile.

    `surprise` is minus the log probability that they are equal by chance. `rough` is how much
    pixels differ from their neighbours. `always` is whether all passes are equal.
    """

    y: int
    x: int
    equal: tuple[int, ...]
    surprise: float
    rough: float
    always: bool


def warn_of_repeats(
    read: Read, shape: tuple[int, int, int, int], name: str, passes: Sequence[str] = ()
) -> None:
    """Warn the caller of the library if passes repeat each other, see `repeats_in`."""
    if message := repeats_in(read, shape, passes):
        warn_caller(f"{name}: {message}")


def repeats_in(read: Read, shape: tuple[int, int, int, int], passes: Sequence[str] = ()) -> str:
    """Return in words if passes repeat each other, as a whole or in tiles; "" if they do not.

    Parameters
    ----------
    read
        Returns the samples of rows, columns and passes, shape (y, x, channel, sample).
    shape
        Shape of all samples.
    passes
        Names of the passes, if they have names.
    """
    height, width, channels, spp = shape
    for edge, number in ((TILE, spp), (_EDGE, spp), (TILE, min(spp, _FEW))):
        places = [*itertools.product(spans(height, edge), spans(width, edge))]
        most = max(_MOST // (channels * number * edge**2), 1)
        if spp < 2 or (edge == TILE and number == spp and most < len(places)):
            continue  # too many values: some of the tiles are next
        chosen = np.linspace(0, len(places) - 1, min(most, len(places))).astype(int)
        found = _Repeats.of(read, [places[i] for i in chosen], number)
        message = found.message([*passes] or [f"pass {i}" for i in range(spp)])
        if message or edge == TILE:
            return message
    return ""


class _Repeats(NamedTuple):
    """Which passes are equal, as far as some tiles of the image show.

    `looked` is the number of tiles; `tiles` are those with equal passes; `whole` is a hash of each
    pass; `noise` is how much passes differ where they do, NaN if unknown.
    """

    looked: int
    tiles: list[_Tile]
    whole: _Hashes
    noise: float

    @classmethod
    def of(cls, read: Read, places: Sequence[tuple[slice, slice]], number: int) -> _Repeats:
        """Compare the passes."""
        whole: _Hashes = np.zeros(number, np.uint64)
        tiles, noise, looked = list[_Tile](), list[float](), 0
        for ys, xs in places:
            block = read(ys, xs, slice(number))
            hashes = _hashes(block[::_STEP, ::_STEP], _EDGE // _STEP)
            repeated = (np.diff(np.sort(hashes, axis=-1), axis=-1) == 0).any(axis=-1)
            for row, column in np.ndindex(repeated.shape):
                of_tile, y, x = hashes[row, column], _EDGE * row, _EDGE * column
                whole = whole * _ODD + of_tile
                tile = block[y : y + _EDGE, x : x + _EDGE]
                if repeated[row, column]:
                    tiles += _verdict(tile, ys.start + y, xs.start + x)
                if len(noise) < _ENOUGH and (other := int((of_tile != of_tile[0]).argmax())):
                    differ = (tile[..., 0] != tile[..., other]).any(axis=2)
                    noise.append(_difference(tile[differ, :, 0], tile[differ, :, other]))
            looked += repeated.size
        known = [value for value in noise if value > 0]
        return cls(looked, tiles, whole, float(np.median(known)) if known else np.nan)

    def message(self, passes: Sequence[str]) -> str:
        """Return a message about passes with these names, "" if there is nothing to say."""
        number = len(self.whole)
        if (self.whole == self.whole[0]).all() and all(tile.always for tile in self.tiles):
            rough = [tile.rough for tile in self.tiles if not np.isnan(tile.rough)]
            if not rough or np.median(rough) == 0:
                return ""
            return (
                f"all {number} passes that were compared are equal, {passes[0]} to "
                f"{passes[number - 1]}. Unless nothing in the image is random, the renderer "
                f"ignored its seed, or one file was copied: {_ADVICE}"
            )
        least = _SURPRISE + np.log(self.looked * number**2)
        # Where passes differ, roughness may be that of things; only their surprise counts.
        sure = [
            t
            for t in self.tiles
            if t.surprise > least or (t.always and t.rough >= _ROUGH * self.noise)
        ]
        surely = {number for tile in sure for number in tile.equal}
        _, firsts, of_hash = np.unique(self.whole, return_index=True, return_inverse=True)
        first = firsts[of_hash].tolist()
        copies = {i: first[i] for i in surely if first[i] < i and first[i] in surely}
        if copies:
            named = [f"{passes[copy]} of {passes[first]}" for copy, first in sorted(copies.items())]
            more = ["..."] * (len(named) > _NAMED)
            return (
                f"copies among {number} passes that were compared ({len(copies)}: "
                f"{', '.join([*named[:_NAMED], *more])}). Leave them out: {_ADVICE}"
            )
        if not sure:
            return ""
        tile, count = sure[0], len({(tile.y, tile.x) for tile in sure})
        return (
            f"passes are equal in {count} of {self.looked} tiles of {_EDGE} x {_EDGE} pixels, "
            f"such as {passes[tile.equal[0]]} and {passes[tile.equal[1]]} in that at y = {tile.y}, "
            f"x = {tile.x}. Unless nothing is random there, the renderer repeats its random "
            f"numbers: {_ADVICE}"
        )


_ADVICE = (
    "errors look smaller than they are where samples repeat each other. Each pass needs a seed of "
    "its own"
)


def _hashes(block: Image, edge: int) -> _Hashes:
    """Return a hash of each pass in each tile, shape (row, column, sample)."""
    height, width, channels, _ = block.shape
    weights = np.random.default_rng(1).integers(2**64, size=(edge, edge, channels), dtype="u8")
    repeats = -(-height // edge), -(-width // edge), 1
    weights = np.tile(weights | np.uint64(1), repeats)[:height, :width, :, np.newaxis]
    weighted = np.ascontiguousarray(block).view(np.uint32) * weights
    of_pixels = weighted.sum(axis=2)
    rows = np.add.reduceat(of_pixels, np.arange(0, height, edge), axis=0)
    return np.asarray(np.add.reduceat(rows, np.arange(0, width, edge), axis=1))


def _verdict(tile: Image, y: int, x: int) -> Iterator[_Tile]:
    """Judge the groups of equal passes in a tile, unless they are black."""
    lit = (np.isfinite(tile) & (tile != 0)).any(axis=2)
    if not lit.any():
        return
    hashes = _hashes(tile, _EDGE)[0, 0]
    values, counts = np.unique(hashes, return_counts=True)
    for value in values[np.argsort(-counts)][:_GROUPS]:
        equal = np.flatnonzero(hashes == value)
        image, kept = tile[..., equal[0]], lit[..., equal[0]]
        if len(equal) < 2 or not kept.any():
            continue
        same = (tile[kept] == image[kept][..., np.newaxis]) | np.isnan(image[kept])[..., np.newaxis]
        share = same.all(axis=1).mean(axis=-1)
        rough = _roughness(image)
        equals = tuple(map(int, equal))
        yield _Tile(y, x, equals, float(-np.log(share).sum()), rough, len(values) == 1)


def _roughness(image: Image) -> float:
    """Return how much pixels differ from the mean of those on both sides: 0 for smooth shading."""
    middle, around = (
        np.concatenate([x.reshape(-1, image.shape[2]) for x in of_both])
        for of_both in (
            (image[1:-1], image[:, 1:-1]),
            ((image[:-2] + image[2:]) / 2, (image[:, :-2] + image[:, 2:]) / 2),
        )
    )
    return _difference(middle, around)


def _difference(one: Image, other: Image) -> float:
    """Return the median relative difference of pixels (..., channel) that are not both black."""
    a, b = (np.nan_to_num(image, posinf=0, neginf=0).sum(axis=-1) for image in (one, other))
    size = np.abs(a) + np.abs(b)
    if np.count_nonzero(size) < _NEIGHBOURS:
        return np.nan
    return float(np.median(np.abs(a - b)[size > 0] / size[size > 0]))
