"""Selection: it finds the family that the samples came from, and says nothing where nothing is."""

import numpy as np
import pytest
from scipy import stats
from statsmodels.stats.proportion import proportion_confint

import chdstat as chd
from chdstat.analysis import pooled_shares

ROWS = 400


def draws(family):
    rng = np.random.default_rng(21)
    return {
        "exponential": lambda: rng.exponential(size=(ROWS, 512)),
        "gamma": lambda: rng.gamma(4.0, size=(ROWS, 512)),
        "lognormal": lambda: rng.lognormal(0, 1.0, size=(ROWS, 512)),
        "weibull": lambda: rng.weibull(0.5, size=(ROWS, 512)),
        "burr": lambda: rng.weibull(1.5, size=(ROWS, 512)) / rng.gamma(0.5, size=(ROWS, 512)),
    }[family]()


@pytest.mark.parametrize("family", ["gamma", "lognormal"])
@pytest.mark.parametrize("criterion", ["aic", "bic", "held_out"])
def test_the_true_one_of_two_families_wins(family, criterion):
    # It wins in more than 99.9 % of the rows; fewer than 99 % of 400 has a chance below 1e-3.
    x = draws("exponential" if family == "gamma" else family)
    selection = chd.fit.select(x, ("gamma", "lognormal"), criterion)
    assert (selection.names == family).mean() > 0.99


@pytest.mark.parametrize("family", ["gamma", "lognormal", "weibull", "burr"])
def test_the_true_one_of_four_families_wins(family):
    """False failure: below 1e-4, where the true family wins in 95 % of the rows or more."""
    selection = chd.fit.select(draws(family), held_out=True)
    assert (selection.names == family).mean() > 0.9
    wrong = (selection.held_out.best != selection.families.index(family)) & (
        selection.held_out.margin > 3 * selection.held_out.margin_se
    )
    assert wrong.mean() < 0.02


def test_margin_is_the_difference_of_the_criteria():
    x = draws("gamma")[:5]
    selection = chd.fit.select(x, ("lognormal", "gamma"))
    bic = np.stack([chd.fit.lognormal(x).bic, chd.fit.gamma(x).bic], axis=-1)
    np.testing.assert_allclose(selection.values, bic)
    np.testing.assert_allclose(selection.margin, np.abs(bic[:, 0] - bic[:, 1]))
    np.testing.assert_array_equal(selection.best, bic.argmin(axis=-1))


def held_out_by_hand(row, family):
    """Return log densities of positive samples at even and odd places, each by the other's fit."""
    halves = row[::2], row[1::2]
    fits = [chd.fit.fit(half, family) for half in halves]
    scored = zip(halves, reversed(fits), strict=True)
    return np.concatenate([np.log(fit.pdf(half[half > 0])) for half, fit in scored])


def test_held_out_loss_is_that_of_the_other_half():
    x = draws("burr")[0]
    families = ("gamma", "lognormal", "weibull", "burr")
    result = chd.fit.select(np.r_[x, np.zeros(20)], families, "held_out")
    densities = np.stack([held_out_by_hand(x, family) for family in families])
    # Searches in the halves end when the last step moves the margin by less than 1 % of its error.
    error = 0.01 * result.held_out.margin_se
    np.testing.assert_allclose(result.values, -densities.mean(axis=-1), rtol=0, atol=error)
    np.testing.assert_allclose(result.values[:2], -densities[:2].mean(axis=-1), rtol=1e-9)
    first, second = np.argsort(result.values)[:2]
    difference = densities[first] - densities[second]
    held_out = result.held_out
    assert held_out.margin == pytest.approx(difference.mean(), abs=error)
    assert held_out.margin_se == pytest.approx(difference.std(ddof=1) / np.sqrt(512), rel=0.01)
    assert result.best == held_out.best == first


def test_halves_differ_from_tight_fits_by_little():
    """Over rows with nulls, the losses are those of tight fits, to a fiftieth of an error."""
    rng = np.random.default_rng(23)
    x = np.where(rng.random((60, 512)) < 0.5, 0, draws("weibull")[:60])
    selection = chd.fit.select(x, held_out=True)
    for row, loss, error in zip(
        x, selection.held_out.loss, selection.held_out.margin_se, strict=True
    ):
        for family, value in zip(selection.families, loss, strict=True):
            if np.isfinite(value):
                other = np.nansum(held_out_by_hand(row, family)) / -(row > 0).sum()
                assert value == pytest.approx(other, abs=0.02 * error)


def test_no_loss_without_a_fit_to_all_samples():
    # Burr has no maximum for half of the Weibull samples: there it is no candidate.
    selection = chd.fit.select(draws("weibull")[:100], held_out=True)
    unfit = np.isnan(selection.fits["burr"].parameters["d"])
    assert 20 < unfit.sum() < 80
    assert np.isnan(selection.held_out.loss[unfit, 3]).all()


def test_two_standard_errors_decide():
    held_out = chd.fit.select(draws("lognormal"), held_out=True).held_out
    np.testing.assert_array_equal(held_out.decided, held_out.margin > 2 * held_out.margin_se)
    assert 0 < held_out.decided.mean() < 1
    assert not chd.fit.select(np.zeros(8), held_out=True).held_out.decided


def test_a_pixel_gives_arrays_without_axes():
    selection = chd.fit.select(draws("gamma")[0], held_out=True)
    for result in (selection, selection.held_out, *selection.fits.values()):
        for name in dir(result):
            value = getattr(result, name)
            assert not isinstance(value, (float, np.generic)), name
    assert selection.names.shape == selection.best.shape == selection.reason.shape == ()


def test_vuong_is_the_paired_z_of_two_fits():
    x = draws("gamma")[0]
    result = chd.fit.select(x)
    pdfs = [chd.fit.fit(x, family).pdf(x) for family in ("gamma", "lognormal")]
    difference = np.log(pdfs[0]) - np.log(pdfs[1])
    z = difference.sum() / (difference.std() * np.sqrt(len(x)))
    assert result.vuong_z == pytest.approx(z)
    assert result.vuong_p_value == pytest.approx(2 * stats.norm.sf(abs(z)))
    assert np.isnan(chd.fit.select(x, ("gamma", "weibull")).vuong_z)


def test_one_family_has_no_margin():
    selection = chd.fit.select(draws("gamma")[0], ("gamma",))
    assert str(selection.names) == "gamma"
    assert np.isnan(selection.margin)


def test_shares_of_an_image():
    radiance = np.stack([draws("lognormal")[:12], draws("gamma")[:12]]).reshape(2, 4, 3, 512)
    radiance[0, 0] = 0
    dataset = chd.fit.select(chd.Samples.from_array(radiance), ("gamma", "lognormal"))
    shares = pooled_shares(dataset)
    assert shares["gamma"].value == pytest.approx(12 / 21)
    expected = proportion_confint(12, 21, method="wilson")
    np.testing.assert_allclose((shares["gamma"].low, shares["gamma"].high), expected)


def test_a_histogram_selects_what_the_samples_select():
    x = np.concatenate([draws(family)[:50] for family in ("gamma", "lognormal", "burr")])
    of_samples, of_bins = chd.fit.select(x), chd.fit.select(chd.histogram(x))
    sure = of_samples.margin > 10
    assert sure.mean() > 0.5
    assert (of_samples.names == of_bins.names)[sure].mean() > 0.95
