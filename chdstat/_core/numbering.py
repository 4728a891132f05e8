"""Numbering: integers that random numbers start from, none of them twice.

Hashing (seed, index) into one integer would repeat streams by the birthday rule. These functions
are one to one.
"""

from __future__ import annotations

import math

_TURNS = 6
"""How often the halves of a number are swapped while it is permuted."""
_WORD = 2**64 - 1
_GOLDEN = (math.sqrt(5) - 1) / 2


def number_of(seed: int, index: int, span: int) -> int:
    """Return the number of a block of streams for a user's seed; one to one with `index`.

    Seeds begin a multiple of the golden section of the span apart, which spreads small ones evenly.

    Examples
    --------
    >>> number_of(0, 5, 2**20), number_of(1, 5, 2**20)
    (5, 648061)
    """
    return (index + seed * round(_GOLDEN * span)) % span


def permuted(number: int, seed: int, *, half: int) -> int:
    """Return another number below `half` squared; one to one.

    It is a Feistel network (Black and Rogaway, "Ciphers with arbitrary finite domains", 2002,
    doi:10.1007/3-540-45760-7_9).

    Examples
    --------
    >>> sorted(permuted(n, 0, half=2) for n in range(4))
    [0, 1, 2, 3]
    """
    left, right = divmod(number, half)
    for turn in range(_TURNS):
        left, right = right, left ^ mixed(right + half * (turn + _TURNS * seed)) % half
    return left * half + right


def mixed(number: int) -> int:
    """Return 64 bits that all depend on all bits of a number.

    Steele, Lea and Flood, "Fast splittable pseudorandom number generators", 2014,
    doi:10.1145/2714064.2660195.
    """
    z = (number + 1) * 0x9E3779B97F4A7C15 & _WORD
    z = (z ^ z >> 30) * 0xBF58476D1CE4E5B9 & _WORD
    z = (z ^ z >> 27) * 0x94D049BB133111EB & _WORD
    return z ^ z >> 31
