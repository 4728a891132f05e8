"""What the benchmarks share."""

import pytest


@pytest.fixture
def as_benchmark(benchmark):
    """Skip a test with the benchmarks that prints more than one time: quality, beside cost."""
    benchmark.pedantic(lambda: None, rounds=1)
