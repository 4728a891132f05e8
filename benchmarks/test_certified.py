"""How far certified numbers are from fresh samples of the same pixels, in standard errors.

Run with ``pytest benchmarks/test_certified.py --benchmark-only -s``. A failure would be more
than 1 % of the numbers beyond 3 standard errors, where chance makes 0.3 %.
"""

import numpy as np

from chdstat.certification import certified, draw

N = 8192


def _judged(name, difference, error):
    z = np.asarray(difference / error)
    z = z[np.isfinite(z)]
    beyond = (np.abs(z) > 3).mean()
    print(f"{name:22}{z.size:8}{z.std():10.2f}{100 * beyond:10.2f} %")
    return beyond


def test_certified_numbers_agree_with_another_seed(benchmark):
    truth = certified().sel(channel=["R", "G", "B"])
    x = benchmark.pedantic(
        lambda: draw(truth, N, seed=77, progress=False).astype(np.float64), rounds=1
    )
    print(f"\n{'':22}{'numbers':>8}{'z, s.d.':>10}{'beyond 3':>11}")
    mean, variance, null = truth["mean"], truth["variance"], truth["null_share"]
    beyond = [
        _judged("mean", x.mean(axis=-1) - mean, np.hypot(np.sqrt(variance / N), truth["mean_se"])),
        _judged(
            "variance",
            x.var(axis=-1) - variance,
            np.hypot(variance * np.sqrt((truth["kurtosis"] + 2) / N), truth["variance_se"]),
        ),
    ]
    error = np.hypot(np.sqrt(null * (1 - null) / N), truth["null_share_se"])
    beyond.append(_judged("share of nulls", (x == 0).mean(axis=-1) - null, error.where(error > 0)))
    for size in (32, 128):
        batches = x.reshape(*x.shape[:2], -1, size)
        half = 1.96 * batches.std(axis=-1, ddof=1) / np.sqrt(size)
        held = np.abs(batches.mean(axis=-1) - mean.to_numpy()[..., np.newaxis]) <= half
        known = truth.sel(size=size)
        share = known["coverage"]
        error = np.hypot(np.sqrt(share * (1 - share) * size / N), known["coverage_se"])
        beyond.append(_judged(f"coverage, n = {size}", held.mean(axis=-1) - share, error))
    assert max(beyond) <= 0.01
