"""Family: what a row of the table of families holds, and what its estimator returns."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from chdstat._core.positive import Floats, Mask
from chdstat.fit.weighted_samples import Points, sum_over_samples
from chdstat.summary.dispatch import Part

__all__ = ["RADIANCE", "Estimate", "Family", "LogDensity", "Parameters", "summed", "take"]

Parameters = Mapping[str, Floats]

LogDensity = Callable[[Points, Parameters], Floats]

RADIANCE = "W sr-1 m-2"
"""Unit of a scale parameter."""


@dataclass(frozen=True)
class Estimate:
    """Parameters and standard errors by name, and where the estimate is a maximum.

    `limit` says where there is none, for the likelihood rises towards a limit of the family: the
    `Reason` code of that limit, and 0 elsewhere.
    """

    parameters: Parameters
    standard_errors: Parameters
    converged: Mask
    limit: npt.NDArray[np.int8] | None = None


@dataclass(frozen=True)
class Family:
    """A parametric family on the positive numbers.

    Attributes
    ----------
    name
        What users call it.
    label
        Its name in running text.
    documentation
        ``__doc__`` of its module: "Name: what it is for.", the formula, references and an example.
    units
        Names of its parameters, with their units.
    estimate
        Maximum likelihood; a search may begin at given parameters, which are NaN where there are
        none. Rows that cannot be fitted may hold anything but must not warn.
    log_likelihood
        Sum over the positive samples of the log density in linear radiance, at given parameters.
    log_density
        Log density of log x at the points of some rows, shape (row, point), given the parameters of
        these rows, shape (row,). That of x is smaller by log x, for every family alike.
    distribution
        SciPy's frozen distribution with given parameters, which may be arrays.
    mean
        Expectation at given parameters; None where SciPy's will do.
    errors_from
        Positive samples from which on 1.96 standard errors hold the truth in nine of ten cases, by
        the name of the parameter, where it is more than the fit needs. Simulated.
    selected
        Whether `select` compares it by default.
    density, tail_index, error_formula
        For the table of the documentation: the density as TeX; the tail index and where standard
        errors come from as reStructuredText.
    typical
        Range of each parameter over the CHDs of rendered images at unit scale, from which to draw
        parameters for simulations.
    """

    name: str
    label: str
    documentation: str | None
    units: Mapping[str, str]
    estimate: Callable[[Part, Parameters | None], Estimate]
    log_likelihood: Callable[[Part, Parameters], Floats]
    log_density: LogDensity
    distribution: Callable[[Parameters], Any]
    mean: Callable[[Parameters], Floats] | None = None
    errors_from: Mapping[str, int] = field(default_factory=dict)
    selected: bool = False
    density: str = ""
    tail_index: str = ""
    error_formula: str = ""
    typical: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    @property
    def minimum(self) -> int:
        """Positive samples that a fit needs: as many as there are parameters."""
        return len(self.units)


def take(parameters: Parameters, points: Points) -> dict[str, Floats]:
    """Return the parameters, of any batch shape, of the rows of these points."""
    return {name: value.reshape(-1)[points.rows] for name, value in parameters.items()}


def summed(log_density: LogDensity) -> Callable[[Part, Parameters], Floats]:
    """Return a log-likelihood that adds up log densities, for families without sufficient sums."""

    def log_likelihood(part: Part, parameters: Parameters) -> Floats:
        known = np.asarray(np.isfinite(np.stack(list(parameters.values()))).all(axis=0))

        def of_points(points: Points) -> Floats:
            return log_density(points, take(parameters, points)) - points.log_mean[:, np.newaxis]

        return sum_over_samples(part, known, of_points)

    return log_likelihood
