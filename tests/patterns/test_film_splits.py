"""Split of the variance by place: its share, interval and test, and what a pixel says of them."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from scipy import stats

import chdstat as chd
from chdstat import viz
from chdstat.errors import InputError, Reason
from chdstat.explorer import tables
from chdstat.patterns import Pixel, film_split
from chdstat.patterns.film_splits import VarianceByPlace, _of_permutations, split_by_place
from chdstat.samples import Samples
from chdstat.samples.tiles import FILM

EDGE = 0.5


def known(x: np.ndarray, places: np.ndarray) -> Samples:
    """Return samples (y, x, channel, sample) that say where they fell, (y, x, 2, sample)."""
    film = Samples.from_array(places.astype(np.float32), axes="yxcs")
    return Samples(x.astype(np.float32), attrs={}, parts={FILM: film})


def pixel(share: float, spp: int = 1024, *, sigma: float = 0.5, seed: int = 0) -> Pixel:
    """Return a pixel with a vertical edge, which makes this share of the variance."""
    rng = np.random.default_rng(seed)
    places = rng.random((2, spp))
    noise = rng.lognormal(0, sigma, spp)
    of_paths = np.exp(sigma**2) * (np.exp(sigma**2) - 1)
    step = 2 * np.sqrt(of_paths * share / (1 - share))
    x = np.repeat([noise + step * (places[0] > EDGE)], 3, axis=0).astype(np.float32)
    return Pixel(0, 0, x, ("R", "G", "B"), "edge", {FILM: places.astype(np.float32)})


def test_p_values_have_the_mean_and_variance_of_all_orders():
    n, x = np.array([2, 3, 1]), np.array([0.1, 0.2, 9.0, 0.4, 3.0, 0.0])
    x -= x.mean()
    cell = np.repeat(np.arange(3), n)
    shares = [
        (np.bincount(cell, x[list(order)], 3) ** 2 / n).sum() / (x**2).sum()
        for order in itertools.permutations(range(6))
    ]
    mean, variance = np.mean(shares), np.var(shares)
    a = mean * (mean * (1 - mean) / variance - 1)
    sums = np.bincount(cell, x, 3)
    given = [v[np.newaxis] for v in (1.0 * n, sums, (x**2).sum(), (x**4).sum())]
    expected = stats.beta.sf((sums**2 / n).sum() / (x**2).sum(), a, a * (1 - mean) / mean)
    assert _of_permutations(*given)[0] == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("sigma", [0.0, 1.0, 2.0])
@pytest.mark.parametrize("spp", [64, 512])
def test_the_test_holds_its_level_whatever_the_tails(sigma, spp):
    """Of 3000 pixels, 5 % are rejected: fails by chance in 1 of 10,000, were it exact."""
    rng = np.random.default_rng(5)
    x = rng.lognormal(0, sigma, (3000, spp)) * (rng.random((3000, spp)) < 0.5)
    p = split_by_place(x, rng.random((3000, 2, spp)), 2 if spp < 100 else 4).p_value
    assert 0.02 < (p <= 0.05).mean() < 0.05 + 3.7 * np.sqrt(0.05 * 0.95 / 3000)
    assert (p <= 0.001).mean() < 0.006  # .001 but for long tails, which two moments do not tell


@pytest.mark.parametrize(("sigma", "least"), [(0.3, 0.93), (1.0, 0.85)])
def test_intervals_hold_the_share_and_long_tails_only_lower_it(sigma, least):
    """Ends of intervals of 600 pixels; the upper one fails in 2.5 % at most, by 3.7 errors."""
    rng = np.random.default_rng(2)
    places = rng.random((600, 2, 512))
    noise = rng.lognormal(0, sigma, (600, 512))
    of_paths = np.exp(sigma**2) * (np.exp(sigma**2) - 1)
    x = noise + 2 * np.sqrt(of_paths / 2) * (places[:, 0] > EDGE)
    found = split_by_place(x, places, 4)
    low, high = found.share_interval.T
    assert ((low <= 1 / 3) & (high >= 1 / 3)).mean() > least
    assert (high < 1 / 3).mean() < 0.025 + 3.7 * np.sqrt(0.025 * 0.975 / 600)


def test_without_variance_there_is_no_share():
    places = np.random.default_rng(0).random((4, 2, 64))
    x = np.array([0.0, 2.0, np.nan, 1.0])[:, np.newaxis] * np.ones(64)
    x[3, 2:] = np.nan
    found = split_by_place(x, places, 2)
    expected = [Reason.ALL_NULL, Reason.CONSTANT, Reason.ALL_BAD, Reason.CONSTANT]
    assert found.reason.tolist() == expected
    assert np.isnan(found.share).all()
    assert np.isnan(found.share_interval).all()


def test_analysis_has_the_split_where_film_was_kept():
    rng = np.random.default_rng(1)
    x, places = rng.gamma(2.0, size=(4, 3, 3, 64)), rng.random((4, 3, 2, 64))
    x += 9 * (places[:, :, :1] > EDGE)
    samples = known(x, places)
    found, split = chd.analyze(samples, progress=False), film_split(samples, progress=False)
    for name in ("variance", "paths", "places", "share", "share_told", "p_value", "reason"):
        np.testing.assert_array_equal(found[f"film_{name}"], split[name])
    assert (split["share_told"] > 0.5).all()
    assert split["share"].attrs["units"] == "1"
    without = chd.analyze(Samples(x.astype(np.float32), attrs={}), progress=False)
    assert not [name for name in without if str(name).startswith("film_")]


def test_samples_of_which_some_places_are_unknown_count_less():
    rng = np.random.default_rng(1)
    x, places = rng.gamma(2.0, size=(2, 2, 1, 128)), rng.random((2, 2, 2, 96))
    fewer = film_split(known(x, places), cells=2, progress=False)
    same = film_split(known(x[..., :96], places), cells=2, progress=False)
    np.testing.assert_allclose(fewer["variance"], same["variance"])
    np.testing.assert_allclose(fewer["p_value"], same["p_value"])


def test_a_pixel_says_what_its_variance_comes_from():
    words = pixel(0.6).variance_by_place.replace("\N{NO-BREAK SPACE}", " ")
    assert words.startswith("6")
    assert "between its 8 × 8 parts, which strata take away; the rest is of paths" in words
    assert "of the variance, within the pixel" in pixel(0.6).told(0)
    assert "variance by place" in str(pixel(0.6))
    assert "no change of the picture within the pixel is seen" in pixel(0.0).variance_by_place
    assert "bright paths that they may miss" in pixel(0.6, 128, sigma=2.5).variance_by_place


def test_a_pixel_without_places_or_variance_is_silent():
    one = pixel(0.6)
    without = Pixel(0, 0, one.radiance, one.channels, "edge")
    assert without.variance_by_place == ""
    assert without.means_by_place is None
    assert "of the variance, within the pixel" not in without.told(0)
    bad = Pixel(0, 0, np.full_like(one.radiance, np.nan), one.channels, "bad", one.parts)
    assert (bad.variance_by_place, bad.means_by_place) == ("", None)
    still = Pixel(0, 0, np.ones_like(one.radiance), one.channels, "still", one.parts)
    assert still.variance_by_place == ""
    with pytest.raises(InputError, match="film=True"):
        viz.pixel_by_place(without)


def test_means_by_place_show_the_edge():
    means, counts = pixel(0.9).means_by_place
    assert means.shape == (4, 8, 8)
    assert counts.sum() == 1024
    assert means[-1, :, :4].max() < means[-1, :, 4:].min()


def test_the_explorer_shows_the_means_as_a_table_with_colours():
    table = tables.places_table(pixel(0.9))
    assert [len(table["rows"]), len(table["columns"])] == [8, 9]
    assert [len(row) for row in table["shades"]] == [8] * 8
    assert table["shades"][0][0][0] != table["shades"][0][7][0]
    assert "the picture changing within the pixel" in table["note"]


def test_as_many_strata_as_samples_take_what_the_split_says():
    """Variance of 4000 means of 64 samples, one in each of 8 x 8 strata: within 4 errors."""
    rng = np.random.default_rng(3)

    def radiance(places):
        return 2.0 * (places[:, 0] > EDGE) + places[:, 1] + rng.gamma(1.0, size=places[:, 0].shape)

    found = split_by_place(radiance(at := rng.random((400, 2, 1024))), at, 8)
    corners = np.stack(np.mgrid[:8, :8]).reshape(2, 64)[np.newaxis]
    means = radiance((corners + rng.random((4000, 2, 64))) / 8).mean(axis=1)
    left = 1 - found.share.mean()
    total = found.variance.mean() / 64
    assert means.var(ddof=1) / total == pytest.approx(left, rel=4 * np.sqrt(2 / 4000))


@pytest.mark.parametrize("k", [4, 8])
def test_sums_over_pixels_know_edges_finer_than_cells(k):
    """Straight edges anywhere in 3000 pixels: a cell hides some of each; 5 % is four errors."""
    rng = np.random.default_rng(4)
    angle, places = rng.uniform(0, np.pi, (3000, 1)), rng.random((3000, 2, 1024))
    across = np.cos(angle) * (places[:, 0] - 0.5) + np.sin(angle) * (places[:, 1] - 0.5)
    x = 2.0 * (across > rng.uniform(-0.5, 0.5, (3000, 1)))
    found = split_by_place(x, places, k)
    known = found.reason == Reason.OK
    variance, places_, limit = (
        v[known].sum() for v in (found.variance, found.places, found.places_limit)
    )
    assert places_ < 0.9 * variance
    assert limit == pytest.approx(variance, rel=0.05)


def test_figures_show_the_split():
    rng = np.random.default_rng(1)
    x, places = rng.gamma(2.0, size=(4, 4, 1, 64)), rng.random((4, 4, 2, 64))
    x[:2] += 9 * (places[:2, :, :1] > EDGE)
    x[3] = 0
    ax = viz.film_split(film_split(known(x, places), progress=False))
    told = [text.get_text() for text in ax.get_legend().get_texts()]
    assert told == ["not significant 25 %", "nothing to split 25 %"]
    again = viz.film_split(chd.analyze(known(x, places), progress=False))
    assert [text.get_text() for text in again.get_legend().get_texts()] == told
    figure = viz.pixel_by_place(pixel(0.9))
    assert next(t.get_text() for t in figure.axes[0].texts).isdecimal()
    with pytest.raises(InputError, match="share_told"):
        viz.film_split(chd.summarize(known(x, places), progress=False))


def test_the_statistic_takes_enough_samples():
    assert VarianceByPlace.of_pixel(7) is None
    assert VarianceByPlace.of_pixel(1024) == VarianceByPlace(8)
