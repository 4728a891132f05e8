"""Error measures: known answers, laws and the coverage of the bootstrap."""

import numpy as np
import pytest

from chdstat.comparison import metrics
from chdstat.errors import InputError


@pytest.fixture
def image():
    rng = np.random.default_rng(0)
    reference = rng.gamma(2, size=(5, 7, 3))
    return reference * rng.lognormal(0, 0.3, size=reference.shape), reference


def test_measures_follow_their_definition_channel_by_channel(image):
    p, y = image
    for c in range(3):
        pc, yc = p[..., c].ravel(), y[..., c].ravel()
        m = yc.mean()
        assert metrics.mse(p, y)[c] == pytest.approx(np.mean((pc - yc) ** 2))
        assert metrics.relmse(p, y)[c] == pytest.approx(
            np.mean((pc - yc) ** 2 / (yc**2 + 0.01 * m**2))
        )
        assert metrics.bias(p, y)[c] == pytest.approx(np.mean(pc - yc) / m)


def test_scaling_the_radiance_scales_mse_and_nothing_else(image):
    p, y = image
    mean = y * 1.3
    assert metrics.mse(8 * p, 8 * y) == pytest.approx(64 * metrics.mse(p, y))
    assert metrics.relmse(8 * p, 8 * y) == pytest.approx(metrics.relmse(p, y))
    assert metrics.bias(8 * p, 8 * y) == pytest.approx(metrics.bias(p, y))
    assert metrics.improved(8 * p, 8 * y, 8 * mean) == pytest.approx(metrics.improved(p, y, mean))


def test_scene_mean_is_that_of_the_whole_scene_where_a_part_is_measured(image):
    p, y = image
    scene_mean = y.mean(axis=(0, 1))
    parts = [metrics.relmse(p[k], y[k], scene_mean=scene_mean) for k in range(len(p))]
    assert np.mean(parts, axis=0) == pytest.approx(metrics.relmse(p, y))


def test_a_tie_is_no_improvement(image):
    p, y = image
    assert (metrics.improved(p, y, p) == 0).all()
    assert (metrics.improved(y, y, p) == 1).all()


def test_a_black_scene_has_no_error_and_no_bias_to_speak_of():
    black = np.zeros((4, 4, 3))
    assert (metrics.mse(black, black) == 0).all()
    assert (metrics.relmse(black, black) == 0).all()
    assert np.isnan(metrics.bias(black, black)).all()
    assert np.isinf(metrics.relmse(black + 1, black)).all()


def test_shapes_must_agree(image):
    for shape in ((5, 7, 1), (7, 3), (1, 7, 3)):
        with pytest.raises(InputError, match="same shape"):
            metrics.mse(np.ones(shape), image[1])


def test_bootstrap_standard_error_is_that_of_a_mean():
    # The bootstrap error of a mean is s / sqrt(n); 2000 replicates know it to about 1.6 %.
    x = np.random.default_rng(1).normal(size=(400, 2))
    interval = metrics.bootstrap(x, replicates=2000, seed=2)
    assert interval.value == pytest.approx(x.mean(axis=0))
    assert interval.standard_error == pytest.approx(x.std(axis=0) / 20, rel=0.08)
    one, again, other = (metrics.bootstrap(x[:, 0], seed=s).low for s in (1, 1, 2))
    assert one == again != other


@pytest.mark.parametrize(("level", "most"), [(0.95, 200), (0.5, 130)])
def test_bootstrap_covers_a_ratio_as_often_as_it_says(level, most):
    # 200 trials of 150 pixels, true ratio 2: the hits are binomial(200, about level). At 0.95
    # fewer than 175 hits has probability below 1e-4 even if the true coverage is 0.93. At 0.5 the
    # negative control: such intervals must not cover nearly always.
    rng = np.random.default_rng(4)
    hits = 0
    for _ in range(200):
        y = rng.gamma(2, size=150)
        pairs = np.stack([2 * y * rng.gamma(4, 1 / 4, size=150), y], axis=1)
        interval = metrics.bootstrap(
            pairs, lambda m: m[:, 0] / m[:, 1], replicates=200, level=level, seed=rng
        )
        hits += bool(interval.low < 2 < interval.high)
    assert hits <= most
    assert hits >= (175 if level == 0.95 else 70)


@pytest.mark.parametrize(
    ("values", "options", "match"),
    [
        (np.empty((0, 3)), {}, "needs pixels"),
        (1.0, {}, "needs pixels"),
        ([1.0], {"replicates": 1}, "replicates must be at least 2, got 1"),
        ([1.0], {"replicates": 9.5}, "replicates must be a whole number, got 9.5"),
        ([1.0], {"level": 95}, "between 0 and 1"),
    ],
)
def test_bootstrap_refuses_what_has_no_answer(values, options, match):
    with pytest.raises(InputError, match=match):
        metrics.bootstrap(values, **options)
