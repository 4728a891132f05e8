"""Tests of the binned part: it says of a histogram what the positive part says of the samples."""

import numpy as np
import pytest

from chdstat import histogram
from chdstat.errors import Reason


def test_log_statistics_agree_with_those_of_the_samples():
    rng = np.random.default_rng(2)
    log = rng.normal(size=(6, 4096)) * np.linspace(0.25, 1.5, 6)[:, np.newaxis]
    x = np.exp(log)
    mean = x.mean(axis=-1)
    binned = histogram(x).positive.log_statistics
    # The centres themselves would be off by h^2 / 12 = 0.0044 in variance, 7 % of the first row's.
    np.testing.assert_allclose(binned.log_variance, log.var(axis=-1), rtol=0.02)
    np.testing.assert_allclose(binned.gap, np.log(mean) - log.mean(axis=-1), rtol=0.03)
    np.testing.assert_allclose(binned.mean, mean, rtol=5e-3)


@pytest.mark.filterwarnings("ignore::chdstat.errors.LeftOutWarning")
def test_the_counts_are_those_of_the_samples():
    x = np.array([0, 0, 1e-7, 0.5, 2, 3e6, np.nan, -1])
    part = histogram(x).positive
    assert (part.n, part.n_null, part.n_zero, part.n_negative, part.n_bad) == (3, 2, 1, 1, 1)
    assert part.n_good == 7
    assert part.counts[-1] == 1


@pytest.mark.filterwarnings("ignore::chdstat.errors.LeftOutWarning")
@pytest.mark.parametrize(
    ("x", "reason"),
    [
        ([0.0, 0.0, 0.0], Reason.ALL_NULL),
        ([np.nan, np.nan], Reason.ALL_BAD),
        ([-2.0, 0.0], Reason.NONE_POSITIVE),
        ([0.0, 2.0], Reason.TOO_FEW),
        ([2.0, 2.0, 2.01], Reason.CONSTANT),
        ([1.0, 2.0, 5.0], Reason.OK),
        ([1e-9, 2.0, 5.0], Reason.OK),
        ([1e-7, 2e-7, 0.0], Reason.OUTSIDE),
        ([1e-6, 2e-6, 1.02e-5, 1e-6], Reason.OUTSIDE),
        ([1.0, 2e5, 3e5], Reason.OUTSIDE),
    ],
)
def test_reasons(x, reason):
    assert histogram(x).positive.reason() == reason
