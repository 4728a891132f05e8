"""How far curves are from histograms: that of `Pixel.curve`, and that of the family of least BIC.

200 pixels of eight scenes, as many of each label as there are. The distance is the total variation
between the shares of the samples in bins of a tenth of a decade and those that the curve expects
there: 0 where they agree, 1 where they share nothing. What chance makes of it is printed, too.

A failure: where the samples have several modes, more than half of the distance of the family that
BIC selects; elsewhere, more than its; no curve for more than a tenth of the pixels that have enough
different samples; or a curve for samples that it does not describe.
Run with ``pytest --benchmark-only -s benchmarks/test_curves.py``.
"""

from __future__ import annotations

import itertools
from collections import defaultdict
from dataclasses import dataclass

import numpy as np
import pytest

import chdstat as chd
from chdstat.fit.curves import Curve
from chdstat.fit.selection import FamilySelection
from chdstat.inference.modes import Modes
from chdstat.patterns import Label, Pixel

SCENES = ("bathroom", "caustic", "cornell-box", "day-room", "fog", "gallery", "many-lights",
          "night-room")  # fmt: skip
SPP, EDGE, FIRST_SEED, PIXELS = 1024, 40, 5200, 200
_OF_LABEL = 30
"""Most pixels of one label and scene."""


@dataclass(frozen=True)
class Drawn:
    """The luminance of a pixel: label, curve, modes, and distances of rule, family and chance."""

    label: str
    pixel: Pixel
    curve: Curve
    modes: int
    distance: float
    of_family: float
    by_chance: float


def chosen() -> list[tuple[str, Pixel]]:
    """Return pixels, as many of each label as there are, by label."""
    rng, places = np.random.default_rng(52), defaultdict(list)
    for number, scene in enumerate(SCENES):
        seed, size = FIRST_SEED + number, (EDGE, EDGE)
        samples = chd.render(scene, spp=SPP, size=size, seed=seed, progress=False)
        labels = chd.classify(samples, progress=False)["label"].to_numpy()
        for label in np.unique(labels):
            those = rng.permutation(np.argwhere(labels == label))[:_OF_LABEL]
            places[Label(int(label)).words] += [samples.pixel(*map(int, place)) for place in those]
    for label in places:
        places[label] = [places[label][i] for i in rng.permutation(len(places[label]))]
    turns = ((i, label) for i in range(PIXELS) for label in places if i < len(places[label]))
    taken = sorted((label, i) for i, label in itertools.islice(turns, PIXELS))
    return [(label, places[label][i]) for label, i in taken]


def measured(label: str, pixel: Pixel) -> Drawn:
    counted = pixel.histograms["log"]
    row, width = len(pixel.names) - 1, float(counted.bin_width[-1])
    seen = counted.density[row] * width
    family = pixel.measured(FamilySelection()).best_fit(row)

    def distance(curve: Curve) -> float:
        expected = curve.density(counted.centers[row], width, "log") * width
        return float(np.abs(expected - seen).sum() + abs(expected.sum() - seen.sum())) / 2

    curve = pixel.curve(row)
    chance = np.sqrt(2 * seen * (1 - seen) / np.pi / max(1, pixel.part.n[row])).sum() / 2
    modes = int(pixel.measured(Modes()).modes[row])
    return Drawn(label, pixel, curve, modes, distance(curve), distance(Curve(family)), chance)


@pytest.fixture(scope="module")
def drawn() -> list[Drawn]:
    return [measured(*one) for one in chosen()]


def test_curves_follow_histograms(as_benchmark, drawn):
    print(f"\n{'':18} pixels  no curve   rule  family  chance   (mean total variation)")
    several = [d for d in drawn if d.modes > 1 and np.isfinite(d.distance)]
    groups = {
        label: [d for d in drawn if d.label == label] for label in sorted({d.label for d in drawn})
    }
    one = [d for d in drawn if d.modes == 1 and np.isfinite(d.distance)]
    groups |= {"several modes": several, "one mode": one}
    for name, those in groups.items():
        known = [d for d in those if np.isfinite(d.distance)]
        means = [np.mean([getattr(d, n) for d in known]) if known else np.nan
                 for n in ("distance", "of_family", "by_chance")]  # fmt: skip
        print(f"{name:18} {len(those):6} {len(those) - len(known):9} "
              + " ".join(f"{mean:7.3f}" for mean in means))  # fmt: skip
    reasons = [d.curve.reason for d in drawn if d.curve.fit is None]
    print({reason: reasons.count(reason) for reason in sorted({*reasons})})
    assert len(drawn) == PIXELS
    assert mean_of(several, "distance") <= 0.5 * mean_of(several, "of_family")
    assert mean_of(one, "distance") <= mean_of(one, "of_family")
    assert reasons.count("no family fits") <= 0.1 * (len(several) + len(one))


def mean_of(drawn: list[Drawn], name: str) -> float:
    return float(np.mean([getattr(d, name) for d in drawn]))
