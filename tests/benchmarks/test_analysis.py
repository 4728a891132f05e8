"""What each statistic of an analysis costs."""

from __future__ import annotations

import time
from collections.abc import Callable

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


@pytest.fixture(scope="module")
def samples():
    return chd.render("bathroom", spp=512, size=(96, 96), backend="scalar")


def seconds(work: Callable[[], object]) -> float:
    """Return the processor time of a piece of work."""
    start = time.process_time()
    work()
    return time.process_time() - start


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
        print(f"{name:34}{1e6 * seconds(act) / part.n.size:8.1f}")
