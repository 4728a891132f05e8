"""The sample mean, also among bad samples."""

import numpy as np
import pytest

from chdstat import estimators


def test_mean_is_that_of_numpy_over_the_last_axis():
    x = np.random.default_rng(0).gamma(1, size=(4, 3, 32))
    assert estimators.mean(x) == pytest.approx(x.mean(axis=-1))


def test_dtype_of_the_samples_is_kept_and_its_rounding_is_not_added_up():
    x = np.full(2**22, 0.1, np.float32)
    x[0] = 1e6
    assert estimators.mean(x).dtype == np.float32
    assert estimators.mean(x) == pytest.approx(x.astype(np.float64).mean(), rel=1e-7)


@pytest.mark.filterwarnings("ignore::chdstat.errors.LeftOutWarning")
def test_no_good_sample_gives_nan_without_a_warning():
    assert np.isnan(estimators.mean([np.nan, -np.inf]))
