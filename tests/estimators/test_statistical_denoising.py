"""Statistical denoising: who shares with whom, by hand; what is kept apart; what places explain."""

from functools import partial

import numpy as np
import pytest
from scipy import stats

from chdstat import estimators
from chdstat.estimators import sakai2024, sakai2025
from chdstat.estimators.similarity import ScaledSamples, root
from chdstat.estimators.statistical_denoising import _moments, _of_variances

BOTH = [sakai2024, sakai2025]


def image(seed=0, shape=(9, 11, 3, 16), sigma=0.5):
    return np.random.default_rng(seed).lognormal(0, sigma, size=shape)


def some_features(shape=(9, 11)):
    rng = np.random.default_rng(1)
    return {name: rng.normal(0, 0.02, (*shape, 3)) for name in ("albedo", "normal", "position")}


def places(shape, seed=2):
    return np.random.default_rng(seed).random((*shape[:2], 2, shape[-1]))


def members_by_hand(shape, radius, alike):
    """Return for each pixel the pixels around it that are alike."""
    height, width = shape[:2]
    found = {}
    for i, j in np.ndindex(height, width):
        rows = range(max(i - radius, 0), min(i + radius + 1, height))
        columns = range(max(j - radius, 0), min(j + radius + 1, width))
        found[i, j] = [
            (k, m)
            for k in rows
            for m in columns
            if (i - k) ** 2 + (j - m) ** 2 <= radius**2
            and ((i, j) == (k, m) or alike((i, j), (k, m)))
        ]
    return found


def average_by_hand(values, members, spread, features):
    """Average over the members of each pixel, weighted by place, albedo and normal."""
    result = np.empty_like(values)
    for (i, j), found in members.items():
        weights = [
            np.exp(-((i - k) ** 2 + (j - m) ** 2) / (2 * spread**2))
            * np.exp(-((features["albedo"][i, j] - features["albedo"][k, m]) ** 2).sum() / 2 / 4e-4)
            * np.exp(-((features["normal"][i, j] - features["normal"][k, m]) ** 2).sum() / 2 / 1e-2)
            for k, m in found
        ]
        result[i, j] = np.average([values[p] for p in found], axis=0, weights=weights)
    return result


@pytest.mark.parametrize("radius", [0, 1, 3])
def test_sakai2024_shares_what_the_formula_says(radius):
    """Welch's test on 2 (sqrt(x) - 1) in every channel, and the weights, literally."""
    x = image()
    x[:, 5:] *= 1.3
    options = {"alpha": 0.05, "radius": radius, "spread": 2.5, "features": some_features()}
    y, n = 2 * (np.sqrt(x) - 1), x.shape[-1]
    s2 = y.var(axis=-1, ddof=1)
    third = ((y - y.mean(axis=-1, keepdims=True)) ** 3).mean(axis=-1)
    mean = y.mean(axis=-1) + third / (6 * s2 * n)
    t = stats.t.ppf(1 - 0.05 / 2, 2 * n - 2)

    def alike(p, q):
        return ((mean[p] - mean[q]) ** 2 <= t**2 * (s2[p] + s2[q]) / n).all()

    members = members_by_hand(x.shape, radius, alike)
    expected = average_by_hand(x.mean(axis=-1), members, 2.5, options["features"])
    assert sakai2024(x, **options) == pytest.approx(expected, rel=1e-12)
    sizes = {len(found) for found in members.values()}
    assert (len(sizes) > 3) == (radius > 0)
    assert all(p in members[q] for p, found in members.items() for q in found)


@pytest.mark.parametrize("with_film", [False, True])
@pytest.mark.parametrize("variances", ["averaged", "own"])
def test_sakai2025_shares_what_the_formula_says(variances, with_film):
    """Bonett's test of variances, then Welch's test of both transforms, literally."""
    x = image(3)
    x[:, 5:] *= 1.3
    n, z, features = x.shape[-1], 2.80703, some_features()
    film = places(x.shape)
    x *= 1 + 0.8 * film[:, :, :1]
    t = stats.t.ppf(1 - 0.05 / 2, 2 * n - 2)
    tests, sizes = [], []
    for y in (x, 4 * (x**0.25 - 1)):
        variance = y.var(axis=-1, ddof=1)
        log = np.log(n / (n - z) * variance)
        error = (n / (n - z)) ** 2 * (stats.kurtosis(y, axis=-1) + 3 - (n - 3) / n) / (n - 1)

        def same_spread(p, q, log=log, error=error):
            return ((log[p] - log[q]) ** 2 <= z**2 * (error[p] + error[q])).all()

        if with_film:
            for axis in (0, 1):
                off = film[:, :, [axis]] - film[:, :, [axis]].mean(axis=-1, keepdims=True)
                of_place = ((y - y.mean(axis=-1, keepdims=True)) * off).sum(axis=-1) / (n - 1)
                variance = variance - 12 * of_place**2
            variance = np.maximum(variance, 0)
        if variances == "averaged":
            members = members_by_hand(x.shape, 3, same_spread)
            sizes += [len(found) for found in members.values()]
            variance = average_by_hand(variance, members, 2.5, features)
        tests.append((y.mean(axis=-1), t**2 * variance / n))

    def alike(p, q):
        return all(((m[p] - m[q]) ** 2 <= b[p] + b[q]).all() for m, b in tests)

    members = members_by_hand(x.shape, 3, alike)
    expected = average_by_hand(x.mean(axis=-1), members, 2.5, features)
    options = {"alpha": 0.05, "radius": 3, "spread": 2.5, "variances": variances}
    options |= {"features": features, "film": film if with_film else None}
    assert sakai2025(x, **options) == pytest.approx(expected, rel=1e-12)
    assert len({len(found) for found in members.values()}) > 3
    assert variances == "own" or len(set(sizes)) > 3


def test_one_transform_and_own_variances_are_sakai2024_without_its_correction():
    """Johnson's correction of symmetric samples is 0."""
    x = image(4, (9, 11, 3, 8)) ** 0.2
    symmetric = np.concatenate([x, 4 - x], axis=-1) ** 2  # roots are symmetric around 2
    found = sakai2025(symmetric, transforms=[0.5], variances="own", radius=4)
    assert found == pytest.approx(sakai2024(symmetric, radius=4), rel=1e-12)


@pytest.mark.parametrize("function", BOTH)
def test_windows_are_averaged_whole_where_there_is_only_noise(function):
    """Normal noise: 29 pixels within a radius of 3, and a level at which none is left out.

    A pair is told apart with a probability of 1e-9 times 6 tests: 29 of 400 pixels fail once in
    10,000 runs. The variance of 196 dependent averages is off by 40 % at most in 1 of 1000.
    """
    x = np.random.default_rng(5).normal(10, 1, size=(20, 20, 3, 32))
    found = function(x, alpha=1e-9, radius=3, spread=1e9)
    y, column = np.mgrid[-3:4, -3:4]
    disc = y**2 + column**2 <= 9
    expected = x.mean(axis=-1)[7:14, 5:12][disc].mean(axis=0)
    assert disc.sum() == 29
    assert found[10, 8] == pytest.approx(expected, rel=1e-12)
    inner = found[3:-3, 3:-3] - 10
    assert 0.6 < (inner**2).mean() / (1 / 32 / 29) < 1.4


@pytest.mark.parametrize("function", BOTH)
@pytest.mark.parametrize("name", ["albedo", "normal"])
def test_an_edge_of_a_feature_is_kept(function, name):
    """Samples on both sides have one distribution; only the feature tells them apart."""
    x = image(6, (8, 12, 3, 16))
    feature = np.zeros((8, 12, 3))
    feature[:, 6:] = 1
    other = x.copy()
    other[:, 6:] = x[::-1, 6:] * 1.01
    left, again = (function(v, features={name: feature})[:, :6] for v in (x, other))
    assert left == pytest.approx(again, rel=1e-9)
    assert function(x)[:, 5] != pytest.approx(function(other)[:, 5], rel=1e-6)  # without it


@pytest.mark.parametrize("variances", ["averaged", "own"])
@pytest.mark.parametrize("function", BOTH)
def test_halves_of_different_means_are_estimated_apart(function, variances):
    """What lies beyond enters no average, but for a like variance, which decides who is in one."""
    x = np.random.default_rng(7).normal(10, 1, size=(8, 12, 3, 32))
    x[:, 6:] += 3
    options = {} if function is sakai2024 else {"variances": variances}
    found = function(x, **options)
    within = 5e-3 if options == {"variances": "averaged"} else 1e-9
    assert found[:, :6] == pytest.approx(function(x[:, :6], **options), rel=within)
    assert found[:, 6:] == pytest.approx(function(x[:, 6:], **options), rel=within)


@pytest.mark.parametrize("function", BOTH)
def test_rare_light_stays_where_it_is_and_is_not_lost(function):
    """Of 99 % nulls: pixels that found no light stay black beside a wall that has no noise."""
    rng = np.random.default_rng(8)
    x = np.where(rng.random((12, 16, 1, 32)) < 0.01, 100.0, 0.0) * np.ones((3, 1))
    x[:, 8:] = 50.0
    found = function(x)
    assert np.isfinite(found).all()
    assert found[:, 8:] == pytest.approx(50.0)
    assert (found[:, :8] < 25).all()
    # Weights are symmetric: what a pixel gives away it takes as far as others are like it.
    assert 0.3 < found[:, :8].mean() / x[:, :8].mean() < 2


def test_variances_that_do_not_differ_are_averaged():
    """Variances of 29 pixels have a 29th of the variance of one, within a factor of two."""
    x = np.random.default_rng(9).normal(10, 1, size=(20, 20, 1, 16))
    x[:, :10] = 10 + 5 * (x[:, :10] - 10)
    found, own = _moments(ScaledSamples.of(x), partial(root, power=1.0), None)
    log, bound = _of_variances(found)
    near = (log[10, 5] - log[10, [4, 6]]) ** 2 <= bound[10, 5] + bound[10, [4, 6]]
    apart = (log[:, 9] - log[:, 10]) ** 2 > bound[:, 9] + bound[:, 10]
    assert near.all()
    assert apart.mean() > 0.9  # a factor of 25 is told from 16 samples
    assert own == pytest.approx(x.var(axis=-1, ddof=1) / ScaledSamples.of(x).unit ** 2)


def test_errors_of_log_variances_are_bonetts():
    """Normal samples: the logarithm's variance is near 2 / (n - 1) (CSDA 50, 2006).

    Over 4000 pixels of 64 samples, mean square deviation and mean error agree within 20 %.
    """
    x = np.random.default_rng(10).normal(5, 1, size=(40, 100, 1, 64))
    log, bound = _of_variances(_moments(ScaledSamples.of(x), np.array, None)[0])
    assert (log.var() * 2.80703**2) / bound.mean() == pytest.approx(1, rel=0.2)


# What the radiance of a place adds to the variance of paths, and what of that is no plane.
OF_PLACES = {
    "nothing": (lambda x, _: 0 * x, 0.0, 0.0),
    "ramp": (lambda x, y: 3 * x + 3 * y, 2 * 9 / 12, 0.0),
    "step": (lambda x, _: 3.0 * (x > 0.5), 9 / 4, 9 / 16),  # 12 (3 / 8)^2 of it is explained
    "ridge": (lambda x, _: 3.0 * (abs(x - 0.5) < 0.25), 9 / 4, 9 / 4),  # which no plane follows
}


@pytest.mark.parametrize("kind", OF_PLACES)
def test_variance_that_places_explain_is_subtracted(kind):
    """Means of 1000 pixels of 256 samples, within 4.5 standard errors.

    By chance, places explain two of 255 degrees of freedom of what they have nothing to do with.
    """
    of_place, added, left = OF_PLACES[kind]
    shape = (20, 50, 1, 256)
    film = places(shape, seed=11)
    paths = np.random.default_rng(12).gamma(4.0, 0.5, size=shape)
    x = paths + of_place(*np.moveaxis(film, 2, 0))[:, :, np.newaxis]
    scaled = ScaledSamples.of(x)
    whole, corrected = (_moments(scaled, np.array, f)[1] * scaled.unit**2 for f in (None, film))
    errors = [4.5 * of.std() / np.sqrt(1000) for of in (whole, corrected)]
    assert abs(whole.mean() - (1 + added)) < errors[0]
    by_chance = 2 * (1 + added) / 255
    assert -errors[1] - by_chance < corrected.mean() - (1 + left) < errors[1]


def test_pixels_on_an_edge_keep_their_mean_if_places_are_known():
    """An edge through pixels: without places, its variance hides that they differ from both sides.

    The error on the edge falls by a quarter or more; with places at random, nothing is gained. In
    40 repeats with other seeds, it was 0.44 to 0.66 and 1.06 to 1.43 of the error without places.
    """
    rng = np.random.default_rng(13)
    x = rng.normal(10, 0.05, size=(64, 15, 3, 8))
    film = places(x.shape, seed=14)
    x[:, 8:] += 1
    x[:, 7] += film[:, 7, :1] > 0.5
    wrong = np.random.default_rng(15).permuted(film, axis=-1)
    plain, kept, mistaken = (
        np.abs(sakai2025(x, film=f, radius=5)[:, 7] - x[:, 7].mean(axis=-1)).mean()
        for f in (None, film, wrong)
    )
    assert kept < 0.75 * plain
    assert mistaken > 0.95 * plain


@pytest.mark.filterwarnings("ignore::chdstat.errors.LeftOutWarning")
def test_bad_samples_and_unknown_places_do_not_count():
    x, film = image(16, (6, 6, 3, 24)), places((6, 6, 3, 24), seed=17)
    x[..., 16:] = np.nan
    film[..., 16:] = np.nan
    found = sakai2025(x, film=film)
    assert found == pytest.approx(sakai2025(x[..., :16], film=film[..., :16]), rel=1e-9)
    film[2, 2] = np.nan
    assert np.isfinite(sakai2025(x, film=film)).all()


def test_places_that_explain_nothing_change_little():
    """Negative control of the correction: 64 samples whose light has nothing to do with places."""
    x = image(18, (12, 12, 3, 64))
    found, plain = sakai2025(x, film=places(x.shape)), sakai2025(x)
    alone = np.abs(estimators.mean(x) - plain).mean()
    assert np.abs(found - plain).mean() < 0.1 * alone
