"""PixelFits: the positive part of some rows of samples, and what fits, tails and modes say of it.

What analyses several of these at once takes them from here: each is found once, when first asked
for, and what needs another of them gets it.
"""

from __future__ import annotations

from functools import cached_property

from chdstat._core.arrays import Result, take_rows
from chdstat._core.positive import PositivePart
from chdstat.fit.families import FAMILIES
from chdstat.fit.results import Mixture
from chdstat.fit.selection import SELECTED, Selection, select_part
from chdstat.fit.tail import Tail, tail_of_part
from chdstat.inference import Modality, mixture_and_modes_of_part
from chdstat.patterns.classification import Patterns, Thresholds, patterns_of_part

__all__ = ["PixelFits"]


class PixelFits:
    """What fits say of the channels of some pixels, and of their luminance as the last row.

    Parameters
    ----------
    part
        Positive part of the rows, shape (..., row, sample), as `PositivePart.of_pixels` makes it
        with ``rows="both"``.
    held_out
        Compare the families by held-out likelihood, too.

    Examples
    --------
    >>> import numpy as np
    >>> x = np.random.default_rng(0).gamma(2.0, size=(3, 512))
    >>> found = PixelFits(PositivePart.of_pixels(x, rows="both"))
    >>> found.selection.best.shape, found.of_luminance(found.tail).xi.shape
    ((4,), ())
    """

    def __init__(self, part: PositivePart, *, held_out: bool = False) -> None:
        self.part = part
        self._held_out = held_out
        self._axis = part.n.ndim - 1

    @cached_property
    def selection(self) -> Selection:
        """The families and which of them is best, of each row."""
        families = [FAMILIES[name] for name in SELECTED]
        return select_part(self.part, families, held_out=self._held_out)

    @cached_property
    def tail(self) -> Tail:
        """Tail of each row."""
        return tail_of_part(self.part)

    @cached_property
    def _mixture_and_modes(self) -> tuple[Mixture, Modality]:
        return mixture_and_modes_of_part(self.part, fits=self.selection.fits.values())

    @property
    def mixture(self) -> Mixture:
        """The log-normal mixture behind the modes, of each row."""
        return self._mixture_and_modes[0]

    @property
    def modes(self) -> Modality:
        """Modes of each row."""
        return self._mixture_and_modes[1]

    def patterns(self, thresholds: Thresholds | None = None) -> Patterns:
        """Return the patterns of luminance, each pixel tested for itself."""
        return patterns_of_part(
            self.of_luminance(self.part),
            thresholds,
            tail=self.of_luminance(self.tail),
            modes=self.of_luminance(self.modes),
            families=self.of_luminance(self.selection),
        )

    def of_luminance(self, result: Result) -> Result:
        """Return what a result says of luminance."""
        return take_rows(result, -1, axis=self._axis)

    def of_first(self, result: Result, rows: int) -> Result:
        """Return what a result says of the first rows, the channels."""
        return take_rows(result, slice(0, rows), axis=self._axis)
