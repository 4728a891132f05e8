"""Maximum likelihood is SciPy's, for random parameters, wherever SciPy's search ends."""

import numpy as np
import pytest

import chdstat as chd
from chdstat.errors import Reason
from chdstat.fit import FAMILIES
from tests.fit import families_by_scipy as by_scipy


@pytest.mark.parametrize("family", FAMILIES)
def test_maximum_likelihood_equals_scipy(family):
    """The whole comparison, 10,000 sets of each, is benchmarks/test_scipy.py."""
    x = by_scipy.draw(family, np.random.default_rng(31), 30, 200)
    compared = by_scipy.compare(family, x)
    assert compared.both > 22
    assert compared.off == 0
    assert compared.likelihood_lost < 1e-9


@pytest.mark.parametrize("family", by_scipy.EQUATIONS)
def test_likelihood_equations_are_solved(family):
    """SciPy's search feels the likelihood, not its slope: the equations in 40 digits are exact."""
    x = by_scipy.draw(family, np.random.default_rng(34), 8, 200)
    fit = chd.fit.fit(x, family)
    for i in np.flatnonzero(fit.reason == Reason.OK):
        ours = {name: float(values[i]) for name, values in fit.parameters.items()}
        exact = by_scipy.exact_fit(family, x[i], ours)
        for name, value in exact.items():
            assert ours[name] == pytest.approx(value, rel=1e-6, abs=1e-8)
