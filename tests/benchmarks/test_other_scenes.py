"""What networks are worth on their scene and on others: errors, bias and coverage.

Run with ``pytest tests/benchmarks/test_other_scenes.py --benchmark-only -s``. Errors are in
units of the mean's; +- is their standard error over pixels. Bias is that of the whole image less
the mean's own, which is noise.
"""

import numpy as np
import pytest

import chdstat as chd
from chdstat.estimators import Progressive, mean_radiance

EDGE, SPP = 48, 1024
SIZES = (4, 16, 64, 256)


def worlds(edge=EDGE, spp=SPP, seed=0):
    """Return images of known radiance: independent pixels, gradients, fireflies and lamps."""
    rng = np.random.default_rng(seed)
    shape = (edge, edge, 1, spp)
    ramp = np.broadcast_to(np.geomspace(0.1, 2, edge)[:, np.newaxis, np.newaxis], (edge, edge, 1))
    lone = rng.lognormal(size=shape[:3])
    lamps = np.where(rng.random(shape[:3]) < 0.01, 30.0, 0.3)
    seldom = 10.0 * (rng.random(shape) < 0.1)
    draws = {
        "independent, 90 % nulls": (lone, seldom * rng.exponential(size=shape)),
        "independent, exponential": (lone, rng.exponential(size=shape)),
        "independent, 90 % nulls, log-normal": (lone, seldom * rng.lognormal(-0.5, 1, shape)),
        "gradient, log-normal 1.5": (ramp, rng.lognormal(-1.125, 1.5, shape)),
        "gradient, fireflies": (
            ramp,
            0.5 * rng.exponential(size=shape) + 250 * (rng.random(shape) < 0.002),
        ),
        "lamps": (lamps, rng.exponential(size=shape)),
    }
    return {
        name: (chd.Samples.from_array((y[..., np.newaxis] * x).astype(np.float32)), y)
        for name, (y, x) in draws.items()
    }


def errors(found, mean, truth):
    """Return MSE and relMSE in units of the mean's, each with its standard error."""
    pairs = []
    for power in (0, 1):
        weight = (truth**2 + 0.01 * truth.mean() ** 2) ** -power
        excess = weight * ((found - truth) ** 2 - (mean - truth) ** 2)
        baseline = (weight * (mean - truth) ** 2).sum()
        noise = excess.std() * np.sqrt(excess.size)
        pairs.append((1 + excess.sum() / baseline, noise / baseline))
    return pairs


def row(name, n, pairs):
    (mse, mse_error), (rel, rel_error) = pairs
    return f"{name:64}{n:5}{mse:8.2f} +-{mse_error:5.2f}{rel:8.2f} +-{rel_error:5.2f}"


def assert_no_worse(pairs):
    for error, noise in pairs:
        assert error <= 1.02 + 2 * noise


def by_thirds(order, holds):
    """Return how often intervals hold in thirds of the pixels; NaN for those that are none."""
    thirds = np.searchsorted(np.quantile(order, [1 / 3, 2 / 3]), order)
    return [holds[thirds == k].mean() if (thirds == k).any() else np.nan for k in range(3)]


def test_with_a_reference(as_benchmark):
    """Every pixel, those that trained among them: errors, bias, and the coverage of intervals.

    These hold 90 %, in thirds of the pixels by radiance and by the share of null samples, too.
    """
    print(f"\n{'':64}{'N':>5}{'MSE':>8}{'relMSE':>16}{'bias':>16}{'90 % holds':>14}")
    for name, (samples, truth) in worlds().items():
        model = Progressive().train(samples, iterations=600, progress=False)
        for n in SIZES:
            drift, held, pairs = [], [], None
            for first in range(0, min(SPP, 16 * n), n):
                x = samples.read(ss=slice(first, first + n))
                found = model.estimate(x, unit=mean_radiance(x))
                mean = x.mean(axis=-1, dtype=np.float64)
                drift.append((found.radiance.sum() - mean.sum()) / truth.sum())
                holds = (found.low <= truth) & (truth <= found.high)
                nulls = (x == 0).mean(axis=-1)
                held.append([*by_thirds(truth, holds), *by_thirds(nulls, holds)])
                pairs = errors(found.radiance, mean, truth) if pairs is None else pairs
            bias = np.mean(drift)
            noise = np.std(drift, ddof=1) / np.sqrt(len(drift)) if len(drift) > 1 else np.nan
            held = np.array(held)
            held = [
                column[np.isfinite(column)].mean()
                for column in held.T[np.isfinite(held).any(axis=0)]
            ]
            shares = "".join(f"{share:8.3f}" for share in held)
            print(row(name, n, pairs) + f"{100 * bias:+8.1f} +-{100 * noise:4.1f} %" + shares)
            assert min(held) >= 0.85
            assert_no_worse(pairs)
            of_mean = (mean - truth).std() * np.sqrt(truth.size) / truth.sum()
            assert abs(bias) <= max(0.02, 2 * of_mean)


@pytest.mark.filterwarnings("ignore::chdstat.errors.OtherSceneWarning")
def test_of_another_scene(as_benchmark):
    """Each network on all other images, at both ends of the loss weight and between them."""
    known = worlds()
    moved = asked = 0
    worse = []
    print(f"\n{'':64}{'N':>5}{'MSE':>8}{'relMSE':>16}")
    for name, (samples, _) in known.items():
        model = Progressive().train(samples, iterations=600, progress=False)
        for other, (image, truth) in known.items():
            if other == name:
                continue
            for n, loss_weight in ((4, 0.5), (16, 0.0), (16, 0.5), (16, 1.0), (64, 0.5)):
                x = image.read(ss=slice(0, n))
                found = model.predict(x, loss_weight=loss_weight)
                pairs = errors(found, x.mean(axis=-1, dtype=np.float64), truth)
                asked += 1
                if pairs[0][1] > 1e-6:
                    moved += 1
                    print(row(f"{name} on {other}", n, pairs))
                if any(error > 1.02 + 2 * noise for error, noise in pairs):
                    worse.append(row(f"{name} on {other}", n, pairs))
    print(f"the others of {asked} keep the mean: {asked - moved}")
    assert not worse, "\n".join(worse)
