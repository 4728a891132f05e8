"""Bounds: without a reference, squared errors are hardly larger than what is expected of them."""

import numpy as np
import pytest

from chdstat.estimators.progressive.error_model import (
    BRIGHTNESS,
    LEVELS,
    LOSS_WEIGHTS,
    LOSSES,
    USUAL,
    ErrorModel,
    error_terms,
    ratio,
    upper_bound,
)


def validation(rng, scale, *, pixels=300, noise=2.0, tail=1.0, draws=4):
    """Return estimates whose squared errors are `scale` times the usual, and the truths of pixels.

    The noise of the targets has `noise` times the variance of a usual error, and a gamma tail.
    """
    estimate = rng.lognormal(size=(pixels, 1))
    mean = estimate * rng.gamma(4, 0.25, size=estimate.shape)
    variance = rng.gamma(2, 0.5, size=estimate.shape) * estimate**2
    certainty = rng.random(pixels)
    usual = error_terms(estimate, mean, certainty, variance) @ USUAL
    truth = estimate + np.sqrt(scale * usual) * rng.normal(size=usual.shape)
    width = np.sqrt(2 * noise * usual * tail)
    halves = np.array(
        [
            [truth + width * (rng.gamma(1 / tail, size=usual.shape) - 1 / tail) for _ in range(2)]
            for _ in range(draws)
        ]
    )
    found = {
        "size": np.full(draws * pixels, 8),
        "rows": np.tile(np.arange(pixels), draws),
        "estimate": np.tile(estimate, (len(LOSSES), draws, 1)),
        "certainty": np.tile(certainty, (len(LOSSES), draws)),
        "mean": np.tile(mean, (draws, 1)),
        "variance": np.tile(variance, (draws, 1)),
        "target": np.concatenate(halves.mean(axis=1)),
        "noise": np.concatenate((halves[:, 0] - halves[:, 1]) ** 2 / 4),
    }
    return found, truth


@pytest.mark.parametrize("scale", [0.3, 1.0, 4.0])
@pytest.mark.parametrize("pixels", [60, 1000])
def test_the_bound_is_seldom_too_small_and_not_much_too_large(scale, pixels):
    """Of 40 images, 5 % or a few more may have a bound below the scale of their own errors.

    With a chance of 0.1 each, more than 12 of 40 are below once in 4000 seeds.
    """
    rng = np.random.default_rng(0)
    found = np.array(
        [upper_bound(validation(rng, scale, pixels=pixels)[0], 0)[1] / USUAL[1] for _ in range(40)]
    )
    assert (found < 0.85 * scale).sum() <= 12
    assert np.median(found) < (2.5 if pixels == 1000 else 6) * max(scale, 1)


def test_intervals_of_bounded_weights_hold_the_truth():
    """Intervals of 90 %, 300 pixels with noisy targets, 20 images.

    Those of the weights themselves are the negative control: divided by 4, they hold far fewer.
    """
    rng = np.random.default_rng(1)
    shares, narrow = [], []
    for _ in range(20):
        found, truth = validation(rng, 0.2, noise=0.1)
        for factor, kept in ((1, shares), (0.25, narrow)):
            weights = np.tile(upper_bound(found, 0), (2, 1)) * factor
            error_model = ErrorModel(
                weights, np.empty(0), np.empty((0, len(LOSS_WEIGHTS), len(BRIGHTNESS), len(LEVELS)))
            )
            own = (found[name] for name in ("estimate", "mean", "certainty", "variance"))
            variance = error_model.variance(error_terms(*own), 0.5)[: len(truth)]
            count = np.full(len(truth), 8)
            low, high = (
                error_model.quantile(
                    found["estimate"][0, : len(truth)],
                    variance,
                    count,
                    loss_weight=0.5,
                    level=level,
                )
                for level in (0.05, 0.95)
            )
            kept.append(((low <= truth) & (truth <= high)).mean())
    assert min(shares) > 0.88
    assert np.mean(narrow) < 0.86


def test_a_ratio_has_the_standard_error_of_its_pixels():
    """Against the standard deviation over 2000 repeats, which is known within 5 %."""
    rng = np.random.default_rng(2)
    below = rng.gamma(2, size=(2000, 100))
    above = 3 * below + rng.normal(size=below.shape)
    found = np.array([ratio(a, b) for a, b in zip(above, below, strict=True)])
    assert found[:, 0].mean() == pytest.approx(3, abs=0.01)
    assert found[:, 1].mean() == pytest.approx(found[:, 0].std(), rel=0.08)


def test_pixels_that_count_for_nothing_change_nothing():
    above, below = np.array([1.0, 2.0, 4.0]), np.array([1.0, 1.0, 2.0])
    more = ratio(np.append(above, 0.0), np.append(below, 0.0))
    assert more == pytest.approx(ratio(above, below))


def test_one_pixel_alone_has_usual_errors():
    assert ratio(np.array([1.0]), np.array([2.0])) == (0.0, np.inf)
    assert ratio(np.zeros(3), np.zeros(3)) == (0.0, np.inf)
    found, _ = validation(np.random.default_rng(3), 1.0, pixels=1)
    assert (upper_bound(found, 1) == USUAL).all()


def test_no_error_at_all_still_leaves_an_interval():
    found, _ = validation(np.random.default_rng(4), 0.0, noise=0.0)
    assert (upper_bound(found, 0)[:5] > 0).all()
