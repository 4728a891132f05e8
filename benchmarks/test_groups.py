"""Groups of pixels, on images whose answers are known."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

import chdstat as chd
from benchmarks.groups import (
    DECILES,
    EDGE,
    SURE,
    Noise,
    errors_of_sums,
    holds,
    means,
    ratios,
    sums,
)
from chdstat.comparison import Judge

SIZE, N, REFERENCE = 64, 32, 1024


@pytest.fixture(scope="module")
def world():
    """Normal samples whose noise spans a factor of 1000, three of its renders, and a reference."""
    rng = np.random.default_rng(0)
    truth = rng.uniform(1, 2, (SIZE, SIZE, 3))
    noise = 10 ** rng.uniform(-3, 0, truth.shape)
    noise[:4, :4] = 0

    def drawn(n):
        return truth + noise * rng.standard_normal(truth.shape) / np.sqrt(n)

    renders = [
        chd.Samples.from_array(
            truth[..., np.newaxis] + noise[..., np.newaxis] * rng.standard_normal((*truth.shape, N))
        )
        for _ in range(3)
    ]
    parts = np.stack([drawn(REFERENCE // 4) for _ in range(4)])
    reference = Judge.of_image(parts, noise / np.sqrt(REFERENCE), parts.mean(axis=(0, 1, 2)))
    of_renders = Noise.of(renders, 2)
    means_of = np.stack([x.read().mean(axis=-1, dtype=np.float64) for x in renders[:2]])
    groupings = of_renders.groupings(reference)
    return SimpleNamespace(
        truth=truth,
        noise=noise,
        reference=reference,
        renders=of_renders,
        means=means_of,
        groupings=groupings,
    )


def test_equal_samples_have_no_noise():
    rng = np.random.default_rng(0)
    x = np.repeat(rng.uniform(size=(32, 32, 3, 1)), 37, axis=-1)
    x[:, ::2] = rng.uniform(size=x[:, ::2].shape)
    noise = Noise.of([chd.Samples.from_array(x)] * 2, 1)
    assert np.array_equal(noise.exact()[0].all(axis=(0, 2)), np.arange(32) % 2 == 1)


def test_deciles_follow_the_noise(world):
    group = world.groupings["noise"]
    assert (group[:, :4, :4] == -1).all()
    level = np.log10(means(group, np.broadcast_to(world.noise, group.shape)))
    assert level == pytest.approx(np.linspace(-2.83, -0.13, DECILES), abs=0.06)
    assert world.renders.exact()[0].sum() == 4 * 4 * 3


@pytest.mark.parametrize("name", ["noise", "relative noise", "channel"])
def test_errors_over_the_mean_and_their_standard_errors(world, name):
    judged = world.reference.squared
    of_mean = np.stack([judged(m) for m in world.means])
    own = np.stack([judged(world.truth + (m - world.truth) / 2) for m in world.means])
    ratio, error, z = ratios(world.groupings[name], own, of_mean)
    assert z.max() < -5
    # The fixed seed is in 99.8 % of all worlds: 10 ratios within 3.7 standard errors.
    assert (abs(ratio - 0.25) < 3.7 * error).all()
    assert (error < 0.05).all()
    same, none, _ = ratios(world.groupings[name], of_mean, of_mean)
    assert same == pytest.approx(1)
    assert none == pytest.approx(0, abs=1e-12)


def test_one_loud_error_in_a_quiet_decile_is_found(world):
    judged = world.reference.squared
    of_mean = np.stack([judged(m) for m in world.means])
    quiet = world.groupings["noise"] == 0
    own = np.stack([judged(m) for m in world.means + 0.01 * quiet])
    *_, z = ratios(world.groupings["noise"], own, of_mean)
    assert np.flatnonzero(z > SURE).tolist() == [0]


def test_sums_in_standard_errors(world):
    group = world.groupings["block"]
    assert group.max() + 1 == (SIZE // EDGE) ** 2
    apart = world.means - world.reference.mean
    # Here channels are independent, which the standard error of a render does not assume.
    assert errors_of_sums(np.zeros((2, 2, 3), int), np.ones((2, 2, 3))) == pytest.approx(6)
    of_mean = np.sqrt(sums(group[:1], world.noise**2 / N))
    assert (world.renders.error_of_sum(group, N) > 1.2 * of_mean).all()
    of_reference = errors_of_sums(group[0, :, :, :1], world.reference.error[..., :1])
    z = sums(group[:1], apart[:1]) / np.hypot(of_mean, of_reference)
    assert abs(z).max() < 3.7
    darker = sums(group[:1], apart[:1] - 0.1 * world.truth) / of_mean
    assert darker.max() < -3


def test_shares_of_intervals_without_the_noise_of_the_reference(world):
    half = 1.645 * world.noise / np.sqrt(REFERENCE / 4)
    rng = np.random.default_rng(1)
    found = world.truth + world.noise / np.sqrt(REFERENCE / 4) * rng.standard_normal(half.shape)
    estimate = SimpleNamespace(low=found - half, high=found + half)
    inside = np.broadcast_to(holds(estimate, world.reference), world.groupings["noise"].shape)
    share = means(world.groupings["noise"], inside)
    # Ten shares of 1200 values, doubled and subtracted, have standard errors of .016.
    assert share == pytest.approx(np.full(DECILES, 0.9), abs=0.05)
    naive = (estimate.low <= world.reference.mean) & (world.reference.mean <= estimate.high)
    assert naive[world.noise > 0].mean() < 0.87
