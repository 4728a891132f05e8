"""Simulate null distributions of statistics of normality, for inference/null_quantiles.json.

    python tools/make_normality_tables.py > tables.txt

For every sample size of a grid, Gaussian samples are drawn and the statistics computed by the
library's own code. A quantile of a scaled statistic is a smooth function of the sample size: it is
kept as a polynomial in 1/sqrt(n), fitted to the grid with the weights of its simulation errors,
which is compact and averages the errors of neighbouring sizes. It says how large the residuals
are, relative to these errors: about 1 says that the polynomial follows. The same work writes the
same tables; 5e8 samples for each size take about seven minutes on one core.
"""

from __future__ import annotations

import argparse
import sys

import numpy as np
from scipy import special

from chdstat.inference import normality
from chdstat.inference.normality import LEVELS, TESTS

SEED = 20240607
SIZES = (
    *(8, 9, 10, 12, 14, 17, 20, 24, 30, 40, 55, 75, 100, 140, 200, 300, 450, 700),
    *(1100, 1800, 3000, 5000),
)
LARGE = (2000, 3000, 5000, 8000, 13000, 20000, 32000)
PLAN = {
    "anderson-darling": (SIZES, 5),
    # In between, the published formulas hold.
    "shapiro-wilk": ((*SIZES[:10], *LARGE), 6),
    "dagostino": (SIZES[6:], 7),
}
"""By statistic: for which sizes, and the degree of the polynomial."""

LIMIT = 10**12
"""A size at which the sums of two squares are chi-square with 2 degrees of freedom."""
CAP = 2_000_000
"""Samples drawn of the smallest sizes: the table need not be better than the others there."""
CHUNK = 2**15


def simulate(names: list[str], n: int, repeats: int) -> dict[str, np.ndarray]:
    """Return the scaled statistics of Gaussian samples of size `n`, by name."""
    rng = np.random.Generator(np.random.SFC64([SEED, n]))
    step = max(1, CHUNK // n)
    found = {name: np.empty(repeats) for name in names}
    for start in range(0, repeats, step):
        count = min(step, repeats - start)
        samples = np.sort(rng.standard_normal((count, n)), axis=-1)
        rows = normality.standardise(samples, np.full(count, n), None)
        for name in names:
            values = TESTS[name].statistic(rows)
            found[name][start : start + count] = TESTS[name].scaled(values, float(n))
    return found


def smooth(
    sizes: list[int], repeats: list[int], quantiles: np.ndarray, degree: int, *, least: float = 0
) -> np.ndarray:
    """Return the coefficients for quantiles of shape (size, level), shape (level, power).

    Quantiles with fewer than `least` samples beyond them count for nothing.
    """
    p = LEVELS
    # The error of a quantile is that of its level over the density.
    slope = np.abs(np.gradient(quantiles, special.logit(p), axis=-1))
    error = slope / np.sqrt(np.array(repeats)[:, np.newaxis] * p * (1 - p))
    known = np.array(repeats)[:, np.newaxis] * np.minimum(p, 1 - p) >= least
    weight = known / error
    x = np.array(sizes) ** -0.5
    polynomial = np.polynomial.polynomial
    fits = [polynomial.polyfit(x, quantiles[:, j], degree, w=weight[:, j]) for j in range(len(p))]
    residual = (polynomial.polyval(x, np.array(fits).T).T - quantiles) * weight
    free = known.mean() - (degree + 1) / len(sizes)
    sys.stderr.write(f"residuals over errors: {np.sqrt((residual**2).mean() / free):.2f}\n")
    return np.array(fits)


def limits(name: str) -> list[tuple[int, int, np.ndarray]]:
    """Return what is known of ever larger samples, as good as the best of the simulations."""
    if name != "dagostino":
        return []
    return [(LIMIT, CAP, TESTS[name].scaled(-2 * np.log(LEVELS), float(LIMIT)))]


def table(name: str, values: np.ndarray) -> str:
    """Return the rows of a statistic as JSON."""
    rows = (", ".join(f"{value:.6g}" for value in row) for row in values)
    return f' "{name}": [\n' + ",\n".join(f"  [{row}]" for row in rows) + "\n ],\n"


def main() -> None:
    """Simulate all, fit and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--work", type=float, default=5e8, help="samples for each size")
    arguments = parser.parse_args()
    kept: dict[str, list[tuple[int, int, np.ndarray]]] = {name: [] for name in PLAN}
    for n in sorted({*SIZES, *LARGE}):
        repeats = int(min(CAP, arguments.work / n))
        names = [name for name, (sizes, _) in PLAN.items() if n in sizes]
        for name, values in simulate(names, n, repeats).items():
            kept[name].append((n, repeats, np.quantile(values, 1 - LEVELS)))
        sys.stderr.write(f"{n} samples\n")
    for name, parts in kept.items():
        sizes, repeats_of, quantiles = zip(*parts, *limits(name), strict=True)
        sys.stderr.write(f"{name}: ")
        fits = smooth(list(sizes), list(repeats_of), np.array(quantiles), PLAN[name][1])
        sys.stdout.write(table(name, fits))


if __name__ == "__main__":
    main()
