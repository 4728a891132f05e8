"""Random numbers: which sampler draws them, and which of them each sample owns.

Samplers other than the independent one spread the samples of a pixel. They do so for a fixed number
of samples at a time, a sequence. Samples of one sequence depend on each other; stratified samples,
for example, lie in different cells of a grid. Sequences are independent, since each has its own
random numbers. A render of several sequences thus holds independent replications of one sequence's
estimate.

Mitsuba seeds its generators with 32-bit integers. Hashing (tile, batch, pass) into one integer
would repeat streams by the birthday rule, so every stream gets its own integer:

* scalar: a pass draws one sample for each of the 64 x 64 pixels of a tile. Pass ``p`` owns the
  streams ``4096 p`` to ``4096 p + 4095``. Passes are numbered by (sample, tile), and the numbers
  are shuffled. Mitsuba's scalar generator (PCG32) starts from its seed without hashing. For seeds
  that grow in equal steps, each of its dimensions would be an arithmetic progression in the state,
  which is too regular for chance: the variance of a mean of 1024 samples was a quarter off.
* llvm, cuda: one call draws a whole chunk. Each lane mixes the 32-bit number of the chunk with its
  lane index; chunks are numbered by (batch, tile).
* sequences of dependent samples: in scalar, one sequence for each pixel of a tile takes the numbers
  of a pass, from the last pass downwards. A wavefront of sequences takes as many numbers as it has
  lanes, since Mitsuba scrambles a sequence by the number plus the lane. There, the user's seed is a
  separate seed of the sampler.
* single pixels drawn on demand own the topmost 2^24 numbers, which none of the above reaches; they
  are permuted, too. In an image with more pixels, some share a stream.

A scalar image takes 2^12 of the 2^32 numbers for each sample of each tile. That is enough for 2048
spp at 1920 x 1080 pixels, and 512 spp at 3840 x 2160. A wavefront has 64 times the number of
chunks: billions.

The user's seed shuffles passes in another order. Two seeds share about spp / 10^6 of the samples of
a pixel. The seed shifts the numbers of chunks and of single pixels by a multiple of the golden
section of their range, which spreads small seeds evenly.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Literal, get_args

from chdstat._core.arrays import whole
from chdstat._core.numbering import mixed, number_of, permuted
from chdstat.errors import InputError, check_option
from chdstat.samples.tiles import BATCH, TILE, Chunk

SamplerName = Literal["independent", "stratified", "multijitter", "orthogonal", "ldsampler"]
"""Mitsuba's samplers whose samples can be kept one by one."""
_LENGTH = 16
"""Samples of a sequence by default."""
LONGEST = 1024
"""Longest sequence: more samples of a tile are too many for a wavefront."""
_PARTS = 4
"""Least number of sequences in a span, if sequences and the chunks of a store end in different
places: the sequences at the ends of a span are drawn twice."""


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
"""Lengths that a sampler takes as they are; Mitsuba rounds others up."""


@dataclass(frozen=True)
class Sequences:
    """The sampler of dependent samples, and the length of its sequences.

    Attributes
    ----------
    sampler
        Mitsuba's name of the sampler.
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
        check_option("sampler", sampler, names)
        if sampler == "independent":
            if length is not None:
                message = (
                    f"sequence is for samplers that spread samples ({', '.join(names[1:])}), got "
                    f"{length} with independent ones; leave it out, or name such a sampler"
                )
                raise InputError(message)
            return None
        length = whole("sequence", _LENGTH if length is None else length, least=2)
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
        """Samples of a pixel in one wavefront: a batch, or one sequence if that is longer."""
        return self.length * max(1, BATCH // self.length)

    @property
    def span(self) -> int:
        """Samples of a pixel to draw before they are cut into batches, a multiple of a batch."""
        batches = max(self.length, BATCH) / BATCH
        if BATCH % self.length and self.length % BATCH:
            batches = math.ceil(_PARTS * self.length / BATCH)
        return int(batches) * BATCH


def grouped(
    chunks: Iterable[Chunk], sequences: Sequences | None
) -> Iterator[tuple[Chunk, list[Chunk]]]:
    """Yield groups of chunks that are drawn together: one chunk that covers them, and each.

    Examples
    --------
    >>> from chdstat.samples.tiles import chunk_grid
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


# --- streams ------------------------------------------------------------------------------------

STREAMS = 2
"""Version of the numbering: samples of two versions are never mixed in a store."""
PIXELS = 2**24
"""Numbers reserved for single pixels, the topmost of the 2^32."""
PASSES = (2**32 - PIXELS) // TILE**2
"""Scalar passes that own streams."""
_SHUFFLED = (983_040, PASSES)
"""Ends of the ranges within which passes are shuffled. The first range was once all there was, so
that older renders continue as they began."""
CHUNKS = 2**31
"""Chunks that have a number for the wavefront."""
SEEDS = 2**31
"""Seeds for users: larger ones would repeat the numbers of smaller ones."""


@dataclass(frozen=True)
class Streams:
    """The numbering of one image: its (width, height) and the user's seed."""

    size: tuple[int, int]
    seed: int

    def of_pass(self, chunk: Chunk, sample: int) -> int:
        """Return the seed of the scalar pass that draws one sample for each pixel of a tile."""
        height, width, _ = chunk.shape
        return pass_seed(shuffled(self._index(sample, chunk), self.seed), width * height)

    def of_chunk(self, chunk: Chunk) -> int:
        """Return the number of a chunk that is drawn as one wavefront."""
        return number_of(self.seed, self._index(chunk.batch, chunk), CHUNKS)

    def of_sequence(self, chunk: Chunk, sequence: int) -> int:
        """Return the first number of a scalar sequence, which has one for each pixel of a tile."""
        return shuffled(PASSES - 1 - self._index(sequence, chunk), self.seed) * TILE**2

    def of_wavefront(self, chunk: Chunk, block: int, lanes: int) -> int:
        """Return the first number of a block of sequences of a tile, which has one for each lane.

        These numbers belong to a separate seed of the sampler, `of_sampler`.
        """
        return self._index(block, chunk) * lanes

    @property
    def of_sampler(self) -> int:
        """The seed of the sampler whose wavefronts `of_wavefront` numbers."""
        return mixed(self.seed) % 2**32

    def of_pixel(self, y: int, x: int) -> int:
        """Return the number of a pixel's own stream, apart from those of chunks."""
        index = y * self.size[0] + x
        number = number_of(self.seed, index, PIXELS)
        return 2**32 - PIXELS + permuted(number, 0, half=2**12)

    def of_training(self, number: int) -> int:
        """Return the number of a training's wavefront, which no sample owns."""
        return CHUNKS + number_of(self.seed, number, PIXELS)

    def _index(self, number: int, chunk: Chunk) -> int:
        """Return the index of a chunk's tile after `number` earlier rounds over the image."""
        across = -(-self.size[0] // TILE)
        return number * _tiles(*self.size) + chunk.tile_y * across + chunk.tile_x


def max_spp(backend: str, width: int, height: int, sequences: Sequences | None = None) -> int:
    """Return how many samples per pixel a backend can draw before random streams repeat."""
    tiles = _tiles(width, height)
    if sequences is not None:
        if backend == "scalar":
            return PASSES // tiles * sequences.length
        together = sequences.drawn_together
        return 2**32 // (TILE**2 * together) // tiles * together
    return PASSES // tiles if backend == "scalar" else CHUNKS // tiles * BATCH


def check_spp(
    backend: str, width: int, height: int, spp: int, sequences: Sequences | None = None
) -> None:
    """Refuse more samples per pixel than a backend has independent random streams for."""
    if sequences is not None:
        sequences.check(spp)
    most = max_spp(backend, width, height, sequences)
    if spp <= most:
        return
    message = (
        f"spp must be at most {most} for {width} x {height} pixels with the {backend} backend "
        f"(then its random streams repeat), got {spp}"
        if most
        else f"{width} x {height} pixels are more than the {backend} backend has random streams"
    )
    if backend == "scalar" and sequences is None:
        more = max_spp("llvm", width, height)
        message += f"; the llvm and cuda backends draw up to {more}, see: chdstat doctor"
    raise InputError(message)


def shuffled(index: int, seed: int) -> int:
    """Return the number of a scalar pass for a user's seed; one to one with `index`.

    It is a Feistel network of 20 bits, repeated until the number lies in its range (Black and
    Rogaway, "Ciphers with arbitrary finite domains", 2002, doi:10.1007/3-540-45760-7_9).

    Examples
    --------
    >>> [shuffled(i, seed=0) for i in range(3)], [shuffled(i, seed=1) for i in range(3)]
    ([550259, 112832, 199408], [195807, 282655, 269606])
    >>> shuffled(1_000_000, seed=0) >= 983_040
    True
    """
    number = index % PASSES
    first, last = (0, _SHUFFLED[0]) if number < _SHUFFLED[0] else _SHUFFLED
    while True:
        number = permuted(number, seed, half=2**10)
        if first <= number < last:
            return number


def pass_seed(number: int, pixels: int) -> int:
    """Return the seed that makes a scalar render use the streams 4096 n to 4096 n + 4095.

    Mitsuba multiplies the seed by the number of pixels of the film, modulo 2^32. A tile of 64 x 64
    has 2^12 pixels. Smaller tiles at the border have 2^v m pixels with v <= 12 and m odd, which is
    invertible.
    """
    power = (pixels & -pixels).bit_length() - 1
    modulus = 1 << (32 - power)
    inverse: int = pow(pixels >> power, -1, modulus)
    return (number * TILE * TILE >> power) * inverse % modulus


def _tiles(width: int, height: int) -> int:
    return -(-width // TILE) * -(-height // TILE)
