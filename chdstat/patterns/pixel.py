"""Pixels: the characteristic distributions (CHDs) of pixels, and everything known about them.

`Samples.pixel` makes a `Pixel`, which computes everything on demand. `Samples.regions` makes
`Regions`: pixels of several parts of an image, side by side as Elek, Thomas and Forbes 2019 show
the scenes of their case study.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import is_bad, is_null, luminance
from chdstat._core.display import Card, Shown, Width, number, percent, with_interval
from chdstat._core.doors import draw, pixel_of, regions_of
from chdstat.errors import InputError
from chdstat.fit.families import FAMILIES, Fit
from chdstat.fit.mixtures import mixture
from chdstat.fit.selection import FEWEST_SHOWN, Selection, select
from chdstat.fit.tail import Tail, tail_index
from chdstat.inference.modes import Modality, modality
from chdstat.patterns.attribution import By, by_part, groups_of, part_names, shares
from chdstat.patterns.classification import Label, Patterns, choose_regions, classify
from chdstat.patterns.definitions import PATTERNS
from chdstat.samples.dependence import check_sequences, sequence_of
from chdstat.samples.samples import Samples
from chdstat.samples.tiles import LightPart
from chdstat.summary.histograms import Histogram, Scale, histogram
from chdstat.summary.statistics import summarize

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.figure import Figure


@dataclass(frozen=True, repr=False)
class Pixel(Shown):
    """The samples of one pixel, and their distribution.

    Attributes
    ----------
    y, x
        Row and column.
    radiance
        Linear radiance, shape (channel, sample), float32.
    channels
        Names of the channels.
    scene
        Name of the scene.
    parts
        Radiance of the same samples with a part of their light: by segments if they were rendered
        with ``by_depth=``, by names of lights if with ``by_light=``.
    sequence
        Number of samples that depend on each other; 1 if they are independent.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> radiance = rng.lognormal(size=(4, 6, 3, 256)) * (rng.random((4, 6, 1, 256)) < 0.25)
    >>> pixel = Samples.from_array(radiance).pixel(2, 3)
    >>> pixel.null.shape, round(pixel.null_share, 2), pixel.families["R"], pixel.patterns_shown
    ((256,), 0.76, 'lognormal', ('null_heavy', 'lognormal_like'))
    >>> pixel.tail.xi.shape, pixel.modality.modes.tolist()
    ((3,), [1, 1, 1])
    """

    y: int
    x: int
    radiance: npt.NDArray[np.float32]
    channels: tuple[str, ...]
    scene: str
    parts: Mapping[LightPart, npt.NDArray[np.float32]] = field(default_factory=dict)
    sequence: int = 1
    _drawn: ClassVar[str] = "histograms, best fits and means"

    @classmethod
    def of(cls, samples: Samples, y: int, x: int) -> Self:
        """Return a pixel of an image; negative places count from the end."""
        height, width = samples.shape[:2]
        radiance = samples[y, x]
        check_sequences(samples)
        parts = {which: part[y, x] for which, part in samples.parts.items()}
        length = sequence_of(samples.attrs)
        place = y % height, x % width
        return cls(*place, radiance, samples.channels, samples.name, parts, length)

    @property
    def spp(self) -> int:
        """Samples of the pixel."""
        return int(self.radiance.shape[-1])

    @property
    def null(self) -> npt.NDArray[np.bool_]:
        """Null samples: paths that found no light, shape (sample,)."""
        return is_null(self.radiance)

    @property
    def bad(self) -> npt.NDArray[np.bool_]:
        """Samples with a channel that is NaN or infinite, shape (sample,)."""
        return np.asarray(is_bad(self.radiance).any(axis=0))

    @property
    def null_share(self) -> float:
        """Share of nulls among the good samples; NaN where none is good."""
        good = ~self.bad
        return float(self.null[good].mean()) if good.any() else np.nan

    @cached_property
    def statistics(self) -> xr.Dataset:
        """Result of `chdstat.summarize` for the pixel: means, moments, counts, by channel."""
        image = Samples(self.radiance[np.newaxis, np.newaxis], attrs={"sequence": self.sequence})
        dataset = summarize(image, progress=False)
        return dataset.assign_coords(channel=np.array(self.channels, object)).isel(y=0, x=0)

    def histogram(self, scale: Scale = "log") -> Histogram:
        """Return the histogram of each channel, see `chdstat.histogram`."""
        return histogram(self.radiance, scale=scale, null=self.null, bad=self.bad)

    @cached_property
    def selection(self) -> Selection:
        """Families fitted to each channel, and the best one by BIC."""
        return select(self._good, null=self.null)

    @property
    def families(self) -> dict[str, str]:
        """Name of the best family, by the name of the channel; "" where none could be fitted."""
        return dict(zip(self.channels, map(str, self.selection.names), strict=True))

    @cached_property
    def tail(self) -> Tail:
        """Tail index of each channel, and whether the variance can be trusted."""
        return tail_index(self._good, null=self.null)

    @cached_property
    def modality(self) -> Modality:
        """Modes of each channel in log radiance."""
        return modality(self._good, null=self.null)

    @cached_property
    def patterns(self) -> Patterns:
        """Patterns of the luminance, tested for this pixel, not for an image; 1 or 3 channels."""
        return classify(self.radiance)

    @property
    def label(self) -> str:
        """Label in words; "" if there are neither 1 nor 3 channels."""
        return Label(int(self.patterns.label)).words if len(self.channels) in (1, 3) else ""

    @property
    def best_families(self) -> str:
        """Families that describe the channels best, in words; "" where none could be fitted."""
        named = dict.fromkeys(FAMILIES[name].label for name in self.families.values() if name)
        return " / ".join(named)

    @property
    def patterns_shown(self) -> tuple[str, ...]:
        """Names of the patterns that the pixel shows."""
        return tuple(p.name for p in PATTERNS if bool(self.patterns.flags[p.name]))

    @cached_property
    def light(self) -> list[dict[str, str | float]]:
        """Path lengths that make the mean, the variance, each mode and the tail.

        Each of these has a row with its share of the samples and, by name, the share of each path
        length in its luminance, or in the variance. The list is empty if the samples were not
        rendered by depth. A sample belongs to the mode that is nearest in log radiance. The tail
        begins where its fit does.
        """
        return self._shares("depth")

    @cached_property
    def lights(self) -> list[dict[str, str | float]]:
        """Lights that make them, as `light`; empty if samples were not rendered by light."""
        return self._shares("light")

    def _shares(self, by: By) -> list[dict[str, str | float]]:
        kind = int if by == "depth" else str
        known = {which: part for which, part in self.parts.items() if isinstance(which, kind)}
        if not known or len(self.channels) not in (1, 3):
            return []
        spp = min(part.shape[-1] for part in known.values())
        light = by_part([part[:, :spp] for part in (*known.values(), self.radiance)], by=by)
        total = np.nan_to_num(light.sum(axis=0))
        names, (mean, variance, _) = part_names(list(known)), shares(light)
        of_luminance = modality(total, null=self.null[:spp])
        places = [float(p) for p in of_luminance.places if np.isfinite(p)]
        threshold = float(tail_index(total, null=self.null[:spp]).threshold)
        rows = [("mean", 1.0, mean), ("variance", 1.0, variance)]
        found: list[dict[str, str | float]] = []
        for name, members in groups_of(total, self.null[:spp], places, threshold).items():
            rows.append((name, float(members.mean()), shares(light[:, members])[0]))
        for of, share, parts in rows:
            named = dict(zip(names, map(float, parts), strict=True))
            found.append({"of": of, "share of the samples": share, **named})
        return found

    @property
    def _good(self) -> npt.NDArray[np.float32]:
        """The samples; a bad sample is NaN in all channels."""
        return np.where(self.bad, np.float32(np.nan), self.radiance)

    @cached_property
    def curve(self) -> Fit | None:
        """What describes its luminance best: a mixture where this has several modes, else a family.

        None where too few samples are positive, or there are neither 1 nor 3 channels.
        """
        if len(self.channels) not in (1, 3):
            return None
        light = np.asarray(luminance(self._good.astype(np.float64)))
        if (light > 0).sum() < FEWEST_SHOWN:
            return None
        if Label(int(self.patterns.label)) in (Label.BIMODAL, Label.MULTIMODAL):
            return mixture(light)
        found = select(light)
        return found.fits.get(str(found.names))

    def plot(
        self,
        *,
        channels: str | Sequence[str] | None = None,
        scales: Scale | Sequence[Scale] = ("linear", "log"),
        width: Width = "page",
        fig: Figure | None = None,
    ) -> Figure:
        """Draw linear and log10 histograms of the channels, their best fits and their means.

        Parameters
        ----------
        channels
            Channels to draw: names, "red", "green", "blue" or "luminance"; None for all but
            luminance.
        scales
            "linear", "log" or both.
        width
            Width of the figure: "column", "page" or inches.
        fig
            Figure to draw into; None makes one, which a notebook shows.

        Raises
        ------
        InputError
            If a channel, a scale or the width is unknown.
        """
        return draw(self, channels=channels, scales=scales, width=width, fig=fig)

    def _card(self) -> Card:
        mean, error = (self.statistics[name].values for name in ("mean", "standard_error"))
        rows = [
            {
                "channel": channel,
                "mean": f"{number(mean[i])} ± {number(error[i])}",
                "best family": FAMILIES[family].label if family else "—",
                "tail index": with_interval(self.tail.xi[i], *self.tail.interval[i]),
                "tail above": number(self.tail.threshold[i]),
                "modes": str(self.modality.modes[i]),
            }
            for i, (channel, family) in enumerate(self.families.items())
        ]
        facts = {"samples": f"{self.spp}, {percent(self.null_share)} null, {self.bad.sum()} bad"}
        if self.sequence > 1:
            facts["dependence"] = (
                f"samples depend on each other in sequences of {self.sequence}; standard errors "
                "know of it, intervals and p-values do not"
            )
        if self.label:
            label = Label(int(self.patterns.label))
            facts |= {"label": self.label, "why": label.meaning, "what helps": label.cure}
        for title, rows_of in (("variance", self.light), ("variance by light", self.lights)):
            for row in rows_of[1:2]:
                named = [(name, float(share)) for name, share in list(row.items())[2:]]
                facts[title] = ", ".join(f"{percent(s)} {n}" for n, s in named if s >= 0.005)
        return Card(f"Pixel y {self.y}, x {self.x} of {self.scene}", facts, rows)


# --- regions --------------------------------------------------------------------------------------


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
            If there are no places.
        """
        if places is None:
            shape = samples.shape[:2]
            chosen = choose_regions(classify(samples))
            places = {region.name: region.center(*shape) for region in chosen}
        if not places:
            message = "expected at least one region, got none"
            raise InputError(message)
        return cls(samples, {name: samples.pixel(y, x) for name, (y, x) in places.items()})

    @cached_property
    def image(self) -> npt.NDArray[Any]:
        """Means of the image, shape (y, x, channel)."""
        return np.asarray(summarize(self.samples)["mean"])

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
            As for `Pixel.plot`; None for luminance if it is known.
        """
        return draw(self, channels=channels, scales=scales, width=width, fig=fig)

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


pixel_of.register(Samples, Pixel.of)
regions_of.register(Samples, Regions.of)
