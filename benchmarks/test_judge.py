"""The judge on images whose errors are known: do its intervals hold the true ratios?

``pytest -n0 -s --benchmark-only benchmarks/test_judge.py`` prints the shares of tables whose
95 % intervals hold the true ratio of errors, and of those that cannot tell. ``CHDSTAT_TABLES`` is
the number of tables of each case, 200 by default. It fails if intervals hold the truth in a share
that is more than 3 standard errors below 90 %, or if a verdict is reversed in more tables than
2.5 % of them and 3 standard errors are. What is told in less than a fifth of them is not judged.
"""

import os

import numpy as np
import pytest
from scipy import ndimage

import chdstat as chd
from chdstat.estimators import Estimator, lookup

TABLES = int(os.environ.get("CHDSTAT_TABLES", "200"))
EDGE = 48
ROWS, COLUMNS = np.mgrid[:EDGE, :EDGE] / EDGE
IMAGES = {
    "constant": np.ones((EDGE, EDGE)),
    "gradient": 10 ** (2 * COLUMNS - 1),
    "texture": np.where(np.sin(40 * ROWS) * np.sin(28 * COLUMNS) > 0, 2.0, 0.2),
}
CASES = [
    ("constant", 0.6, 64, 16),
    ("constant", 0.9, 128, 32),
    ("constant", 0.99, 48, 16),
    ("constant", 0.99, 512, 32),
    ("gradient", 0.3, 48, 16),
    ("gradient", 0.9, 128, 32),
    ("gradient", 0.9, 1024, 64),
    ("gradient", 0.99, 256, 32),
    ("texture", 0.3, 1024, 512),
    ("texture", 0.6, 64, 32),
    ("texture", 0.9, 128, 32),
    ("texture", 0.99, 1024, 32),
]


def blurred(x):
    return ndimage.gaussian_filter(np.asarray(x).mean(axis=-1), (1, 1, 0))


OWN = {
    "black": lambda x: np.zeros(np.shape(x)[:-1]),
    "half": lambda x: 0.5 * np.asarray(x).mean(axis=-1),
    "blurred": blurred,
}
ENTRIES = [
    *(Estimator(name, function, "this benchmark") for name, function in OWN.items()),
    *map(lookup, ("median_of_means", "trimmed_mean")),
]


def draw(rng, image, nulls, n):
    """Draw exponential samples with the mean of the image and a share of nulls, float32."""
    x = rng.exponential(size=(EDGE, EDGE, 1, n)) * (rng.random((EDGE, EDGE, 1, n)) >= nulls)
    return (x * (image[..., np.newaxis, np.newaxis] / (1 - nulls))).astype(np.float32)


def true_ratios(rng, image, nulls, n, times=200):
    """Measure both errors against the truth itself; shape (entry, measure).

    Those of a scaled mean are known: a sample has the variance v, in squared means.
    """
    truth = image[..., np.newaxis]
    weight = 1 / (truth**2 + 0.01 * image.mean() ** 2)
    sums = np.zeros((1 + len(ENTRIES), 2))
    for _ in range(times):
        x = draw(rng, image, nulls, n)
        for k, estimate in enumerate((x.mean(axis=-1), *(entry(x) for entry in ENTRIES))):
            error = np.square(estimate - truth)
            sums[k] += error.mean(), (weight * error).mean()
    ratios, v = sums[1:] / sums[0], 2 / (1 - nulls) - 1
    for k, c in enumerate((0.0, 0.5)):
        ratios[k] = c**2 + (1 - c) ** 2 * n / v
    return ratios


@pytest.mark.parametrize("case", CASES, ids=lambda case: "-".join(map(str, case)))
def test_intervals_hold_the_true_ratios(benchmark, case):
    name, nulls, spp, n = case
    rng = np.random.default_rng(CASES.index(case))
    image = IMAGES[name]
    truth = true_ratios(rng, image, nulls, n)
    held, told, wrong = np.zeros((3, *truth.shape))
    said = []

    def tables():
        for seed in range(TABLES):
            samples = chd.Samples.from_array(draw(rng, image, nulls, spp))
            rows = chd.compare(samples, ENTRIES, n=n, seed=seed, progress=False).table()
            columns = [
                f"{m}_ratio{end}" for m in ("mse", "relmse") for end in ("", "_low", "_high")
            ]
            value, low, high = np.moveaxis(
                np.array([[row[c] for c in columns] for row in rows]).reshape(-1, 2, 3), -1, 0
            )
            held[:] += (low <= truth) & (truth <= high)
            told[:] += np.isfinite(value)
            wrong[:] += ((high < 1) & (truth > 1)) | ((low > 1) & (truth < 1))
            said.append(value)

    benchmark.pedantic(tables, rounds=1)
    share = held / np.maximum(told, 1)
    print(f"\n{name}, {nulls:.0%} nulls, {spp} spp, n = {n}: true, said, told, held, reversed")
    middle = np.nansum(said, axis=0) / np.maximum(told, 1)
    for k, entry in enumerate(ENTRIES):
        for m, measure in enumerate(("MSE", "relMSE")):
            print(
                f"  {entry.name:16} {measure:7} {truth[k, m]:8.3f} {middle[k, m]:8.3f} "
                f"{told[k, m] / TABLES:5.0%} {share[k, m]:6.1%} {wrong[k, m]:3.0f}"
            )
    enough = told >= 0.2 * TABLES
    least = 0.9 - 3 * np.sqrt(0.9 * 0.1 / np.maximum(told, 1))
    assert (share >= least)[enough].all()
    assert (wrong <= 0.025 * TABLES + 3 * np.sqrt(0.025 * TABLES)).all()
