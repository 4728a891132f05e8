"""What the estimators cost, as multiples of one pass over the samples."""

import numpy as np
import pytest

import chdstat as chd
from chdstat.estimators import MLP


@pytest.fixture(scope="module")
def samples():
    rng = np.random.default_rng(0)
    return rng.gamma(0.5, size=(200, 200, 3, 32)).astype(np.float32)


@pytest.mark.parametrize("name", chd.estimators.names("fixed"))
def test_fixed_estimators(benchmark, samples, name):
    benchmark(chd.estimators.lookup(name), samples)


def test_learned_estimate(benchmark, samples):
    model = MLP.preset("elek2019").train(
        chd.Samples.from_array(np.tile(samples[:16, :16], 2)), iterations=1
    )
    benchmark(model.predict, samples)


@pytest.mark.slow
def test_published_training(benchmark):
    rng = np.random.default_rng(0)
    picture = chd.Samples.from_array(rng.gamma(0.5, size=(128, 128, 3, 256)).astype(np.float32))
    benchmark.pedantic(MLP.preset("elek2019").train, args=(picture,), rounds=1)
