"""How often the predicted N is identified, and how often its interval then holds the truth.

Run with ``pytest tests/benchmarks/test_averages.py --benchmark-only -s``.
"""

import numpy as np
import pytest
from scipy import stats

from chdstat.errors import Reason
from chdstat.inference import N_MEANS, gaussianity_of_means

ROWS = 400
LAWS = {
    "exponential": stats.expon(),
    "gamma 0.3": stats.gamma(0.3),
    "gamma 2": stats.gamma(2),
    "uniform": stats.uniform(),
    "Weibull 0.7": stats.weibull_min(0.7),
    "log-normal 0.5": stats.lognorm(0.5),
    "log-normal 1": stats.lognorm(1),
    "log-normal 1.5": stats.lognorm(1.5),
    "GPD 0.1": stats.genpareto(0.1),
    "GPD 0.2": stats.genpareto(0.2),
    "GPD 0.6": stats.genpareto(0.6),
}


@pytest.mark.slow
@pytest.mark.parametrize("spp", [512, 2048, 8192])
def test_predicted_n(as_benchmark, spp):
    print(
        f"\n{'':16}{'spp':>6}{'truth':>7}{'median':>8}{'interval':>12}{'answered':>10}{'wrong':>7}"
    )
    rng = np.random.default_rng(spp)
    for name, law in LAWS.items():
        skewness, kurtosis = (float(v) for v in law.stats("sk"))
        by_skewness = skewness**2 / (4 * 6 / N_MEANS)
        by_kurtosis = abs(kurtosis) / (2 * np.sqrt(24 / N_MEANS))
        # SciPy's kurtosis of infinite moments is infinite or not a number.
        truth = np.ceil(max(1.0, by_skewness, by_kurtosis)) if kurtosis < np.inf else np.inf
        means = gaussianity_of_means(law.rvs((ROWS, spp), random_state=rng), sizes=[1])
        known = means.n_predicted_reason == Reason.OK
        low, high = means.n_predicted_interval.T
        wrong = np.mean(known & ~((low <= truth) & (truth <= high)))
        middle = [
            np.nanmedian(v) if known.any() else np.nan for v in (means.n_predicted, low, high)
        ]
        print(
            f"{name:16}{spp:6}{truth:7.0f}{middle[0]:8.0f}{middle[1]:6.0f}{middle[2]:6.0f}"
            f"{100 * known.mean():9.0f}%{100 * wrong:6.1f}%"
        )
        assert wrong <= 0.1
