"""What the estimators cost: time per estimate, and multiples of one pass over the samples."""

import time

import numpy as np
import pytest

import chdstat as chd
from chdstat.estimators import MLP


@pytest.fixture(scope="module")
def samples():
    rng = np.random.default_rng(0)
    return rng.gamma(0.5, size=(200, 200, 3, 32)).astype(np.float32)


@pytest.fixture(scope="module")
def one_pass(samples):
    """Seconds that reading all samples once takes."""
    return min(_seconds(samples.sum) for _ in range(10))


def _seconds(work):
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


@pytest.mark.parametrize("name", chd.estimators.names("fixed"))
def test_fixed_estimators(benchmark, samples, one_pass, name):
    entry = chd.estimators.lookup(name)
    benchmark.pedantic(entry, args=(samples,), rounds=3, warmup_rounds=1)
    seconds = benchmark.stats.stats.min
    per_estimate = 1e6 * seconds / samples[..., 0].size
    benchmark.extra_info.update(microseconds=per_estimate, passes=seconds / one_pass)
    marks = [m for m in ("uses_neighbours", "joint_channels") if getattr(entry, m)]
    print(
        f"\n{name:26s} {per_estimate:6.2f} us per estimate of 32 samples, "
        f"{seconds / one_pass:6.0f} passes over the data  {' '.join(marks)}"
    )


def test_learned_estimate(benchmark, samples):
    model = MLP.preset("elek2019").train(
        chd.Samples.from_array(np.tile(samples[:16, :16], 2)), iterations=1
    )
    benchmark(model.predict, samples)


def test_published_training(benchmark):
    rng = np.random.default_rng(0)
    image = chd.Samples.from_array(rng.gamma(0.5, size=(128, 128, 3, 256)).astype(np.float32))
    benchmark.pedantic(MLP.preset("elek2019").train, args=(image,), rounds=1)
