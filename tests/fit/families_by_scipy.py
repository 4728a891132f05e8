"""The families as SciPy has them: its fits, and parameters to draw from."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import optimize, stats

import chdstat as chd
from chdstat.fit import FAMILIES

TYPICAL: dict[str, dict[str, tuple[float, float]]] = {
    "gamma": {"shape": (0.1, 31.6), "scale": (1.0, 1.0)},
    "lognormal": {"mu": (0.0, 0.0), "sigma": (0.1, 2.5)},
    "weibull": {"shape": (0.3, 5.0), "scale": (1.0, 1.0)},
    "burr": {"c": (0.6, 5.0), "d": (0.25, 4.0), "scale": (1.0, 1.0)},
}
"""Range of each parameter over the CHDs of rendered images at unit scale."""


def random_parameters(family: str, rng: np.random.Generator, size: int) -> dict[str, np.ndarray]:
    """Draw parameters of CHDs at unit scale: shapes from spiky to peaked."""
    return parameters_at(family, rng.random((len(FAMILIES[family].units), size, 1)))


def parameters_at(family: str, place: Any) -> dict[str, np.ndarray]:
    """Return parameters at a place from 0 to 1 in the range of each that is typical of CHDs."""
    ranges = TYPICAL[family]
    place = np.broadcast_to(place, (len(ranges), *np.shape(place)[1:]))
    return {
        name: low * (high / low) ** u if low > 0 else low + (high - low) * u
        for (name, (low, high)), u in zip(ranges.items(), place, strict=True)
    }


def typical(family: str) -> Any:
    """Return SciPy's distribution in the middle of the range that is typical of CHDs."""
    return FAMILIES[family].distribution(parameters_at(family, 0.5))


def draw(family: str, rng: np.random.Generator, rows: int, n: int) -> np.ndarray:
    """Draw n samples for each of many random parameter sets and scales, shape (rows, n)."""
    distribution = FAMILIES[family].distribution(random_parameters(family, rng, rows))
    scale = 10 ** rng.uniform(-4, 4, (rows, 1))
    return np.asarray(scale * distribution.rvs((rows, n), random_state=rng))


def scipy_fit(family: str, x: np.ndarray) -> tuple[float, ...] | None:
    """Fit by SciPy, as tightly as it can; None where it raises or its search does not end.

    Samples are given relative to their geometric mean, and the scale is put back: SciPy's searches
    start from scale 1 and stop at steps of an absolute size.

    Returns
    -------
    tuple of float
        SciPy's shapes, then its scale: see `in_scipys_words`.
    """
    center = np.exp(np.log(x).mean())
    searches: list[bool] = []

    def search(function, start, args=(), disp=0):
        simplex = optimize.minimize(
            function,
            start,
            args=args,
            method="Nelder-Mead",
            options={"xatol": 1e-10, "fatol": 1e-13, "maxiter": 10_000, "maxfev": 10_000},
        )
        searches.append(bool(simplex.success))
        return simplex.x

    frozen = typical(family)
    try:
        *shapes, _, scale = frozen.dist.fit(x / center, *frozen.args, floc=0, optimizer=search)
    except (ValueError, RuntimeError, FloatingPointError, stats.FitError):
        return None
    return (*shapes, scale * center) if all(searches) else None


def in_scipys_words(family: str, parameters: Mapping[str, Any]) -> tuple[float, ...]:
    """Return the shapes, then the scale, of SciPy's distribution with a family's parameters."""
    frozen = FAMILIES[family].distribution(parameters)
    return tuple(float(value) for value in (*frozen.args, frozen.kwds["scale"]))


def difference(family: str, one: tuple[float, ...], other: tuple[float, ...]) -> float:
    """Return the largest relative difference; relative to 1, of a shape that may be negative."""
    dist = typical(family).dist
    signed = np.isfinite(dist.support(*(-abs(value) for value in other[:-1]))).any()
    units = [*(1.0 if signed else abs(value) for value in other[:-1]), other[-1]]
    return max(abs(a - b) / unit for a, b, unit in zip(one, other, units, strict=True))


def log_density(family: str, x: np.ndarray, parameters: Mapping[str, Any]) -> np.ndarray:
    return np.asarray(FAMILIES[family].distribution(parameters).logpdf(x))


@dataclass(frozen=True)
class Comparison:
    """How the library's fits compare with SciPy's.

    Attributes
    ----------
    both
        Rows that both could fit.
    off
        Of these, rows with a parameter off by more than 1e-6, relative (of xi, which may be 0,
        relative to 1), where SciPy's answer is as likely as the library's to 1e-9 per sample, and
        that the library is to blame for: its answer is off the root of the likelihood equations in
        40 digits. Where that root is the library's, the likelihood is flatter than SciPy can feel.
    likelihood_lost
        Largest log-likelihood per sample by which SciPy's answer is better.
    """

    both: int
    off: int
    likelihood_lost: float


def compare(family: str, x: np.ndarray) -> Comparison:
    """Fit every row of x both ways."""
    fit = chd.fit.fit(x, family)
    both = off = 0
    lost = 0.0
    for i in np.flatnonzero(fit.reason == 0):
        row, theirs = x[i], scipy_fit(family, x[i])
        if theirs is None:
            continue
        both += 1
        ours = {name: float(values[i]) for name, values in fit.parameters.items()}
        *shapes, scale = theirs
        per_sample = typical(family).dist.logpdf(row, *shapes, scale=scale)
        gained = float((per_sample - log_density(family, row, ours)).mean())
        lost = max(lost, gained)
        by_name = in_scipys_words(family, ours)
        if gained >= -1e-9 and difference(family, theirs, by_name) > 1e-6:
            exact = family in EQUATIONS and in_scipys_words(family, exact_fit(family, row, ours))
            off += not (exact and difference(family, exact, by_name) <= 1e-6)
    return Comparison(both, off, lost)


def exact_fit(family: str, x: np.ndarray, near: Mapping[str, float]) -> dict[str, float]:
    """Solve the likelihood equations in 40 digits, from a solution in double precision."""
    import mpmath as mp

    with mp.workdps(40):
        samples = [mp.mpf(float(value)) for value in x]
        equations = EQUATIONS[family](samples)
        start = [mp.mpf(value) for value in near.values()]
        # Relative to where it starts, every parameter is about 1, however large its scale.
        root = mp.findroot(
            lambda *r: equations(*(a * b for a, b in zip(r, start, strict=True))),
            [mp.mpf(1)] * len(start),
            tol=1e-40,
        )
        return {n: float(r * s) for n, r, s in zip(near, root, start, strict=True)}


def _burr_equations(x: list[Any]) -> Callable[..., list[Any]]:
    import mpmath as mp

    logs = [mp.log(value) for value in x]

    def equations(c: Any, d: Any, scale: Any) -> list[Any]:
        v = [c * (log - mp.log(scale)) for log in logs]
        share = [1 / (1 + mp.exp(-value)) for value in v]
        n = len(v)
        return [
            n + mp.fsum(v) - (d + 1) * mp.fsum(a * b for a, b in zip(share, v, strict=True)),
            n - d * mp.fsum(mp.log1p(mp.exp(value)) for value in v),
            n - (d + 1) * mp.fsum(share),
        ]

    return equations


EQUATIONS = {"burr": _burr_equations}
"""Likelihood equations of families whose SciPy search is not always tight."""
