"""Passes: images of one sample of every pixel, and what draws them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple, Protocol

from chdstat._core.arrays import Image
from chdstat._core.numbering import number_of, permuted
from chdstat.samples.tiles import LightPart

_HALF = 2**15


class DrawnPass(NamedTuple):
    """One sample of every pixel.

    Attributes
    ----------
    image
        Linear radiance, shape (y, x, channel).
    features
        First-hit features by name: albedo, normal and position, shape (y, x, 3); depth, (y, x).
    parts
        Parts of the same samples, each as `image`: `chdstat.samples.tiles.DIRECT_DEPTH` is emission
        and direct light; a name is what one light or group of lights adds.
    """

    image: Image
    features: Mapping[str, Image] = {}
    parts: Mapping[LightPart, Image] = {}


class PassSource(Protocol):
    """A renderer with a scene, which draws passes.

    It can be sent to other processes, where it starts its renderer again.
    """

    @property
    def name(self) -> str:
        """Name of the scene."""

    @property
    def attrs(self) -> Mapping[str, Any]:
        """Provenance, ready for JSON: all that samples depend on, apart from seeds."""

    def __call__(self, seed: int) -> DrawnPass:
        """Draw one sample of every pixel. Equal seeds need not give equal samples."""

    def close(self) -> None:
        """Stop the renderer."""


def seed_of_pass(seed: int, number: int) -> int:
    """Return the seed below 2^30 that draws a pass; one to one with its number.

    Seeds of consecutive passes have nothing in common, as a weak generator may need. Those of two
    user's seeds differ, unless the seeds are far apart or there are millions of passes.

    Examples
    --------
    >>> [seed_of_pass(0, number) for number in range(3)]
    [632626252, 458925464, 523402588]
    """
    return permuted(number_of(seed, number, _HALF**2), 0, half=_HALF)
