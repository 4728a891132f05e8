"""The study: how long it takes from nothing and once more, and whether three seeds agree.

All built-in scenes at the size of their recipes. CHDSTAT_STUDY names a folder that keeps the
renders, which takes 4 GB; what it holds already is not timed. Without it, nothing is kept, and it
takes an hour.
"""

import os
import time
from collections import Counter

import pytest

import chdstat as chd

SEEDS = 1, 2, 3


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return os.environ.get("CHDSTAT_STUDY") or tmp_path_factory.mktemp("study")


def timed(work):
    start = time.perf_counter()
    found = work()
    return found, time.perf_counter() - start


def test_time_from_nothing_and_once_more(benchmark, folder, tmp_path):
    def study():
        return chd.study(folder=folder)

    (_, first), (found, again) = timed(study), timed(study)
    _, typeset = timed(lambda: found.save_pdf(tmp_path / "study.pdf"))
    benchmark.pedantic(study, rounds=1)
    print(
        f"\n{len(found.names)} scenes: {first:.0f} s, once more {again:.1f} s, PDF {typeset:.1f} s"
    )
    assert again < 60


def test_three_seeds_agree(benchmark, folder):
    studies = [chd.study(folder=folder, seed=seed) for seed in SEEDS]
    rows = benchmark.pedantic(lambda: [s.table() for s in studies], rounds=1)
    alike = Counter()
    print()
    for same in zip(*rows, strict=True):
        for scene in (*studies[0].names, "all scenes"):
            verdicts = [row[scene] for row in same]
            alike[len(set(verdicts))] += bool(verdicts[0])
            if len(set(verdicts)) > 1:
                print(f"{same[0]['number']:>3} {scene:12s} {', '.join(verdicts)}")
    print(f"{alike[1]} of {alike.total()} verdicts are the same for all of {len(SEEDS)} seeds")
    opposite = [
        (a["number"], scene)
        for a, b, c in zip(*rows, strict=True)
        for scene in studies[0].names
        if {"supported", "not supported"} <= {a[scene], b[scene], c[scene]}
    ]
    assert not opposite
