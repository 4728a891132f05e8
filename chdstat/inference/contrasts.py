"""Contrasts: whether two renders of a view have the same mean, and which is more efficient.

Use it to contrast two integrators, a renderer before and after a change, or a render with a
converged image. It tests pixels, and regions, which show differences that no single pixel shows.
"""

from __future__ import annotations

import contextlib
import itertools
import math
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeAlias, TypedDict, Unpack, overload

import numpy as np
import numpy.typing as npt
from scipy import stats

from chdstat._core.arrays import (
    Array,
    Floats,
    Seed,
    check_real,
    label_variables,
    plain,
    seed_number,
    whole,
)
from chdstat._core.display import (
    Card,
    Shown,
    Tabled,
    Width,
    colour,
    listed,
    number,
    percent,
    png,
    with_interval,
)
from chdstat._core.doors import draw, report
from chdstat._core.files import checked_target
from chdstat._core.image_scales import relative_scale, tonemap
from chdstat._core.progress import portion, track
from chdstat._core.resampling import Blocks, Interval, q_values
from chdstat._core.statistic import RADIANCE
from chdstat.errors import InputError, Reason, check_probability
from chdstat.inference.noise_rankings import (
    NoiseRanking,
    RankedRender,
    check_one_view,
    cost_ratio,
    named_renders,
    noise_ranking,
)
from chdstat.inference.rare_light import RareLight
from chdstat.inference.references import Reference
from chdstat.inference.render_pairs import Pair, independent, seconds_of
from chdstat.inference.windows import (
    CHANCE_TO_MISS,
    LEAST_LIGHT,
    Cells,
    ClearestWindow,
    WindowTest,
    scan_windows,
    window_sums,
)
from chdstat.samples import ImageLike, Samples

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.figure import Figure

_RenderLike: TypeAlias = ImageLike | Reference | npt.ArrayLike
"""A render, or an image without samples."""
Draw: TypeAlias = Callable[[int], npt.ArrayLike]
"""Returns samples of every pixel from a seed, shape (y, x, channel) or (y, x, channel, sample)."""
_Outcome = Literal["no difference found", "differ", "cannot tell"]

LEAST_TERMS = 8
"""With fewer terms, no p-value is small enough."""
_OF_WINDOWS = 0.8
"""Share of alpha for windows; single pixels get the rest."""
_ROUNDING = 1e-6
_MANY_TIMES = 10
_OUTCOMES = ("no difference found", "cannot tell", "differ")
"""From the best to the worst."""
_LOOKS = (0.25, 0.5, 1.0)
"""Shares of the samples at which a render that is drawn is looked at."""
_TIMED = {"": "", "clock": "", "pixels": ", by the measured time of samples"}
"""What is said of the times behind an efficiency."""
_STANDARD_ERRORS = 4
"""Difference that is surely found, in standard errors."""


@dataclass(frozen=True, repr=False)
class Contrast(Shown):
    """How two renders of a view, A and B, differ, and how certain that is.

    Attributes
    ----------
    names
        Names of A and B.
    scenes
        Names of the scenes of A and B, "" where they are unknown.
    maps
        Maps over the image. With dims (y, x, channel), luminance first if there are R, G and B:
        ``mean_a``, ``mean_b``, ``difference`` (B - A), its ``standard_error``, ``p_value``, and
        ``q_value`` (over all pixels and channels together). For luminance, with dims (y, x):
        ``variance_a`` and ``variance_b`` of a sample, ``efficiency`` (of B over that of A), and
        ``bad_a`` and ``bad_b``, the shares of bad samples, and ``reason``, why a pixel has no
        p-value. If asked for, also p- and q-values of equal variances and distributions,
        ``variance_p_value`` and so on.
    outcome
        "no difference found", "differ" or "cannot tell", at the level `alpha`.
    why
        Why the answer is "cannot tell"; "" otherwise.
    spp_needed
        Samples per pixel that the shorter render needs for a decision. With so many, it would miss
        the light that it has not seen with a probability of only 5 %; or it is the fewest that a
        test takes. None if there is a decision, or if no number is known.
    image_p_value
        P-value of the whole test, that the means are equal in all pixels. (`p_value` is a map.)
    share
        Share of the image in pixels whose means differ, with a false discovery rate of `alpha`.
    loss
        How much darker B is as a whole, 1 - mean of B over mean of A, with its 95 % interval.
    window
        Window in which the difference is clearest, if there is one: y, x, height and width in
        pixels; a single pixel if no window differs.
    window_channel
        Channel in which it is clearest; "luminance" if R, G and B differ together.
    window_loss
        How much darker B is in this channel of the window, by plain means.
    window_brighter
        Render that is brighter there by what was tested: "A" or "B". The test may give noisy pixels
        less weight than plain means do.
    detectable
        Smallest relative difference that would have been found with a probability of 90 %: in the
        whole ``image``, and in a square of about a ``tenth`` of it, wherever it lies.
    efficiency_ratio
        1 / (relative variance x time) of B over that of A, with its 95 % interval. NaN if a time is
        unknown, or A or B has no variance.
    timed
        What times are of: "pixels", if both renders know what the samples of each pixel take;
        ``efficiency`` is then that of each pixel, with its own time. Else "clock", the time of the
        whole render, or "" if it is unknown.
    spp
        Samples per pixel of A and B that were contrasted; None if that of an image is unknown.
    spp_range
        The same in words, such as "16 to 64" if pixels differ.
    reference
        "" if B has samples. Otherwise how the noise of the image B is known: by a "variance", by
        its "spp" alone, by means of "batches", or not at all, so that B is taken as "exact".
    cannot_show
        What no test with the image B can tell, in sentences; none if B has samples.
    seconds
        Rendering time of one sample in every pixel, for A and B; NaN if it is unknown.
    correlation
        Correlation of the samples of A and B, in the median pixel.
    paired
        Whether A and B share random numbers.
    alpha
        Level of the test.
    """

    names: tuple[str, str]
    scenes: tuple[str, str]
    maps: xr.Dataset
    outcome: _Outcome
    why: str
    spp_needed: int | None
    image_p_value: float
    share: float
    loss: Interval[float]
    window: tuple[int, int, int, int]
    window_channel: str
    window_loss: float
    window_brighter: Literal["A", "B"]
    detectable: dict[str, float]
    efficiency_ratio: Interval[float]
    timed: Literal["", "clock", "pixels"]
    spp: tuple[int, int | None]
    spp_range: tuple[str, str]
    reference: Literal["", "exact", "spp", "variance", "batches"]
    cannot_show: tuple[str, ...]
    seconds: tuple[float, float]
    correlation: float
    paired: bool
    alpha: float

    @property
    def p_value(self) -> xr.DataArray:
        """p-values of equal means, (y, x, channel)."""
        return self.maps["p_value"]

    @property
    def q_value(self) -> xr.DataArray:
        """q-values of equal means, over all pixels and channels together, (y, x, channel)."""
        return self.maps["q_value"]

    @property
    def difference(self) -> xr.DataArray:
        """Mean of B minus that of A, (y, x, channel), radiance."""
        return self.maps["difference"]

    @property
    def efficiency(self) -> xr.DataArray:
        """1 / (variance x time) of B over that of A, (y, x)."""
        return self.maps["efficiency"]

    @property
    def conclusion(self) -> str:
        """What was found, in words."""
        found = {
            "cannot tell": f"Cannot tell: {self.why}",
            "differ": self._difference(),
            "no difference found": self._no_difference(),
        }
        return " ".join([f"{found[self.outcome]}.", *self._left_out()])

    def _no_difference(self) -> str:
        if not np.isfinite(self.p_value).any():
            return "No difference found: the samples of A do not vary, and B is as bright"
        found = f"No difference found (p {number(self.image_p_value)})"
        if not np.isfinite(self.detectable["image"]):
            return f"{found}; no loss can be stated, since the mean of A is not above 0"
        image, tenth = self._smallest("image"), self._smallest("tenth")
        return (
            f"{found}. With a probability of 90 %, the test would have found a loss of {image} in "
            f"the image, or of {tenth} in a tenth of it"
        )

    def _difference(self) -> str:
        _, _, height, width = self.window
        pixels = "no single pixel differs"
        if self.share:
            rate = percent(self.alpha)
            pixels = f"{percent(self.share)} of the pixels differ (false discovery rate {rate})"
        where = "the whole image"
        if (height, width) == (1, 1):
            where = f"the pixel at {_place(self.window)}"
        elif (height, width) != self.maps["reason"].shape:
            where = f"{width} x {height} pixels at {_place(self.window)}"
        if self.maps.sizes["channel"] > 1:
            name = colour(self.window_channel)
            where = f"{name if name == self.window_channel else f'the {name} channel'} of {where}"
        return (
            f"The means differ (p {number(self.image_p_value)}), most clearly in {where}, where "
            f"{self._how()}; {pixels}{self._reservation()}"
        )

    def _how(self) -> str:
        """Return how B differs from A in the window; how A does from a reference."""
        y, x, height, width = self.window
        here = {"y": slice(y, y + height), "x": slice(x, x + width)}
        maps = self.maps.sel(channel=self.window_channel).isel(here)
        means = {name: float(maps[f"mean_{name.lower()}"].mean()) for name in "AB"}
        base, other = "BA" if self.reference else "AB"
        one, two = means[base], means[other]
        if min(one, means["A"]) <= 0 or two < 0:
            a, b = (f"has a mean of {number(x)}" if x else "is black" for x in means.values())
            return f"render A {a} and render B {b}"
        size = f"{number(two / one)} times as bright"
        if two <= _MANY_TIMES * one:
            size = f"{percent(abs(two / one - 1))} {'brighter' if two >= one else 'darker'}"
        if (two >= one) == (self.window_brighter == other):
            return f"render {other} is {size}"
        tested = "brighter" if self.window_brighter == other else "darker"
        return (
            f"render {other} is {tested} by pixels of little noise, though its plain mean, which "
            f"few bright samples decide, is {size}"
        )

    def _reservation(self) -> str:
        """Return what remains possible if A is darker than an image without samples; or ""."""
        if self.reference not in ("exact", "spp") or self.window_loss > 0:
            return ""
        _, _, height, width = self.window
        rarest = max(1, int(height * width * self.spp[0] / -np.log(CHANCE_TO_MISS)))
        return (
            f", unless light of that amount comes in fewer than one of {rarest} samples there, "
            "which A may have missed and an image without samples does not show"
        )

    def _left_out(self) -> list[str]:
        """Return sentences on pixels without a good sample."""
        found = []
        for name in "AB":
            places = np.argwhere(self._lost(name))
            if len(places):
                first = f"{'first ' * (len(places) > 1)}at {_place(places[0])}"
                image = name == "B" and self.reference
                why = f"{'B is' if image else f'all samples of {name} are'} NaN or infinite"
                found.append(f"{_counted(len(places), 'pixel')} where {why} ({first})")
        return [f"Not contrasted: {'; '.join(found)}."] if found else []

    def _lost(self, name: str) -> Array:
        """Return where a render has no good sample, shape (y, x)."""
        return np.asarray(self.maps[f"bad_{name.lower()}"] == 1)

    def _smallest(self, part: str) -> str:
        value = self.detectable.get(part, np.nan)
        return percent(value) if value < 1 else "all light"

    def to_dict(self) -> dict[str, Any]:
        """Return the numbers, without maps, ready for JSON."""
        y, x, height, width = self.window
        content = {
            "a": self.names[0],
            "b": self.names[1],
            "scenes": self.scenes,
            "outcome": self.outcome,
            "conclusion": self.conclusion,
            "spp_needed": self.spp_needed,
            "image_p_value": self.image_p_value,
            "alpha": self.alpha,
            "share_of_pixels": self.share,
            "loss": self.loss.to_dict(),
            "efficiency_ratio": self.efficiency_ratio.to_dict(),
            "timed": self.timed,
            "window": {"y": y, "x": x, "height": height, "width": width},
            "window_channel": self.window_channel,
            "window_loss": self.window_loss,
            "window_brighter": self.window_brighter,
            "detectable": self.detectable,
            "spp": self.spp,
            "reference": self.reference,
            "cannot_show": self.cannot_show,
            "bad_samples": {n: float(self.maps[f"bad_{n}"].mean()) for n in "ab"},
            "pixels_left_out": {n: int(self._lost(n).sum()) for n in "ab"},
            "seconds_per_sample": self.seconds,
            "paired": self.paired,
            "correlation": self.correlation,
        }
        return dict(plain(content | {f"share_of_{n}": share for n, share in self._shapes()}))

    def _shapes(self) -> list[tuple[str, float]]:
        """Return the shares of pixels whose variances and distributions differ, NaN if untested."""
        names = [n for n in ("variance", "distribution") if f"{n}_q_value" in self.maps]
        maps = [(f"{n}s", self.maps[f"{n}_q_value"].to_numpy()) for n in names]
        return [
            (name, float((q <= self.alpha).mean()) if np.isfinite(q).any() else np.nan)
            for name, q in maps
        ]

    def table(self) -> dict[str, str]:
        """Return the numbers beside the conclusion, in words."""
        counts = self.spp_range
        of_b = {
            "": f"{counts[1]} spp",
            "exact": "an image taken as exact",
            "spp": f"a mean of {counts[1]} spp",
            "variance": f"a mean and a variance of {counts[1]} spp",
            "batches": f"means of batches, {counts[1]} spp",
        }
        ends = -self.loss.value, -self.loss.high, -self.loss.low
        bad = [float(self.maps[f"bad_{name}"].mean()) for name in "ab"]
        found = {
            "A": f"{self.names[0]}, {counts[0]} spp",
            "B": f"{self.names[1]}, {of_b[self.reference]}",
            "B − A over A": with_interval(*ends, partial(percent, sign=True)),
            "efficiency of B over A": f"{self.efficiency_ratio}{_TIMED[self.timed]}",
        }
        if all(self.scenes) and self.scenes[0] != self.scenes[1]:
            found["scenes"] = f"{self.scenes[0]} and {self.scenes[1]}"
        if any(bad):
            found["bad samples"] = f"{percent(bad[0])} of A, {percent(bad[1])} of B"
        if self.cannot_show:
            found["what B cannot show"] = " ".join(self.cannot_show)
        if not self.reference:
            shared = "the same" if self.paired else "independent"
            found["random numbers"] = f"{shared}, correlation {number(self.correlation)}"
        for name, share in self._shapes():
            known = np.isfinite(share)
            found[f"{name} differ"] = f"in {percent(share)} of the pixels" if known else "not known"
        return found

    def plot(
        self,
        *,
        channels: str | Sequence[str] | None = None,
        width: Width = "page",
        fig: Figure | None = None,
    ) -> Figure:
        """Draw both images and where their means differ, as `chdstat.viz.contrast`."""
        return draw(self, channels=channels, width=width, fig=fig)

    def _card(self) -> Card:
        facts = {"conclusion": self.conclusion, **self.table()}
        if self.maps.sizes["channel"] not in (1, 4):
            return Card("Contrast", facts)
        last = slice(-3, None)
        shown = {n: self.maps[f"mean_{n.lower()}"].to_numpy()[..., last] for n in ("A", "B")}
        return Card("Contrast", facts, images={n: png(tonemap(i)) for n, i in shown.items()})


@dataclass(frozen=True, repr=False)
class Contrasts(Tabled):
    """Contrasts of several renders with one, of which `alpha` bounds the chance of any false alarm.

    Attributes
    ----------
    contrasts
        `Contrast` of each render, by its name; each at the level alpha / number of renders.
    alpha
        Level of all of them together.
    noise
        Which of the renders is noisier, where and why, with the one that the others are contrasted
        with; None if that was not asked for.
    """

    contrasts: Mapping[str, Contrast]
    alpha: float
    noise: NoiseRanking | None = None

    def __getitem__(self, name: str) -> Contrast:
        return self.contrasts[name]

    @property
    def outcome(self) -> _Outcome:
        """The worst of all: "differ", or else "cannot tell", or else "no difference found"."""
        return max((of.outcome for of in self.contrasts.values()), key=_OUTCOMES.index)

    @property
    def conclusion(self) -> str:
        """What was found, in words."""
        return " ".join([self.means, *([] if self.noise is None else [self.noise.conclusion])])

    @property
    def means(self) -> str:
        """Whether the means agree, in words; if renders are ranked, with their names."""
        alarm = f"chance of any false alarm {percent(self.alpha)}"
        by_outcome: dict[str, list[str]] = {name: [] for name in _OUTCOMES}
        for name, of in self.contrasts.items():
            by_outcome[of.outcome].append(name)
        if self.noise is None:
            counts = [len(by_outcome[name]) for name in _OUTCOMES]
            found = f"{counts[2]} of {_counted(sum(counts), 'render')} differ ({alarm})"
            return f"{found}; {counts[1]} cannot be told." if counts[1] else f"{found}."
        last = self.noise.names[-1]
        same, unknown, _ = (listed(names) for names in by_outcome.values())
        parts = [f"no difference from {last} found in {same}"] if same else []
        parts += [f"for {unknown} that cannot be told"] if unknown else []
        if differ := by_outcome["differ"]:
            each = [f"{name} ({self._how_bright(name)})" for name in differ]
            parts.append(f"{listed(each)} differ{'s' * (len(each) == 1)} from {last}")
        darker = listed(self._darker_and_less_noisy())
        less = f" A render that lacks light also has less noise: perhaps {darker}." * bool(darker)
        return f"Means: {'; '.join(reversed(parts))} ({alarm}).{less}"

    def _how_bright(self, name: str) -> str:
        """Return how bright a render is as a whole, beside the last one."""
        loss = self[name].loss
        more = 1 / (1 - loss.value) - 1 if loss.value < 1 else np.nan
        if np.isfinite(more) and not loss.low <= 0 <= loss.high:
            return f"{percent(abs(more))} {'brighter' if more > 0 else 'darker'} as a whole"
        a, b = (float(self[name].maps[f"mean_{side}"].mean()) for side in "ab")
        return "black" if not a else "brighter" if not b else "about as bright as a whole"

    def _darker_and_less_noisy(self) -> list[str]:
        """Return the renders that differ from another, are darker as a whole, and noise less."""
        assert self.noise is not None, "renders are ranked"
        noise, last = self.noise.order.noise, self.noise.names[-1]
        found: dict[str, None] = {}
        for name, of in self.contrasts.items():
            if of.outcome == "differ" and {name, last} <= noise.keys():
                darker, other = (name, last) if of.loss.value < 0 else (last, name)
                if not of.loss.low <= 0 <= of.loss.high and noise[darker] < noise[other]:
                    found[darker] = None
        return [*found]

    def table(self) -> list[dict[str, Any]]:
        """Return a row for each render; if renders are ranked, the least noisy one first."""
        means = self.mean_rows()
        if self.noise is None:
            return means
        by_name = {row["render"]: row for row in means}
        missing = dict.fromkeys(means[0])
        ranked = [*self.noise.table(), *({"render": name} for name in self.noise.unlit)]
        rows = [missing | by_name.get(row["render"], {}) | row for row in ranked]
        # The longest text comes last.
        return [row | {"conclusion": row.pop("conclusion")} for row in rows]

    def mean_rows(self) -> list[dict[str, Any]]:
        """Return what was found of the mean of each render, but of the last one."""
        return [
            {
                "render": name,
                "outcome": of.outcome,
                "p": of.image_p_value,
                "loss": of.loss.value,
                **{
                    f"smallest_loss_{part}": loss if np.isfinite(loss) else np.nan
                    for part, loss in of.detectable.items()
                },
                "conclusion": of.conclusion,
            }
            for name, of in self.contrasts.items()
        ]

    def to_dict(self) -> dict[str, Any]:
        """Return the numbers of all contrasts, ready for JSON."""
        of_each = {name: of.to_dict() for name, of in self.contrasts.items()}
        about = {"outcome": self.outcome, "conclusion": self.conclusion, "alpha": self.alpha}
        noise = {} if self.noise is None else {"noise": self.noise.to_dict()}
        return dict(plain(about | {"contrasts": of_each} | noise))

    def plot(self, *, width: Width = "page", fig: Figure | None = None) -> Figure:
        """Draw the renders, their noise, and where each is the least noisy.

        Raises
        ------
        InputError
            If the renders are not ranked by their noise.
        """
        return draw(self, width=width, fig=fig)

    def report(self, path: str | Path) -> Path:
        """Write a short PDF: the ranking, where in the image each render wins, and why.

        Parameters
        ----------
        path
            The PDF to write; an existing one is replaced.

        Raises
        ------
        InputError
            If the path does not end in .pdf, or the renders are not ranked by their noise.
        """
        return report(self, checked_target(path, ".pdf"))

    def _card(self) -> Card:
        if self.noise is None:
            of_each = {name: of.conclusion for name, of in self.contrasts.items()}
            return Card("Contrasts", {"conclusion": self.conclusion} | of_each)
        means = self.means.removeprefix("Means: ").partition(". ")[0]
        facts = {"means": means, **self.noise.facts(brief=True)}
        return Card("Contrasts", facts, self.noise.in_words())


class _Options(TypedDict, total=False):
    alpha: float
    spp: int | None
    finds: float | None
    seconds: float | None
    distributions: bool
    seed: Seed
    progress: bool


@overload
def contrast(
    a: Mapping[str, Any] | Sequence[Any], b: None = None, **options: Unpack[_Options]
) -> Contrasts: ...
@overload
def contrast(a: Mapping[str, Any], b: _RenderLike, **options: Unpack[_Options]) -> Contrasts: ...
@overload
def contrast(a: _RenderLike | Draw, b: _RenderLike, **options: Unpack[_Options]) -> Contrast: ...
def contrast(
    a: _RenderLike | Draw | Mapping[str, Any] | Sequence[Any],
    b: _RenderLike | None = None,
    *,
    alpha: float = 0.05,
    spp: int | None = None,
    finds: float | None = None,
    seconds: float | None = None,
    distributions: bool = False,
    seed: Seed = 0,
    progress: bool = True,
) -> Contrast | Contrasts:
    """Test whether renders of a view have the same mean; of several, rank them by noise, too.

    The means are tested pixel by pixel and over regions.

    **Equal numbers of samples.** Sample i of A and sample i of B make a term, B - A. If both
    renders have one distribution, both signs of a term are equally likely. Flipping signs then
    gives exact p-values, with any tails and nulls, whether or not the renders share random numbers.
    If they do, the terms are smaller, and smaller differences are found. If the renders agree in
    their means only, flips of signs are right for many samples. Where rare bright paths decide, the
    neighbours of a pixel show what it may have missed (`chdstat.inference.windows`). Where one
    render meets light by chance in few and large samples, and the other in many small ones, a
    window without that light is no evidence (`chdstat.inference.rare_light`).

    **Unequal numbers**, such as with a reference. A term is then a sample of the shorter render
    minus the average of many, and flips of its sign are not exact. But if both renders have one
    distribution, any division of all samples into A's and B's is as likely as the real one.
    P-values are never smaller than those of such divisions. The longer render may have light that
    the shorter one is likely to have missed. If that is more than the difference that would have
    been found, the outcome is "cannot tell", and `Contrast.spp_needed` says how many samples would
    do.

    **References.** An image without samples is contrasted with each sample of A. What rounding of
    the file and of a conversion of colours explains is no difference, nor is what its noise
    explains, if that is known. Unless there is an image of variances, it does not say how rare
    its light is. Pixels of A without any sample of that light are evidence only as far as their
    neighbours show how bright its samples can be (`chdstat.inference.render_pairs`). If A is
    darker, the conclusion says what it may have missed.

    **Regions.** Small differences show in sums over windows of all sizes up to the whole image. The
    largest such sum is compared with the largest sums that flips of signs give. This test has four
    fifths of `alpha`, and the smallest q-value of a pixel has one fifth; either decides "differ".

    **References with batches** are contrasted by units of their size, too: any division of them
    into A's and B's is as likely as the real one.

    **Renders drawn as needed.** A function `draw` is asked for samples until they tell the renders
    apart, or `spp` are drawn. It is looked at after a quarter, a half and all of them, with levels
    that add up to `alpha`.

    **Several renders**, a list without `b`, are each contrasted with the last one, and ranked by
    their noise: which is noisier at equal spp and at equal time, where in the image, and why
    (`chdstat.inference.noise_rankings`).

    Parameters
    ----------
    a
        A render: `Samples`, the path of a store, or an array (y, x, channel, sample). Or a function
        that draws one from a seed, as an array (y, x, channel) or (y, x, channel, sample). Or a
        `Reference` or an image, as `b`. Or several renders by their names. Or, without `b`, a list
        of renders with samples, or several by their names, to be ranked.
    b
        Another render of the same view and size, or an image without samples: a `Reference`, which
        says how well its means are known; or else the path of an EXR file, the result of
        `chdstat.io.read_exr`, or an array (y, x, channel), which count as exact up to the precision
        of half floats.
    alpha
        Level of the outcome and of the share of pixels, between 0 and 1; of several renders, the
        level of all together.
    spp
        Largest number of samples per pixel to draw; only for a function.
    finds
        Stop drawing as soon as no difference is found and a loss of this share of the image would
        have been found.
    seconds
        Contrast as many samples of each render as it makes in this time. By default, contrast all
        samples; if the renders share random numbers, the same number of both.
    distributions
        Also test in each pixel whether the variances and the whole distributions of luminance
        differ, by permutation. That takes twice as long.
    seed
        Seed of the 499 flips for windows; p-values of pixels need no seed. Also the first seed of
        `draw`, which counts up from it.
    progress
        Show progress: a bar in a terminal or notebook, elsewhere a line every ten seconds.

    Returns
    -------
    Contrast or Contrasts
        The conclusion in words, the numbers, and maps; for several renders, one for each, and their
        ranking.

    Raises
    ------
    InputError
        If sizes or channels differ, `alpha` or `seconds` is out of range, or `seconds` is given for
        samples whose rendering time is unknown or that are too few for it.
    StoreError
        If a file is missing or damaged.

    References
    ----------
    Jung, Hanika and Dachsbacher, "Detecting bias in Monte Carlo renderers using Welch's t-test",
    2020, Journal of Computer Graphics Techniques 9(2): the question, and a test of many samples.
    Janssen, "Studentized permutation tests for non-i.i.d. hypotheses and the generalized
    Behrens-Fisher problem", 1997, doi:10.1016/S0167-7152(97)00043-6. Veach, "Robust Monte Carlo
    methods for light transport simulation", 1997, equation 2.19: efficiency.

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> a, b = rng.gamma(2.0, size=(2, 32, 32, 3, 64))
    >>> contrast(a, b).outcome
    'no difference found'
    >>> b[:16, :16] *= 0.9
    >>> found = contrast(a, b)
    >>> found.outcome, found.window
    ('differ', (0, 0, 16, 16))
    >>> c = 1 + (a - 2) * 0.5  # a quarter of the variance
    >>> contrast({"a": a, "c": c + 1}).noise.order.names
    ('c', 'a')
    """
    options: dict[str, Any] = {"seconds": seconds, "seed": seed, "distributions": distributions}
    if b is None:
        if (spp, finds) != (None, None) or not isinstance(a, Mapping | list | tuple):
            given = type(a).__name__ if (spp, finds) == (None, None) else "spp or finds"
            message = f"without b, expected a list of finished renders, got {given}; give b, too"
            raise InputError(message)
        return _ranked(a, alpha=alpha, progress=progress, **options)
    if isinstance(a, Mapping):
        if not a:
            message = "contrast needs a render, got an empty mapping"
            raise InputError(message)
        b = Reference.of(b) or b
        if any(map(callable, a.values())):
            options |= {"spp": spp, "finds": finds}
        return Contrasts(_each(a, b, alpha, progress, options), alpha)
    if callable(a) or (spp, finds) != (None, None):
        options |= {"spp": spp, "finds": finds}
    with track("contrasting renders", 0, unit="render", show=progress):
        return _one(a, b, alpha=alpha, **options)


def _each(
    a: Mapping[str, Any], b: Any, alpha: float, progress: bool, options: Mapping[str, Any]
) -> dict[str, Contrast]:
    """Contrast each of several renders with one."""
    found = {}
    with track("contrasting renders", len(a), unit="render", show=progress) as advance:
        for name, of in a.items():
            own = {n: v for n, v in options.items() if callable(of) or n not in ("spp", "finds")}
            with portion(1, advance):
                found[str(name)] = _one(of, b, alpha=alpha / len(a), **own)
    return found


def _one(a: Any, b: Any, **options: Any) -> Contrast:
    """Contrast a render with another, and show what is being done."""
    if not callable(a) and "spp" in options:
        message = "spp and finds are for a function that draws samples, got a finished render"
        raise InputError(message)
    work = _drawing(a, b, **options) if callable(a) else contrasting(a, b, **options)
    what, done = "", 0.0
    with contextlib.ExitStack() as shown:
        while True:
            try:
                step, share = next(work)
            except StopIteration as end:
                found: Contrast = end.value
                return found
            if step != what:
                shown.close()
                advance = shown.enter_context(track(step, 100, unit="%"))
                what, done = step, 0.0
            advance(100 * (share - done))
            done = share


def _ranked(
    given: Mapping[str, Any] | Sequence[Any], *, alpha: float, progress: bool, **options: Any
) -> Contrasts:
    """Return several renders contrasted with the last one, and ranked by their noise."""
    for one in given.values() if isinstance(given, Mapping) else given:
        if (image := Reference.of(one)) is not None:
            message = (
                f"a ranking by noise needs the samples of each render, got an image, {image.name}: "
                "contrast renders with it as the second argument, b"
            )
            raise InputError(message)
    if isinstance(given, Mapping):
        renders = {str(name): independent(of) for name, of in given.items()}
    else:
        renders = named_renders([independent(of) for of in given])
    if len(renders) < 2:
        message = f"a ranking needs two renders or more, got {len(renders)}"
        raise InputError(message)
    check_one_view(renders)
    *names, last = renders
    others = {name: renders[name] for name in names}
    found = _each(others, renders[last], alpha, progress, options)
    return with_noise(Contrasts(found, alpha), renders, progress=progress)


def with_noise(
    found: Contrasts,
    renders: Mapping[str, Samples],
    *,
    patterns: bool = True,
    progress: bool = True,
) -> Contrasts:
    """Return contrasts of renders with the last one, with their ranking by noise.

    Parameters
    ----------
    found
        Contrast of each render with the last one.
    renders
        Samples of all renders by name, in the same order.
    patterns
        Say which patterns hold the noise, too; that takes longer than all else.
    progress
        Show progress, as `contrast`.
    """
    contrasts = [*found.contrasts.values()]
    sides = [*((of, "a") for of in contrasts), (contrasts[0], "b")]
    ranked = [
        RankedRender(
            name,
            samples,
            of.maps[f"mean_{side}"].to_numpy()[..., -samples.shape[2] :],
            of.maps[f"variance_{side}"].to_numpy(),
            seconds,
        )
        for (name, samples), (of, side), seconds in zip(
            renders.items(), sides, seconds_of([*renders.values()]), strict=True
        )
    ]
    with track("ranking renders", 0, unit="render", show=progress):
        noise = noise_ranking(ranked, alpha=found.alpha, patterns=patterns, progress=progress)
    return replace(found, noise=noise)


def contrasting(
    a: _RenderLike,
    b: _RenderLike,
    *,
    alpha: float = 0.05,
    seconds: float | None = None,
    distributions: bool = False,
    seed: Seed = 0,
) -> Generator[tuple[str, float], None, Contrast]:
    """Return what `contrast` does, in steps.

    Yields what is being done, and the share that is done.
    """
    check_probability(alpha=alpha)
    pair, seed = Pair.of(a, b, seconds), seed_number(seed)
    maps, cells, edge = yield from pair.compare()
    cells = cells.with_extra_variance(seed)
    p = maps["p_value"]
    height, width, bands = p.shape
    q = maps["q_value"] = q_values(p.reshape(height, width * bands)).reshape(p.shape)
    rare = None if pair.of_image else RareLight(maps, pair.spp)

    def is_rare(of: ClearestWindow) -> bool:
        return rare is not None and rare.in_cells(of, edge) is not None

    scan = yield from scan_windows(cells, alpha=alpha * _OF_WINDOWS, seed=seed, is_rare=is_rare)
    p_with_rare = _of_parts(scan.p_with_rare, q)
    if rare is not None:
        q[rare.in_pixels() & np.isfinite(q)] = 1.0
    image_p_value, parts = _of_parts(scan.p_value, q), _parts(scan.p_value, q)
    y, x, rows, columns = (edge * size for size in scan.window)
    band, higher = scan.band, scan.higher
    (loss, window_loss), detectable = _losses(cells, pair.terms, scan), scan.detectable
    one = (q <= alpha).any(axis=-1).sum() == 1 and parts[1] < parts[0]
    if parts[1] <= alpha and (one or not parts[0] <= alpha):  # a pixel decides
        rows = columns = 1
        y, x, band, window_loss, higher = _clearest_pixel(maps, q)
    unseen = (
        scan.unseen if all(pair.units) or not pair.of_image else _hidden(maps, pair, detectable)
    )
    differ = image_p_value <= alpha
    why, spp_needed = _why_not(maps, pair, detectable, unseen, differ=differ)
    if p_with_rare <= alpha and not differ:
        why, spp_needed = _may_have_missed(rare, scan.rare, edge, pair)
    dataset = _dataset(maps, pair)
    return Contrast(
        names=pair.names,
        scenes=pair.scenes,
        maps=dataset.assign(pair.shapes(seed) if distributions else {}),
        outcome="cannot tell" if why else "differ" if differ else "no difference found",
        why=why,
        spp_needed=spp_needed,
        image_p_value=image_p_value,
        share=float((q <= alpha).any(axis=-1).mean()),
        loss=loss,
        window=(y, x, min(rows, height - y), min(columns, width - x)),
        window_channel=str(dataset["channel"].values[band]),
        window_loss=window_loss,
        window_brighter="B" if higher else "A",
        detectable=detectable,
        efficiency_ratio=_efficiency(maps, pair.seconds),
        timed=("pixels" if pair.costs else "clock") if np.isfinite(pair.seconds).all() else "",
        spp=pair.counts,
        spp_range=pair.spp_range,
        reference=pair.b.known if isinstance(pair.b, Reference) else "",
        cannot_show=pair.b.cannot_show if isinstance(pair.b, Reference) else (),
        seconds=pair.seconds,
        correlation=np.nan if pair.of_image else _median(maps["correlation"]),
        paired=pair.paired,
        alpha=alpha,
    )


def _clearest_pixel(maps: dict[str, Array], q: Floats) -> tuple[int, int, int, float, bool]:
    """Return place and band of the smallest q-value, the loss there, and whether B is brighter."""
    y, x, band = map(int, np.unravel_index(np.nanargmin(q), q.shape))
    of_a, of_b = (float(maps[f"mean_{name}"][y, x, band]) for name in "ab")
    return y, x, band, 1 - of_b / of_a if of_a > 0 else np.nan, of_b > of_a


def _parts(of_windows: float, q: Floats) -> tuple[float, float]:
    """Return p-values of windows and of the clearest pixel, each with its share of alpha."""
    smallest = float(np.nanmin(q)) if np.isfinite(q).any() else np.nan
    return of_windows / _OF_WINDOWS, smallest / (1 - _OF_WINDOWS)


def _of_parts(of_windows: float, q: Floats) -> float:
    """Return the p-value of the whole test."""
    return float(np.min([1.0, *(p for p in _parts(of_windows, q) if np.isfinite(p))]))


def _drawing(
    draw: Draw,
    b: _RenderLike,
    *,
    alpha: float,
    spp: int | None,
    finds: float | None,
    seed: Seed,
    **options: Any,
) -> Generator[tuple[str, float], None, Contrast]:
    """Return the contrast of a render that is drawn until it can be told from B.

    References
    ----------
    Lan and DeMets, "Discrete sequential boundaries for clinical trials", 1983,
    doi:10.1093/biomet/70.3.659, with Pocock's spending of the level.
    """
    check_probability(alpha=alpha)
    if spp is None:
        message = "a function that draws samples needs spp, the most to draw, got None"
        raise InputError(message)
    most, first = whole("spp", spp, least=LEAST_TERMS), seed_number(seed)
    other = Reference.of(b) or b
    parts: list[Array] = []
    seeds, drawn, smallest, spent = itertools.count(first), 0, 1.0, 0.0
    for look in _LOOKS:
        while drawn < look * most:
            x = _samples_of(draw, next(seeds), parts)
            parts.append(x[..., : most - drawn])
            drawn += parts[-1].shape[-1]
            yield "drawing samples", drawn / most
        share = math.log1p((math.e - 1) * look) - spent
        spent += share
        parts = [np.concatenate(parts, axis=-1)]
        samples = Samples.from_array(parts[0], axes="yxcs")
        found = yield from contrasting(samples, other, alpha=alpha * share, seed=first, **options)
        smallest = min(smallest, found.image_p_value / share)
        told = finds is not None and found.detectable["image"] <= finds
        if drawn == most or found.outcome == "differ" or (told and not found.why):
            break
    return replace(found, image_p_value=smallest, alpha=alpha)


def _samples_of(draw: Draw, seed: int, others: list[Array]) -> Array:
    """Return what a function draws from a seed, shape (y, x, channel, sample)."""
    drawn = np.asarray(draw(seed))
    check_real(drawn.dtype, f"what draw({seed}) returned")
    x = drawn[..., np.newaxis] if drawn.ndim == 3 else drawn
    shape = others[0].shape[:3] if others else x.shape[:3]
    if x.ndim != 4 or 0 in x.shape or x.shape[:3] != shape:
        wanted = "(y, x, channel) or (y, x, channel, sample)" if x.ndim != 4 else f"{shape}"
        message = f"draw must return an array of shape {wanted}, got {drawn.shape} for seed {seed}"
        raise InputError(message)
    return x


def _why_not(
    maps: dict[str, Array],
    pair: Pair,
    detectable: dict[str, float],
    unseen: tuple[float, int] | None,
    *,
    differ: bool,
) -> tuple[str, int | None]:
    """Return why there is no decision, "" if there is one, and the spp that would give one."""
    spp = min(pair.spp)
    if not np.isfinite(maps["p_value"]).any():
        if spp < 2:
            needs = f"a contrast needs at least 2 samples per pixel, got {spp}"
            return f"{needs}: render {LEAST_TERMS} or more", LEAST_TERMS
        equal = maps["reason"] == Reason.CONSTANT
        if (equal & ~maps["constant"]).any():
            return (
                "the samples of A and B are equal, one by one, as of one render given twice",
                None,
            )
        if not equal.any():
            black = (maps["reason"] == Reason.ALL_NULL).any()
            return "A and B are black" if black else "no pixel has good samples in A and B", None
    if pair.terms < LEAST_TERMS:
        return f"{spp} samples per pixel are too few, render {LEAST_TERMS} or more", LEAST_TERMS
    if differ:
        return "", None
    lost = int(((maps["bad_a"] == 1) != (maps["bad_b"] == 1)).sum())
    if lost:
        has = "has" if lost == 1 else "have"
        return f"{_counted(lost, 'pixel')} {has} good samples on one side only", None
    if unseen is not None:
        share, needed = unseen
        if pair.of_image and not all(pair.units):
            why = (
                f"B has {percent(share)} of its light in pixels where A and its neighbours show "
                f"none of it in {spp} samples, which may be too rare: render "
            )
            return (f"{why}{needed} of A", needed) if needed > spp else (f"{why}more of A", None)
        short, longer, seen = "A", "B", pair.spp[0]
        if pair.units[0] > pair.units[1]:
            short, longer, seen = "B", "A", pair.counts[1] or pair.spp[1]
        why = (
            f"{longer} has {percent(share)} of its light in samples so rare that {seen} per "
            f"pixel are likely to miss them, and {short} has none: render {needed} of {short}"
        )
        return why, needed
    if detectable.get("image", np.nan) >= 1:
        return "not even the loss of all light would have been found; render more samples", None
    return "", None


def _may_have_missed(
    rare: RareLight | None, of: ClearestWindow | None, edge: int, pair: Pair
) -> tuple[str, int | None]:
    """Return why a difference is no evidence, and the spp that would make it one."""
    unmet = None if rare is None or of is None else rare.in_cells(of, edge)
    if unmet is None or of is None:
        why = "pixels differ where one render may have missed light that it meets rarely"
        return f"{why}: render more samples", None
    render, spp = "AB"[unmet.render], pair.spp[unmet.render]
    y, x, height, width = (edge * at for at in of.window)
    needed = unmet.needed(spp)
    where = f"{width} x {height} pixels at {_place((y, x))}"
    return (
        f"in {where}, {render} meets its light in samples so rare that {spp} per pixel may have "
        f"missed them, and the other render does not: render {needed} of {render}",
        needed,
    )


@np.errstate(all="ignore")
def _hidden(
    maps: dict[str, Array], pair: Pair, detectable: dict[str, float]
) -> tuple[float, int] | None:
    """Return the share of the light of a reference that A does not show, and the spp for it.

    None if it is less than would have been found.
    """
    light, total = maps["hidden"].sum(), np.nansum(maps["mean_b"][..., 0])
    found = detectable["image"] if detectable["image"] < 1 else 0
    if not light > max(found, LEAST_LIGHT) * total > 0:
        return None
    error = np.sqrt(maps["extra"][maps["hidden"] > 0].sum() / pair.terms)
    return float(light / total), int(np.ceil(pair.spp[0] * (_STANDARD_ERRORS * error / light) ** 2))


@np.errstate(all="ignore")
def _losses(cells: Cells, terms: int, scan: WindowTest) -> tuple[Interval[float], float]:
    """Return how much darker B is, overall and in the window."""
    y, x, rows, columns = scan.window
    here = scan.band, slice(y, y + rows), slice(x, x + columns)
    shift = cells.differences[here].sum(dtype=float)
    level = cells.levels[here].sum(dtype=float) - shift / 2
    d, both = cells.differences[0], cells.levels[0]
    edge = max(d.shape[:2])
    value, error = (found.item() for found in _relative(d, both, edge))
    reach = float(stats.t.ppf(0.975, terms - 1)) * error if terms > 1 else np.nan
    return (
        Interval(-value, -value - reach, -value + reach, standard_error=error),
        float(-shift / level) if level > _ROUNDING * np.abs(shift) else np.nan,
    )


def _relative(d: Array, level: Array, edge: int) -> tuple[Floats, Floats]:
    """Return relative differences of windows and their standard errors, each (y, x)."""
    sums = window_sums(d, edge)[0]
    mean, terms = sums.mean(axis=-1), sums.shape[-1]
    base = window_sums(level, edge)[0].mean(axis=-1) - mean / 2
    base = np.where(base > _ROUNDING * np.abs(mean), base, np.nan)  # else A is black
    error = sums.std(axis=-1, ddof=1) / np.sqrt(terms) if terms > 1 else np.nan
    return mean / base, np.broadcast_to(error / base, base.shape)


@np.errstate(all="ignore")
def _efficiency(maps: dict[str, Array], seconds: tuple[float, float]) -> Interval[float]:
    """Return the ratio of 1 / (relative variance x time), B over A, over the image."""
    # The scale is the mean of all samples: the mean of few is as uncertain as their variance.
    mean = maps["radiance"]
    good = mean[np.isfinite(mean)]
    scale = relative_scale(mean, good.sum() / max(good.size, 1))
    costs = [
        (maps[name] / scale * time).ravel()
        for name, time in zip(("variance_a", "variance_b"), seconds, strict=True)
    ]
    known = np.isfinite(costs).all(axis=0)
    if not known.any():
        return Interval.unknown()
    return cost_ratio(costs[0][known], costs[1][known], Blocks.strata(*mean.shape)[known])


def _median(x: Array) -> float:
    known = x[np.isfinite(x)]
    return float(np.median(known)) if known.size else np.nan


def _place(at: Sequence[int]) -> str:
    return f"y {at[0]}, x {at[1]}"


def _counted(count: int, noun: str) -> str:
    return f"{count} {noun}{'s' * (count != 1)}"


_LABELS: dict[str, str | tuple[str, str]] = {
    "mean_a": ("mean of A", RADIANCE),
    "mean_b": ("mean of B", RADIANCE),
    "difference": ("mean of B minus mean of A", RADIANCE),
    "standard_error": ("standard error of the difference", RADIANCE),
    "p_value": "p-value of equal means",
    "q_value": "q-value of equal means, over pixels and channels",
    "variance_a": ("variance of the luminance of a sample of A", "W2 sr-2 m-4"),
    "variance_b": ("variance of the luminance of a sample of B", "W2 sr-2 m-4"),
    "efficiency": "1 / (variance x time), B over A",
    "bad_a": ("share of bad samples of A", "1"),
    "bad_b": ("share of bad samples of B", "1"),
    "reason": "why there is no p-value",
}


@np.errstate(all="ignore")
def _dataset(maps: dict[str, Array], pair: Pair) -> xr.Dataset:
    import xarray as xr

    times = pair.costs or pair.seconds
    cost_a, cost_b = maps["variance_a"] * times[0], maps["variance_b"] * times[1]
    efficiency = cost_a / cost_b
    efficiency = np.where(np.isfinite(efficiency), efficiency, np.nan)
    maps = {**maps, "difference": maps["mean_b"] - maps["mean_a"], "efficiency": efficiency}
    variables = {name: (("y", "x", "channel")[: maps[name].ndim], maps[name]) for name in _LABELS}
    height, width, bands = maps["p_value"].shape
    names = (*("luminance",)[: bands - len(pair.a.channels)], *pair.a.channels)
    coords = {"y": np.arange(height), "x": np.arange(width), "channel": np.array(names, object)}
    return label_variables(xr.Dataset(variables, coords), _LABELS)
