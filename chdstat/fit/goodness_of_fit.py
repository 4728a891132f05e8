"""Goodness of fit: whether a fitted family describes the samples, and how large the misfit is.

For each test, `goodness` gives a p-value that accounts for the estimated parameters, and an effect
size. With thousands of samples, every family is rejected; the effect size shows whether the misfit
matters. To compare families with each other, use `chdstat.fit.select`.

- Anderson-Darling has the most power against misfits in the tails, which decide noise.
- Cramer-von Mises weighs the body.
- Kolmogorov-Smirnov takes the largest gap, whose size is the easiest to read.
- Chi-square weighs all cells equally, whatever their order; it is the weakest of the four.

The bootstrap draws samples from the fit and fits them again, with the replicates of several rows at
once. The random numbers of a row follow from the seed and the row's own samples, so that its
p-value does not depend on the other rows.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Literal, get_args

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Counts, Floats, Mask, Seed, chunks, seed_number, whole
from chdstat._core.positive import Part, PositiveHistogram, PositivePart
from chdstat._core.statistic import Result, Statistic, result, variable
from chdstat.errors import InputError, Reason, check_probability
from chdstat.fit.families import FAMILIES, FamilyFit, Fit, estimate_part, get_family
from chdstat.fit.family import Family, Parameters, take, take_part, width_of
from chdstat.fit.selection import FamilySelection
from chdstat.summary.runner import Source, measured, of_source, run

if TYPE_CHECKING:
    import xarray as xr


FitTest = Literal["kolmogorov-smirnov", "cramer-von-mises", "anderson-darling", "chi-square"]
FIT_TESTS: tuple[FitTest, ...] = get_args(FitTest)
"""Names of the tests."""


@result
class Goodness(Result):
    """Goodness of fit of a family; arrays of shape (..., test), NaN where `reason` says why.

    With the reasons `UNTESTED` and `FEW_REPLICATES`, statistic and effect are still there.

    Attributes
    ----------
    family, tests
        The family that was tested, and the names of the tests along the last axis.
    statistic
        Kolmogorov's D, Cramer and von Mises' W^2, Anderson and Darling's A^2, Pearson's X^2.
    p_value
        P-value of the hypothesis that the samples are of the family; NaN where fewer than half of
        the replicates could be fitted.
    effect
        D; sqrt(W^2 / n), the mean distance of the distribution functions; sqrt(A^2 / n), the same
        relative to its standard deviation; and Cohen's w, sqrt(X^2 / n).
    resamples
        Bootstrap replicates that could be fitted.
    n
        Samples that were tested, shape (...).
    reason
        `Reason` codes.
    """

    family: str
    tests: tuple[FitTest, ...]
    statistic: Floats = variable("{}: statistic of goodness of fit", "fit_test")
    p_value: Floats = variable(
        "{}: bootstrap p-value of the family",
        "fit_test",
        pooled=True,
        rejected="{}: 1 where not of this family, at the false discovery rate of the dataset",
    )
    effect: Floats = variable("{}: misfit, whatever the number of samples", "fit_test")
    resamples: Counts = variable("{}: bootstrap replicates that could be fitted", "fit_test")
    n: Counts
    reason: npt.NDArray[np.int8] = variable("why there is no test of {}", "fit_test")


@dataclass(frozen=True, eq=False)
class GoodnessOfFit(Statistic[Goodness]):
    """Tests of a family, or (None) of the best one of each row; options as in `goodness`."""

    result: ClassVar = Goodness
    description: ClassVar = "testing {}"
    binned: ClassVar = True
    prefix: ClassVar = "{}_goodness_"

    family: Family | None = None
    tests: tuple[FitTest, ...] = FIT_TESTS
    resamples: int = 0
    seed: int = 0
    alpha: float = 0.05

    def __post_init__(self) -> None:
        known = isinstance(self.tests, tuple) and set() < set(self.tests) <= set(FIT_TESTS)
        if not known:
            message = f"tests must be some of {', '.join(FIT_TESTS)}, got {self.tests!r}"
            raise InputError(message)
        check_probability(alpha=self.alpha)

    @property
    def subject(self) -> str:
        """Name of the family that was tested."""
        return "best" if self.family is None else self.family.name

    def coordinates(self) -> dict[str, tuple[FitTest, ...]]:
        """Return the tests."""
        return {"fit_test": self.tests}

    def measure(self, part: Part) -> Goodness:
        """Test each row against the family, which is fitted to it first, or its best family.

        The p-value of the best family is a little too large, since the replicates are fitted with
        that family alone.
        """
        reason, cases = self._cases(part)
        values = np.full((3, *part.n.shape, len(self.tests)), np.nan)
        for family, parameters, rows in cases:
            few = rows & (reason == Reason.OK) & (part.n < max(_MINIMUM, family.minimum + 1))
            reason[few] = Reason.TOO_FEW
            usable = rows & (reason == Reason.OK)
            found = self._bootstrap(part, usable, family, parameters)
            values[:, usable] = found.reshape(values.shape)[:, usable]
        statistic, p_value, fitted = values
        effect = np.sqrt(np.maximum(statistic, 0) / np.maximum(part.n, 1)[..., np.newaxis])
        # Kolmogorov's D is a distance already, whatever the number of samples.
        effect = np.where(np.array(self.tests) == "kolmogorov-smirnov", statistic, effect)
        reasons = np.repeat(reason[..., np.newaxis], len(self.tests), axis=-1)
        reasons[(reasons == Reason.OK) & np.isnan(statistic)] = Reason.TOO_FEW
        untested = Reason.FEW_REPLICATES if self.resamples else Reason.UNTESTED
        reasons[(reasons == Reason.OK) & np.isnan(p_value)] = untested
        return Goodness(
            family=self.subject,
            tests=self.tests,
            statistic=statistic,
            p_value=p_value,
            effect=effect,
            resamples=np.nan_to_num(fitted).astype(np.int64),
            n=part.n,
            reason=reasons,
        )

    def _cases(
        self, part: Part
    ) -> tuple[npt.NDArray[np.int8], list[tuple[Family, Parameters, Mask]]]:
        """Return why rows have no fit, and each family, its parameters, and its rows."""
        if self.family is not None:
            fit = measured(part, FamilyFit(self.family))
            whole = np.ones(part.n.shape, dtype=bool)
            return fit.reason.copy(), [(self.family, fit.parameters, whole)]
        best = measured(part, FamilySelection())
        cases = [
            (FAMILIES[name], best.fits[name].parameters, np.asarray(best.best == i))
            for i, name in enumerate(best.families)
        ]
        return best.reason.copy(), cases

    def _bootstrap(
        self, part: Part, usable: Mask, family: Family, parameters: Parameters
    ) -> Floats:
        """Return statistics, p-values and replicates that could be fitted, shape (3, row, test).

        Rows are those of the flattened batch; rows that are not usable are NaN. P-values are NaN
        where fewer than half of the replicates could be fitted.
        """
        table = np.full((3, part.n.size, len(self.tests)), np.nan)
        statistic, p_value, fitted = table
        rows = np.flatnonzero(usable)
        # Rows with similar numbers of samples go together: a block is as wide as its rows need.
        rows = rows[np.argsort(part.n.ravel()[rows], kind="stable")]
        for block in chunks(len(rows), width_of(part) * max(1, self.resamples)):
            here = rows[block]
            some = take_part(part, here)
            known = take(parameters, here)
            statistic[here] = _distances(some, family, known, self.tests)
            if not self.resamples:
                continue
            more, count = self._replicates(some, family, known, statistic[here])
            fitted[here] = count
            # Davison and Hinkley (1997), equation 4.11.
            known_enough = (count > 0) & (2 * count >= self.resamples)
            p_value[here] = np.where(known_enough, (more + 1) / (count + 1), np.nan)
        return table

    def _replicates(
        self, part: Part, family: Family, parameters: Parameters, statistic: Floats
    ) -> tuple[Floats, Floats]:
        """Count the replicates that are as far from their fit as the samples, and those fitted."""
        if isinstance(part, PositiveHistogram):
            held = list(part.counts)
        else:
            held = [row[:n].astype(np.float64) for row, n in zip(part.sorted, part.n, strict=True)]
        # The generator depends on the seed and on the row's samples, in any order. The seed alone
        # would not do: the samples may have been drawn with it.
        streams = [np.random.default_rng([self.seed, zlib.crc32(row.tobytes())]) for row in held]
        more, count = np.zeros(statistic.shape), np.zeros(statistic.shape)
        least = statistic[:, np.newaxis] * (1 - _EQUAL)
        for piece in chunks(self.resamples, width_of(part) * len(part.n)):
            times = piece.stop - piece.start
            repeated = {name: np.repeat(value, times) for name, value in parameters.items()}
            # If the sum of the samples is close to overflow, a replicate may overflow: no fit.
            drawn = _draw(part, family, parameters, times, streams)
            estimate, _ = estimate_part(drawn, family, repeated)
            found = _distances(drawn, family, estimate.parameters, self.tests)
            found = found.reshape(len(part.n), times, len(self.tests))
            more += np.count_nonzero(found >= least, axis=1)
            count += np.count_nonzero(np.isfinite(found) & np.isfinite(least), axis=1)
        return more, count

    def finish(self, dataset: xr.Dataset) -> xr.Dataset:
        """Add names, and q-values; without replicates, there are no p-values."""
        if not self.resamples:
            prefix = self.prefix.format(self.subject)
            dataset = dataset.drop_vars([f"{prefix}p_value", f"{prefix}resamples"])
        return super().finish(dataset)


_MINIMUM = 8
_EQUAL = 1e-9
"""Relative difference below which two statistics differ by rounding only."""


@of_source
def goodness(
    x: Source,
    fit: str | Family | Fit,
    *,
    tests: Sequence[FitTest] = FIT_TESTS,
    resamples: int = 99,
    seed: Seed = 0,
    alpha: float = 0.05,
    null: npt.ArrayLike | None = None,
    progress: bool = True,
) -> Goodness | xr.Dataset:
    """Test whether the positive samples are of a family whose parameters are estimated from them.

    Samples are closer to a fitted family than to the true one, so that textbook tables do not hold.
    The parametric bootstrap does. It draws B replicates of as many samples from the fitted family
    and fits the family to each. If b replicates are at least as far from their fit as the samples
    are from theirs, ``p = (b + 1) / (B + 1)``, which is never 0.

    Parameters
    ----------
    x, null, progress
        As for `chdstat.fit.fit`.
    fit
        Name of a family, or a `Family`. A `Fit` stands for its family, which is fitted to x again.
    tests
        Any of 'kolmogorov-smirnov', 'cramer-von-mises', 'anderson-darling', 'chi-square'.
    resamples
        Replicates B; 0 for statistics and effects alone.
    seed
        Seed of the replicates. The random numbers of a pixel follow from the seed and the pixel's
        positive samples: its p-value does not depend on the other pixels, and equal samples have
        equal p-values.
    alpha
        For an image: false discovery rate of ``rejected``.

    Returns
    -------
    Goodness or xarray.Dataset
        `Goodness` for an array or a `Histogram`. For an image, its fields over (y, x, channel,
        fit_test), such as ``gamma_goodness_p_value``. Added are q-values (Benjamini and Hochberg)
        over the image, for each channel and test separately, and ``gamma_goodness_rejected``: 1
        where the q-value is at most `alpha`, 0 where it is not, NaN without a p-value. Without
        replicates, there are no p-values, q-values or rejections.

    Raises
    ------
    InputError
        If there is no such family or test, or a number is out of range.

    Notes
    -----
    Chi-square counts samples in ``2 n^(2/5)`` equiprobable cells of the fitted family. For a log
    histogram, its cells are bins, merged until each is expected to hold 5 samples; the other
    statistics are sums over bins, and replicates are histograms. Replicates that cannot be fitted
    do not count.

    References
    ----------
    Stute, Gonzalez Manteiga and Presedo Quindimil, "Bootstrap based goodness-of-fit-tests", 1993,
    doi:10.1007/BF02613687. Davison and Hinkley, "Bootstrap methods and their application", 1997,
    equation 4.11, doi:10.1017/CBO9780511802843. Anderson and Darling, "Asymptotic theory of certain
    goodness of fit criteria", 1952, doi:10.1214/aoms/1177729437. Cohen, "Statistical power analysis
    for the behavioral sciences", 1988, chapter 7, doi:10.4324/9780203771587.

    Examples
    --------
    >>> x = np.random.default_rng(1).gamma(2.0, size=500)
    >>> gamma, lognormal = goodness(x, "gamma"), goodness(x, "lognormal")
    >>> gamma.p_value > 0.05
    array([ True,  True,  True,  True])
    >>> lognormal.p_value[:3], bool(lognormal.effect[0] > gamma.effect[0])
    (array([0.01, 0.01, 0.01]), True)
    """
    names: Any = tests if isinstance(tests, str) else tuple(tests)
    count, root = whole("resamples", resamples, least=0), seed_number(seed)
    family = get_family(fit.name if isinstance(fit, Fit) else fit)
    statistic = GoodnessOfFit(family, names, count, root, alpha)
    return run(statistic, x, null=null, progress=progress)


def _draw(
    part: Part,
    family: Family,
    parameters: Parameters,
    times: int,
    streams: Sequence[np.random.Generator],
) -> Part:
    """Draw `times` replicates of each row, with as many samples, one row after the other."""
    if isinstance(part, PositiveHistogram):
        probability = _bin_probabilities(part, family, parameters)
        total = np.maximum(probability.sum(axis=-1, keepdims=True), np.finfo(np.float64).tiny)
        rows = zip(streams, part.n, probability / total, strict=True)
        counts = [rng.multinomial(n, row, size=times) for rng, n, row in rows]
        drawn_counts = np.concatenate(counts).astype(np.float64)
        none = np.zeros(len(drawn_counts), dtype=np.int64)
        return PositiveHistogram(
            counts=drawn_counts,
            log_centers=np.repeat(part.log_centers, times, axis=0),
            width=np.repeat(part.width, times),
            n=drawn_counts.sum(axis=-1).astype(np.int64),
            **dict.fromkeys(("n_null", "n_zero", "n_negative", "n_bad", "n_above"), none),
        )
    drawn = np.ones((len(part.n), times, int(part.n.max())))
    for i, (rng, n) in enumerate(zip(streams, part.n, strict=True)):
        law = family.distribution({n: v[i, None, None] for n, v in parameters.items()})
        drawn[i, :, :n] = law.rvs(size=(times, n), random_state=rng)
    bad = np.arange(drawn.shape[-1]) >= np.repeat(part.n, times)[:, np.newaxis]
    return PositivePart.of(drawn.reshape(-1, drawn.shape[-1]), bad=bad)


_LEAST = 1e-300
"""Least probability whose logarithm is taken."""
_FAR = 0.9
"""Where F is larger than this, 1 - F is computed separately to keep its digits."""
_EXPECTED = 5.0
"""Fewest samples expected in a cell (Cochran 1954, doi:10.2307/3001616)."""

Distances = Mapping[FitTest, Callable[[], Floats]]
"""Functions that compute the statistic of each test for some rows, shape (row,)."""


def _distances(
    part: Part, family: Family, parameters: Parameters, tests: Sequence[FitTest]
) -> Floats:
    """Return statistics, shape (row, test), at parameters (row,); NaN where these are NaN."""
    fitted = np.asarray(np.isfinite(np.stack(list(parameters.values()))).all(axis=0))
    found = np.full((len(fitted), len(tests)), np.nan)
    rows = np.flatnonzero(fitted)
    if not len(rows):
        return found
    some = part if len(rows) == len(fitted) else take_part(part, rows)
    known, free = take(parameters, rows), len(parameters)
    if isinstance(some, PositiveHistogram):
        expected = _bin_probabilities(some, family, known) * some.n[:, np.newaxis]
        statistics = _of_bins(some.counts, expected, some.n, free)
    else:
        # Rows have from few to all samples; distribution functions are slow, so only for those.
        present = some.valid
        below, above = np.ones((2, *present.shape))
        x, each = some.sorted[present].astype(np.float64), take(parameters, np.repeat(rows, some.n))
        of_samples = np.asarray(family.distribution(each).cdf(x))
        beyond, far = 1 - of_samples, of_samples > _FAR
        beyond[far] = family.distribution(take(each, far)).sf(x[far])
        below[present], above[present] = of_samples, beyond
        statistics = _of_samples(below, above, present, some.n, free)
    found[rows] = np.stack([statistics[test]() for test in tests], axis=-1)
    return found


def _bin_probabilities(part: PositiveHistogram, family: Family, parameters: Parameters) -> Floats:
    """Return the probability of each bin, shape (row, bin), given that a sample is in a bin.

    The last bin has no upper edge, since it also counts the samples above the support. Samples
    below the support count as zeros and are left out.
    """
    edges = np.exp(part.log_centers - part.width[:, np.newaxis] / 2)
    columns = {name: value[:, np.newaxis] for name, value in parameters.items()}
    above = np.broadcast_to(family.distribution(columns).sf(edges), part.counts.shape)
    probability = -np.diff(above, axis=-1, append=0) / above[:, :1]
    return np.asarray(np.maximum(np.nan_to_num(probability), 0))


def _of_samples(
    below: Floats, above: Floats, present: Mask, n: Counts, parameters: int
) -> Distances:
    """Return statistics of ascending samples, whose F and 1 - F have shape (row, sample).

    Both are 1 where there is no sample.
    """
    rank = np.arange(1.0, below.shape[-1] + 1)
    # From the middle of each step of the empirical distribution function.
    gap = below - (rank - 0.5) * (1 / n)[:, np.newaxis]
    gap *= present

    def kolmogorov_smirnov() -> Floats:
        return np.asarray(np.abs(gap).max(axis=-1) + 0.5 / n)

    def cramer_von_mises() -> Floats:
        return np.asarray(1 / (12 * n) + np.vecdot(gap, gap))

    def anderson_darling() -> Floats:
        log_below, log_above = (np.log(np.maximum(f, _LEAST)) for f in (below, above))
        both = np.vecdot(2 * rank - 1, log_below - log_above) + 2 * n * log_above.sum(axis=-1)
        return np.asarray(-n - both / n)

    def chi_square() -> Floats:
        # There are 2 n^(2/5) equiprobable cells (Moore 1986, in D'Agostino and Stephens,
        # "Goodness-of-fit techniques", chapter 3), but no more than leaves 5 expected samples in
        # each.
        cells = np.minimum(2 * n**0.4, n / _EXPECTED).astype(np.int64)
        most, last = int(cells.max(initial=1)), cells[:, np.newaxis] - 1
        cell = np.minimum(below * cells[:, np.newaxis], last).astype(np.int64)
        index = np.where(present, cell, most) + np.arange(len(n))[:, np.newaxis] * (most + 1)
        counts = np.bincount(index.ravel(), minlength=len(n) * (most + 1)).reshape(len(n), -1)
        square = (counts[:, :most].astype(np.float64) ** 2).sum(axis=-1)
        return np.where(cells >= parameters + 2, cells * square / n - n, np.nan)

    return {
        "kolmogorov-smirnov": kolmogorov_smirnov,
        "cramer-von-mises": cramer_von_mises,
        "anderson-darling": anderson_darling,
        "chi-square": chi_square,
    }


def _of_bins(counts: Floats, expected: Floats, n: Counts, parameters: int) -> Distances:
    """Return statistics of bins, shape (row, bin).

    Cramer, von Mises, Anderson and Darling's statistics weight each bin by the samples expected in
    it (Choulakian, Lockhart and Stephens 1994, doi:10.2307/3315828).
    """
    excess = np.cumsum(counts - expected, axis=-1)

    def kolmogorov_smirnov() -> Floats:
        return np.asarray(np.abs(excess).max(axis=-1) / n)

    def cramer_von_mises() -> Floats:
        return np.asarray(np.vecdot(excess**2, expected) / n**2)

    def anderson_darling() -> Floats:
        below = np.cumsum(expected, axis=-1) / n[:, np.newaxis]
        variance = below * (1 - below)
        # Outside the bins that expect a sample, both are 0 but for rounding.
        weight = np.where(variance > 1e-12, expected / np.maximum(variance, 1e-12), 0)
        return np.asarray(np.vecdot(excess**2, weight) / n**2)

    def chi_square() -> Floats:
        # Bins are merged from the left until a cell expects 5 samples; the rest joins the last
        # cell.
        square, cells = np.zeros(len(n)), np.zeros(len(n), dtype=np.int64)
        count, mean = np.zeros(len(n)), np.zeros(len(n))
        left = expected.sum(axis=-1) - np.cumsum(expected, axis=-1).T
        for more, expects, rest in zip(counts.T, expected.T, left, strict=True):
            count, mean = count + more, mean + expects
            # The remaining bins must fill a cell, too.
            full = (mean >= _EXPECTED) & (rest >= _EXPECTED)
            square += np.where(full, (count - mean) ** 2 / np.maximum(mean, _EXPECTED), 0)
            cells += full
            count, mean = np.where(full, 0, count), np.where(full, 0, mean)
        square += (count - mean) ** 2 / np.maximum(mean, _LEAST)
        return np.where(cells + 1 >= parameters + 2, square, np.nan)

    return {
        "kolmogorov-smirnov": kolmogorov_smirnov,
        "cramer-von-mises": cramer_von_mises,
        "anderson-darling": anderson_darling,
        "chi-square": chi_square,
    }
