"""The families as SciPy has them: its distributions, its fits, and parameters to draw from."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import optimize, stats

import chdstat as chd

DISTRIBUTIONS: Mapping[str, Callable[..., Any]] = {
    "gamma": lambda p: stats.gamma(p["shape"], scale=p["scale"]),
    "lognormal": lambda p: stats.lognorm(p["sigma"], scale=np.exp(p["mu"])),
    "weibull": lambda p: stats.weibull_min(p["shape"], scale=p["scale"]),
    "burr": lambda p: stats.burr12(p["c"], p["d"], scale=p["scale"]),
    "pareto": lambda p: stats.genpareto(p["xi"], scale=p["scale"]),
}


def random_parameters(family: str, rng: np.random.Generator, size: int) -> dict[str, np.ndarray]:
    """Draw parameters of CHDs: scales over eight decades, shapes from spiky to peaked."""
    column = (size, 1)
    scale = 10 ** rng.uniform(-4, 4, column)
    return {
        "gamma": lambda: {"shape": 10 ** rng.uniform(-1, 1.5, column), "scale": scale},
        "lognormal": lambda: {"mu": np.log(scale), "sigma": rng.uniform(0.1, 2.5, column)},
        "weibull": lambda: {"shape": 10 ** rng.uniform(-0.5, 0.7, column), "scale": scale},
        "burr": lambda: {
            "c": 10 ** rng.uniform(-0.2, 0.7, column),
            "d": 10 ** rng.uniform(-0.6, 0.6, column),
            "scale": scale,
        },
        "pareto": lambda: {"xi": rng.uniform(-0.4, 1.0, column), "scale": scale},
    }[family]()


def draw(family: str, rng: np.random.Generator, rows: int, n: int) -> np.ndarray:
    """Draw n samples for each of many random parameter sets, shape (rows, n)."""
    parameters = random_parameters(family, rng, rows)
    return np.asarray(DISTRIBUTIONS[family](parameters).rvs((rows, n), random_state=rng))


def scipy_fit(family: str, x: np.ndarray) -> dict[str, float] | None:
    """Fit by SciPy, as tightly as it can; None where it raises or its search does not end.

    Samples are given relative to their geometric mean, and the scale is put back: SciPy's searches
    start from scale 1 and stop at steps of an absolute size.
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

    try:
        fitted = _FITS[family](x / center, search)
    except (ValueError, RuntimeError, FloatingPointError, stats.FitError):
        return None
    if not all(searches):
        return None
    if family == "lognormal":
        return {**fitted, "mu": fitted["mu"] + np.log(center)}
    return {**fitted, "scale": fitted["scale"] * center}


def log_density(family: str, x: np.ndarray, parameters: Mapping[str, Any]) -> np.ndarray:
    return np.asarray(DISTRIBUTIONS[family](parameters).logpdf(x))


def _gamma(x: np.ndarray, search: Callable[..., Any]) -> dict[str, float]:
    shape, _, scale = stats.gamma.fit(x, floc=0)
    return {"shape": shape, "scale": scale}


def _lognormal(x: np.ndarray, search: Callable[..., Any]) -> dict[str, float]:
    sigma, _, scale = stats.lognorm.fit(x, floc=0)
    return {"mu": np.log(scale), "sigma": sigma}


def _weibull(x: np.ndarray, search: Callable[..., Any]) -> dict[str, float]:
    shape, _, scale = stats.weibull_min.fit(x, floc=0, optimizer=search)
    return {"shape": shape, "scale": scale}


def _burr(x: np.ndarray, search: Callable[..., Any]) -> dict[str, float]:
    c, d, _, scale = stats.burr12.fit(x, 2.0, 1.0, floc=0, optimizer=search)
    return {"c": c, "d": d, "scale": scale}


def _pareto(x: np.ndarray, search: Callable[..., Any]) -> dict[str, float]:
    xi, _, scale = stats.genpareto.fit(x, 0.1, floc=0, optimizer=search)
    return {"xi": xi, "scale": scale}


_FITS = {
    "gamma": _gamma,
    "lognormal": _lognormal,
    "weibull": _weibull,
    "burr": _burr,
    "pareto": _pareto,
}


@dataclass(frozen=True)
class Comparison:
    """How the library's fits compare with SciPy's.

    Attributes
    ----------
    both, scipy_only, ours_only, neither
        Rows that each could fit.
    off
        Rows that both fitted, with a parameter off by more than 1e-6, relative (of xi, which may be
        0, relative to 1), where SciPy's answer is as likely as the library's to 1e-9 per sample,
        and that the library is to blame for: its answer is off the root of the likelihood equations
        in 40 digits.
    scipy_off
        Such rows where SciPy is to blame: the likelihood is flatter than its search can feel.
    less_likely
        Rows where SciPy's search ended, says it converged, and its answer is less likely by more.
    largest
        Largest difference of a parameter among the rows that are not `less_likely`.
    likelihood_lost
        Largest log-likelihood per sample by which SciPy's answer is better.
    scipy_at_limit
        Rows that SciPy alone fitted, with a shape above 1e4 or below 1e-4: no answer, but a limit.
    """

    both: int
    scipy_only: int
    ours_only: int
    neither: int
    off: int
    scipy_off: int
    less_likely: int
    largest: float
    likelihood_lost: float
    scipy_at_limit: int


def compare(family: str, x: np.ndarray) -> Comparison:
    """Fit every row of x both ways."""
    fit = chd.fit.fit(x, family)
    counts = dict.fromkeys(("both", "scipy_only", "ours_only", "neither"), 0)
    off = scipy_off = less_likely = at_limit = 0
    largest = lost = 0.0
    for i, row in enumerate(x):
        theirs, have = scipy_fit(family, row), fit.reason[i] == 0
        key = ("both" if have else "scipy_only") if theirs else ("ours_only" if have else "neither")
        counts[key] += 1
        if theirs is not None and not have:
            shapes = [theirs[name] for name in ("c", "d", "shape") if name in theirs]
            at_limit += not all(1e-4 < shape < 1e4 for shape in shapes)
        if theirs is None or not have:
            continue
        ours = {name: float(values[i]) for name, values in fit.parameters.items()}
        per_sample = log_density(family, row, theirs) - log_density(family, row, ours)
        lost = max(lost, float(per_sample.mean()))
        if per_sample.mean() < -1e-9:
            less_likely += 1
            continue
        difference = max(abs(theirs[n] - ours[n]) / _unit(n, ours[n]) for n in ours)
        largest = max(largest, difference)
        if difference > 1e-6:
            exact = exact_fit(family, row, ours)
            wrong = max(abs(exact[n] - ours[n]) / _unit(n, ours[n]) for n in ours) > 1e-6
            off, scipy_off = off + wrong, scipy_off + (not wrong)
    return Comparison(
        **counts,
        off=off,
        scipy_off=scipy_off,
        less_likely=less_likely,
        largest=largest,
        likelihood_lost=lost,
        scipy_at_limit=at_limit,
    )


def exact_fit(family: str, x: np.ndarray, near: Mapping[str, float]) -> dict[str, float]:
    """Solve the likelihood equations in 40 digits, from a solution in double precision."""
    import mpmath as mp

    with mp.workdps(40):
        samples = [mp.mpf(float(value)) for value in x]
        equations = {"burr": _burr_equations, "pareto": _pareto_equations}[family](samples)
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


def _pareto_equations(x: list[Any]) -> Callable[..., list[Any]]:
    import mpmath as mp

    def equations(xi: Any, scale: Any) -> list[Any]:
        inside = [1 + xi * value / scale for value in x]
        tilted = mp.fsum(a / scale / b for a, b in zip(x, inside, strict=True))
        return [
            mp.fsum(mp.log(value) for value in inside) / xi**2 - (1 / xi + 1) * tilted,
            len(x) - (1 + xi) * tilted,
        ]

    return equations


def _unit(name: str, value: float) -> float:
    return 1.0 if name in ("xi", "mu") else abs(value)
