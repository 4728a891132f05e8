"""References, held out or not: errors that are known come out, whatever noise the samples have.

Samples are nulls with the probability z, else exponential: a sample has v = 2 / (1 - z) - 1 times
its squared mean as variance. The mean of n samples times c has c^2 + (1 - c)^2 n / v of the error
of the mean itself.
"""

import numpy as np
import pytest

import chdstat as chd
from chdstat.comparison.judges import PARTS, Judge, PartialSums
from chdstat.errors import InputError
from chdstat.estimators import Estimator
from chdstat.estimators.held_out import (
    Totals,
    batches,
    check_spp,
    draw_pixels,
    judging_pixels,
    training_batches,
)

EDGE = 48
GRADIENT = 10 ** np.linspace(-1, 1, EDGE)


def draw(seed, nulls, spp, *, image=1.0):
    rng = np.random.default_rng(seed)
    x = rng.exponential(size=(EDGE, EDGE, 1, spp)) * (rng.random((EDGE, EDGE, 1, spp)) >= nulls)
    return chd.Samples.from_array((x.T * image).T.astype(np.float32) / (1 - nulls))


def scaled(c):
    return Estimator(f"x{c}", lambda x: c * np.asarray(x).mean(axis=-1), "this test")


@pytest.mark.parametrize(
    ("nulls", "spp", "n"), [(0.3, 48, 16), (0.9, 128, 32), (0.99, 128, 32), (0.6, 64, 16)]
)
@pytest.mark.parametrize("image", [1.0, GRADIENT], ids=["constant", "gradient"])
def test_ratios_lie_within_their_intervals(nulls, spp, n, image):
    """Twice 3 intervals of 95 %, all of which are dependent, in 3 images: 2 of 3 hold them all."""
    factors, held = (0.0, 0.5, 1.3), []
    truth = np.array([c**2 + (1 - c) ** 2 * n / (2 / (1 - nulls) - 1) for c in factors])
    for seed in range(3):
        rows = chd.compare(
            draw(seed, nulls, spp, image=image), [*map(scaled, factors)], n=n, progress=False
        ).table()
        for measure in ("mse_ratio", "relmse_ratio"):
            low, high = (
                np.array([row[measure + end] for row in rows]) for end in ("_low", "_high")
            )
            held.append(((low <= truth) & (truth <= high)).all())
            # No verdict is reversed.
            assert not ((low > 1) & (truth < 1) | (high < 1) & (truth > 1)).any()
    assert np.sum(held) >= 4


def test_rare_light_rewards_no_black_image():
    """Seen against the mean of the other samples, the black image seemed .46 as wrong as the mean:
    a reference that missed its light weighed its pixel a hundredfold."""
    rows = chd.compare(draw(4, 0.9, 128), [scaled(0.0), "median_of_means"], progress=False).table()
    assert all(row["relmse_ratio_low"] > 1.2 for row in rows)


def test_errors_of_the_truth_are_0_on_average():
    reference = PartialSums.of(draw(0, 0.6, 32)).judge()
    errors = reference.squared(np.ones((EDGE, EDGE, 1)))
    assert abs(errors.mean()) < 4 * errors.std() / EDGE
    relative = reference.relative(np.ones((EDGE, EDGE, 1)))
    assert (np.abs(relative.mean(axis=(1, 2, 3))) < 4 * relative.std(axis=(1, 2, 3)) / EDGE).all()


def test_an_exact_reference_gives_defined_errors():
    truth = np.random.default_rng(1).gamma(0.3, size=(9, 11, 3))
    scene = truth.mean(axis=(0, 1))
    parts = np.broadcast_to(truth, (PARTS, *truth.shape))
    reference = Judge.of_image(parts, np.zeros_like(truth), scene)
    estimate = 1.5 * truth + 0.1
    squared = np.square(estimate - truth)
    np.testing.assert_allclose(reference.squared(estimate), squared)
    expected = squared / (truth**2 + 0.01 * scene**2)
    for relative in reference.relative(estimate):
        np.testing.assert_allclose(relative, expected, rtol=1e-4)


@pytest.mark.parametrize("unit", [2.0**-80, 2.0**80])
def test_relative_errors_do_not_depend_on_the_unit(unit):
    x = draw(2, 0.6, 32).read()
    ours, theirs = (
        PartialSums.of(chd.Samples.from_array(x * np.float32(scale))).judge() for scale in (1, unit)
    )
    estimate = x[..., :4].mean(axis=-1, dtype=np.float64)
    np.testing.assert_allclose(
        theirs.relative(estimate * unit), ours.relative(estimate), rtol=1e-4, atol=1e-9
    )


def test_a_batch_is_in_no_part_of_its_reference():
    x = np.random.default_rng(0).exponential(size=(8, 8, 1, 64)).astype(np.float32)
    spoilt = x.copy()
    spoilt[..., 16:32] += 100
    ours, theirs = (
        PartialSums.of(chd.Samples.from_array(y)).judge(y[..., 16:32], first=16)
        for y in (x, spoilt)
    )
    np.testing.assert_allclose(theirs.mean, ours.mean, rtol=1e-10)
    np.testing.assert_allclose(theirs.variance, ours.variance, rtol=1e-8)


def test_unknown_parts_have_no_reference():
    x = np.random.default_rng(0).exponential(size=(8, 8, 1, 64)).astype(np.float32)
    x[1, 2, 0, 3::4] = np.nan
    x[3, 4, 0, 5] = np.inf
    sums = PartialSums.of(chd.Samples.from_array(x))
    known = np.isfinite(sums.judge().mean[..., 0])
    assert np.argwhere(~known).tolist() == [[1, 2]]
    without = sums.judge(x[..., :16])
    assert np.argwhere(np.isnan(without.mean[..., 0])).tolist() == [[1, 2], [3, 4]]


@pytest.mark.parametrize(("n", "spp"), [(1, 8), (2, 9), (7, 14), (16, 32)])
def test_the_fewest_samples_leave_some_for_each_part(n, spp):
    rng = np.random.default_rng(n)
    x = rng.exponential(size=(12, 12, 1, spp))
    assert np.isfinite(chd.compare(x, ["mean"], n=n, progress=False).table()[0]["mse"])
    with pytest.raises(InputError, match=f"{spp} spp, got {spp - 1}"):
        chd.compare(x[..., 1:], ["mean"], n=n, progress=False)


# --- held-out protocol ----------------------------------------------------------------------------


@pytest.fixture
def samples():
    rng = np.random.default_rng(0)
    return chd.Samples.from_array(rng.gamma(0.7, size=(6, 5, 3, 75)))


def test_the_reference_is_the_mean_of_all_other_samples(samples):
    totals, x = Totals.of(samples), samples.read()
    assert totals.mean() == pytest.approx(x.mean(axis=-1), rel=1e-6)
    for k, batch in enumerate(batches(samples, 10)):
        others = np.delete(x, np.s_[10 * k : 10 * k + 10], axis=-1)
        assert totals.mean_without(batch) == pytest.approx(others.mean(axis=-1), rel=1e-6)
    assert k == 6


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_bad_sample_leaves_no_reference(samples, bad):
    x = samples.read().copy()
    x[2, 3, 1, 15] = bad
    spoilt = chd.Samples.from_array(x)
    totals = Totals.of(spoilt)
    assert totals.count[2, 3] == 74
    first, second = list(batches(spoilt, 10))[:2]
    assert np.isnan(totals.mean_without(second)[2, 3]).all()
    others = np.delete(x[2, 3], [*range(10), 15], axis=-1).mean(axis=-1)
    assert totals.mean_without(first)[2, 3] == pytest.approx(others, rel=1e-6)
    assert np.isfinite(totals.mean_without(second)).sum() == 6 * 5 * 3 - 3


def test_training_batches_are_those_of_the_pixels_named(samples):
    x = samples.read()
    found, references = training_batches(samples, np.array([[0, 0], [5, 4]]), 25)
    assert found.shape == (6, 3, 25)
    assert references.shape == (6, 3)
    assert (found[1] == x[5, 4, :, :25]).all()
    assert references[1] == pytest.approx(x[5, 4, :, 25:].mean(axis=-1), rel=1e-6)


def test_drawn_pixels_leave_half_of_the_image():
    drawn = draw_pixels((9, 7), 6400, seed=0)
    assert len(np.unique(drawn, axis=0)) == len(drawn) == 31
    assert (drawn >= 0).all()
    assert (drawn < (9, 7)).all()
    assert len(draw_pixels((9, 7), 4, seed=0)) == 4
    assert (draw_pixels((9, 7), 31, seed=0) == drawn).all()
    assert (draw_pixels((9, 7), 31, seed=1) != drawn).any()


@pytest.mark.parametrize(
    ("side", "trained"), [(64, 2048), (92, 4232), (93, 6400), (113, 6400), (114, 6400), (128, 6400)]
)
def test_training_leaves_a_quarter_to_judge(side, trained):
    drawn = draw_pixels((side, side), 6400, seed=2)
    judging = judging_pixels((side, side), seed=2)
    assert len(drawn) == trained
    assert not judging[tuple(drawn.T)].any()
    assert judging.sum() == max(side * side - max(trained, side * side // 2), 0)
    more = draw_pixels((side, side), 8192, seed=2)
    assert not judging[tuple(more.T)].any()
    assert set(map(tuple, drawn.tolist())) <= set(map(tuple, more.tolist()))


def test_too_few_samples_say_what_is_needed(samples):
    check_spp(samples, 37)
    with pytest.raises(InputError, match="76 spp, got 75"):
        check_spp(samples, 38)
