"""Selection: it finds the family that the samples came from, and says nothing where nothing is."""

import numpy as np
import pytest

import chdstat as chd
from chdstat.errors import InputError

ROWS = 400


def draws(family):
    rng = np.random.default_rng(21)
    if family == "gamma":
        return rng.gamma(1.0, size=(ROWS, 512))
    return rng.lognormal(0, 1.0, size=(ROWS, 512))


@pytest.mark.parametrize("family", ["gamma", "lognormal"])
@pytest.mark.parametrize("criterion", ["aic", "bic"])
def test_the_true_family_wins(family, criterion):
    # It wins in more than 99.9 % of the rows; fewer than 99 % of 400 has a chance below 1e-3.
    selection = chd.fit.select(draws(family), criterion=criterion)
    assert (selection.names == family).mean() > 0.99


def test_margin_is_the_difference_of_the_criteria():
    x = draws("gamma")[:5]
    selection = chd.fit.select(x, ("lognormal", "gamma"))
    bic = np.stack([chd.fit.lognormal(x).bic, chd.fit.gamma(x).bic], axis=-1)
    np.testing.assert_allclose(selection.values, bic)
    np.testing.assert_allclose(selection.margin, np.abs(bic[:, 0] - bic[:, 1]))
    np.testing.assert_array_equal(selection.best, bic.argmin(axis=-1))


def test_a_black_pixel_has_no_family():
    selection = chd.fit.select(np.zeros((2, 64)))
    np.testing.assert_array_equal(selection.best, -1)
    np.testing.assert_array_equal(selection.names, "")
    assert np.isnan(selection.margin).all()


def test_one_family_has_no_margin():
    selection = chd.fit.select(draws("gamma")[0], ("gamma",))
    assert str(selection.names) == "gamma"
    assert np.isnan(selection.margin)


def test_image():
    radiance = draws("lognormal")[:12].reshape(2, 2, 3, 512)
    radiance[0, 0] = 0
    dataset = chd.fit.select(chd.Samples.from_array(radiance), progress=False)
    assert dataset["best_family"].attrs["flag_meanings"] == "none gamma lognormal"
    np.testing.assert_array_equal(dataset["best_family"][0, 0], -1)
    np.testing.assert_array_equal(dataset["best_family"][1, 1], 1)
    difference = np.abs(dataset["gamma_bic"] - dataset["lognormal_bic"])
    np.testing.assert_allclose(dataset["margin"], difference)


def test_wrong_options_are_refused():
    with pytest.raises(InputError, match="criterion"):
        chd.fit.select([1.0, 2.0], criterion="r2")
    with pytest.raises(InputError, match="sequence of one or more families"):
        chd.fit.select([1.0, 2.0], families="gamma")
