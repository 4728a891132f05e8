"""Simulate the null distribution of the dip; print it for inference/null_quantiles.json.

    python tools/make_dip_table.py > table.txt

The null distribution of the dip test is that of uniform samples (Hartigan and Hartigan, "The dip
test of unimodality", 1985, doi:10.1214/aos/1176346577). Quantiles of sqrt(n) times the dip are kept
as polynomials in 1/sqrt(n), as those of the statistics of normality are: see
make_normality_tables.py, whose fits these are. About ten minutes on one core.
"""

from __future__ import annotations

import argparse
import sys

import numpy as np
from make_normality_tables import smooth, table

from chdstat.inference.modes import dips
from chdstat.inference.normality import LEVELS

SEED = 20240611
SIZES = (
    *(20, 23, 27, 32, 40, 50, 65, 85, 110, 150, 200, 280, 400, 550, 800, 1200, 2000, 3500),
    *(7000, 15000, 40000),
)
DEGREE = 7
CAP = 1_000_000
"""Samples drawn of the smaller sizes."""
LEAST = 20
"""Dips beyond a quantile, without which it is not used."""
CHUNK = 2**15


def simulate(n: int, repeats: int) -> np.ndarray:
    """Return sqrt(n) times the dips of uniform samples of size `n`."""
    rng = np.random.Generator(np.random.SFC64([SEED, n]))
    step = max(1, CHUNK // n)
    found = np.empty(repeats)
    for start in range(0, repeats, step):
        count = min(step, repeats - start)
        # Partial sums of exponential numbers are, relative to the last, uniform ones in order.
        ascending = np.cumsum(rng.standard_exponential((count, n + 1)), axis=-1)[:, :-1]
        found[start : start + count] = dips(ascending, np.full(count, n))
    return np.sqrt(n) * found


def main() -> None:
    """Simulate all, fit and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--work", type=float, default=5e8, help="samples for each size")
    arguments = parser.parse_args()
    repeats = [int(min(CAP, arguments.work / n)) for n in SIZES]
    quantiles = []
    for n, count in zip(SIZES, repeats, strict=True):
        quantiles.append(np.quantile(simulate(n, count), 1 - LEVELS))
        sys.stderr.write(f"{n} samples\n")
    fits = smooth(list(SIZES), repeats, np.array(quantiles), DEGREE, least=LEAST)
    sys.stdout.write(table("dip", fits))


if __name__ == "__main__":
    main()
