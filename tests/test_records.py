"""Records: what is written comes back the same, and what is no record is refused."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

import chdstat as chd
from chdstat._records import read_record, write_record
from chdstat.atlases import Atlas
from chdstat.comparison import Comparison
from chdstat.errors import StoreError
from chdstat.findings import Evidence, Finding
from chdstat.findings.registry import find
from chdstat.recipes import Region


@pytest.fixture(scope="module")
def samples():
    return chd.simulate("gamma", size=(8, 8), spp=128)


def same(one, other):
    """Whether two results are alike in type, value and shape, NaN included."""
    np.testing.assert_equal(vars(other), vars(one))


def test_findings_come_back_with_all_that_they_show(samples, tmp_path):
    found = tuple(find(Evidence("box", samples, (Region("wall", "diffuse", (0, 0, 1, 1)),))))
    back = read_record(write_record(tmp_path / "f.npz", found), tuple[Finding, ...])
    assert [f.to_dict() for f in back] == [f.to_dict() for f in found]
    for one, other in zip(found, back, strict=True):
        same(one.exhibit, other.exhibit)
        assert [part.verdict for part in one.parts] == [part.verdict for part in other.parts]
        assert math.isinf(one.parts[0].most) == math.isinf(other.parts[0].most) if one.parts else 1


def test_atlases_and_comparisons_come_back(samples, tmp_path):
    shapes = chd.atlas(samples, clusters=2)
    same(shapes, read_record(write_record(tmp_path / "a.npz", shapes), Atlas))
    compared = replace(chd.compare(samples, ["mean", "median_of_means"], n=32), models={})
    back = read_record(write_record(tmp_path / "c.npz", compared), Comparison)
    np.testing.assert_equal(back.table(), compared.table())
    assert back.estimates.dtype == np.float32


def test_what_is_no_record_is_refused_by_name(samples, tmp_path):
    path = tmp_path / "a.npz"
    with pytest.raises(StoreError, match=r"a\.npz is no record"):
        read_record(path, Atlas)
    path.write_bytes(b"PK nothing")
    with pytest.raises(StoreError, match=r"a\.npz is no record"):
        read_record(path, Atlas)
    write_record(path, {"one": 1})
    with pytest.raises(StoreError, match=r"a\.npz is no record"):
        read_record(path, tuple[Finding, ...])


@dataclass
class Holder:
    """Something with a field."""

    what: Any


@pytest.mark.parametrize("what", [np.array([print]), {1, 2}, print], ids=["objects", "set", "code"])
def test_what_would_need_a_pickle_is_not_written(what, tmp_path):
    path = write_record(tmp_path / "a.npz", Holder(3))
    with pytest.raises(TypeError, match="a record holds numbers, words and arrays"):
        write_record(path, Holder(what))
    assert read_record(path, Holder).what == 3
    assert list(tmp_path.iterdir()) == [path]
