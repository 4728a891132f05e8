"""The registry: what is entered is found, by name and as an attribute."""

import numpy as np
import pytest

import chdstat as chd
from chdstat import estimators
from chdstat.errors import InputError
from chdstat.estimators import registry
from chdstat.explorer.batch_estimates import batches_of, estimates
from chdstat.viz.styling import NAMES


@pytest.fixture
def brightest():
    @estimators.register("brightest", source="this test", minimum_samples=2)
    def function(x):
        return x.max(axis=-1)

    yield function
    registry.forget("brightest")


def test_a_registered_name_is_an_attribute(brightest):
    assert estimators.brightest is brightest
    registry.forget("brightest")
    with pytest.raises(AttributeError, match="brightest"):
        estimators.brightest  # noqa: B018
    estimators.register("brightest", source="again")(brightest)


def test_a_name_is_given_once(brightest):
    with pytest.raises(InputError, match="registered already"):
        estimators.register("brightest", source="twice")(np.max)


def test_a_cell_of_a_notebook_is_run_again():
    """So is a module that is loaded anew; the second definition counts."""
    cell = "@register('bright', source='a cell')\ndef bright(x):\n    return {} * x.max(axis=-1)\n"
    names = {"register": estimators.register, "__name__": "__main__"}
    for factor in (1, 2):
        exec(cell.format(factor), names)
        assert estimators.bright([1.0, 3.0]) == 3 * factor
    registry.forget("bright")


def test_a_row_has_a_label_and_a_place():
    @estimators.register("darkest", source="this test", label="the darkest", place=1)
    def function(x):
        return x.min(axis=-1)

    listed = estimators.names()
    assert listed.index("median") < listed.index("darkest") < listed.index("huber")
    assert NAMES["darkest"] == "the darkest"
    assert estimators.darkest is function
    samples = chd.Samples.from_array(np.random.default_rng(0).gamma(1, size=(9, 9, 3, 64)))
    assert chd.compare(samples, ["mean", "darkest"], progress=False).estimators[1] == "darkest"
    x = samples.read()[0, 0]
    assert "darkest" in {found.name for found in estimates(batches_of(x, 32))}
    registry.forget("darkest")
    assert "darkest" not in NAMES
