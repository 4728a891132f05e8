"""Maximum likelihood against SciPy's on 10,000 random parameter sets of each family."""

import numpy as np
import pytest

from chdstat.fit import FAMILIES
from tests.fit import families_by_scipy as by_scipy


@pytest.mark.parametrize("family", FAMILIES)
def test_ten_thousand_parameter_sets(benchmark, family):
    x = by_scipy.draw(family, np.random.default_rng(33), 10_000, 200)
    compared = benchmark.pedantic(by_scipy.compare, args=(family, x), rounds=1)
    print(f"\n{family}: {compared}")
    assert compared.off == 0
