"""Distributions: the families that can be fitted, each with its maximum likelihood.

`chdstat.fit.families` lists them and fits them.

`maximise` maximises profile likelihoods of one or two parameters. Newton's method climbs all rows
at once. Steps are damped where the function is not concave or a
step did not climb (Levenberg 1944, doi:10.1090/qam/10666). A row thus converges from afar, and
quadratically in the end. Rows that are done leave the block.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from scipy import special, stats

from chdstat._core.arrays import Floats, Mask
from chdstat._core.display import number
from chdstat._core.positive import Part
from chdstat._core.statistic import RADIANCE
from chdstat.errors import Reason
from chdstat.fit.family import TIGHT, Estimate, Family, Parameters, WeightedSamples, of_rows

_MANY_STEPS, _FEW_STEPS = 60, 30
"""Most steps of the search on all points, and of the search on a few points."""
_REACH = 2.0
_ROUGHLY = 1e-2
"""Newton step at which the search on a few points ends."""
_CONCAVE = 1e-3
_NEXT, _APART = 0.3, 0.05
"""Distance below which a start leads to the same maximum, and above which two maxima differ."""
_CLOSE = 0.05
"""Difference per sample that the few points may get wrong."""

_Surface = Callable[[WeightedSamples, Floats], Floats]
"""A function of two parameters, for some points, at parameters of shape (2, row).

It returns six numbers, shape (6, row): the value; the first derivatives by the first and the second
parameter; the second derivatives by the first, mixed, and by the second. They are NaN where there
is no value. A function of the first parameter alone returns three numbers: the value and its two
derivatives.
"""


def maximise(
    part: Part,
    surface: _Surface,
    *,
    start: Callable[[WeightedSamples], Floats],
    finish: Callable[[WeightedSamples, Floats, Mask], Floats],
    names: int,
    minimum: int,
    floor: float = -np.inf,
    near: tuple[Floats, Floats] | None = None,
    tolerance: float = TIGHT,
) -> Floats:
    """Maximise for all rows of a part, first on a few points of each row, then on all points.

    Parameters
    ----------
    part, surface
        The samples, and the function to maximise for each row.
    start
        Returns first parameters for the points of some rows, shape (2, row); or two sets, where
        there may be two maxima, shape (2, 2, row).
    finish
        Returns the result for the points of some rows, shape (names, row), from the parameters and
        where they are a maximum.
    names
        Numbers that `finish` returns for a row.
    minimum
        Fewest samples of a row.
    floor
        Least value of the second parameter, above 0, if it has any: a maximum at the floor counts.
    near
        First parameters, if they are known, each with the batch's shape. The search on a few points
        is then skipped, and rows where they are NaN are left out.
    tolerance
        Step size that ends the search; after a Newton step, the error is about its square.

    Returns
    -------
    Results of `finish`, shape (names, ...).
        Shape (names, ...).
    """
    climb = _Climb(surface, floor)

    def roughly(points: WeightedSamples) -> Floats:
        first, *others = start(points).reshape(-1, 2, len(points.n))
        one, _ = climb.from_start(points, first, _ROUGHLY, _FEW_STEPS)
        two = np.full_like(one, np.nan)
        for other in others:
            # A start close to the first maximum would lead to it again.
            rows = np.flatnonzero(~(np.abs(other - one) < _NEXT).all(axis=0))
            if len(rows):
                some = points.take(rows), other[:, rows], _ROUGHLY, _FEW_STEPS
                two[:, rows], _ = climb.from_start(*some)
        if not others:
            return np.concatenate([one, two])
        # The higher maximum comes first. The other is kept if it may be the higher one on all
        # points.
        of_one, of_two = climb.value(points, one)[0], climb.value(points, two)[0]
        swap = (of_two > of_one) | (np.isnan(of_one) & np.isfinite(of_two))
        undecided = (np.abs(two - one) > _APART).any(axis=0) & (np.abs(of_two - of_one) < _CLOSE)
        higher, lower = np.where(swap, two, one), np.where(swap, one, two)
        return np.concatenate([higher, np.where(undecided, lower, np.nan)])

    def exactly(points: WeightedSamples) -> Floats:
        begin, other = rough[:2, points.rows], rough[2:, points.rows]
        lost = np.isnan(begin).any(axis=0)
        if lost.any():
            # The few points were all equal, but other points are not.
            begin = np.where(lost, start(points).reshape(-1, *begin.shape)[0], begin)
        at, converged = climb.from_start(points, begin, tolerance)
        rows = np.flatnonzero(np.isfinite(other).all(axis=0))
        if len(rows):
            some = points.take(rows)
            there, done = climb.from_start(some, other[:, rows], tolerance)
            better = climb.value(some, there)[0] > climb.value(some, at[:, rows])[0]
            at[:, rows] = np.where(better, there, at[:, rows])
            converged[rows] = np.where(better, done, converged[rows])
        return finish(points, at, converged)

    known = None
    if near is None:
        rough = of_rows(part, minimum, 4, roughly, thin=True)
    else:
        rough = np.full((4, part.n.size), np.nan)
        rough[:2] = np.stack(near).reshape(2, -1)
        known = np.asarray(np.isfinite(rough[:2]).all(axis=0))
    return of_rows(part, minimum, names, exactly, among=known).reshape(names, *part.n.shape)


@dataclass(frozen=True)
class _Climb:
    """Newton's method on a surface whose second parameter has a floor."""

    surface: _Surface
    floor: float

    def value(self, points: WeightedSamples, at: Floats) -> Floats:
        """Return six numbers; without a second parameter, the surface is at its maximum in it."""
        found = self.surface(points, at)
        if len(found) == 6:
            return found
        value, slope, curvature = found
        zero = np.zeros_like(value)
        return np.stack([value, slope, zero, curvature, zero, zero - 1])

    def from_start(
        self, points: WeightedSamples, start: Floats, tolerance: float, most: int = _MANY_STEPS
    ) -> tuple[Floats, Mask]:
        """Climb from `start` to the next maximum, shape (2, row); return it and where it is one."""
        best, (converged, closed) = start.copy(), np.zeros((2, start.shape[1]), dtype=bool)
        rows = np.arange(start.shape[1])
        at, here = start, self.value(points, start)
        damping = np.zeros(len(rows))
        for _ in range(most):
            step = np.clip(self._step(at, here, damping), -_REACH, _REACH)
            small = np.abs(step) < tolerance
            if np.isfinite(self.floor):
                # A step towards the floor leaves at least a hundredth of the parameter.
                step[1] = np.maximum(step[1], np.maximum(-0.99 * at[1], self.floor - at[1]))
                small[1] = np.abs(step[1]) < tolerance * np.minimum(at[1], 1)
            # The last step is not checked: the remaining error is of the order of its square.
            done = small.all(axis=0) & (damping == 0)
            # A row that is done does not change, however long the others take.
            open_ = ~closed[rows]
            best[:, rows[open_]] = np.where(done, at + step, at)[:, open_]
            converged[rows[open_]] = done[open_]
            closed[rows] |= done | ~np.isfinite(step).all(axis=0) | (damping >= 1e8)
            active = ~closed[rows]
            if not active.any():
                break
            if np.count_nonzero(active) < 0.7 * len(rows):
                kept = np.flatnonzero(active)
                rows, points, damping = rows[kept], points.take(kept), damping[kept]
                at, step, here = at[:, kept], step[:, kept], here[:, kept]
            trial = at + step
            there = self.value(points, trial)
            climbs = there[0] >= here[0] - 1e-11 * (1 + np.abs(here[0]))
            if climbs.all() and not damping.any():
                at, here = trial, there
                continue
            at, here = np.where(climbs, trial, at), np.where(climbs, there, here)
            damping = np.where(
                climbs, np.where(damping < 1e-2, 0, damping / 10), 10 * damping + 0.1
            )
        return best, converged

    def _step(self, at: Floats, here: Floats, damping: Floats) -> Floats:
        """Solve (H - shift) step = -gradient, with a shift that makes H negative definite.

        Rows at the floor whose step would cross it move along it.
        """
        _, by_first, by_second, a, b, d = here
        held = (at[1] <= self.floor) & (by_second < 0)
        if held.any():
            by_second, b, d = (
                np.where(held, fixed, free) for fixed, free in ((0, by_second), (0, b), (-1, d))
            )
        determinant = a * d - b * b
        concave = (a < 0) & (determinant > 0)
        if not concave.all() or damping.any():
            size = np.abs(a) + np.abs(d)
            largest = (a + d) / 2 + np.sqrt(((a - d) / 2) ** 2 + b**2)
            shift = np.where(concave, 0, largest + _CONCAVE * size) + damping * size
            a, d = a - shift, d - shift
            determinant = a * d - b * b
        p, q = by_first / determinant, by_second / determinant
        return np.stack([b * q - d * p, b * p - a * q])


# --- maximum likelihood ---------------------------------------------------------------------------


_ITERATIONS = 20
_TOLERANCE = 1e-12


class Gamma(Family):
    """Gamma: what the paper sees most often.

    ``f(x) = x^(shape-1) exp(-x/scale) / (Gamma(shape) scale^shape)``. Newton's method solves
    ``log(shape) - digamma(shape) = log(mean) - mean(log x)``.

    References
    ----------
    Minka, "Estimating a Gamma distribution", technical report, 2002.

    Examples
    --------
    >>> import chdstat as chd
    >>> result = chd.fit.gamma([0.0, 0.0, 1.0, 2.0, 3.0])
    >>> float(result.null_share), round(float(result.parameters["shape"]), 3)
    (0.4, 5.375)
    """

    name: ClassVar = "gamma"
    label: ClassVar = "gamma"
    units: ClassVar = {"shape": "1", "scale": RADIANCE}
    errors_from: ClassVar = {"scale": 60}
    density: ClassVar = r"x^{k-1} e^{-x/s} / (\Gamma(k)\, s^k)"
    tail_index: ClassVar = "0"
    error_formula: ClassVar = "expected information"

    def estimate(self, part: Part, /, *_search: object) -> Estimate:
        """Return the maximum of the likelihood."""
        sums = part.log_statistics
        shape, converged = gamma_shape(sums.gap)
        scale = np.asarray(sums.mean / shape)
        # Inverse of the Fisher information; excess = shape * trigamma(shape) - 1.
        excess = shape * _gap_slope(shape)
        shape_error = np.sqrt(shape / (sums.n * excess))
        scale_error = scale * np.sqrt((1 + excess) / shape / (sums.n * excess))
        return Estimate(
            parameters={"shape": shape, "scale": scale},
            standard_errors={"shape": shape_error, "scale": scale_error},
            converged=converged,
        )

    def log_likelihood(self, part: Part, parameters: Parameters) -> Floats:
        """Return the log-likelihood of the positive samples."""
        sums, k = part.log_statistics, parameters["shape"]
        # Written around mean = k * scale, where the maximum is, so that large terms cancel first.
        ratio = sums.mean / (k * parameters["scale"])
        off = k * (np.log(ratio) - (ratio - 1))
        per_sample = off + _peak(k) - (k - 1) * sums.gap - np.log(sums.mean)
        return np.asarray(sums.n * per_sample)

    def log_density(self, points: WeightedSamples, parameters: Parameters) -> Floats:
        """Return the log density of log x."""
        shape = parameters["shape"]
        # With z = x / mean, log f(log x) = k (log z - z + 1) + peak, where large terms cancel.
        log_mean = np.log(shape * parameters["scale"]) - points.log_mean
        log = points.log - log_mean[:, np.newaxis]
        density = log - np.expm1(log)
        density *= shape[:, np.newaxis]
        density += _peak(shape)[:, np.newaxis]
        return density

    def distribution(self, parameters: Parameters) -> Any:
        """Return SciPy's distribution."""
        return stats.gamma(parameters["shape"], scale=parameters["scale"])


def gamma_shape(gap: Floats) -> tuple[Floats, Mask]:
    """Solve log(k) - digamma(k) = gap (Minka 2002, "Estimating a Gamma distribution")."""
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        k = np.asarray((3 - gap + np.sqrt((gap - 3) ** 2 + 24 * gap)) / (12 * gap))
        step = np.full_like(k, np.inf)
        for _ in range(_ITERATIONS):
            # Newton in 1/k, in which the equation is nearly linear.
            inverse = 1 / k + (gap - gap_of_shape(k)) / (k**2 * _gap_slope(k))
            step = np.abs(k * inverse - 1)
            k = 1 / inverse
            if not (step > _TOLERANCE).any():
                break
    return k, np.asarray(step <= 1e-9)


def gap_of_shape(k: Floats) -> Floats:
    """Return log(k) - digamma(k)."""
    # Both terms grow while their difference falls; the asymptotic series keeps its digits.
    series = (1 + (1 - 0.1 / k**2) / (6 * k)) / (2 * k)
    return np.where(k > 1e3, series, np.log(k) - special.digamma(k))


def _gap_slope(k: Floats) -> Floats:
    """Return trigamma(k) - 1/k, minus the derivative of the gap by k."""
    series = (1 + (1 - 0.2 / k**2) / (3 * k)) / (2 * k**2)
    return np.where(k > 1e3, series, special.polygamma(1, k) - 1 / k)


def _peak(k: Floats) -> Floats:
    """Return k log(k) - k - log(Gamma(k)), by Stirling's series where the terms are large."""
    series = 0.5 * np.log(k / (2 * np.pi)) - 1 / (12 * k)
    return np.where(k > 1e3, series, special.xlogy(k, k) - k - special.gammaln(k))


class LogNormal(Family):
    """Log-normal: Gaussian in the log domain.

    ``mu = mean(log x)``, ``sigma^2 = mean((log x - mu)^2)``, with natural logarithms. The
    likelihood is that of linear radiance, so that it compares with other families.

    References
    ----------
    Johnson, Kotz and Balakrishnan, "Continuous univariate distributions", vol. 1, 1994, chap. 14.

    Examples
    --------
    >>> import chdstat as chd
    >>> result = chd.fit.lognormal([1.0, 10.0, 100.0])
    >>> round(float(np.exp(result.parameters["mu"])), 6)
    10.0
    """

    name: ClassVar = "lognormal"
    label: ClassVar = "log-normal"
    units: ClassVar = {"mu": f"ln({RADIANCE})", "sigma": "1"}
    errors_from: ClassVar = {"mu": 12, "sigma": 20}
    density: ClassVar = r"e^{-(\log x - \mu)^2 / 2 \sigma^2} / (\sqrt{2\pi}\, \sigma x)"
    tail_index: ClassVar = "0, but only far out"
    error_formula: ClassVar = r":math:`\sigma / \sqrt{n}` and :math:`\sigma / \sqrt{2n}`"

    def estimate(self, part: Part, /, *_search: object) -> Estimate:
        """Return the maximum of the likelihood."""
        sums = part.log_statistics
        mu, sigma = sums.log_mean, np.sqrt(sums.log_variance)
        return Estimate(
            parameters={"mu": mu, "sigma": sigma},
            standard_errors={"mu": sigma / np.sqrt(sums.n), "sigma": sigma / np.sqrt(2 * sums.n)},
            converged=np.isfinite(mu),
        )

    def log_likelihood(self, part: Part, parameters: Parameters) -> Floats:
        """Return the log-likelihood of the positive samples."""
        sums, mu, sigma = part.log_statistics, parameters["mu"], parameters["sigma"]
        misfit = (sums.log_variance + (sums.log_mean - mu) ** 2) / (2 * sigma**2)
        # Minus log x is the Jacobian of the logarithm: likelihoods are compared in linear radiance.
        per_sample = -misfit - np.log(sigma) - 0.5 * np.log(2 * np.pi) - sums.log_mean
        return np.asarray(sums.n * per_sample)

    def log_density(self, points: WeightedSamples, parameters: Parameters) -> Floats:
        """Return the log density of log x."""
        sigma = parameters["sigma"]
        density = points.log + (points.log_mean - parameters["mu"])[:, np.newaxis]
        density /= sigma[:, np.newaxis]
        np.square(density, out=density)
        density *= -0.5
        density -= (np.log(sigma) + 0.5 * np.log(2 * np.pi))[:, np.newaxis]
        return density

    def distribution(self, parameters: Parameters) -> Any:
        """Return SciPy's distribution."""
        return stats.lognorm(parameters["sigma"], scale=np.exp(parameters["mu"]))

    def words(self, parameters: Mapping[str, float]) -> str:
        """Return the median, which says more than the mean of the logarithm, and sigma."""
        median, sigma = np.exp(parameters["mu"]), parameters["sigma"]
        return f"median {number(median, 2)}, σ {number(sigma, 2)}"


class Weibull(Family):
    """Weibull: an exponential, stretched or squeezed; the light-tailed limit of Burr distributions.

    ``f(x) = (k/s) (x/s)^(k-1) exp(-(x/s)^k)``, where k is the shape and s the scale. Newton's
    method solves ``mean(x^k log x) / mean(x^k) - 1/k = mean(log x)``; then ``s = mean(x^k)^(1/k)``.

    References
    ----------
    Johnson, Kotz and Balakrishnan, "Continuous univariate distributions", vol. 1, 1994, chap. 21.

    Examples
    --------
    >>> import chdstat as chd
    >>> x = 3 * np.random.default_rng(1).weibull(0.7, size=4096)
    >>> result = chd.fit.weibull(x)
    >>> {name: round(float(value), 1) for name, value in result.parameters.items()}
    {'shape': 0.7, 'scale': 3.0}
    """

    name: ClassVar = "weibull"
    label: ClassVar = "Weibull"
    units: ClassVar = {"shape": "1", "scale": RADIANCE}
    errors_from: ClassVar = {"scale": 20}
    density: ClassVar = "(k/s) (x/s)^{k-1} e^{-(x/s)^k}"
    tail_index: ClassVar = "0"
    error_formula: ClassVar = "expected information"

    def estimate(
        self, part: Part, near: Parameters | None = None, tolerance: float = TIGHT, /
    ) -> Estimate:
        """Return the maximum of the likelihood."""
        shape, scale, converged = maximise(
            part,
            self._profile,
            start=self._start,
            finish=self._finish,
            names=3,
            minimum=self.minimum,
            near=None if near is None else (np.log(near["shape"]), np.zeros(part.n.shape)),
            tolerance=tolerance,
        )
        # Inverse of the Fisher information, in closed form: Johnson, Kotz and Balakrishnan,
        # "Continuous univariate distributions", vol. 1, 1994, chapter 21.
        root = np.sqrt(6 / part.n) / np.pi
        scale_factor = np.sqrt(np.pi**2 / 6 + (1 - np.euler_gamma) ** 2)
        # The mean of (x/s)^k is 1.
        log_mean = part.log_statistics.log_mean
        likelihood = np.log(shape) + shape * (log_mean - np.log(scale)) - 1 - log_mean
        return Estimate(
            parameters={"shape": shape, "scale": scale},
            standard_errors={"shape": shape * root, "scale": scale / shape * root * scale_factor},
            converged=converged == 1,
            log_likelihood=part.n * likelihood,
        )

    def log_density(self, points: WeightedSamples, parameters: Parameters) -> Floats:
        """Return the log density of log x."""
        shape = parameters["shape"]
        power = points.log - (np.log(parameters["scale"]) - points.log_mean)[:, np.newaxis]
        power *= shape[:, np.newaxis]
        density = power - np.exp(power)
        density += np.log(shape)[:, np.newaxis]
        return density

    def distribution(self, parameters: Parameters) -> Any:
        """Return SciPy's distribution."""
        return stats.weibull_min(parameters["shape"], scale=parameters["scale"])

    def _profile(self, points: WeightedSamples, at: Floats) -> Floats:
        """Profile log-likelihood of a sample, ``log k + k mean(log x) - log mean(x^k)``."""
        k, top = np.exp(at[0]), points.log_top
        total, first, second = points.moments(_powers(points, k, top))
        first, second = first / total, second / total
        second -= first**2
        value = at[0] - np.log(total) - k * top
        return np.stack([value, 1 - k * first, -k * first - k**2 * second])

    def _start(self, points: WeightedSamples) -> Floats:
        """Match the standard deviation of log x, which is pi / (sqrt(6) k)."""
        spread = np.sqrt(points.average(points.log**2))
        return np.stack([np.log(np.pi / np.sqrt(6) / spread), np.zeros_like(spread)])

    def _finish(self, points: WeightedSamples, at: Floats, converged: Mask) -> Floats:
        """Return shape, scale and convergence; the scale is profiled out, ``mean(x^k)^(1/k)``."""
        shape = np.exp(at[0])
        power = points.average(_powers(points, shape, points.log_top))
        log_scale = points.log_mean + points.log_top + np.log(power) / shape
        return np.stack([shape, np.exp(log_scale), converged])


def _powers(points: WeightedSamples, k: Floats, top: Floats) -> Floats:
    """Return (x / largest x)^k, which is at most 1 for any k."""
    power = points.log - top[:, np.newaxis]
    power *= k[:, np.newaxis]
    return np.exp(power, out=power)


_LEAST = 1e-4
"""Floor of b: below it, d is about 1e4 or more, which no sample can tell from the Weibull limit."""
_NEAR_LIMIT = 0.01
_SHAPES = np.exp(np.linspace(np.log(0.02), np.log(100), 200))
"""Shapes d at which the skewness of log x is tabulated for the start."""
_SKEWNESS = (special.polygamma(2, 1) - special.polygamma(2, _SHAPES)) / (
    special.polygamma(1, 1) + special.polygamma(1, _SHAPES)
) ** 1.5


class Burr(Family):
    """Burr XII: a body of any width with a power tail; Weibull is its light-tailed limit.

    ``f(x) = (c d / s) (x/s)^(c-1) (1 + (x/s)^c)^(-d-1)``, which economists call Singh-Maddala. Its
    tail index is ``1 / (c d)``. The likelihood has no maximum where it rises towards one of two
    limits; such rows are NaN:

    - `AT_LIMIT`: as d grows without bound, the distribution becomes a Weibull distribution. The
      Weibull fit describes the row.
    - `AT_PARETO_LIMIT`: as c grows without bound while c d does not, the distribution becomes a
      power law that begins at the smallest sample, as above a floor of ambient light. No family of
      this library describes the row; `chdstat.fit.tail_index` estimates the index of its tail.

    Standard errors come from the observed information.

    References
    ----------
    Burr, "Cumulative frequency functions", 1942, doi:10.1214/aoms/1177731607. Singh and Maddala, "A
    function for size distribution of incomes", 1976, doi:10.2307/1911538. Shao, "Notes on maximum
    likelihood estimation for the three-parameter Burr XII distribution", 2004,
    doi:10.1016/S0167-9473(02)00367-5.

    Examples
    --------
    >>> import chdstat as chd
    >>> x = stats.burr12(2.0, 0.5, scale=3.0).rvs(4096, random_state=1)
    >>> result = chd.fit.burr(x)
    >>> round(1 / float(result.parameters["c"] * result.parameters["d"]), 1)
    1.0
    """

    name: ClassVar = "burr"
    label: ClassVar = "Burr"
    units: ClassVar = {"c": "1", "d": "1", "scale": RADIANCE}
    errors_from: ClassVar = {"c": 60, "d": 60, "scale": 60}
    density: ClassVar = "(cd/s) (x/s)^{c-1} (1 + (x/s)^c)^{-d-1}"
    tail_index: ClassVar = ":math:`1 / (cd)`"
    error_formula: ClassVar = "observed information"

    def estimate(
        self, part: Part, near: Parameters | None = None, tolerance: float = TIGHT, /
    ) -> Estimate:
        """Maximise the profile likelihood of a = log c and b = log(1 + q), q = log(1 + e^rho).

        With v = c (log x - log scale), rho is v at the log mean. d is profiled out: ``1 / d = mean
        log(1 + e^v)``.

        At the Weibull limit, d and the scale go to infinity together, q goes to 0, and the profile
        stays smooth. If it rises all the way to q = 0, no Burr distribution attains the maximum
        (Shao 2004, doi:10.1016/S0167-9473(02)00367-5).

        Nor does one if the profile rises while c goes to infinity and c d stays: that limit is a
        power law above the smallest sample. On the way there, q grows with c, so that the ridge of
        the profile is straight in a and b.
        """
        start = None
        if near is not None:
            rho = near["c"] * (part.log_statistics.log_mean - np.log(near["scale"]))
            start = np.log(near["c"]), np.maximum(np.log1p(np.logaddexp(0, rho)), _LEAST)
        c, d, scale, c_error, d_error, scale_error, converged, limit = maximise(
            part,
            self._profile,
            start=self._start,
            finish=self._finish,
            names=8,
            minimum=self.minimum,
            floor=_LEAST,
            near=start,
            tolerance=tolerance,
        )
        log_mean = part.log_statistics.log_mean
        # The mean of log(1 + (x/s)^c) is 1 / d.
        likelihood = np.log(c * d) + c * (log_mean - np.log(scale)) - 1 - 1 / d - log_mean
        return Estimate(
            parameters={"c": c, "d": d, "scale": scale},
            standard_errors={"c": c_error, "d": d_error, "scale": scale_error},
            converged=converged == 1,
            limit=np.nan_to_num(limit).astype(np.int8),
            log_likelihood=part.n * likelihood,
        )

    def log_density(self, points: WeightedSamples, parameters: Parameters) -> Floats:
        """Return the log density of log x."""
        c, d = parameters["c"], parameters["d"]
        shift = (points.log_mean - np.log(parameters["scale"])) * c
        v = points.log * c[:, np.newaxis]
        v += shift[:, np.newaxis]
        # A row without a fit is NaN; it must not hide that another row is too large for exp.
        if np.fmax.reduce(v, axis=None, initial=0) > 700:
            density = np.logaddexp(0, v)
        else:
            density = np.log1p(np.exp(v))
        density *= -(d + 1)[:, np.newaxis]
        density += v
        density += np.log(c * d)[:, np.newaxis]
        return np.asarray(density)

    def distribution(self, parameters: Parameters) -> Any:
        """Return SciPy's distribution."""
        return stats.burr12(parameters["c"], parameters["d"], scale=parameters["scale"])

    def mean(self, parameters: Parameters) -> Floats:
        """Return ``s d B(1 + 1/c, d - 1/c)``, infinite where c d <= 1; SciPy has NaN there."""
        c, d = parameters["c"], parameters["d"]
        log_mean = np.log(parameters["scale"]) + np.log(d) + special.betaln(1 + 1 / c, d - 1 / c)
        return np.asarray(np.where(c * d <= 1, np.inf, np.exp(log_mean)))

    def _profile(self, points: WeightedSamples, at: Floats) -> Floats:
        """Profile log-likelihood per sample, ``log c + mean v - log L - L`` with L = 1 / d."""
        c, rho = np.exp(at[0]), _log_expm1(np.expm1(at[1]))
        level, rest = _logistic(points, c, rho)
        l_rho, l_c, _ = points.moments(1 - rest)
        l_rho_rho, l_rho_c, l_c_c = points.moments(_slope(rest))
        f, g = 1 + 1 / level, 1 / level**2
        by_c, by_rho = 1 / c - f * l_c, 1 - f * l_rho
        by_c_c = -1 / c**2 + g * l_c**2 - f * l_c_c
        by_rho_c = g * l_c * l_rho - f * l_rho_c
        by_rho_rho = g * l_rho**2 - f * l_rho_rho
        # From (c, rho) to (a, b): d rho / d q = 1 + e^-rho, and d q / d b = e^b.
        rise, more = np.exp(at[1]), np.exp(-rho)
        stretch = rise * (1 + more)
        value = at[0] + rho - np.log(level) - level
        mixed = c * stretch * by_rho_c
        by_b_b = stretch**2 * by_rho_rho + (1 - more * rise) * stretch * by_rho
        curvatures = c**2 * by_c_c + c * by_c, mixed, by_b_b
        return np.stack([value, c * by_c, stretch * by_rho, *curvatures])

    def _start(self, points: WeightedSamples) -> Floats:
        """Match mean, variance and skewness of log x: cumulants of v are polygamma functions of d.

        If the samples form two heaps, the likelihood may have one maximum there and one in the
        Weibull limit. A second start therefore lies close to that limit.
        """
        square = points.log**2
        variance = points.average(square)
        square *= points.log
        skewness = points.average(square) / variance**1.5
        # Tables must ascend; the skewness falls as d grows.
        d = np.interp(skewness, _SKEWNESS[::-1], _SHAPES[::-1])
        c = np.sqrt((special.polygamma(1, 1) + special.polygamma(1, d)) / variance)
        rho = special.digamma(1) - special.digamma(d)
        weibull = np.log(np.pi / np.sqrt(6 * variance))
        cumulants = np.stack([np.log(c), np.log1p(np.logaddexp(0, rho))])
        return np.stack([cumulants, np.stack([weibull, np.full_like(weibull, _NEAR_LIMIT)])])

    def _finish(self, points: WeightedSamples, at: Floats, converged: Mask) -> Floats:
        """Return parameters, standard errors, convergence, and the code of a limit, (8, row)."""
        c, rho = np.exp(at[0]), _log_expm1(np.expm1(at[1]))
        level, rest = _logistic(points, c, rho)
        d = 1 / level
        scale = np.exp(points.log_mean - rho / c)
        errors = _standard_errors(points, rest, c, d, rho)
        errors[2] *= scale
        # A maximum at the floor is the Weibull limit. Any other maximum is a local one if the power
        # law above the smallest sample, the limit of growing c, is likelier.
        reached = at[0] + rho - np.log(level) - level
        weibull = converged & (at[1] <= 2 * _LEAST)
        # The limit of the profile as c goes to infinity, -log mean log(x / smallest x).
        power_law = -np.log(-np.where(points.weight > 0, points.log, 0).min(axis=-1))
        limit = np.where(weibull, Reason.AT_LIMIT, Reason.OK)
        limit = np.where(power_law >= reached, Reason.AT_PARETO_LIMIT, limit)
        interior = (limit == Reason.OK) & np.isfinite(errors).all(axis=0)
        return np.stack([c, d, scale, *errors, converged & interior, limit])


def _standard_errors(
    points: WeightedSamples, rest: Floats, c: Floats, d: Floats, rho: Floats
) -> Floats:
    """Return standard errors of c, d and log scale, shape (3, row), from observed information."""
    offset = rho / c
    # Moments of the logistic function and its derivative by t = log x - log scale.
    mean, first, _ = points.moments(1 - rest)
    zero, one, two = points.moments(_slope(rest))
    two = two + 2 * offset * one + offset**2 * zero
    one = one + offset * zero
    cc, cs, ss = 1 / c**2 + (d + 1) * two, -(d + 1) * c * one, (d + 1) * c**2 * zero
    cd, sd, dd = first + offset * mean, -c * mean, 1 / d**2
    determinant = cc * (ss * dd - sd**2) - cs * (cs * dd - sd * cd) + cd * (cs * sd - ss * cd)
    inverse = np.stack([ss * dd - sd**2, cc * ss - cs**2, cc * dd - cd**2]) / determinant
    return np.asarray(np.sqrt(np.where(inverse > 0, inverse, np.nan) / points.n))


def _logistic(points: WeightedSamples, c: Floats, rho: Floats) -> tuple[Floats, Floats]:
    """Return mean log(1 + e^v), and 1 / (1 + e^v) at every point."""
    v = points.log * c[:, np.newaxis]
    v += rho[:, np.newaxis]
    power = np.exp(v, out=v)
    power += 1
    rest = np.reciprocal(power)
    return points.average(np.log(power, out=power)), rest


def _slope(rest: Floats) -> Floats:
    """Return the derivative of the logistic function, e^v / (1 + e^v)^2; works in `rest`."""
    square = rest * rest
    return np.subtract(rest, square, out=rest)


def _log_expm1(q: Floats) -> Floats:
    """Return log(e^q - 1), the inverse of log(1 + e^rho)."""
    return np.asarray(q + np.log(-np.expm1(-q)))
