"""Regions: pixels of several parts of an image, side by side as a paper shows them.

`Samples.regions` makes them. Elek, Thomas and Forbes 2019 show the scenes of their case study this
way: the image with its regions, and the distribution of a pixel of each.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Self

import numpy as np

from chdstat._core.display import Card, Shown, Width, number, percent, with_interval
from chdstat.errors import InputError
from chdstat.patterns.classification import choose_regions, classify
from chdstat.patterns.pixel import Pixel
from chdstat.samples.samples import Samples
from chdstat.summary.histograms import Scale
from chdstat.summary.statistics import summarize

if TYPE_CHECKING:
    from matplotlib.figure import Figure


__all__ = ["Regions"]

_HALF = 2
"""Pixels around that of a region which are marked with it."""


@dataclass(frozen=True, repr=False)
class Regions(Shown):
    """Pixels of several regions of an image; `plot` draws them, `to_latex` is their table.

    Attributes
    ----------
    samples
        The image.
    pixels
        One pixel of each region, by its name.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> samples = Samples.from_array(rng.gamma(2.0, size=(8, 8, 1, 256)))
    >>> study = samples.regions({"wall": (2, 3), "floor": (6, 1)})
    >>> list(study.pixels), study.pixels["floor"].spp
    (['wall', 'floor'], 256)
    """

    samples: Samples
    pixels: Mapping[str, Pixel]
    _drawn: ClassVar[str] = "regions, and the histograms of their pixels"

    @classmethod
    def of(cls, samples: Samples, places: Mapping[str, tuple[int, int]] | None = None) -> Self:
        """Return the pixels at some places, or one for each pattern of the image.

        Raises
        ------
        InputError
            If there is no place.
        """
        if places is None:
            shape = samples.shape[:2]
            chosen = choose_regions(classify(samples))
            places = {region.name: region.center(*shape) for region in chosen}
        if not places:
            message = "expected at least one region, got none"
            raise InputError(message)
        return cls(samples, {name: samples.pixel(y, x) for name, (y, x) in places.items()})

    def plot(
        self,
        *,
        channels: str | Sequence[str] | None = None,
        scales: Scale | Sequence[Scale] = "log",
        width: Width = "page",
        fig: Figure | None = None,
    ) -> Figure:
        """Draw the image with its regions and the histograms of their pixels.

        Parameters
        ----------
        channels, scales, width, fig
            As for `Pixel.plot`; None takes luminance where it is known.
        """
        from chdstat import viz

        height, across = self.samples.shape[:2]
        marks = []
        for name, pixel in self.pixels.items():
            ys, xs = (
                slice(max(0, at - _HALF), min(size, at + _HALF + 1))
                for at, size in ((pixel.y, height), (pixel.x, across))
            )
            marks.append(viz.Mark(name, ys, xs, (pixel.y, pixel.x)))
        return viz.region_study(
            summarize(self.samples)["mean"].to_numpy(),
            marks,
            [pixel.panel(name) for name, pixel in self.pixels.items()],
            notes=[pixel.label for pixel in self.pixels.values()],
            channels=channels,
            scales=scales,
            width=width,
            fig=fig,
        )

    def _card(self) -> Card:
        rows = []
        for name, pixel in self.pixels.items():
            xi = pixel.tail.xi
            heaviest = int(np.nanargmax(xi)) if np.isfinite(xi).any() else 0
            mean = pixel.statistics["mean"].to_numpy()
            error = pixel.statistics["standard_error"].to_numpy()
            brightest = int(np.nanargmax(mean)) if np.isfinite(mean).any() else 0
            rows.append(
                {
                    "region": name,
                    "y, x": f"{pixel.y}, {pixel.x}",
                    "pattern": pixel.label or "—",
                    "nulls": percent(pixel.null_share),
                    "largest mean": f"{number(mean[brightest])} ± {number(error[brightest])}",
                    "best family": pixel.best_families or "—",
                    "largest tail index": with_interval(
                        xi[heaviest], *pixel.tail.interval[heaviest]
                    ),
                    "modes": str(int(pixel.modality.modes.max())),
                }
            )
        facts = {"samples": f"{self.samples.spp} per pixel"}
        return Card(f"Regions of {self.samples.name}", facts, rows)
