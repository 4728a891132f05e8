"""Files of a comparison: all of them, or none."""

import errno

import numpy as np
import pytest
from matplotlib.figure import Figure

import chdstat as chd
from chdstat.errors import StoreError
from chdstat.reporting.figures import save_comparison


@pytest.fixture(scope="module")
def found():
    rng = np.random.default_rng(0)
    samples = chd.Samples.from_array(rng.exponential(size=(4, 4, 3, 64)))
    return chd.compare(samples, ["mean"], n=4, progress=False)


def test_a_comparison_is_there_when_it_is_complete(found, tmp_path, monkeypatch):
    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    target = tmp_path / "new" / "found"
    with monkeypatch.context() as patch:
        patch.setattr(Figure, "savefig", full)
        with pytest.raises(StoreError, match="cannot write to .*found: No space left"):
            save_comparison(found, target)
    assert list(target.parent.iterdir()) == []
    written = save_comparison(found, target)
    assert {"comparison.json", "comparison.zarr", "measures.pdf"} <= {p.name for p in written}
    assert list(target.parent.iterdir()) == [target]
    with pytest.raises(StoreError, match="nothing was overwritten"):
        save_comparison(found, target)
