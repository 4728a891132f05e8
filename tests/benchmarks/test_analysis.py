"""The whole analysis against the obvious loop, one pass of np.log, and itself on more of the same.

The loop takes a random part of the distributions, in one process; the analysis all of them, with
as many threads as there are cores. What is compared is the time per distribution, a distribution
being the samples of one channel of one pixel, luminance included, as `analyze` takes it.
"""

from __future__ import annotations

import os
import runpy
import time
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import pytest

import chdstat as chd
from chdstat._core.positive import PositivePart
from chdstat.fit.families import SELECTED, FamilyFit
from chdstat.fit.goodness_of_fit import GoodnessOfFit
from chdstat.fit.selection import FamilySelection
from chdstat.fit.tail import TailIndex
from chdstat.inference import TESTS, TRANSFORMS
from chdstat.inference.averages import NormalityOfMeans, sizes_of_means
from chdstat.inference.modes import ModalMixture
from chdstat.inference.normality import Normality
from chdstat.summary.runner import measured

characterize = runpy.run_path(Path(__file__).with_name("obvious_loop.py"))["characterize"]

ROWS = 48
"""Distributions that the loop takes."""


@pytest.fixture(scope="module")
def samples():
    return chd.render("bathroom", spp=512, size=(96, 96), backend="scalar")


def seconds(work: Callable[[], object]) -> tuple[float, float]:
    """Return wall and processor time of a piece of work."""
    wall, cpu = time.perf_counter(), time.process_time()
    work()
    return time.perf_counter() - wall, time.process_time() - cpu


def report(benchmark, figures: Mapping[str, float]) -> None:
    benchmark.extra_info.update(figures)
    print()
    for name, value in figures.items():
        print(f"{name}: {value:.3g}")


def analysed(samples: chd.Samples) -> None:
    chd.analyze(samples, progress=False)


def looped(rows: np.ndarray, chosen: np.ndarray) -> None:
    for index in chosen:
        characterize(rows[index])


def test_against_the_obvious_loop(benchmark, samples):
    x = samples.read()
    luminance = np.float32([[0.212671, 0.715160, 0.072169]]) @ x
    rows = np.concatenate([x, luminance], axis=-2).reshape(-1, samples.spp)
    chosen = np.random.default_rng(0).choice(len(rows), ROWS, replace=False)
    analysed(chd.Samples.from_array(x[:16, :16]))  # imports and tables
    # Interleaved, so that both see the same machine.
    halves = np.array_split(chosen, 2)
    loop = [seconds(lambda: looped(rows, halves[0]))]
    wall, cpu = benchmark.pedantic(lambda: seconds(lambda: analysed(samples)), rounds=1)
    loop.append(seconds(lambda: looped(rows, halves[1])))
    of_loop = sum(w for w, _ in loop) / ROWS
    positive = rows[rows > 0]
    _, log = seconds(lambda: np.log(positive))
    report(
        benchmark,
        {
            "distributions": len(rows),
            "positive samples of each": round(positive.size / len(rows)),
            "cores": len(os.sched_getaffinity(0)),
            "loop, ms per distribution": of_loop * 1e3,
            "analyze, ms per distribution": wall / len(rows) * 1e3,
            "loop / analyze, wall time": of_loop / (wall / len(rows)),
            "loop / analyze, processor time": sum(c for _, c in loop) / ROWS / (cpu / len(rows)),
            "analyze, passes of np.log (processor time)": cpu / log,
        },
    )


def test_cost_of_each_statistic(as_benchmark, samples):
    """Each after those before it, of whose work it is part: fits are those of the selection."""
    families = [FamilyFit(chd.fit.FAMILIES[name]) for name in SELECTED]
    sizes = tuple(sizes_of_means(samples.spp).tolist())
    statistics = [*families, FamilySelection(held_out=True), GoodnessOfFit()]
    statistics += [TailIndex(), ModalMixture(), Normality(tuple(TRANSFORMS), tuple(TESTS))]
    part = PositivePart.of_pixels(samples.read()[:32, :32].copy())
    work: dict[str, Callable[[], object]] = {
        "split": lambda: PositivePart.of_pixels(samples.read()[:32, :32].copy()),
        "sorted": lambda: part.sorted,
        "logarithms": lambda: part.log_sorted,
        "sums": lambda: part.log_statistics,
        **{
            f"{type(s).__name__} {s.subject}": lambda s=s: measured(part, s)
            for s in [*statistics, NormalityOfMeans(sizes)]
        },
    }
    print(f"\nus of processor time per channel of {samples.spp} samples")
    for name, act in work.items():
        _, cpu = seconds(act)
        print(f"{name:34}{1e6 * cpu / part.n.size:8.1f}")


def test_linear_in_pixels(benchmark, samples):
    x = samples.read()
    one = chd.Samples.from_array(x[:48, :48])
    four = chd.Samples.from_array(np.tile(x[:48, :48], (2, 2, 1, 1)))
    first, _ = seconds(lambda: analysed(one))
    wall, _ = benchmark.pedantic(lambda: seconds(lambda: analysed(four)), rounds=1)
    again, _ = seconds(lambda: analysed(one))
    report(benchmark, {"time for 4 times the pixels": wall / ((first + again) / 2)})


def test_histogram_route_does_not_depend_on_spp(benchmark, samples):
    x = samples.read()[:48, :48]
    few, many = (chd.histogram(chd.Samples.from_array(y)) for y in (x, np.tile(x, 8)))

    def fitted(counts: object) -> None:
        chd.fit.select(counts)
        chd.fit.mixture(counts, effort="fast")

    fitted(few)
    first, _ = seconds(lambda: fitted(few))
    wall, _ = benchmark.pedantic(lambda: seconds(lambda: fitted(many)), rounds=1)
    again, _ = seconds(lambda: fitted(few))
    report(benchmark, {"time for 8 times the spp": wall / ((first + again) / 2)})
