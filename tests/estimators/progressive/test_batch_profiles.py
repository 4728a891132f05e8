"""Batches: what is kept is all there, can be cut in two at random, and takes constant memory."""

import numpy as np
import pytest

from chdstat.estimators.progressive.dataset import Profile
from chdstat.estimators.progressive.online import BatchProfiles, BatchSplits


def draws(n, *, pixels=40, seed=0):
    rng = np.random.default_rng(seed)
    return rng.exponential(size=(pixels, 3, n)).astype(np.float32)


def filled(x, *ends, unit=0.5, **options):
    kept = BatchProfiles(*x.shape[:2], unit=unit, **options)
    for part in np.split(x, ends, axis=-1):
        kept.add(part)
    return kept


def parts(x, **options):
    kept = filled(x, **options)
    return BatchSplits(batches=kept, chosen=kept.usable())


@pytest.mark.parametrize("ends", [(), (1,), (3, 20), (8, 16, 24)])
def test_samples_are_dealt_in_turn_however_they_arrive(ends):
    x = draws(29)
    kept = filled(x, *ends)
    for batch in range(8):
        expected = Profile.of(x[..., batch::8], unit=0.5)
        assert kept.bins[batch] == pytest.approx(expected.bins, rel=1e-4, abs=1e-5)
        assert (kept.count[batch] == kept.sizes[batch]).all()
        assert (expected.count == kept.sizes[batch]).all()


def test_all_batches_together_are_the_profile_of_all_samples():
    x = draws(50)
    kept, whole = filled(x, 16, 32), Profile.of(x, unit=0.5)
    assert kept.bins.sum(axis=0) == pytest.approx(whole.bins, rel=1e-4, abs=1e-5)
    assert (kept.count.sum(axis=0) == whole.count).all()
    assert kept.sums.sum(axis=0) / 50 * 0.5 == pytest.approx(x.mean(axis=-1), rel=1e-5)


def test_the_order_matters_only_for_the_dealing():
    """A shift by one sample is the negative control: it changes every batch."""
    x = draws(32)
    rounds = x.reshape(40, 3, 4, 8)
    same = rounds[:, :, [2, 0, 3, 1]].reshape(x.shape)
    first, second, other = filled(x), filled(same), filled(np.roll(x, 1, axis=-1))
    assert second.bins == pytest.approx(first.bins, rel=1e-4, abs=1e-5)
    for batch in range(8):
        assert np.abs(other.bins[batch] - first.bins[batch]).max() > 1


def test_memory_does_not_grow():
    kept, sizes = filled(draws(4)), set()
    for seed in range(5):
        kept.add(draws(64, seed=seed))
        sizes.add(kept.nbytes)
    assert sizes == {40 * 8 * (24 * 4 * 4 + 3 * 8 + 8)}


@pytest.mark.parametrize("spp", [16, 27, 5])
def test_both_parts_together_are_all_samples(spp):
    made = parts(draws(spp))
    for n in made.sizes:
        rows, drawn = made.draw(np.arange(40), n, 100, np.random.default_rng(1))
        profile, _, target = made.minibatch(rows, drawn)
        size = made.counts[drawn].sum()
        assert abs(size - n) <= max(spp // 8, 1)
        assert (profile.count == size).all()
        both = size * profile.mean() + (spp - size) * target
        assert both / spp == pytest.approx(made.mean[rows], rel=1e-5)


def test_no_part_is_empty_or_all():
    made = parts(draws(16))
    for n, size in ((0, 2), (1, 2), (8, 8), (16, 14), (99, 14)):
        _, drawn = made.draw(np.arange(40), n, 10, np.random.default_rng(0))
        assert made.counts[drawn].sum() == size


def test_halves_share_no_sample_with_each_other_or_with_the_part():
    made, rng = parts(draws(32)), np.random.default_rng(2)
    rows, drawn = made.draw(np.arange(40), 16, 30, rng)
    (first, second), _ = made.halves(rows, drawn, rng)
    assert (first + second) / 2 == pytest.approx(made.minibatch(rows, drawn)[2], rel=1e-5)
    assert np.abs(first - second).min() > 0


def test_uneven_halves_tell_the_variance_of_the_target_without_bias():
    """Three batches of eight samples are left: 3 x 5000 pixels, within five deviations."""
    made, rng = parts(draws(64, pixels=5000), unit=1.0), np.random.default_rng(2)
    noise = made.noise(*made.draw(np.arange(5000), 40, 5000, rng), rng)
    assert abs(noise.mean() - 1 / 24) < 5 * noise.std() / np.sqrt(noise.size)


@pytest.mark.parametrize("spp", [61, 64])
def test_the_variance_of_a_sample_is_told_without_bias(spp):
    """Of 3 x 5000 pixels, within five standard errors: it fails once in a million seeds."""
    made = parts(draws(spp, pixels=5000), unit=1.0)
    found = made.variance.ravel()
    assert abs(found.mean() - 1) < 5 * found.std() / np.sqrt(len(found))


def test_what_rounding_makes_is_no_variance():
    assert (parts(np.full((9, 3, 100), 0.1, np.float32)).variance == 0).all()
    assert (parts(draws(100, pixels=9)).variance > 0).all()


def test_pixels_with_a_bad_sample_or_beyond_single_precision_are_not_used():
    x = draws(16)
    x[3, 1, 5], x[4, 0, 0], x[5, 2, 7], x[6, :, 2] = np.nan, -np.inf, np.inf, 1e30
    assert filled(x).usable().tolist() == [0, 1, 2, *range(7, 40)]
    made = parts(x)
    assert len(made) == 36
    assert made.mean[3] == pytest.approx(x[7].mean(axis=-1) / 0.5, rel=1e-5)
    assert np.isfinite(made.variance).all()


def test_few_samples_fill_few_batches():
    made = parts(draws(5))
    assert made.spp == 5
    assert made.sizes == [1, 2, 3]
    _, drawn = made.draw(np.arange(40), 3, 10, np.random.default_rng(0))
    assert set(drawn.tolist()) < set(range(5))
