"""Files are whole or not there, records come back the same, and workers keep the order."""

from __future__ import annotations

import errno
import math
import os
import subprocess
import sys
import tempfile
import threading
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import chdstat as chd
from chdstat._core.files import Lock, read_record, replacing, room, scratch, sweep, write_record
from chdstat._core.work import in_order
from chdstat.comparison import Comparison
from chdstat.errors import StoreError
from chdstat.patterns import Atlas
from chdstat.samples.tiles import Region
from chdstat.studies.claims import Finding, SceneData, find


@pytest.fixture(scope="module")
def samples():
    return chd.simulate("gamma", shape=(8, 8), spp=128)


def same(one, other):
    """Whether two results are alike in type, value and shape, NaN included."""
    np.testing.assert_equal(vars(other), vars(one))


def test_findings_come_back_with_all_that_they_show(samples, tmp_path):
    found = tuple(find(SceneData("box", samples, (Region("wall", "diffuse", (0, 0, 1, 1)),))))
    back = read_record(write_record(tmp_path / "f.npz", found), tuple[Finding, ...])
    assert [f.to_dict() for f in back] == [f.to_dict() for f in found]
    for one, other in zip(found, back, strict=True):
        same(one.plot_data, other.plot_data)
        assert [test.verdict for test in one.tests] == [test.verdict for test in other.tests]
        assert math.isinf(one.tests[0].most) == math.isinf(other.tests[0].most) if one.tests else 1


def test_atlases_and_comparisons_come_back(samples, tmp_path):
    shapes = chd.atlas(samples, clusters=2)
    same(shapes, read_record(write_record(tmp_path / "a.npz", shapes), Atlas))
    compared = replace(chd.compare(samples, ["mean", "median_of_means"], n=32), models={})
    back = read_record(write_record(tmp_path / "c.npz", compared), Comparison)
    np.testing.assert_equal(back.table(), compared.table())
    assert back.estimates.dtype == np.float32


def test_what_is_no_record_is_refused_by_name(samples, tmp_path):
    path = tmp_path / "a.npz"
    with pytest.raises(StoreError, match=r"a\.npz"):
        read_record(path, Atlas)
    path.write_bytes(b"PK nothing")
    with pytest.raises(StoreError, match=r"a\.npz"):
        read_record(path, Atlas)
    write_record(path, {"one": 1})
    with pytest.raises(StoreError, match=r"a\.npz"):
        read_record(path, tuple[Finding, ...])


@dataclass
class Holder:
    """Something with a field."""

    what: Any


@pytest.mark.parametrize("what", [np.array([print]), {1, 2}, print], ids=["objects", "set", "code"])
def test_what_would_need_a_pickle_is_not_written(what, tmp_path):
    path = write_record(tmp_path / "a.npz", Holder(3))
    with pytest.raises(TypeError, match="numbers, words and arrays"):
        write_record(path, Holder(what))
    assert read_record(path, Holder).what == 3
    assert list(tmp_path.iterdir()) == [path]


# --- files that are written ---------------------------------------------------------------------


KILLED = """
import os, pathlib, signal, sys
from chdstat._core.files import Lock, replacing, scratch
place = pathlib.Path(sys.argv[1])
lock = Lock(place / ".lock", "the folder")
b = replacing(place / "b", folder=True)
with scratch() as folder, replacing(place / "a.json") as file, b as b:
    for part in (folder / "x", file, b / "x"):
        part.write_text("half")
    if sys.argv[2] == "killed":
        os.kill(os.getpid(), signal.SIGKILL)
    print("ready", flush=True)
    sys.stdin.read()
"""


def started(place: Path, how: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-c", KILLED, str(place), how]
    return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)


def written(place: Path) -> None:
    """Write what `KILLED` began."""
    lock = Lock(place / ".lock", "the folder")
    with scratch(), replacing(place / "a.json") as file, replacing(place / "b", folder=True) as b:
        for part in (file, b / "x"):
            part.write_text("whole")
    lock.release()


@pytest.fixture
def temporary(tmp_path, monkeypatch):
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setenv("TMPDIR", str(folder))
    monkeypatch.setattr(tempfile, "tempdir", None)
    return folder


def test_killed_processes_leave_nothing(tmp_path, temporary):
    place = tmp_path / "place"
    place.mkdir()
    (place / "a.json").write_text("before")
    started(place, "killed").communicate()
    assert len(list(place.iterdir())) == 4
    assert len(list(temporary.iterdir())) == 1
    assert (place / "a.json").read_text() == "before"
    written(place)
    assert sorted(p.name for p in place.iterdir()) == ["a.json", "b"]
    assert (place / "b/x").read_text() == (place / "a.json").read_text() == "whole"
    assert list(temporary.iterdir()) == []


def test_what_a_living_process_writes_stays(tmp_path, temporary):
    place = tmp_path / "place"
    place.mkdir()
    other = started(place, "alive")
    assert other.stdout.readline() == "ready\n"
    before = {p.name for p in (*place.iterdir(), *temporary.iterdir())}
    with pytest.raises(StoreError, match=f"process {other.pid}"):
        Lock(place / ".lock", "the folder")
    sweep(place)
    with scratch(), replacing(place / "a.json"):
        pass
    assert {p.name for p in (*place.iterdir(), *temporary.iterdir())} == before | {"a.json"}
    other.communicate("")
    assert sorted(p.name for p in place.iterdir()) == ["a.json", "b"]
    Lock(place / ".lock", "the folder").release()


def test_what_is_not_written_whole_is_not_there(tmp_path):
    for folder in (False, True):
        with pytest.raises(KeyError), replacing(tmp_path / "a", folder=folder):
            raise KeyError
    assert list(tmp_path.iterdir()) == []


# --- workers --------------------------------------------------------------------------------------


def test_results_come_in_the_order_of_the_items():
    later = threading.Event()

    def first_waits(i):
        assert i or later.wait(timeout=600)
        later.set()
        return i

    assert list(in_order(first_waits, range(8), workers=4)) == list(range(8))


def test_an_error_ends_the_work_in_its_place():
    begun = []

    def fail_at_three(i):
        begun.append(i)
        if i == 3:
            message = "three"
            raise ValueError(message)
        return i

    results = in_order(fail_at_three, range(1000), workers=2)
    assert [next(results) for _ in range(3)] == [0, 1, 2]
    with pytest.raises(ValueError, match="three"):
        next(results)
    assert len(begun) < 10


def test_items_are_taken_only_as_results_are_asked_for():
    taken = []

    def items():
        for i in range(100):
            taken.append(i)
            yield i

    results = in_order(abs, items(), workers=2)
    next(results)
    assert len(taken) <= 4
    results.close()


def test_a_full_disk_is_an_error(tmp_path, monkeypatch):
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "posix_fallocate", full, raising=False)
    with pytest.raises(StoreError, match="4 MB"):
        room((1000, 1000), "f4", tmp_path)
    assert not list(tmp_path.iterdir())
