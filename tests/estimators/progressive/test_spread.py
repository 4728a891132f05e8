"""Spread: how large errors are, and that quantiles are those of the radiance."""

import numpy as np
import pytest
from scipy import stats

from chdstat.estimators.progressive.errors import (
    BRIGHTNESS,
    ERROR_TERMS,
    LEVELS,
    ErrorModel,
    calibrate,
    error_terms,
    least_squares,
)


def known(estimate, truth, *, rows, mean, variance, certainty):
    """Return what is known of estimates of 16 samples, which are the same for both losses."""
    return {
        "size": np.full(len(rows), 16),
        "rows": rows,
        "estimate": np.stack([estimate, estimate]),
        "certainty": np.stack([certainty, certainty]),
        "mean": mean,
        "variance": variance,
        "target": truth,
        "noise": np.zeros_like(truth),
    }


def validation(rng, rows=4000, *, dark=0.0):
    """Return estimates whose errors have the terms 1, 3 and none else; gamma distributed truth."""
    estimate = rng.lognormal(-dark, 1 + dark, size=(rows, 1))
    variance = rng.gamma(1, 1, size=estimate.shape) * estimate**2
    expected = 0.02 * estimate**2 + 0.05 * variance
    truth = rng.gamma(estimate**2 / expected, expected / estimate)
    certainty, mean = rng.random(rows), estimate * rng.gamma(2, 0.5, size=estimate.shape)
    about = {"mean": mean, "variance": variance, "certainty": certainty}
    return known(estimate, truth, rows=np.arange(rows), **about)


def terms(found):
    """Return the error terms of estimates."""
    return error_terms(*(found[name] for name in ("estimate", "mean", "certainty", "variance")))


def test_error_terms_get_the_weights_that_they_have():
    """Least squares of 40,000 rows with a fixed seed; weights have standard errors below 0.004."""
    rng = np.random.default_rng(0)
    weights = least_squares(validation(rng, 40_000, dark=2.0), 0)
    expected = np.array([0, 0.02, 0, 0.05, 0, 0])
    assert weights == pytest.approx(expected, abs=0.012)
    assert (weights >= 0).all()


def test_levels_beyond_the_calibrated_ones_are_wider_still():
    rng = np.random.default_rng(0)
    weights = np.full((2, ERROR_TERMS), 0.05)
    one = validation(rng)
    normal = calibrate(weights, one, one)[np.newaxis]
    error_model = ErrorModel(weights, np.array([16.0]), normal)
    estimate, count = np.ones((1, 1)), np.array([16])
    high = [
        error_model.quantile(estimate, 0.1 * estimate, count, loss_weight=0.5, level=level).item()
        for level in (0.99, 0.995, 0.9995, 0.99995)
    ]
    assert (np.diff(high) > 0.01).all()


def test_calibrated_quantiles_hold_as_often_as_stated():
    """8000 trials calibrate and 8000 judge: a share strays by 0.03 once in a million seeds."""
    rng = np.random.default_rng(1)
    weights = np.tile([1e-4, 0.06, 0.0, 0.02, 0.0, 0.0], (2, 1))  # not the true ones
    own = validation(rng, 8000)
    normal = calibrate(weights, own, own)[np.newaxis]
    error_model = ErrorModel(weights, np.array([16.0]), normal)
    fresh = validation(rng, 8000)
    variance = error_model.variance(terms(fresh), 0.5)
    count = np.full(8000, 16)
    for level in (0.05, 0.25, 0.5, 0.95):
        end = error_model.quantile(
            fresh["estimate"][0], variance, count, loss_weight=0.5, level=level
        )
        assert (fresh["target"] <= end).mean() == pytest.approx(level, abs=0.03)


def normal_errors():
    """Return an error model whose errors are as normal as a cube root of gamma is."""
    normal = np.tile(stats.norm.ppf(LEVELS), (1, 3, len(BRIGHTNESS), 1))
    return ErrorModel(np.ones((2, ERROR_TERMS)), np.array([16.0]), normal)


def test_uncalibrated_quantiles_are_those_of_a_gamma_distribution():
    error_model = normal_errors()
    mean, variance, count = np.full((1, 1), 5.0), np.full((1, 1), 1.0), np.array([16])
    for level in (0.05, 0.5, 0.95):
        found = error_model.quantile(mean, variance, count, loss_weight=0.5, level=level)
        assert found.item() == pytest.approx(stats.gamma.ppf(level, 25, scale=1 / 5), rel=0.01)


def test_quantiles_between_sizes_and_beyond_them():
    levels = np.tile(stats.norm.ppf(LEVELS), (2, 3, len(BRIGHTNESS), 1))
    normal = levels * np.array([2, 1])[:, None, None, None]
    error_model = ErrorModel(np.ones((2, ERROR_TERMS)), np.array([4.0, 64.0]), normal)

    def high(count):
        ends = np.ones((1, 1)), np.full((1, 1), 0.01)
        return error_model.quantile(*ends, np.array([count]), loss_weight=0.75, level=0.9).item()

    assert high(4) > high(16) > high(64)
    assert high(0) == high(1) == high(4)
    assert high(64) == high(4096)


def test_quantiles_are_radiance_whatever_the_variance():
    error_model = normal_errors()
    estimate = np.array([[0.0, 1e-9, 1.0, 1e20]])
    for variance in (0.0, 1.0, 1e30):
        found = error_model.quantile(
            estimate, np.full((1, 4), variance), np.array([8]), loss_weight=0.5, level=0.05
        )
        assert (found >= 0).all()
        assert np.isfinite(found).all()


def test_few_bright_pixels_with_other_errors_have_quantiles_of_their_own():
    """Of 2000 pixels 20 are lamps, whose errors have four times the standard deviation."""
    rng = np.random.default_rng(2)
    weights = np.zeros((2, ERROR_TERMS))
    weights[:, 1] = 0.01

    def lit(lamps, times):
        rows = np.repeat(np.arange(lamps + 1980), times)
        estimate = np.where(rows < lamps, 16.0, 0.25)[:, np.newaxis]
        wide = np.where(rows < lamps, 0.4, 0.1)[:, np.newaxis] * estimate
        truth = rng.gamma(estimate**2 / wide**2, wide**2 / estimate)
        about = {"mean": estimate, "variance": 0 * truth, "certainty": np.zeros(len(rows))}
        return known(estimate, truth, rows=rows, **about)

    error_model = ErrorModel(
        weights, np.array([16.0]), calibrate(weights, lit(0, 1), lit(20, 4))[None]
    )
    fresh = lit(1980, 1)
    count = np.full(len(fresh["rows"]), 16)
    variance = error_model.variance(terms(fresh), 0.5)
    low, high = (
        error_model.quantile(fresh["estimate"][0], variance, count, loss_weight=0.5, level=level)
        for level in (0.05, 0.95)
    )
    holds = (low <= fresh["target"]) & (fresh["target"] <= high)
    assert holds[fresh["rows"] < 1980].mean() > 0.8
    assert 0.87 < holds[fresh["rows"] >= 1980].mean() < 0.95
