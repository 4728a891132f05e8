"""StatER beside StatMC, Bayesian collaborative denoising, Open Image Denoise and our estimate.

``--benchmark-only -s`` prints, for each scene, number of samples and estimator: relMSE and MSE over
those of StatMC (`sakai2024`) with intervals of 95 % over blocks of pixels, and how much the image
is too bright. The parts of StatER (`sakai2025`) follow, each on its own. The second test prints the
same at equal processor time: all have as long as the slowest needs from the largest number of
samples, render included, and draw samples in what their own estimate leaves. Last come geometric
means over the scenes, and the largest bias.

`rendered` names the scenes and where they are kept; CHDSTAT_NUMBERS are numbers of samples, apart
by commas, and CHDSTAT_SEEDS is how many seeds. A failure: StatER whose relMSE is, in the geometric
mean over the scenes at the same number of samples, above StatMC's, or an image of it whose sum is
off by more than 5 % at equal time.
"""

from __future__ import annotations

import os
import time
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
import pytest

import chdstat as chd
from benchmarks.rendered import SIZE, Rendered, scenes
from benchmarks.rows import errors_of
from chdstat.comparison import Judge
from chdstat.comparison.estimator_choice import Entry, choose, estimate_by
from chdstat.estimators import Estimator, sakai2025
from chdstat.scenes.builtin import BUILTIN
from chdstat.studies.claims import SceneData

NUMBERS = tuple(int(n) for n in os.environ.get("CHDSTAT_NUMBERS", "16,64").split(","))
SEEDS = int(os.environ.get("CHDSTAT_SEEDS", "1"))
BASE, OURS = "sakai2024", "sakai2025"
COMPARED = (BASE, OURS, "boughida2017", "mean + OIDN features", "combination", "mean")


def step(name: str, *, film: bool = False, **options: Any) -> Estimator:
    """Return StatER with some of its parts."""
    function = partial(sakai2025, **options)
    uses = {"uses_neighbours": True, "uses_features": True, "uses_film": film}
    return Estimator(name, function, "this benchmark", minimum_samples=3, **uses)


STEPS = (
    step("fourth roots alone", transforms=[0.25], variances="own"),
    step("samples and fourth roots", variances="own"),
    step("roots, averaged variances", transforms=[0.5]),
    step("roots, places", transforms=[0.5], variances="own", film=True),
    step("all but places"),
)
"""Parts of StatER, each without the others; roots are those of StatMC, whose correction for
skewness is left out."""

Images = Mapping[str, np.ndarray]


def made(entries: Mapping[str, Entry], samples: chd.Samples) -> tuple[Images, dict[str, float]]:
    """Return the image of each estimator, and the processor time that it took."""
    x, images, seconds = samples.read(), {}, {}
    for name, entry in entries.items():
        start = time.process_time()
        images[name] = estimate_by(entry, x, features=samples.features, film=samples.film)
        seconds[name] = time.process_time() - start
    return images, seconds


class Table:
    """Errors over those of StatMC, of scenes and estimators."""

    def __init__(self) -> None:
        self.ratios: dict[tuple[str, str], list[list[float]]] = {}
        self.bias: dict[tuple[str, str], list[float]] = {}

    def add(
        self, scene: str, at: str, runs: Sequence[Images], judge: Judge, x: chd.Samples
    ) -> None:
        """Print the rows of a scene."""
        errors = {
            name: np.stack([errors_of(run[name], judge) for run in runs])
            .mean(axis=(0, -1))
            .reshape(2, -1)
            for name in runs[0]
        }
        whole = SceneData(x.name, x).whole()
        for name, own in errors.items():
            mse, relative = (whole.ratio(a, b) for a, b in zip(own, errors[BASE], strict=True))
            bias = np.mean([run[name] for run in runs]) / judge.mean.mean() - 1
            shown = "  ".join(
                f"{r.value:5.2f} [{r.low:.2f}, {r.high:.2f}]" for r in (relative, mse)
            )
            print(f"{scene:24}{at:>12}  {name:26}{shown:44}{bias:+7.1%}", flush=True)
            self.ratios.setdefault((at, name), []).append([relative.value, mse.value])
            self.bias.setdefault((at, name), []).append(bias)

    def mean(self, at: str, name: str) -> np.ndarray:
        """Return the geometric means of relMSE and MSE over those of StatMC."""
        return np.exp(np.log(np.clip(self.ratios[at, name], 0.01, 100)).mean(axis=0))

    def summary(self) -> None:
        """Print the geometric means, and the largest bias."""
        print()
        for at, name in self.ratios:
            relative, mse = self.mean(at, name)
            worst = max(self.bias[at, name], key=abs)
            print(f"{at:>12}  {name:26} relMSE {relative:5.2f}  MSE {mse:5.2f}  bias {worst:+.1%}")


def seconds_per_sample(scene: str) -> float:
    """Return the processor time of a sample of each pixel, once kernels are compiled."""
    took = []
    for spp in (16, 64):
        start = time.process_time()
        chd.render(scene, spp=spp, size=(SIZE, SIZE), seed=7, progress=False)
        took.append(time.process_time() - start)
    return took[1] / 64


@pytest.fixture(scope="module")
def rendered(tmp_path_factory) -> list[Rendered]:
    return scenes(tmp_path_factory.mktemp("rendered"), tuple(BUILTIN))


def test_at_equal_samples(as_benchmark, rendered):
    entries, table = choose([*COMPARED, *STEPS], NUMBERS).entries, Table()
    print(f"\n{SIZE} x {SIZE}, {SEEDS} seeds; relMSE and MSE over those of {BASE}, bias")
    for one in rendered:
        judge = one.reference()
        renders = [one.samples(i, max(NUMBERS), film=True) for i in range(SEEDS)]
        for n in NUMBERS:
            runs = [made(entries, render.first(n))[0] for render in renders]
            table.add(one.name, f"{n} spp", runs, judge, renders[0])
    table.summary()
    assert all(table.mean(f"{n} spp", OURS)[0] <= 1 for n in NUMBERS)


def test_at_equal_time(as_benchmark, rendered):
    entries, table = choose(COMPARED, NUMBERS).entries, Table()
    print(f"\n{SIZE} x {SIZE}, {SEEDS} seeds; relMSE and MSE over those of {BASE}, bias")
    for one in rendered:
        judge, first = one.reference(), one.samples(0, max(NUMBERS), film=True)
        made(entries, first.isel(y=slice(16), x=slice(16), sample=slice(16)))  # loads networks
        taken, cost = made(entries, first.first(max(NUMBERS)))[1], seconds_per_sample(one.scene)
        whole = max(NUMBERS) * cost + max(taken.values())
        numbers = {name: int((whole - seconds) / cost) for name, seconds in taken.items()}
        drawn = ", ".join(f"{name} {n} in {taken[name]:.1f} s" for name, n in numbers.items())
        print(f"{one.name:24}{whole:.1f} s of processor time; samples and estimates: {drawn}")
        renders = [one.samples(i, max(numbers.values()), film=True) for i in range(SEEDS)]
        runs = [
            {name: made({name: entries[name]}, r.first(n))[0][name] for name, n in numbers.items()}
            for r in renders
        ]
        table.add(one.name, "equal time", runs, judge, renders[0])
    table.summary()
    assert abs(np.array(table.bias["equal time", OURS])).max() <= 0.05
