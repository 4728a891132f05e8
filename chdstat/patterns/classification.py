"""Patterns: which pixels are null-heavy, long-tailed, bimodal or constant, and how the rest looks.

`chdstat.patterns.definitions` says what a pattern means, its statistic, and the rule that turns it
into a flag at a threshold. `classify` applies all rules to the luminance of each pixel. A pixel may
have several flags, except those that describe a plain body; `Label` says which one comes first.
`agreement` compares labels with those of the neighbours: meaningful labels form regions; labels
that are noise look like the same labels shuffled.
"""

from __future__ import annotations

import enum
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from chdstat._core.arrays import (
    Floats,
    Mapped,
    Mask,
    first_of,
    flag_attributes,
    flag_names,
    label_variables,
    place_attributes,
)
from chdstat._core.display import Card, Shown, number, percent, with_interval
from chdstat._core.doors import classified, untrusted
from chdstat._core.positive import PositivePart
from chdstat._core.resampling import q_values
from chdstat._core.statistic import MapKind, Result, Statistic, result, variable
from chdstat.errors import InputError, Reason
from chdstat.fit.error_bars import (
    HOLDS,
    LEAST,
    Bar,
    ErrorBars,
    pooled_bars,
    shape_variables,
    spp_in_words,
    with_pooled_bars,
)
from chdstat.fit.families import FAMILIES
from chdstat.fit.tail import TailIndex, is_infinite
from chdstat.patterns.cures import cure_in, renderer_of
from chdstat.patterns.definitions import (
    BODIES,
    PATTERNS,
    Thresholds,
    body_of,
    firefly_limit,
    gather,
)
from chdstat.samples import Samples
from chdstat.samples.tiles import Region
from chdstat.summary.runner import Source, measured, of_source, run

if TYPE_CHECKING:
    import xarray as xr


class Label(enum.IntEnum):
    """The first of these labels that holds for a pixel; UNDETERMINED if none does."""

    UNDETERMINED = 0
    """Too few usable samples for a label."""
    BLACK = 1
    """Every good sample is null."""
    CONSTANT = 2
    FIREFLY_DOMINATED = 3
    MULTIMODAL = 4
    BIMODAL = 5
    LONG_TAIL = 6
    NULL_HEAVY = 7
    GAMMA_LIKE = 8
    LOGNORMAL_LIKE = 9
    OTHER = 10
    """None of these: one mode without a long tail, which neither family describes."""

    @property
    def meaning(self) -> str:
        """The cause of the pattern."""
        return _EXPLAINED[self][0]

    @property
    def cure(self) -> str:
        """What helps against the noise of such pixels."""
        return _EXPLAINED[self][1]

    def cure_by(self, attrs: Mapping[str, Any]) -> str:
        """Return what helps in the words of the renderer that drew samples with these attributes.

        Examples
        --------
        >>> Label.GAMMA_LIKE.cure_by({"renderer": "LuxCore 2.11.2"})
        'batch.haltspp: four times as many halve the noise'
        """
        return cure_in(renderer_of(attrs), self.name.lower(), otherwise=self.cure)

    @property
    def typical(self) -> str:
        """A typical pixel: where it lies in a built-in scene, and how its samples look."""
        return _EXPLAINED[self][2]

    @property
    def words(self) -> str:
        """The name in running text."""
        return self.name.lower().replace("_", "-")


_EXPLAINED: dict[Label, tuple[str, str, str]] = {
    Label.UNDETERMINED: (
        "too few samples that find light",
        "more samples: 128 that are not null show shapes, 512 or more tails and modes",
        "a few bars without a shape",
    ),
    Label.BLACK: (
        "no path finds light",
        "compare it with its neighbours; if they are lit, render it alone with more samples",
        "the frame outside of the Cornell box",
    ),
    Label.OTHER: (
        "one kind of paths, or several that overlap, without a pattern that stands out",
        "more samples, at the usual rate",
        "the floor under many lights: one broad, skewed hump",
    ),
} | {Label[p.name.upper()]: (p.meaning, p.cure, p.typical) for p in PATTERNS}
_FLAGGED = {label: label.name.lower() for label in Label if label not in (0, 1, 10)}


@result
class Patterns(Result):
    """Patterns of pixels; arrays with the batch's shape, dimensionless.

    Attributes
    ----------
    flags
        Whether the pixel has the pattern, by the name of the pattern.
    large_enough
        Whether the effect is large enough, by the name of the pattern, significant or not, excluded
        or not.
    statistics
        Statistic of the pattern, by its name; NaN where there is nothing to measure.
    p_values
        P-value of the hypothesis that the pattern is absent, by the name of patterns with a test.
    intervals
        95 % interval of the statistic, by the name of patterns that have one, shape (..., 2).
    dip
        Hartigan's dip of log luminance.
    luminance_family
        Index of the best family in `chdstat.fit.families.FAMILIES`, -1 for none.
    misfit
        Kolmogorov-Smirnov distance between the samples and the better of gamma and log-normal.
    body
        What describes the samples: 0 for gamma, 1 for log-normal, 2 for a mixture of several modes,
        3 for one mode that neither describes, -1 where nothing is known.
    luminance_tail_index, long_tail_se
        Tail index without a sample that dominates, and its standard error.
    variance_unidentified
        Where the samples do not tell whether their error bar holds: the absence of a long tail is
        then no promise of a short one.
    body_tail_index
        Tail index of the excesses over the 0.9 quantile of the better of gamma and log-normal.
    label
        `Label` codes.
    reason
        `Reason` codes of the positive part.
    error_bars
        What the statistic of a long tail uses: see `ErrorBars`.
    """

    flags: Mapping[str, Mask]
    large_enough: Mapping[str, Mask]
    statistics: Mapping[str, Floats]
    p_values: Mapping[str, Floats]
    intervals: Mapping[str, Floats]
    dip: Floats = variable("Hartigan's dip of log10 luminance")
    luminance_family: npt.NDArray[np.int8] = variable("family of luminance with the smallest BIC")
    misfit: Floats = variable("Kolmogorov distance to the better of gamma and log-normal")
    body: npt.NDArray[np.int8] = variable("what describes the samples of luminance")
    luminance_tail_index: Floats = variable("tail index of luminance, without a firefly")
    long_tail_se: Floats = variable("standard error of the tail index of luminance")
    variance_unidentified: Mask = variable("the samples do not tell whether their error bar holds")
    body_tail_index: Floats = variable(
        "tail index of the better of gamma and log-normal above its quantile 0.9"
    )
    label: npt.NDArray[np.int8] = variable("what the pixel is first of all")
    reason: npt.NDArray[np.int8] = variable("why there is no positive part to look at")
    error_bars: ErrorBars

    def _card(self) -> Card:
        first = [Label(int(code)).name.lower() for code in np.ravel(self.label)]
        if len(first) > 1:
            shares = {name: percent(first.count(name) / len(first)) for name in sorted({*first})}
            held = {name: percent(float(flag.mean())) for name, flag in self.flags.items()}
            return Card(f"Patterns of {len(first)} rows", {"label": shares, "flags": held})
        rows = []
        for name, flag in self.flags.items():
            low, high = np.ravel(self.intervals.get(name, np.full(2, np.nan)))
            value, p = self.statistics[name], self.p_values.get(name, np.array(np.nan))
            shown = with_interval(value.item(), low, high)
            holds = "yes" if flag.any() else "no"
            rows.append(
                {"pattern": name, "holds": holds, "statistic": shown, "p": number(p.item())}
            )
        return Card("Patterns", {"label": first[0]}, rows)


_DEFAULT = Thresholds()
_LONG_TAIL = next(pattern for pattern in PATTERNS if pattern.name == "long_tail")


@dataclass(frozen=True)
class Classification(Statistic[Patterns]):
    """The patterns of luminance in `PATTERNS`, at given thresholds."""

    result: ClassVar = Patterns
    description: ClassVar = "classifying"
    rows: ClassVar = "luminance"

    thresholds: Thresholds = _DEFAULT

    def maps(self) -> tuple[MapKind, ...]:
        """Return the label, which is decided with p-values that the size of the image corrects."""
        names = {int(label): label.name.lower() for label in Label}
        of = lambda found: found.label  # noqa: E731 - as in other maps
        return (MapKind("pattern", "Pattern", "primary label", of, names, decided="label"),)

    def measure(self, part: PositivePart) -> Patterns:
        """Classify each row, with tests of its own."""
        thresholds = self.thresholds
        found = gather(part, thresholds)
        # For a single pixel, arithmetic returns numbers: results are arrays of shape ().
        p_values = {p.name: np.asarray(p.test(found, thresholds)) for p in PATTERNS if p.test}
        large_enough = {p.name: np.asarray(p.large_enough(found, thresholds)) for p in PATTERNS}
        flags = self._decide(large_enough, p_values)
        reason = part.reason()
        return Patterns(
            flags=flags,
            large_enough=large_enough,
            statistics={p.name: np.asarray(p.measure(found)) for p in PATTERNS},
            p_values=p_values,
            intervals={p.name: p.interval(found) for p in PATTERNS if p.interval},
            dip=found.modes.dip,
            luminance_family=found.family,
            misfit=found.misfit,
            body=body_of(found, thresholds),
            luminance_tail_index=np.asarray(found.tail.xi),
            long_tail_se=np.asarray(found.tail.standard_error),
            variance_unidentified=found.tail.variance_unidentified,
            body_tail_index=found.body_index,
            label=_label(flags, reason, found.modes.modes > 0),
            reason=reason,
            error_bars=found.error_bars,
        )

    def variables(self, found: Patterns) -> Mapped:
        """Return patterns as variables; flags only say that effects are large enough, so far."""
        single: dict[str, npt.NDArray[Any]] = {
            **found.large_enough,
            **{f"{name}_statistic": value for name, value in found.statistics.items()},
            **{f"{name}_p_value": value for name, value in found.p_values.items()},
        }
        intervals = {f"{name}_interval": (("bound",), v) for name, v in found.intervals.items()}
        variables = {name: ((), value) for name, value in single.items()}
        own = {"long_tail_own": ((), found.statistics["long_tail"])}
        around = shape_variables(found.error_bars, (), "long_tail_")
        return {**variables, **super().variables(found), **intervals, **own, **around}

    def finish(self, dataset: xr.Dataset) -> xr.Dataset:
        """Correct the p-values of an image, decide its flags and labels, and compare neighbours."""
        spp = spp_in_words(dataset["long_tail_shape_samples"].to_numpy())
        dataset = self._with_neighbours(with_pooled_bars(dataset, "long_tail_"))
        q = {p.name: q_values(dataset[f"{p.name}_p_value"].to_numpy()) for p in PATTERNS if p.test}
        flags = self._decide({p.name: dataset[p.name].to_numpy() for p in PATTERNS}, q)
        known = dataset["label"].to_numpy() != Label.UNDETERMINED
        label = _label(flags, dataset["reason"].to_numpy(), known)
        found = agreement(label, known)
        decided = {**flags, **{f"{name}_q_value": v for name, v in q.items()}, "label": label}
        decided["label_agreement"] = found.share
        dataset = dataset.assign({name: (("y", "x"), value) for name, value in decided.items()})
        texts = {"label_agreement": "share of the neighbours with the same label"}
        for pattern in PATTERNS:
            texts[pattern.name] = f"{pattern.meaning}: {pattern.rule}"
            texts[f"{pattern.name}_statistic"] = pattern.statistic
            texts[f"{pattern.name}_interval"] = f"95 % interval of the {pattern.statistic}"
            texts[f"{pattern.name}_p_value"] = f"p-value of no {pattern.name}"
            texts[f"{pattern.name}_q_value"] = f"q-value of no {pattern.name}"
            dataset[pattern.name].attrs["source"] = pattern.source
        texts["long_tail_own"] = f"{_LONG_TAIL.statistic}, by its own samples"
        for name in ("long_tail", "firefly_dominated"):
            texts[name] += f"; at {spp}"
        dataset = label_variables(super().finish(dataset), texts)
        dataset["luminance_family"].attrs.update(place_attributes(tuple(FAMILIES)))
        dataset["body"].attrs.update(place_attributes(BODIES))
        dataset["label"].attrs.update(flag_attributes(Label))
        dataset["label_agreement"].attrs.update(
            observed=found.observed, by_chance=found.expected, kappa=found.kappa
        )
        given = asdict(self.thresholds)
        return dataset.assign_attrs({f"threshold_{name}": value for name, value in given.items()})

    def _with_neighbours(self, dataset: xr.Dataset) -> xr.Dataset:
        """Let the pixels around say which error bars fail, where they are known."""
        coverage, interval = (dataset[f"long_tail_{n}"] for n in ("coverage", "coverage_interval"))
        misses, known = 1 - coverage, np.isfinite(coverage)
        is_long = (misses > self.thresholds.misses).where(known, dataset["long_tail"])
        named = {
            "long_tail": is_long,
            "long_tail_statistic": misses,
            "long_tail_interval": 1 - interval.isel(bound=slice(None, None, -1)),
            "variance_unidentified": (coverage < HOLDS).where(
                known, dataset["variance_unidentified"]
            )
            & ~is_long,
        }
        return dataset.drop_vars([coverage.name, interval.name]).assign(named)

    def _decide(
        self, large_enough: Mapping[str, Mask], significance: Mapping[str, Floats]
    ) -> dict[str, Mask]:
        """Keep the flags that are significant, if their rule asks for it, and not excluded."""
        flags = {name: np.array(large) for name, large in large_enough.items()}
        for pattern in PATTERNS:
            if pattern.decisive:
                flags[pattern.name] &= significance[pattern.name] <= self.thresholds.alpha
        for pattern in PATTERNS:
            for other in pattern.excluded_by:
                flags[pattern.name] &= ~flags[other]
        return flags


def _label(
    flags: Mapping[str, Mask], reason: npt.NDArray[np.int8], known: Mask
) -> npt.NDArray[np.int8]:
    cases = {
        Label.BLACK: reason == Reason.ALL_NULL,
        **{label: flags[name] for label, name in _FLAGGED.items()},
        Label.OTHER: known,
    }
    return first_of(cases, Label.UNDETERMINED)


@of_source
def classify(
    x: Source, *, thresholds: Thresholds | None = None, progress: bool = True
) -> Patterns | xr.Dataset:
    """Return the patterns that the sample distribution of each pixel shows.

    Each flag is a row of `PATTERNS`: a statistic, an effect that is large enough and, if the rule
    asks for it, a p-value. For an image, the p-values of a pattern are corrected for the number of
    pixels (Benjamini and Hochberg). For an array, they are not: each pixel is tested at level
    `Thresholds.alpha`. `label` is the first entry of `Label` that holds.

    Parameters
    ----------
    x
        An image, as `Samples` or the path of a store; or an array of radiance, shape (..., channel,
        sample), with 1 or 3 channels. A sample is null if all its channels are 0, bad if any is
        bad.
    thresholds
        Thresholds of the patterns; None for the defaults.
    progress
        For `Samples`: show progress, as a bar in a terminal or notebook, elsewhere as a line every
        ten seconds.

    Returns
    -------
    Patterns or xarray.Dataset
        `Patterns` for an array. For `Samples`, a dataset over (y, x): for each pattern, the flag by
        its name, and ``_statistic``, ``_p_value``, ``_q_value`` and ``_interval`` with the name as
        prefix, if the pattern has them; the other fields of `Patterns`; and ``label_agreement``,
        the share of the neighbours with the same label. Its attributes ``kappa`` and ``z`` compare
        the image with shuffled labels (see `agreement`).

    Raises
    ------
    InputError
        If there are neither 1 nor 3 channels.

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> gray = rng.gamma(2.0, size=(4, 1, 1024))
    >>> gray[1, :, :700] = 0
    >>> gray[2, :, ::2] *= 1000
    >>> gray[3] = 1
    >>> [Label(code).name for code in classify(gray).label]
    ['GAMMA_LIKE', 'NULL_HEAVY', 'BIMODAL', 'CONSTANT']
    """
    return run(Classification(thresholds or Thresholds()), x, progress=progress)


_OFFSETS = tuple((i, j) for i in (0, 1, 2) for j in (0, 1, 2) if (i, j) != (1, 1))


@dataclass(frozen=True, repr=False)
class Agreement(Shown):
    """Agreement of labels with their neighbours.

    Attributes
    ----------
    share
        Share of the up to 8 neighbours that have the pixel's label, shape (y, x); NaN where the
        pixel or all of its neighbours have no label.
    observed, expected
        Share of all pairs of neighbours with equal labels, as observed and for shuffled labels.
    kappa
        ``(observed - expected) / (1 - expected)``: 0 for shuffled labels, 1 for complete agreement;
        NaN where all labels are equal.
    """

    share: Floats
    observed: float
    expected: float
    kappa: float


def agreement(labels: npt.NDArray[np.integer], known: Mask | None = None) -> Agreement:
    """Compare the labels of an image with those of their neighbours, and with shuffled labels.

    The number of equal pairs of neighbours is Moran's join count, for all labels at once; its mean
    over all permutations is known without permuting. `kappa` corrects for agreement by chance, as
    Cohen's does.

    Parameters
    ----------
    labels
        Labels, shape (y, x).
    known
        Which pixels have a label, same shape; None for all. Other pixels are ignored.

    Raises
    ------
    InputError
        If the shapes are not those of one image.

    References
    ----------
    Moran, "The interpretation of statistical maps", 1948, doi:10.1111/j.2517-6161.1948.tb00012.x.
    Cohen, "A coefficient of agreement for nominal scales", 1960, doi:10.1177/001316446002000104.

    Examples
    --------
    >>> halves = np.repeat([[0, 1]], 8, axis=0).repeat(4, axis=1)
    >>> found = agreement(halves)
    >>> round(found.kappa, 2), float(found.share[0, 0])
    (0.79, 1.0)
    """
    known = np.ones(labels.shape, dtype=bool) if known is None else known
    if labels.ndim != 2 or known.shape != labels.shape:
        message = f"labels and known must have one shape (y, x), got {labels.shape}, {known.shape}"
        raise InputError(message)
    height, width = labels.shape
    around, there = np.pad(labels, 1), np.pad(known, 1)
    # Known neighbours of each pixel, and those with an equal label.
    neighbours, equal = np.zeros((2, height, width), dtype=np.int64)
    for i, j in _OFFSETS:
        here = np.s_[i : i + height, j : j + width]
        both = there[here] & known
        neighbours += both
        equal += both & (around[here] == labels)
    _, counts = np.unique(labels[known], return_counts=True)
    n = counts.sum()
    with np.errstate(invalid="ignore", divide="ignore"):
        share = np.where(known, equal / neighbours, np.nan)
        observed = equal.sum() / neighbours.sum()
        expected = (counts * (counts - 1)).sum() / (n * (n - 1))
        kappa = (observed - expected) / (1 - expected)
    return Agreement(share, float(observed), float(expected), float(kappa))


def choose_regions(patterns: xr.Dataset, *, edge: int = 5, most: int = 8) -> tuple[Region, ...]:
    """Choose one region for every pattern of an image, where the pattern is purest.

    The region is the window of `edge` x `edge` pixels around a pixel of the label that has the most
    pixels of the label. Among equal windows, it is the one deepest inside its patch, so that marks
    do not lie on borders. At the border of the image, it is smaller.

    Parameters
    ----------
    patterns
        Result of `chdstat.classify`: `label` (y, x) with its flag meanings.
    edge
        Edge of a region in pixels; smaller in smaller images.
    most
        Most regions; the most frequent labels come first.
    """
    label = patterns["label"]
    codes = np.asarray(label.values)
    masks = {n.replace("_", "-"): codes == c for c, n in flag_names(label.attrs).items()}
    edge = min(edge, *codes.shape)
    found = sorted(filter(lambda n: masks[n].any(), masks), key=lambda n: -masks[n].sum())
    return tuple(
        Region(
            n,
            n,
            _purest(masks[n], edge),
            f"{percent(float(masks[n].mean()))} of the pixels have this label",
        )
        for n in found[:most]
    )


def _purest(mask: npt.NDArray[np.bool_], edge: int) -> tuple[float, float, float, float]:
    height, width = mask.shape
    depth = ndimage.distance_transform_edt(np.pad(mask, 1))[1:-1, 1:-1]
    score = ndimage.uniform_filter(mask.astype(float), edge, mode="constant") + 1e-3 * depth
    y, x = np.unravel_index(np.argmax(np.where(mask, score, -1)), mask.shape)
    # Around that pixel, so that the one in the middle has the label.
    half = int(min((edge - 1) // 2, y, x, height - 1 - y, width - 1 - x))
    ends = x - half, y - half, x + half + 1, y + half + 1
    left, top, right, bottom = (
        float(end / length) for end, length in zip(ends, (width, height) * 2, strict=True)
    )
    return left, top, right, bottom


def untrusted_variance(samples: Samples, *, progress: bool = True) -> Mask:
    """Return where `classify` flags a long tail or a firefly, at an eighth of its cost; (y, x).

    Examples
    --------
    >>> x = np.random.default_rng(1).gamma(2.0, size=(16, 16, 1, 128))
    >>> x[2, 2, 0, 7] = 1e4
    >>> found = untrusted_variance(Samples.from_array(x), progress=False)
    >>> bool(found[2, 2]), bool(found[12, 12])
    (True, False)
    """

    def of_block(block: npt.NDArray[np.float32]) -> Mapped:
        part = PositivePart.of_pixels(block, rows="luminance")
        bars = measured(part, Bar())
        firefly = np.asarray(part.largest_share > firefly_limit(part.n, _DEFAULT))
        infinite = np.zeros(firefly.shape, bool)
        if (part.n_good < LEAST).any():  # pixels with fewer have no error bars to judge
            infinite = np.asarray(is_infinite(measured(part, TailIndex())))
        own = {"firefly": ((), firefly), "infinite": ((), infinite)}
        return {**own, **shape_variables(bars, (), "")}

    found = samples.map(of_block, description="judging variances", progress=progress)
    at_hand = {name: of.to_numpy() for name, of in found.items()}
    coverage = pooled_bars(at_hand["shape"], at_hand["shape_samples"]).coverage
    fails = np.where(np.isfinite(coverage), 1 - coverage > _DEFAULT.misses, at_hand["infinite"])
    return np.asarray(fails | at_hand["firefly"])


classified.register(Samples, classify)
untrusted.register(Samples, untrusted_variance)
