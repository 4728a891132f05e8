"""The sample mean, also among bad samples."""

import numpy as np
import pytest

from chdstat import estimators
from chdstat.errors import InputError


def test_mean_is_that_of_numpy_over_the_last_axis():
    x = np.random.default_rng(0).gamma(1, size=(4, 3, 32))
    assert estimators.mean(x) == pytest.approx(x.mean(axis=-1))


def test_dtype_of_the_samples_is_kept_and_its_rounding_is_not_added_up():
    x = np.full(2**22, 0.1, np.float32)
    x[0] = 1e6
    assert estimators.mean(x).dtype == np.float32
    assert estimators.mean(x) == pytest.approx(x.astype(np.float64).mean(), rel=1e-7)


@pytest.mark.filterwarnings("ignore::chdstat.errors.LeftOutWarning")
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_bad_sample_leaves_the_mean_of_the_others(bad):
    assert estimators.mean([[1.0, bad, 3.0], [4.0, 4.0, 1.0]]).tolist() == [2.0, 3.0]


@pytest.mark.filterwarnings("ignore::chdstat.errors.LeftOutWarning")
def test_no_good_sample_gives_nan_without_a_warning():
    assert np.isnan(estimators.mean([np.nan, -np.inf]))


def test_no_samples_are_refused():
    with pytest.raises(InputError, match="at least 1 sample"):
        estimators.mean(np.empty((3, 0)))
