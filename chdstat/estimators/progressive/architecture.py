"""Shape: what a network of the progressive estimator looks at, and how large it is."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

from chdstat.estimators.progressive.auxiliary import BANDS, RADII
from chdstat.estimators.progressive.profile import OCTAVES

__all__ = ["GROUPS", "LEVELS", "LOSSES", "MOST_TRUST", "Architecture"]

LOSSES = ("mse", "relmse")
"""What the answers of a network minimise."""
LEVELS = tuple(range(-8, 5, 2))
"""Levels of the mean, in octaves of the unit, that networks are trusted at."""
GROUPS = 2 * len(LEVELS)
"""Groups of pixels that a network is trusted in: of each level, brightened and darkened ones."""
MOST_TRUST = 1.5
"""Share of a move at most: beyond 1 where others are held back and the image would lose light."""


@dataclass(frozen=True)
class Architecture:
    """What a network looks at, and how large it is.

    Attributes
    ----------
    channels
        Channels of a sample.
    described
        Numbers that describe the first hit; 0 without features.
    neighbours
        Whether it looks at its surroundings and at what alike pixels say.
    parts
        Of a sample that it sees apart: 2 for direct and indirect light.
    width, layers
        Neurons of a hidden layer, and how many of these there are.
    """

    channels: int
    described: int = 0
    neighbours: bool = False
    parts: int = 1
    width: int = 128
    layers: int = 3

    @property
    def octaves(self) -> int:
        """Octaves of all parts."""
        return OCTAVES * self.parts

    @property
    def pools(self) -> int:
        """Windows around a pixel that it looks at."""
        return len(RADII) if self.neighbours else 0

    @property
    def inputs(self) -> int:
        """Numbers that go in."""
        own = self.octaves * (1 + self.channels) + 1
        around = self.pools * (BANDS * (1 + self.channels) + 1)
        return own + self.described + around + self.channels * self.neighbours

    @property
    def outputs(self) -> int:
        """Numbers that come out for each aim: weights, offsets, and the worth of the experience."""
        return self.octaves + self.channels + 1 + self.pools * BANDS + int(self.neighbours)

    def to_dict(self) -> dict[str, Any]:
        """Return the fields, ready for JSON."""
        return asdict(self)
