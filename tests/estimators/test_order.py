"""Order statistics against NumPy and SciPy, and where they are black."""

import numpy as np
import pytest
from scipy import stats

from chdstat import estimators
from chdstat.errors import InputError

SHARES = [0.0, 0.05, 0.1, 0.25, 0.49]


@pytest.mark.parametrize("n", [1, 2, 31, 32])
def test_median_is_that_of_numpy(n):
    x = np.random.default_rng(n).gamma(0.5, size=(40, 3, n))
    assert estimators.median(x) == pytest.approx(np.median(x, axis=-1), rel=1e-15)


@pytest.mark.parametrize("share", SHARES)
@pytest.mark.parametrize("n", [7, 32])
def test_trimmed_mean_is_that_of_scipy(n, share):
    x = np.random.default_rng(n).gamma(0.5, size=(40, n))
    expected = stats.trim_mean(x, share, axis=-1)
    assert estimators.trimmed_mean(x, share=share) == pytest.approx(expected, rel=1e-13)


@pytest.mark.parametrize("share", SHARES)
@pytest.mark.parametrize("n", [7, 32])
def test_winsorized_mean_is_that_of_scipy(n, share):
    x = np.random.default_rng(n).gamma(0.5, size=(40, n))
    expected = np.asarray(stats.mstats.winsorize(x, (share, share), axis=-1)).mean(axis=-1)
    assert estimators.winsorized_mean(x, share=share) == pytest.approx(expected, rel=1e-13)


@pytest.mark.filterwarnings("ignore::chdstat.errors.LeftOutWarning")
def test_a_share_counts_the_good_samples_only():
    x = np.array([np.nan, 0.0, 1.0, 2.0, 30.0, np.inf])
    assert estimators.trimmed_mean(x, share=0.25) == 1.5
    assert estimators.winsorized_mean(x, share=0.25) == 1.5


def test_half_the_samples_null_leave_the_median_black_and_the_mean_not():
    x = np.r_[np.zeros(17), np.ones(15)]
    assert estimators.median(x) == 0
    assert estimators.mean(x) == 15 / 32


@pytest.mark.parametrize("share", [-0.1, 0.5, np.nan])
@pytest.mark.parametrize("name", ["trimmed_mean", "winsorized_mean"])
def test_a_share_must_leave_something(name, share):
    with pytest.raises(InputError, match=rf"at least 0 and less than 0.5, got {share}"):
        estimators.lookup(name)(np.ones(8), share=share)
