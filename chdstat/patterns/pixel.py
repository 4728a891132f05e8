"""Pixels: the characteristic distributions (CHDs) of pixels, and everything known about them.

`Samples.pixel` makes a `Pixel`, which computes everything on demand. `Samples.regions` makes
`Regions`: pixels of several parts of an image, side by side as Elek, Thomas and Forbes 2019 show
the scenes of their case study.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar, Self, TypeVar

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Floats, is_bad, is_null, luminance, take_rows
from chdstat._core.display import Card, Shown, Width, duration, number, percent, with_interval
from chdstat._core.doors import draw, pixel_of, regions_of
from chdstat._core.moments import Moments
from chdstat._core.positive import PositivePart
from chdstat._core.statistic import Statistic, shown_statistics
from chdstat.errors import InputError, Reason
from chdstat.fit.curves import Curve, misfit
from chdstat.fit.families import FAMILIES, FamilyFit, Fit
from chdstat.fit.goodness_of_fit import FitTest, Goodness, GoodnessOfFit
from chdstat.fit.mixtures import MixtureFit
from chdstat.fit.selection import FEWEST_SHOWN, FamilySelection, Selection
from chdstat.fit.tail import Tail, TailIndex, tail_index
from chdstat.inference.modes import Modality, ModalMixture, Modes, modality
from chdstat.patterns.attribution import By, by_part, groups_of, part_names, shares
from chdstat.patterns.classification import (
    Classification,
    Label,
    Patterns,
    choose_regions,
    classify,
)
from chdstat.patterns.definitions import PATTERNS, Thresholds, largest_misfit
from chdstat.patterns.film_splits import VarianceByPlace, means_by_place
from chdstat.samples.dependence import check_sequences, sequence_of
from chdstat.samples.samples import Samples
from chdstat.samples.tiles import FILM, LightPart
from chdstat.summary.histograms import Histogram, Scale, drawn_histograms, histogram
from chdstat.summary.runner import measured
from chdstat.summary.statistics import summarize

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.figure import Figure

Found = TypeVar("Found")

_POINTS = 96
"""Numbers of samples at which the running mean is known."""
_OF_FITTED = ("part", "places", "patterns", "constant", "_curves")
"""What depends on the fitted samples alone, and with `part` all that was measured of it."""
_MORE = MixtureFit(max_k=8, effort="fast")
"""The mixture of samples that one with few components does not describe."""


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
        with ``by_depth=``, by names of lights if with ``by_light=``. With ``film=True``, also where
        they fell in the pixel, by 0.
    sequence
        Number of samples that depend on each other; 1 if they are independent.
    most_fitted
        Most samples that fits, tests and modes look at; None for all.
    attrs
        Provenance of the image; cures are in the words of its renderer.
    seconds, over_median
        What a sample takes, as value and standard error in seconds, and over that of the median
        pixel; None if it is unknown.

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
    most_fitted: int | None = None
    attrs: Mapping[str, Any] = field(default_factory=dict)
    seconds: tuple[float, float] | None = None
    over_median: float | None = None
    _drawn: ClassVar[str] = "histograms, curves and means"

    @classmethod
    def of(cls, samples: Samples, y: int, x: int) -> Self:
        """Return a pixel of an image; negative places count from the end."""
        height, width = samples.shape[:2]
        radiance = samples[y, x]
        check_sequences(samples.attrs, samples.part[2])
        parts = {which: part[y, x] for which, part in samples.parts.items()}
        length = sequence_of(samples.attrs)
        place = y % height, x % width
        name, attrs = samples.name, samples.attrs
        found = cls(*place, radiance, samples.channels, name, parts, length, attrs=attrs)
        if (costs := samples.costs) is None or not np.isfinite(costs.seconds[place]):
            return found
        seconds = float(costs.seconds[place]), float(costs.error[place])
        return replace(found, seconds=seconds, over_median=costs.over_median(*place))

    @property
    def spp(self) -> int:
        """Samples of the pixel."""
        return int(self.radiance.shape[-1])

    @property
    def fitted_spp(self) -> int:
        """Samples that fits, tests and modes look at."""
        return self.spp if self.most_fitted is None else min(self.spp, self.most_fitted)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the rows: the channels, and luminance if there are three of them."""
        return (*self.channels, "luminance") if len(self.channels) == 3 else self.channels

    @cached_property
    def rows(self) -> npt.NDArray[np.float32]:
        """Radiance of the channels, and luminance if there are three, shape (row, sample)."""
        if len(self.channels) != 3:
            return self.radiance
        with np.errstate(invalid="ignore", over="ignore"):
            return np.concatenate([self.radiance, luminance(self.radiance)[np.newaxis]])

    @cached_property
    def null(self) -> npt.NDArray[np.bool_]:
        """Null samples: paths that found no light, shape (sample,)."""
        return is_null(self.radiance)

    @cached_property
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

    @cached_property
    def moments(self) -> Moments:
        """Moments of the good samples of each row; the mean is NaN where none is good."""
        found = Moments.of(self.rows, ~self.bad)
        return replace(found, mean=found.seen(found.mean))

    def histogram(self, scale: Scale = "log") -> Histogram:
        """Return the histogram of each channel, see `chdstat.histogram`."""
        return histogram(self.radiance, scale=scale, null=self.null, bad=self.bad)

    @cached_property
    def histograms(self) -> dict[Scale, Histogram]:
        """Linear and log10 histogram of each row, as figures draw them."""
        null, bad = (np.broadcast_to(mask, self.rows.shape) for mask in (self.null, self.bad))
        return drawn_histograms(self.rows, null=null, bad=bad)

    # --- what is measured of each row, once for all users ---------------------------------------

    @cached_property
    def part(self) -> PositivePart:
        """The positive samples of each row, of the samples that are fitted."""
        x = self.radiance[:, : self.fitted_spp]
        return PositivePart.of_pixels(
            x, rows="both" if self.has_luminance else "channels", places=self.places
        )

    @cached_property
    def places(self) -> npt.NDArray[np.float32] | None:
        """Where in the pixel each fitted sample fell, (2, sample), NaN if unknown; None for all."""
        if FILM not in self.parts:
            return None
        found = np.full((2, self.fitted_spp), np.nan, np.float32)
        known = self.parts[FILM][:, : self.fitted_spp]
        found[:, : known.shape[1]] = known
        return found

    def measured(self, statistic: Statistic[Found]) -> Found:
        """Return a statistic of each row, or of luminance if it is one of luminance."""
        if statistic == Modes():
            measured(self.part, ModalMixture())  # which finds the modes on its way
        part = self.part if statistic.rows == "channels" else self.part.rows(-1)
        return measured(part, statistic)

    @property
    def variance_by_place(self) -> str:
        """How much of the variance of luminance is the picture changing within the pixel.

        "" if it is unknown where samples fell, or they do not vary.
        """
        statistic = VarianceByPlace.of_pixel(self.fitted_spp)
        if self.places is None or statistic is None or not self.moments.variance[-1] > 0:
            return ""
        tail = self.measured(TailIndex())
        holds = not (tail.variance_suspect[-1] or tail.variance_unidentified[-1])
        return self._of_each(statistic).in_words(-1, holds=holds)

    @cached_property
    def means_by_place(self) -> tuple[Floats, npt.NDArray[np.int64]] | None:
        """Mean radiance of each row by cell of the pixel, and samples there; None if unknown.

        Shapes (row, k, k) and (k, k); `chdstat.viz.pixel_by_place` draws them.
        """
        if self.places is None:
            return None
        means, counts = means_by_place(self.rows[:, : self.fitted_spp], self.places)
        return (means, counts) if counts.any() else None

    def _of_each(self, statistic: Statistic[Found]) -> Found:
        """Return a statistic of each row, also where images have it of luminance alone."""
        return measured(self.part, statistic)

    @cached_property
    def selection(self) -> Selection:
        """Families fitted to each channel, and the best one by BIC."""
        return self._of_channels(self.measured(FamilySelection()))

    @property
    def families(self) -> dict[str, str]:
        """Name of the best family, by the name of the channel; "" where none could be fitted."""
        return dict(zip(self.channels, map(str, self.selection.names), strict=True))

    @cached_property
    def tail(self) -> Tail:
        """Tail index of each channel, and whether the variance can be trusted."""
        return self._of_channels(self.measured(TailIndex()))

    @cached_property
    def modality(self) -> Modality:
        """Modes of each channel in log radiance."""
        return self._of_channels(self.measured(Modes()))

    @cached_property
    def patterns(self) -> Patterns:
        """Patterns of the luminance, tested for this pixel, not for an image; 1 or 3 channels."""
        return self.measured(Classification())

    @property
    def label(self) -> str:
        """Label in words; "" if there are neither 1 nor 3 channels."""
        return Label(int(self.patterns.label)).words if self.has_luminance else ""

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
    def constant(self) -> npt.NDArray[np.bool_]:
        """Whether the positive samples of each row are equal, but for what rounding leaves."""
        spread = self.part.log_statistics
        return np.asarray(spread.log_variance <= Thresholds().constant ** 2) & (spread.n > 1)

    def curve(self, row: int, family: str = "best") -> Curve:
        """Return what is drawn over the histogram of a row, or why nothing is.

        It is the family that BIC selects where the row has one mode and the family describes its
        samples; else the mixture that does, so that no single family is drawn over two humps. The
        mixture has at most three components, or up to eight where three do not describe the
        samples. What describes them has a misfit of at most `Thresholds.misfit`, or no larger than
        chance explains. Where nothing does, or samples are constant or too few, there is no curve.

        Parameters
        ----------
        row
            A channel, or luminance, by its place in `names`.
        family
            "best" for this rule; the name of a family or "mixture" for that one, however poor.
        """
        if (row, family) not in self._curves:
            self._curves[row, family] = self._curve(row, family)
        return self._curves[row, family]

    @cached_property
    def _curves(self) -> dict[tuple[int, str], Curve]:
        return {}

    def _curve(self, row: int, family: str) -> Curve:
        n = int(self.part.n[row])
        if self.constant[row]:
            return Curve(reason="constant samples")
        if n < FEWEST_SHOWN:
            return Curve(reason=f"{'too few' if n else 'no'} positive samples")
        ascending, least = self.part.sorted[row, :n], np.nan
        for fit in self._fits(row, family):
            if fit.reason != Reason.OK:
                continue
            curve = Curve(fit, misfit(fit, ascending))
            if family != "best" or curve.misfit <= largest_misfit(self.part.n[row], Thresholds()):
                return curve
            least = float(np.fmin(least, curve.misfit))
        values = self.measured(ModalMixture()).reason[row] == Reason.TIED
        return Curve(None, least, "only a few values" if values else "no family fits")

    def _fits(self, row: int, family: str) -> Iterator[Fit]:
        """Yield the fits to try in turn."""
        modes = int(self.measured(Modes()).modes[row])
        if family in FAMILIES:
            yield take_rows(self.measured(FamilyFit(FAMILIES[family])), row, axis=0)
        elif family == "best" and modes <= 1:
            best = self.measured(FamilySelection()).best_fit(row)
            if best is not None:
                yield best
        if family in {"best", "mixture"}:
            of_modes = take_rows(self.measured(ModalMixture()), row, axis=0)
            if of_modes.k >= modes:
                yield of_modes
            yield take_rows(measured(self.part.rows(slice(row, row + 1 or None)), _MORE), 0, axis=0)

    def averages(self, n: int) -> Floats:
        """Return the averages of consecutive good samples, n each, shape (row, average)."""
        good = self.rows if not self.bad.any() else self.rows[:, ~self.bad]
        count = good.shape[1] // n
        cut = good[:, : count * n].reshape(len(good), count, n)
        return np.asarray(cut.mean(axis=-1, dtype=np.float64))

    @cached_property
    def running(self) -> tuple[npt.NDArray[np.int64], Floats, Floats]:
        """Spp, running means and their standard errors, shapes (point,) and (row, point)."""
        good = np.flatnonzero(~self.bad)
        if good.size < 2:
            return np.empty(0, np.int64), *np.empty((2, len(self.rows), 0))
        at = np.unique(np.geomspace(2, good.size, min(_POINTS, good.size)).astype(np.int64))
        x = self.rows[:, good].astype(np.float64)
        # Deviations from the mean of all keep the sum of squares from cancelling.
        center = x.mean(axis=-1, keepdims=True)
        x -= center
        with np.errstate(over="ignore", invalid="ignore"):
            total, squares = np.cumsum(x, axis=-1)[:, at - 1], np.cumsum(x * x, axis=-1)[:, at - 1]
            mean = total / at
            variance = np.maximum(squares / at - mean**2, 0) * at / (at - 1)
        return at, mean + center, np.sqrt(variance / at)

    def told(self, row: int, *, brief: bool = False) -> dict[str, str]:
        """Return what statistics say of a row, by their titles; with `brief`, the most important.

        A statistic is in it if it declares a `chdstat._core.statistic.Quantity`.
        """
        found = {}
        for kind in shown_statistics():
            if kind.film and self.places is None:
                continue
            statistic = kind.of_pixel(self.fitted_spp)
            for quantity in kind.quantities:
                title = quantity.brief if brief else quantity.title
                if title:
                    found[title] = "—"
                if title and statistic and (quantity.of_constant or not self.constant[row]):
                    of_rows = self.measured if kind.rows == "channels" else self._of_each
                    found[title] = quantity.text(of_rows(statistic), row)
        return found

    def grown(self, radiance: npt.NDArray[np.float32]) -> Self:
        """Return the pixel with further samples after its own.

        What is known of the fitted ones stays known where these are the same.
        """
        found = replace(self, radiance=radiance)
        if found.fitted_spp == self.fitted_spp:
            vars(found).update({name: v for name, v in vars(self).items() if name in _OF_FITTED})
        return found

    def goodness(
        self, *, resamples: int, most: int | None = None
    ) -> Iterator[tuple[str, Goodness]]:
        """Test by the bootstrap whether each family describes each row; yield its name and test.

        Parameters
        ----------
        resamples
            Replicates B, as in `chdstat.fit.goodness`.
        most
            Most samples to test, the first ones; None for all.
        """
        part = replace(self, most_fitted=most).part
        tests: tuple[FitTest, ...] = ("anderson-darling", "kolmogorov-smirnov")
        for i, name in enumerate(FAMILIES):
            yield name, measured(part, GoodnessOfFit(FAMILIES[name], tests, resamples, i))

    @property
    def has_luminance(self) -> bool:
        """Whether there are 1 or 3 channels, which have luminance."""
        return len(self.channels) in (1, 3)

    def _of_channels(self, found: Found) -> Found:
        return take_rows(found, slice(len(self.channels)), axis=0)

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
        known = {n: p for n, p in self.parts.items() if isinstance(n, kind) and n != FILM}
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

    def plot(
        self,
        *,
        channels: str | Sequence[str] | None = None,
        scales: Scale | Sequence[Scale] = ("linear", "log"),
        width: Width = "page",
        fig: Figure | None = None,
    ) -> Figure:
        """Draw linear and log10 histograms of the channels, their curves and their means.

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
            {"channel": channel, "mean": f"{number(mean[i])} ± {number(error[i])}"}
            | self.told(i, brief=True)
            for i, channel in enumerate(self.channels)
        ]
        facts = {"samples": f"{self.spp}, {percent(self.null_share)} null, {self.bad.sum()} bad"}
        if self.sequence > 1:
            facts["dependence"] = (
                f"samples depend on each other in sequences of {self.sequence}; standard errors "
                "know of it, intervals and p-values do not"
            )
        if self.seconds and self.over_median:
            taken, within = self.seconds
            facts["cost"] = (
                f"a sample takes {duration(taken)} here"
                f"{f' ± {duration(within)}' if np.isfinite(within) else ''}, "
                f"{number(self.over_median, 2)} times the median"
            )
        if self.label:
            label = Label(int(self.patterns.label))
            facts |= {
                "label": self.label,
                "why": label.meaning,
                "what helps": label.cure_by(self.attrs),
            }
        if self.variance_by_place:
            facts["variance by place"] = self.variance_by_place
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
