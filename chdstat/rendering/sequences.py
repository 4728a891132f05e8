"""Sequences: samplers that spread the samples of a pixel, so many of them at a time.

Samples of one sequence depend on each other: stratified ones, say, lie in different cells of a
grid. Sequences do not: each has random numbers of its own, so that a render of several sequences
holds independent replications of the estimate that one of them gives.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal, get_args

from chdstat._core.arrays import whole
from chdstat.errors import InputError
from chdstat.samples.tiles import BATCH, Chunk

__all__ = ["SamplerName", "Sequences", "grouped"]

SamplerName = Literal["independent", "stratified", "multijitter", "orthogonal", "ldsampler"]
"""Mitsuba's samplers of which samples can be kept one by one."""
LENGTH = 16
"""Samples of a sequence, unless told."""
LONGEST = 1024
"""More samples of a tile at once are more than a wavefront should have."""
_PARTS = 4
"""Sequences that a span holds, at least, where they and the chunks of a store end in different
places: those at its ends are drawn twice."""


def _is_square(n: int) -> bool:
    return math.isqrt(n) ** 2 == n


_FITS: dict[str, tuple[Callable[[int], bool], str]] = {
    "stratified": (_is_square, "a square"),
    "multijitter": (lambda n: n % math.isqrt(n) == 0, "a full grid"),
    "orthogonal": (
        lambda n: _is_square(n) and all(math.isqrt(n) % i for i in range(2, math.isqrt(n))),
        "the square of a prime",
    ),
    "ldsampler": (lambda n: _is_square(n) and n & (n - 1) == 0, "a power of 4"),
}
"""Which lengths a sampler takes as they are; Mitsuba rounds others up."""


@dataclass(frozen=True)
class Sequences:
    """The sampler of dependent samples, and how many of them make a sequence.

    Attributes
    ----------
    sampler
        Mitsuba's name of it.
    length
        Samples of a pixel in one sequence.

    Examples
    --------
    >>> Sequences.of("stratified", 16).drawn_together
    64
    """

    sampler: str
    length: int

    @classmethod
    def of(cls, sampler: str, length: int | None = None) -> Sequences | None:
        """Return the sequences that are asked for; None for independent samples.

        Raises
        ------
        InputError
            If there is no such sampler, or it would round the length.
        """
        names = get_args(SamplerName)
        if sampler not in names:
            message = f"sampler must be one of {', '.join(names)}, got {sampler!r}"
            raise InputError(message)
        if sampler == "independent":
            if length is not None:
                message = (
                    f"sequence is of samplers that spread samples ({', '.join(names[1:])}), got "
                    f"{length} with independent ones; leave it out, or name such a sampler"
                )
                raise InputError(message)
            return None
        length = whole("sequence", LENGTH if length is None else length, least=2)
        fits, kind = _FITS[sampler]
        if length > LONGEST or not fits(length):
            below = (n for n in range(min(length, LONGEST + 1) - 1, 1, -1) if fits(n))
            above = (n for n in range(length + 1, LONGEST + 1) if fits(n))
            near = [next(below, None), next(above, None)]
            message = (
                f"sequence must be {kind}, at most {LONGEST}, with sampler {sampler!r}, got "
                f"{length}; next to it are {' and '.join(str(n) for n in near if n)}"
            )
            raise InputError(message)
        return cls(sampler, length)

    def check(self, spp: int) -> None:
        """Refuse a number of samples that does not end with a sequence.

        Raises
        ------
        InputError
            If it does not.
        """
        if rest := spp % self.length:
            near = [n for n in (spp - rest, spp - rest + self.length) if n]
            message = (
                f"spp must be a multiple of {self.length}, the samples of a sequence of "
                f"{self.sampler!r}, got {spp}; next to it are {' and '.join(map(str, near))}"
            )
            raise InputError(message)

    @property
    def drawn_together(self) -> int:
        """Samples of a pixel in one wavefront: a batch at most, unless a sequence is longer."""
        return self.length * max(1, BATCH // self.length)

    @property
    def span(self) -> int:
        """Samples of a pixel to draw before they are cut into batches, a multiple of a batch."""
        batches = max(self.length, BATCH) / BATCH
        if BATCH % self.length and self.length % BATCH:
            batches = math.ceil(_PARTS * self.length / BATCH)
        return int(batches) * BATCH


def grouped(
    chunks: Sequence[Chunk], sequences: Sequences | None
) -> Iterator[tuple[Chunk, list[Chunk]]]:
    """Yield chunks that are drawn together, as one and each by itself.

    Examples
    --------
    >>> from chdstat.samples.layout import chunk_grid
    >>> groups = grouped(list(chunk_grid(8, 8, 512)), Sequences("ldsampler", 256))
    >>> [(together.ss, len(parts)) for together, parts in groups]
    [(slice(0, 256, None), 4), (slice(256, 512, None), 4)]
    """
    if sequences is None:
        yield from ((chunk, [chunk]) for chunk in chunks)
        return

    def place(chunk: Chunk) -> tuple[int, int, int]:
        return chunk.ss.start // sequences.span, chunk.tile_y, chunk.tile_x

    for _, group in itertools.groupby(sorted(chunks, key=place), place):
        parts = sorted(group, key=lambda chunk: chunk.ss.start)
        ends = slice(parts[0].ss.start, parts[-1].ss.stop)
        yield replace(parts[0], ss=ends), parts
