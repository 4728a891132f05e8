"""Windows: whether sums of differences over windows of an image are larger than chance explains.

If two renders have one distribution, or if pairs of their samples differ symmetrically, the
difference of sample i has either sign with equal probability. That holds for any tails and any
number of nulls: flips of signs are exact.

Integrators that agree in the mean only, such as with and without Russian roulette, differ in
skewness. A pixel that missed all its rare bright paths then seems to be too dark beyond doubt. Its
neighbours have seen such paths, so their standard error counts, too (`guarded`).

With unequal numbers of samples, a term is the average of many samples minus one sample, and flips
of its sign are not exact. Then divisions of the samples of both renders are compared, too.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, NamedTuple, cast

import numpy as np
from scipy import ndimage, sparse, special, stats

from chdstat._core.arrays import Array, Floats, Image, Mask, Reals, Seed, generator
from chdstat.inference.permutations import log_choices, p_of_tail, quantile_of_tail

CHANCE_TO_MISS = 0.05
"""Probability of missing the light that `Contrast.spp_needed` is about."""

_Window = tuple[int, int, int, int]
_NEAR = (5, 11)
"""Edges of neighbourhoods whose standard errors count where skewness opposes a pixel."""
_WIDE = (5, 15)
"""Edges of neighbourhoods whose standard errors count for p-values below `_EXTREME`."""
_EXTREME = 3e-3
_SKEWED = 1.2
"""Limit for the sum of cubes over the root of the sum of sixth powers. That ratio is 1 for a single
outlier, and N(0, 1) without skewness."""
_ONE_SIDED = 0.02
"""If the sums of both signs have a smaller ratio, the rarer sign may have been missed."""
_FEW = 0.3
"""Skewness that about ten outliers have."""
_DARK = 1e-3
"""Share of the image's mean radiance below which a pixel has no scale of its own."""
LEAST_LIGHT = 1e-3
"""Share of the image's light below which light is not worth more samples."""
_FLIPS = 499
FEWEST_FLIPS = 32
"""Terms from which on flips can be as rare as the level of one of many tests."""
_OF_WINDOWS = 7
"""Edge of the neighbourhood of a window, in windows, which overlap by two thirds."""
_ROUNDING = 1e-9
_ROUNDING_OF_SUMS = 1e-13
_TINY = 1e-300
_TENTH = 0.1
_POWER = 0.9
_STEPS = 60
_NOISES = 100
"""Flips that show which losses are found."""
_Z_90 = 1.2816
"""Quantile of a normal distribution: with so many standard errors more, 90 % are found."""


@dataclass(frozen=True)
class FlipMoments:
    """Sums over the terms of each place of a map, all with shape (y, x).

    Attributes
    ----------
    n
        Number of terms.
    scale
        Largest size of a term, 1 if all are 0; the sums below are of terms divided by it.
    total, square
        Sums of terms and of their squares.
    central2, central3, central6
        Sums of powers of the deviations from the mean.
    rarer
        Sum of the sizes for the sign with the smaller sum, over that for the other sign.
    mean
        Mean radiance of both renders, for relative differences; not divided by `scale`.
    """

    n: int
    scale: Floats
    total: Floats
    square: Floats
    central2: Floats
    central3: Floats
    central6: Floats
    rarer: Floats
    mean: Floats

    @classmethod
    def of(cls, d: Reals, mean: Floats) -> FlipMoments:
        """Return the sums for terms (y, x, term)."""
        largest = np.abs(d).max(axis=-1, initial=0)
        scale = np.where(largest > 0, largest, 1).astype(float)
        x = d / scale[..., np.newaxis].astype(d.dtype)
        total = x.sum(axis=-1, dtype=float)
        square = np.einsum("...i,...i->...", x, x, dtype=float)
        above = np.maximum(x, 0).sum(axis=-1, dtype=float)
        below = above - total
        x -= (total / d.shape[-1])[..., np.newaxis].astype(d.dtype)
        cube = x * x
        central2 = cube.sum(axis=-1, dtype=float)
        cube *= x
        central3 = cube.sum(axis=-1, dtype=float)
        central6 = np.einsum("...i,...i->...", cube, cube, dtype=float)
        more = np.maximum(above, below)
        rarer = np.minimum(above, below) / np.where(more > 0, more, 1)
        return cls(d.shape[-1], scale, total, square, central2, central3, central6, rarer, mean)

    @classmethod
    def joined(cls, parts: list[FlipMoments]) -> FlipMoments:
        """Return the moments of consecutive rows as one."""
        names = [field.name for field in fields(cls) if field.name != "n"]
        maps = {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
        return cls(n=parts[0].n, **maps)

    def nearby(self, edge: int, *, relative: bool, against: bool) -> Floats:
        """Return the mean square of terms, over `scale`, in the neighbourhood of each place.

        With `against`, it is 0 unless the neighbourhood may explain the sum of the place: its
        skewness is against the sum, or nearly all terms of the place have one sign. With
        `relative`, terms are divided by the mean radiance, since bright pixels vary more.
        """
        unit = np.ones_like(self.scale)
        if relative:
            unit = np.maximum(self.mean, _DARK * self.mean.mean())
        ratio = self.scale / np.where(unit > 0, unit, 1)
        ratio = ratio / max(float(ratio.max()), _TINY)  # so that sixth powers are numbers

        def near(x: Floats) -> Floats:
            return np.asarray(np.maximum(ndimage.uniform_filter(x, edge, mode="nearest"), 0))

        square = near(self.central2 * ratio**2) / self.n / np.maximum(ratio, 1e-150) ** 2
        if not against:
            return np.asarray(np.nan_to_num(square))
        cubes = self.central3 * ratio**3
        sixth = near(self.central6 * ratio**6)
        places = min(edge, self.scale.shape[0]) * min(edge, self.scale.shape[1])
        signed = near(np.maximum(cubes, 0)) - near(np.maximum(-cubes, 0))
        skewness = signed * np.sqrt(places) / np.sqrt(sixth)
        opposed = -np.sign(self.total) * np.nan_to_num(skewness) > _SKEWED
        return np.asarray(np.nan_to_num(square) * (opposed | self.one_sided))

    @property
    def one_sided(self) -> Mask:
        """Where nearly all terms have one sign."""
        return self.rarer < _ONE_SIDED

    @property
    def skewness_against(self) -> Floats:
        """Skewness over the root of the number of terms, if it is against the sum; 1 at most.

        It is one over the root of the number of outliers, if they decide.
        """
        spread = np.maximum(self.central2, _TINY) ** 1.5
        skewness = np.where(spread > 0, self.central3, 0) / np.where(spread > 0, spread, 1)
        return np.asarray(np.maximum(-np.sign(self.total) * skewness, 0))

    @property
    def few_outliers(self) -> Mask:
        """Where the sign against the sum has no terms, or at most about ten that decide."""
        return self.one_sided | (self.skewness_against > _FEW)

    def p_value_with(self, more: Floats, outlier: float) -> Floats:
        """Return two-sided normal p-values of the sums if terms vary by so much `more` (y, x).

        One outlier may have made each term larger by so much.
        """
        square = self.square + self.n * more / self.scale**2
        size = np.maximum(self.total - self.n * outlier / self.scale, -self.total)
        return np.asarray(
            2 * special.ndtr(-np.maximum(size, 0) / np.sqrt(np.maximum(square, _TINY)))
        )

    def p_value(self, edges: tuple[int, ...], *, against: bool) -> Floats:
        """Return two-sided normal p-values of the sums, by the terms of neighbours; see `nearby`.

        The largest mean square counts, over all edges, in radiance and relative to the mean.
        """
        kinds = (False, True)
        square = np.max(
            [self.nearby(e, relative=k, against=against) for e in edges for k in kinds], axis=0
        )
        z = np.abs(self.total) / np.sqrt(self.n * square)
        return np.where(square > 0, 2 * special.ndtr(-np.nan_to_num(z)), 0)


@np.errstate(all="ignore")
def guarded(p: Floats, moments: FlipMoments, exact: Mask) -> Floats:
    """Raise the p-values of a map (y, x) where a pixel may have missed rare samples.

    The standard error of a pixel is at least that of its neighbours if their differences are skewed
    against its own, or if nearly all its terms have one sign. For other pixels, the neighbours can
    raise p to at most 3/1000. Neighbours are compared in radiance and relative to their means.
    Where both renders are constant (`exact`), as lamps are, p-values stay as they are.
    """
    by_neighbours = np.maximum(
        moments.p_value(_NEAR, against=True),
        np.minimum(moments.p_value(_WIDE, against=False), _EXTREME),
    )
    return np.where(exact | np.isnan(p), p, np.maximum(p, by_neighbours))


@dataclass(frozen=True)
class Cells:
    """Sums over the pixels of each cell of an image.

    Attributes
    ----------
    differences, levels
        Sums of terms, and of the mean of both renders for each term, shape (band, y, x, term).
    units, unit_level
        For renders with different numbers of samples: units, which are averages of the same number
        of samples, minus the mean of all, shape (band, y, x, unit); and that mean, shape (band, y,
        x, 1). The units of the render with fewer samples come first.
    short
        Number of units of the render with fewer samples.
    unit_size
        Number of samples of a unit.
    extra, slack
        Against a reference: what the variance of a term lacks, and how far rounding may have moved
        each term, shape (band, y, x).
    outlier
        By how much one outlier of the reference may have made terms larger, shape (band,).
    """

    differences: Image
    levels: Image
    units: Image | None = None
    unit_level: Image | None = None
    short: int = 0
    unit_size: int = 1
    extra: Image | None = None
    slack: Image | None = None
    outlier: Floats | None = None

    def with_extra_variance(self, seed: Seed) -> Cells:
        """Return cells whose terms vary by `extra` more, and have the same sums.

        That adds signs to the terms, as many of one as of the other among the terms of even and
        of odd numbers. They are the same for all bands: where one is wrong, all are.
        """
        if self.extra is None:
            return self
        rng, (_, *shape, terms) = generator(seed), self.differences.shape
        signs = np.zeros((*shape, terms), np.float32)
        for half in (slice(0, None, 2), slice(1, None, 2)):
            count = len(range(terms)[half])
            even = np.concatenate([np.repeat([1, -1], count // 2), np.zeros(count % 2)])
            signs[..., half] = rng.permuted(np.broadcast_to(even, (*shape, count)), axis=-1)
        signs *= np.sqrt(terms / max(np.count_nonzero(signs[0, 0]), 1))
        more = np.sqrt(self.extra)[..., np.newaxis] * signs
        return replace(self, differences=self.differences + more, extra=None)


class ClearestWindow(NamedTuple):
    """The clearest window of a size, in a band and a weighting.

    Attributes
    ----------
    score
        Its sum over its standard error, without its sign.
    window
        In cells: y, x, height and width.
    band
        Its band.
    higher
        Whether its sum is above 0.
    weights
        Those of the cells of the image, (y, x).
    """

    score: float
    window: _Window
    band: int
    higher: bool
    weights: Floats


_SCORE = operator.attrgetter("score")


@dataclass(frozen=True)
class WindowTest:
    """Result of `scan_windows`: whether the sum over a square window is beyond chance.

    Attributes
    ----------
    p_value
        P-value of all windows together: all sizes, bands and both weightings; without those whose
        difference is `rare` light.
    window
        Window with the largest sum over its standard error, in cells: y, x, height and width.
    band
        Band of this window.
    higher
        Whether the sum over this window is above 0: B is brighter there, by what was tested.
    p_with_rare
        The p-value with all windows.
    rare
        The clearest of the windows that are left out since a render may not have met rare light
        there; None if there is none.
    detectable
        Smallest relative losses that are found with a probability of 90 %: of the whole ``image``,
        and of a square of about a ``tenth`` of it, at any place. Infinite if no loss is; NaN
        without light.
    unseen
        Light of the longer render that the shorter one may have missed, if it is more than the loss
        that the shorter one would have shown: its share of the light of the image, and the samples
        per pixel that miss it with a probability of 5 %.
    """

    p_value: float
    window: tuple[int, int, int, int]
    band: int
    detectable: dict[str, float]
    unseen: tuple[float, int] | None = None
    higher: bool = True
    p_with_rare: float = np.nan
    rare: ClearestWindow | None = None


@dataclass(frozen=True)
class _Crossing:
    """Mean of sums, in standard errors, that reaches a critical value of a test.

    Attributes
    ----------
    log_p
        Critical log probability.
    count
        Number of terms or units. A shift of the mean adds to their sum of squares.
    power
        Power of that sum of squares which divides the sum: 1/2 for terms; 1/3 for units, whose
        standard error is only in part that of all of them (`_divided`).
    freedom
        Degrees of freedom of Welch's test, which must agree.
    """

    log_p: float
    count: int
    power: float
    freedom: float = np.inf

    @np.errstate(all="ignore")
    def __call__(self, windows: float) -> float:
        """Return it for the largest of so many independent windows."""
        tail = -np.expm1(np.log1p(-np.exp(self.log_p)) / windows) / 2
        z = found = float(-special.ndtri(tail))
        for _ in range(_STEPS):
            found = z * (1 + found**2 / max(self.count - 1, 1)) ** self.power
        return max(found, float(stats.t.isf(tail, self.freedom)))


@dataclass(frozen=True)
class _Losses:
    """Relative losses that make windows of one edge exceed a critical value.

    Attributes
    ----------
    edge, starts
        Edge of the windows, and where they begin, in cells.
    windows
        Number of independent windows, for each test that looks at them.
    noise
        Sums of terms for some flips, shape (flip, y, x).
    root
        Standard error of these sums, shape (y, x).
    least
        What a sum must exceed beside its standard error, shape (y, x).
    light
        Sum of the terms of all light, shape (y, x).
    """

    edge: int
    starts: list[Array]
    windows: tuple[float, ...]
    noise: Floats
    root: Floats
    least: Floats
    light: Floats

    @np.errstate(all="ignore")
    def needed(self, tests: list[_Crossing]) -> Floats:
        """Return the loss of each window that all tests find, shape (flip, y, x)."""
        errors = max(test(n) for test, n in zip(tests, self.windows, strict=True))
        sums = errors * self.root + self.least - self.noise
        return np.where(self.light > 0, np.maximum(sums, 0) / self.light, np.inf)

    def within(self, needed: Floats, corners: list[Array], edge: int) -> Floats:
        """Return the least loss of the windows within squares, shape (flip, y, x)."""
        for axis, (starts, begins) in enumerate(zip(self.starts, corners, strict=True), start=1):
            inside = [(starts >= at) & (starts + self.edge <= at + edge) for at in begins]
            least = [needed.compress(of, axis).min(axis=axis, initial=np.inf) for of in inside]
            needed = np.stack(least, axis=axis)
        return needed


def _detectable(found: list[_Losses], tests: list[_Crossing], cells: Cells) -> dict[str, float]:
    """Return the losses of the image, and of squares of a tenth of it, that 90 % of noise shows."""
    light = cells.levels[0].sum(axis=-1)
    height, width = light.shape
    if light.sum() <= 0:
        return {"image": np.nan, "tenth": np.nan}
    needed = [of.needed(tests) for of in found]
    of_image = np.min([loss.min(axis=(1, 2)) for loss in needed], axis=0)
    edge = max(1, round(np.sqrt(_TENTH * height * width)))
    of_squares, corners = window_sums(light[..., np.newaxis], edge)
    lit = of_squares[..., 0] > LEAST_LIGHT * edge**2 * max(float(light.mean()), 0)
    of_tenth = np.full((_NOISES, *lit.shape), np.inf)
    for of, losses in zip(found, needed, strict=True):
        of_tenth = np.minimum(of_tenth, of.within(losses, corners, edge))
    least = {
        name: float(np.quantile(losses, _POWER, method="higher")) if np.size(losses) else np.inf
        for name, losses in (("image", of_image), ("tenth", of_tenth[:, lit]))
    }
    return {name: loss if loss < 1 else np.inf for name, loss in least.items()}


def scan_windows(
    cells: Cells,
    *,
    alpha: float = 0.05,
    seed: Seed = 0,
    is_rare: Callable[[ClearestWindow], bool] = lambda _: False,
) -> Generator[tuple[str, float], None, WindowTest]:
    """Test sums of terms over windows of 1, 2, 4 ... cells and over the whole image.

    The statistic of a window is its sum over the root of its sum of squares. The largest statistic
    of each size is compared with those that flips of signs give. All windows share the flips, which
    accounts for their overlap. The smallest p-value over sizes, bands and weightings is again
    compared with those of the flips.

    A second weighting, by mean over variance, finds losses in proportion to the radiance where a
    few pixels are much noisier than others. Each half of the terms is weighted by what the other
    half knows, so that no sum is shifted.

    With units, random divisions of the units of both renders are compared, too. Divisions are exact
    for renders of one distribution; flips are right for many samples if only the means agree. The
    larger p-value counts. Against a reference, fewer than 32 terms have no flips that are rare
    enough: then divisions decide, as far as Welch's test agrees.

    `alpha` is the level at which losses are found, `seed` the seed of flips and divisions. The
    clearest window of each size counts only if the difference is no rare light, which `is_rare`
    says. P-values below those of all flips are those of the tail fitted to them. Yields what is
    being done, and the share that is done.

    References
    ----------
    Westfall and Young, "Resampling-based multiple testing", 1993, section 2.6. Walther, "Optimal
    and fast detection of spatial clusters with scan statistics", 2010, doi:10.1214/09-AOS732:
    each size gets a critical value of its own. Hall, "On the removal
    of skewness by transformation", 1992, doi:10.1111/j.2517-6161.1992.tb01876.x: the skewness of
    studentised means.
    """
    d, mean = cells.differences, cells.levels
    size, terms = d.shape[1:3], d.shape[-1]
    flips = (1.0 - 2.0 * generator(seed).integers(0, 2, (_FLIPS + 1, terms))).astype(np.float32)
    flips[0] = 1
    divisions = None if cells.units is None else _divisions(cells, seed)
    alone = divisions is not None and cells.slack is not None and terms < FEWEST_FLIPS
    # Powers of 2, and the whole image last.
    edges = [*(2**i for i in range(8) if 2**i < max(size)), max(size)]
    scores, of_divisions, clearest, losses = [], [], list[ClearestWindow](), []
    weightings = (lambda _, mean: np.ones_like(mean)), _weights
    total, done = len(d) * len(weightings) * len(edges), 0
    for band in range(len(d)):
        for weigh in weightings:
            weights = weigh(d[band], mean[band])
            values, light, moved = d[band] * weights, mean[band] * weights, None
            heavy = weights.sum(axis=-1)
            if cells.slack is not None and cells.outlier is not None:
                moved = np.stack([cells.slack[band] * heavy, cells.outlier[band] * heavy])
            if cells.units is not None and cells.unit_level is not None:
                of_units = weigh(cells.units[band], cells.unit_level[band])
                units, slack = cells.units[band] * of_units, None
                if alone and cells.slack is not None:
                    slack = (cells.slack[band] * of_units.mean(axis=-1))[..., np.newaxis]
            for edge in edges:
                yield "contrasting regions", done / total
                done += 1
                independent: tuple[float, ...] = ()
                if divisions is not None:
                    rounding = None if slack is None else window_sums(slack, edge)[0]
                    divided = _divided(divisions, window_sums(units, edge)[0], rounding).max(axis=1)
                    independent = (_independent(divided[1:]),)
                    of_divisions.append(_log_p(divided, *independent))
                found = _largest(values, mean[band], light, edge, flips, moved)
                if found is None:
                    continue
                largest, (y, x), higher, loss = found
                windows = _independent(largest[1:])
                scores.append(_log_p(largest, windows))
                place = y, x, min(edge, size[0]), min(edge, size[1])
                clearest.append(ClearestWindow(float(largest[0]), place, band, higher, heavy))
                independent = independent if alone else (windows, *independent)
                losses.append(replace(loss, windows=independent))
    if not scores:
        return WindowTest(np.nan, (0, 0, *size), 0, {"image": np.nan, "tenth": np.nan})
    left_out = [i for i, of in enumerate(clearest) if is_rare(of)]
    told = max([of for i, of in enumerate(clearest) if i not in left_out] or clearest, key=_SCORE)
    with_rare, tests = (np.nan, []) if alone else _of_flips(scores, left_out, alpha, terms)
    if divisions is not None:
        tests.append(_of_divisions(of_divisions, alpha, units.shape[-1], cells.short, alone=alone))
    crossings = [crossing for _, crossing in tests]
    return WindowTest(
        p_value=max(p for p, _ in tests),
        window=told.window,
        band=told.band,
        higher=told.higher,
        p_with_rare=max([with_rare, *(p for p, _ in tests[1:])]),
        rare=max((clearest[i] for i in left_out), key=_SCORE, default=None),
        detectable=_detectable(losses, crossings, cells),
        unseen=_unseen(cells, crossings[0](losses[-1].windows[0]) + _Z_90),
    )


def _of_flips(
    scores: list[Floats], left_out: Sequence[int], alpha: float, terms: int
) -> tuple[float, list[tuple[float, _Crossing]]]:
    """Return the p-value of all windows, and the test without what some of them have shown."""
    choices = np.log(2) * (terms - 1)
    counted = [np.append(0.0, of[1:]) if i in left_out else of for i, of in enumerate(scores)]
    with_rare, _ = _of_all(scores, choices, alpha, terms, 1 / 2)
    return with_rare, [_of_all(counted, choices, alpha, terms, 1 / 2)]


def _of_divisions(
    scores: list[Floats], alpha: float, units: int, short: int, *, alone: bool
) -> tuple[float, _Crossing]:
    """Return the test by divisions of units, of which `short` belong to one render."""
    choices = float(log_choices(np.array(units), np.array(short)))
    freedom = _freedom(short, units - short) if alone else np.inf
    return _of_all(scores, choices, alpha, units, 1 / 3, freedom)


def _of_all(
    log_p: list[Floats], choices: float, alpha: float, count: int, power: float, *freedom: float
) -> tuple[float, _Crossing]:
    """Return the p-value of the smallest of all log probabilities, and what crosses level alpha.

    `choices` is the log of the number of flips or divisions: none is rarer than one of them.
    """
    least = -np.min(log_p, axis=0)[np.newaxis]
    p = float(p_of_tail(least[:, 0], least[:, 1:])[0])
    critical = -float(quantile_of_tail(least[:, 1:], alpha)[0])
    return max(p, float(np.exp(-choices))), _Crossing(critical, count, power, *freedom)


def window_sums(x: Array, edge: int) -> tuple[Array, list[Any]]:
    """Return sums of cells (y, x, term) over overlapping windows, and where the windows begin."""
    total = np.zeros((x.shape[0] + 1, x.shape[1] + 1, *x.shape[2:]))
    total[1:, 1:] = x.cumsum(axis=0, dtype=float).cumsum(axis=1)
    step, starts, ends = max(1, edge // 3), [], []
    for size in x.shape[:2]:
        last = max(size - edge, 0)
        starts.append(np.unique(np.minimum(np.arange(0, last + step, step), last)))
        ends.append(np.minimum(starts[-1] + edge, size))
    rows = total[ends[0]] - total[starts[0]]
    sums = rows[:, ends[1]] - rows[:, starts[1]]
    # What is left of sums over much more light is rounding, which may be alike in all terms.
    sums[np.abs(sums) <= _ROUNDING_OF_SUMS * np.abs(total).max()] = 0
    return sums, starts


@np.errstate(all="ignore")
def _largest(
    d: Array, mean: Array, light: Array, edge: int, flips: Image, moved: Array | None
) -> tuple[Floats, tuple[int, int], bool, _Losses] | None:
    """Return the largest standardised sum over windows for each flip, its window, and losses.

    Also whether this sum is above 0.

    None without any term. `light` are the terms of all light. Against a reference, all sums of
    cells may be `moved` by rounding, and one by an outlier, shape (2, y, x).
    """
    sums, starts = window_sums(d, edge)
    moments = FlipMoments.of(sums, window_sums(mean.mean(axis=-1, keepdims=True), edge)[0][..., 0])
    known = moments.square > 0
    if not known.any():
        return None
    # As for pixels, the terms of neighbours count, too; the whole image has none.
    square = moments.square
    if known.size > 1:
        near = np.maximum(
            moments.nearby(_OF_WINDOWS, relative=True, against=False),
            moments.nearby(_OF_WINDOWS, relative=False, against=True),
        )
        square = np.maximum(square, moments.n * near)
    unit = sums[known] / (moments.scale * np.sqrt(moments.square))[known][:, np.newaxis]
    z = flips @ unit.astype(np.float32).T
    noise = np.zeros((_NOISES, *known.shape), np.float32)
    noise[:, known] = z[1 : 1 + _NOISES] * (moments.scale * np.sqrt(moments.square))[known]
    z = np.abs(z)
    missed = _missed(d, edge, starts, moments.total > 0) / moments.scale
    least = np.abs(moments.total) - missed
    rounding = np.zeros_like(least)
    if moved is not None:
        rounding = window_sums(moved[0][..., np.newaxis], edge)[0][..., 0]
        outlier = np.where(moments.total > 0, _highest(moved[1], edge, starts), 0)
        least -= (rounding + outlier) / moments.scale
    seen = np.maximum(least, 0) / np.sqrt(np.where(square > 0, square + missed**2, 1))
    z[0] = (seen if moved is None else _without_skewness(seen, moments))[known]
    at = np.argwhere(known)[int(z[0].argmax())]
    largest = z.max(axis=1).astype(float)
    losses = _Losses(
        edge,
        starts,
        (),
        noise,
        moments.scale * np.sqrt(np.where(square > 0, square, 0) + missed**2),
        missed * moments.scale + rounding,
        np.where(known, window_sums(light.sum(axis=-1, keepdims=True), edge)[0][..., 0], 0),
    )
    place = int(starts[0][at[0]]), int(starts[1][at[1]])
    return largest, place, bool(moments.total[tuple(at)] > 0), losses


def _without_skewness(z: Floats, moments: FlipMoments) -> Floats:
    """Return sums over their standard errors, less what skewness against them explains.

    The samples of one render are skewed, and the reference is not, so that signs are not even.

    References
    ----------
    Hall, "On the removal of skewness by transformation", 1992,
    doi:10.1111/j.2517-6161.1992.tb01876.x.
    """
    c = moments.skewness_against
    return np.asarray(np.maximum(z - c / 6 - c * z**2 / 3 + c**2 * z**3 / 27, 0))


def _missed(d: Array, edge: int, starts: list[Any], up: Mask) -> Floats:
    """Return how much of the sign against the sum of each window may have been missed.

    Events that are rare may as well have included one more of the largest size, as in bounds of
    weighted sums of Poisson counts. The terms against the sum are rare if they are worth at most
    half as many terms of one size as those of its own sign. If both are worth as many, as for
    renders of one distribution, nothing is missing.

    References
    ----------
    Fay and Feuer, "Confidence intervals for directly standardized rates: a method based on the
    gamma distribution", 1997, doi:10.1002/(SICI)1097-0258(19970415)16:7<791::AID-SIM500>3.0.CO;2-#.
    """
    scale = max(float(np.abs(d).max()), _TINY)
    worth, largest = [], []
    for sign in (1, -1):
        x = np.maximum(d.astype(float) * (sign / scale), 0)
        of_cells = np.stack([x.sum(axis=-1), np.square(x).sum(axis=-1)], axis=-1)
        total, square = np.moveaxis(np.maximum(window_sums(of_cells, edge)[0], 0), -1, 0)
        worth.append(total**2 / np.maximum(square, _TINY))
        largest.append(_highest(x.max(axis=-1), edge, starts) * scale)
    with_it, against = np.where(up, worth, worth[::-1])
    # Where terms are 0, both are rounding errors of sums over the image.
    share = np.clip(2 - 2 * against / np.maximum(np.maximum(with_it, against / 2), _TINY), 0, 1)
    return np.asarray(share * np.where(up, largest[1], largest[0]))


def _highest(x: Array, edge: int, starts: list[Any]) -> Floats:
    """Return the largest cell (y, x) of each window."""
    shape = tuple(min(edge, size) for size in x.shape)
    windows = np.lib.stride_tricks.sliding_window_view(x, shape)
    return np.asarray(windows[np.ix_(*starts)].max(axis=(2, 3)))


def _divisions(cells: Cells, seed: Seed) -> sparse.csr_matrix:
    """Return which units belong to the shorter render: in fact, and in random divisions."""
    assert cells.units is not None
    count, short = cells.units.shape[-1], cells.short
    drawn = generator(seed).random((_FLIPS, count), dtype=np.float32)
    chosen = np.sort(np.argpartition(drawn, short, axis=1)[:, :short], axis=1)
    chosen = np.concatenate([np.arange(short)[np.newaxis], chosen])
    ends = np.arange(_FLIPS + 2) * short
    return sparse.csr_matrix(
        (np.ones(chosen.size, np.float32), chosen.ravel(), ends), shape=(_FLIPS + 1, count)
    )


@np.errstate(all="ignore")
def _divided(divisions: sparse.csr_matrix, sums: Array, rounding: Array | None) -> Array:
    """Return sizes of differences between both groups of units (y, x, unit), for each division.

    They are divided by a standard error: the geometric mean of Welch's, with weight 1/3, and that
    of all units. For skewed samples, Welch's gives the ratio twice the skewness that the other
    gives it, with the opposite sign.

    If nothing else looks at the means, there is `rounding`, which explains so much of the real
    difference (y, x, 1). The rest is at most as unlikely as by Welch's test, since the groups may
    have other variances.

    References
    ----------
    Welch, "The generalization of 'Student's' problem when several different population variances
    are involved", 1947, doi:10.1093/biomet/34.1-2.28.
    """
    x = sums.reshape(-1, sums.shape[-1])
    x = (x / np.maximum(np.abs(x).max(axis=1, keepdims=True), _TINY)).astype(np.float32)
    short = int(divisions.indptr[1])
    n = short, x.shape[1] - short
    total, square = (np.asarray(y.sum(axis=1, dtype=float)) for y in (x, x * x))
    one, squares = (
        np.asarray(divisions @ np.ascontiguousarray(y.T), dtype=float) for y in (x, x * x)
    )
    other = total - one
    welch = [
        np.maximum(s - t**2 / k, 0) / max(k - 1, 1) / k
        for s, t, k in zip((squares, square - squares), (one, other), n, strict=True)
    ]
    pooled = (square - total**2 / sum(n)) / (sum(n) - 1) * (1 / n[0] + 1 / n[1])
    pooled = np.where(pooled > 0, pooled, 1)
    ratio = np.maximum(sum(welch) / pooled, _ROUNDING) ** (1 / 3)
    size = np.abs(one / n[0] - other / n[1])
    found = size / np.sqrt(pooled * ratio)
    if rounding is not None:
        scale = np.maximum(np.abs(sums).max(axis=-1), _TINY).ravel()
        size[0] = np.maximum(size[0] - rounding.ravel() / scale, 0)
        found[0] = size[0] / np.sqrt(pooled * ratio[0])
        a, b = (of[0] for of in welch)
        freedom = (a + b) ** 2 / (a**2 / max(n[0] - 1, 1) + b**2 / max(n[1] - 1, 1))
        normal = -special.ndtri(special.stdtr(freedom, -size[0] / np.sqrt(a + b)))
        found[0] = np.fmin(found[0], normal)
    return np.asarray(found)


def _freedom(*n: int) -> float:
    """Return the degrees of freedom of Welch's test of groups of one variance."""
    squares = sum((1 / k) ** 2 / max(k - 1, 1) for k in n)
    return float(sum(1 / k for k in n) ** 2 / squares)


@np.errstate(all="ignore")
def _unseen(cells: Cells, detectable: float) -> tuple[float, int] | None:
    """Return the light of the image that the shorter render may have missed, if it matters.

    It matters if it is more than the loss that the standard error of the shorter render alone would
    have shown.
    """
    if cells.units is None or cells.unit_level is None:
        return None
    sums = cells.units.sum(axis=(1, 2), dtype=float)
    level = cells.unit_level.sum(axis=(1, 2, 3), dtype=float)
    short, longer = sums[:, : cells.short], sums[:, cells.short :]
    least = LEAST_LIGHT * np.abs(level)
    if cells.short > 1:
        error = short.std(axis=-1, ddof=1) / np.sqrt(cells.short)
        # Without an error, no multiple of it is detectable.
        least = np.fmax(detectable * error, least)
    found = None
    for outside in (
        longer - short.max(axis=-1, keepdims=True),
        short.min(axis=-1, keepdims=True) - longer,
    ):
        outside = np.maximum(outside, 0)
        light = outside.mean(axis=-1)
        # Units that are hardly outside hardly count among those that carry the light.
        square = np.square(outside).mean(axis=-1)
        rate = light**2 / np.where(square > 0, square, 1)
        needed = np.log(CHANCE_TO_MISS) / np.log1p(-rate)
        hidden = (rate > 0) & (needed > cells.short) & (light > least)
        for band in np.flatnonzero(hidden & (level > 0)):
            share = float(light[band] / level[band])
            if found is None or share > found[0]:
                found = share, int(np.ceil(needed[band] * cells.unit_size))
    return found


def _independent(largest: Floats) -> float:
    """Return the number of independent normal numbers whose largest size has this median."""
    middle = max(float(np.median(largest)), _ROUNDING)
    return float(np.log(0.5) / np.log1p(-2 * special.ndtr(-middle)))


@np.errstate(all="ignore")
def _log_p(largest: Floats, windows: float) -> Floats:
    """Return the log probability that the largest of `windows` normal numbers is at least this."""
    below = np.log1p(-2 * special.ndtr(-np.maximum(largest, _ROUNDING)))
    # A probability that is too small for a float becomes 0.
    return np.asarray(np.log(-np.expm1(windows * below)))


def _weights(d: Array, mean: Array) -> Array:
    """Return mean over variance for terms (y, x, term), as known from the other half of them."""
    found = np.zeros(d.shape)
    mean = np.broadcast_to(mean, d.shape)
    for half in (slice(0, None, 2), slice(1, None, 2)):
        other = slice(1 - (half.start or 0), None, 2)
        level = np.maximum(mean[..., other].sum(axis=-1, dtype=float), 0)
        square = np.einsum("...i,...i->...", d[..., other], d[..., other], dtype=float)
        # No cell counts as much less noisy than the average of the image: it may have missed much.
        usual = square.sum() / max(float((level**2).sum()), _TINY)
        near = cast("Floats", ndimage.uniform_filter(level, 3, mode="constant"))
        noise = np.maximum(ndimage.uniform_filter(square, 3, mode="constant"), 0) + near**2 * usual
        weight = near / np.where(noise > 0, noise, 1)
        found[..., half] = weight[..., np.newaxis]
    return found
