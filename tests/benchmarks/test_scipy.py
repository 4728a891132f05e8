"""Maximum likelihood against SciPy's on 10,000 random parameter sets of each family."""

import runpy
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from chdstat.fit import FAMILIES

HELPERS = Path(__file__).parents[1] / "fit" / "families_by_scipy.py"
BY_SCIPY = SimpleNamespace(**runpy.run_path(HELPERS))


@pytest.mark.parametrize("family", FAMILIES)
def test_ten_thousand_parameter_sets(benchmark, family):
    x = BY_SCIPY.draw(family, np.random.default_rng(33), 10_000, 200)
    compared = benchmark.pedantic(BY_SCIPY.compare, args=(family, x), rounds=1)
    print(f"\n{family}: {compared}")
    assert compared.off == 0
