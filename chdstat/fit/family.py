"""Family: what a family of distributions has, and the samples that it is fitted to.

A family that is fitted from sums over the samples only sees `WeightedSamples`: samples with weight
1, or bins of a log histogram with their counts. Rows are sorted by their number of samples, so that
a block is as wide as its rows need and pixels with many nulls cost little.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, ClassVar, Literal, TypeVar

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Floats, Mask, batch_rows, rows_by_count
from chdstat._core.display import number
from chdstat._core.positive import Part, PositiveHistogram, PositivePart
from chdstat.errors import Reason

Parameters = Mapping[str, Floats]

TIGHT = 3e-5
"""Newton step at which a search ends; the remaining error is of the order of its square."""

_THIN = 32
_EDGES = np.sin(np.linspace(0, np.pi / 2, _THIN + 1)) ** 2
"""Quantiles that divide the samples: close at both ends, where single samples count."""


@dataclass(frozen=True)
class Estimate:
    """Parameters and standard errors by name, and where the estimate is a maximum.

    Where the likelihood has no maximum but rises towards a limit of the family, `limit` is the
    `Reason` code of that limit; it is 0 elsewhere. `log_likelihood` is the family's, if the maximum
    has a closed form.
    """

    parameters: Parameters
    standard_errors: Parameters
    converged: Mask
    limit: npt.NDArray[np.int8] | Literal[0] = 0
    log_likelihood: Floats | None = None


class Family:
    """A parametric family on the positive numbers.

    A family documents itself as "Name: what it is for.", formula, references and an example.

    Attributes
    ----------
    name
        What users call it.
    label
        Its name in running text.
    units
        Names of its parameters, with their units.
    errors_from
        Positive samples, by parameter, from which 1.96 standard errors hold the truth in nine of
        ten cases, where that takes more samples than the fit. Simulated.
    density, tail_index, error_formula
        For the table in the documentation: the density as TeX; the tail index and the source of the
        standard errors as reStructuredText.
    """

    name: ClassVar[str]
    label: ClassVar[str]
    units: ClassVar[Mapping[str, str]]
    errors_from: ClassVar[Mapping[str, int]] = {}
    density: ClassVar[str] = ""
    tail_index: ClassVar[str] = ""
    error_formula: ClassVar[str] = ""

    def __eq__(self, other: object) -> bool:
        """Compare by name: a family that was sent to a worker of a cluster stays the same."""
        return isinstance(other, Family) and self.name == other.name

    def __hash__(self) -> int:
        return hash(self.name)

    @property
    def minimum(self) -> int:
        """Positive samples that a fit needs: as many as there are parameters."""
        return len(self.units)

    def estimate(
        self, part: Part, near: Parameters | None = None, tolerance: float = TIGHT, /
    ) -> Estimate:
        """Return the maximum of the likelihood.

        A search may begin at the parameters `near`; it then leaves out rows where they are NaN. It
        ends when a Newton step is below the tolerance. Rows that cannot be fitted may hold anything
        but must not warn.
        """
        raise NotImplementedError

    def log_density(self, points: WeightedSamples, parameters: Parameters) -> Floats:
        """Return the log density of log x at the points of some rows, shape (row, point).

        The parameters are those of these rows, shape (row,). The log density of x is smaller by
        log x. A row without a fit has NaN parameters, which must not warn.
        """
        raise NotImplementedError

    def distribution(self, parameters: Parameters) -> Any:
        """Return SciPy's frozen distribution with the given parameters, which may be arrays."""
        raise NotImplementedError

    def mean(self, parameters: Parameters) -> Floats:
        """Return the expectation."""
        return np.asarray(self.distribution(parameters).mean())

    def words(self, parameters: Mapping[str, float]) -> str:
        """Return the parameters of one fit as a legend has room for them."""
        return ", ".join(f"{name} {number(value, 2)}" for name, value in parameters.items())

    def log_likelihood(self, part: Part, parameters: Parameters) -> Floats:
        """Return the sum of the log densities of the positive samples in linear radiance, (...)."""
        known = np.isfinite(np.stack(list(parameters.values()))).all(axis=0)
        total = np.full(part.n.size, np.nan)
        for points in blocks(part, known.ravel() & (part.n.ravel() > 0)):
            density = self.log_density(points, take(parameters, points.rows))
            density -= points.log_mean[:, np.newaxis]
            total[points.rows] = np.vecdot(points.weight, density)
        return total.reshape(part.n.shape)


def take(parameters: Parameters, rows: npt.NDArray[Any]) -> dict[str, Floats]:
    """Select the parameters of some rows of the flattened batch."""
    return {name: value.reshape(-1)[rows] for name, value in parameters.items()}


@dataclass(frozen=True)
class WeightedSamples:
    """Logarithms of some rows of samples, or of bins, with weights.

    Attributes
    ----------
    rows
        Which rows of the flattened part these are, shape (row,).
    log
        Log radiance minus its mean in the row, shape (row, point); 0 where there is no point.
    weight
        Samples at each point, same shape; 0 where there is no point.
    n
        Samples of each row: the sum of its weights.
    log_mean
        Mean of log radiance, which is subtracted from `log` so that magnitudes drop out.
    log_top
        Largest `log`, shape (row,). For bins, the upper edge of the highest bin with samples, which
        no sample exceeds.
    single
        Whether every point is one sample, with weight 1.
    """

    rows: npt.NDArray[np.intp]
    log: Floats
    weight: Floats
    n: Floats
    log_mean: Floats
    log_top: Floats
    single: bool = False

    @cached_property
    def log_weight(self) -> Floats:
        """Weight times `log`, shape of `log`."""
        return self.log if self.single else self.weight * self.log

    @cached_property
    def square_weight(self) -> Floats:
        """Weight times the square of `log`, shape of `log`."""
        return self.log_weight * self.log

    def take(self, rows: npt.NDArray[Any]) -> WeightedSamples:
        """Select some of these rows."""
        names = ("rows", "log", "weight", "n", "log_mean", "log_top")
        return replace(self, **{name: getattr(self, name)[rows] for name in names})

    def average(self, values: Floats) -> Floats:
        """Average over the samples of each row, shape (row,)."""
        return np.asarray(np.vecdot(self.weight, values) / self.n)

    def moments(self, values: Floats) -> tuple[Floats, Floats, Floats]:
        """Return averages of values, of values times `log`, and of values times `log` squared."""
        zero = np.vecdot(self.weight, values)
        one = np.vecdot(self.log_weight, values)
        two = np.vecdot(self.square_weight, values)
        return zero / self.n, one / self.n, two / self.n


def blocks(part: Part, usable: Mask, *, thin: bool = False) -> Iterator[WeightedSamples]:
    """Cut the usable rows of a part into blocks.

    With `thin`, 32 samples represent all samples of a row; each has the weight of its neighbours.
    The maximum is then close to that of all samples, at a sixteenth of the cost for 512 samples.
    """
    for rows in rows_by_count(part.n.ravel(), usable, _THIN if thin else width_of(part)):
        yield points_of(part, rows, thin=thin)


def of_rows(
    part: Part,
    minimum: int,
    names: int,
    of_points: Callable[[WeightedSamples], Floats],
    *,
    thin: bool = False,
    among: Mask | None = None,
) -> Floats:
    """Compute `names` numbers per row from its points, shape (name, row); NaN where unusable."""
    results = np.full((names, part.n.size), np.nan)
    usable = part.reason(minimum).ravel() == Reason.OK
    for points in blocks(part, usable if among is None else usable & among, thin=thin):
        results[:, points.rows] = of_points(points)
    return results


def width_of(part: Part) -> int:
    """Return how many samples, or bins, a row of a part has room for."""
    held = part.counts if isinstance(part, PositiveHistogram) else part.x
    return int(held.shape[-1])


_AnyPart = TypeVar("_AnyPart", bound=Part)


def take_part(part: _AnyPart, rows: npt.NDArray[np.intp]) -> _AnyPart:
    """Select some rows of the flattened batch; of samples in any order, their places are left."""

    def taken(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
        trailing = values.shape[part.n.ndim :]
        return batch_rows(np.broadcast_to(values, part.n.shape + trailing), part.n.shape, rows)

    names = [field.name for field in fields(part) if field.name != "places"]
    kept: dict[str, Any] = {name: taken(getattr(part, name)) for name in names}
    return type(part)(**kept)


def halves_of(part: PositivePart, rows: npt.NDArray[np.intp]) -> PositivePart:
    """Split the samples of some rows into the even and the odd ones, shape (2, row, sample)."""
    samples = part.x.shape[-1]
    shape = 2, len(rows), (samples + 1) // 2
    x, positive = np.zeros(shape, part.x.dtype), np.zeros(shape, dtype=bool)
    for to, values in ((x, part.x), (positive, part.positive)):
        taken = batch_rows(values, part.n.shape, rows)
        to[0], to[1, :, : samples // 2] = taken[:, ::2], taken[:, 1::2]
    n = np.count_nonzero(positive, axis=-1)
    return PositivePart(x, positive, n, *np.zeros((4, *n.shape), dtype=np.int64))


def points_of(part: Part, rows: npt.NDArray[np.intp], *, thin: bool = False) -> WeightedSamples:
    """Return the samples or bins of some rows, or the middle sample of each of 32 groups."""
    if isinstance(part, PositiveHistogram):
        return _bins(part, rows)
    n, log_mean = part.n.ravel()[rows], part.log_statistics.log_mean.ravel()[rows]
    if thin:
        edges = np.rint(n[:, np.newaxis] * _EDGES).astype(np.intp)
        middle = np.minimum((edges[:, 1:] + edges[:, :-1]) // 2, n[:, np.newaxis] - 1)
        log = batch_rows(part.log_sorted, part.n.shape, rows[:, np.newaxis], middle)
        weight = np.diff(edges).astype(np.float64)
        log -= log_mean[:, np.newaxis]
    else:
        log = batch_rows(part.log_sorted, part.n.shape, rows, slice(int(n.max(initial=1))))
        log -= log_mean[:, np.newaxis]
        weight = (np.arange(log.shape[-1]) < n[:, np.newaxis]).astype(np.float64)
        # In a block of similar rows, few columns hold places without a sample.
        least = int(n.min(initial=log.shape[-1]))
        np.copyto(log[:, least:], 0, where=weight[:, least:] == 0)
    return WeightedSamples(
        rows=rows,
        log=log,
        weight=weight,
        n=n.astype(np.float64),
        log_mean=log_mean,
        log_top=log.max(axis=-1),
        single=not thin,
    )


def _bins(part: PositiveHistogram, rows: npt.NDArray[np.intp]) -> WeightedSamples:
    """Move the bin centres together until they have the log variance of the samples.

    Bins add h^2 / 12 to the variance of the samples (see `PositiveHistogram.log_statistics`).
    Contracting the centres about their mean removes it and keeps the weights.
    """
    some = take_part(part, rows)
    weight, centers = some.counts, some.log_centers
    n = some.n.astype(np.float64)
    log_mean = np.vecdot(weight, centers) / n
    centered = centers - log_mean[:, np.newaxis]
    spread = np.vecdot(weight, centered**2) / n
    wanted = part.log_statistics.log_variance.ravel()[rows]
    centered *= np.sqrt(wanted / spread)[:, np.newaxis]
    empty = weight == 0
    # The edge, not the contracted centre, which samples exceed.
    edge = np.where(empty, -np.inf, centers).max(axis=-1) + some.width / 2 - log_mean
    centered[empty] = 0
    return WeightedSamples(rows, centered, weight, n, log_mean, edge)
