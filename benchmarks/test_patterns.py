"""How often the flags of the patterns are right, by the number of samples.

Run with ``pytest --benchmark-only -s benchmarks/test_patterns.py``.
"""

import numpy as np
import pytest

from tests.patterns.flag_scores import flag_scores, random_chds

SAMPLES = (64, 128, 256, 512, 1024, 2048, 4096)
DEFINITIONS = ("constant", "firefly_dominated")
LEAST = {128: 0.85, 512: 0.95}


@pytest.fixture(scope="module")
def population():
    return random_chds(3000, seed=31)


@pytest.mark.parametrize("samples", SAMPLES)
def test_flags_of_a_population(benchmark, population, samples):
    scores = benchmark.pedantic(flag_scores, args=(population, samples), rounds=1)
    macro = np.mean([score.f1 for score in scores.values()])
    tested = [score.f1 for name, score in scores.items() if name not in DEFINITIONS]
    print(f"\n{samples} samples that are not null: macro-F1 {macro:.3f}")
    print(f"  without the flags that are definitions {np.mean(tested):.3f}")
    print(f"  {'flag':18s} precision recall    F1  cases")
    for name, score in scores.items():
        cases = score.hits + score.missed
        print(f"  {name:18s} {score.precision:9.3f} {score.recall:6.3f} {score.f1:5.3f} {cases:6d}")
    assert macro >= LEAST.get(samples, 0)
