"""How many modes are found: of hard edges, of clamps, and of two modes.

Run with ``pytest benchmarks/test_modes.py --benchmark-only -s``.
"""

import numpy as np
import pytest
from scipy import stats

import chdstat as chd
from tests.inference.test_modes import CLAMPED, HARD_EDGED

ROWS = 400
SPP = (128, 512, 2048, 8192)
SEPARATIONS, WEIGHTS, POWER_SPP = (3.0, 3.5, 4.0), (0.2, 0.3, 0.5), (128, 512, 2048)


def shares(draw, spp):
    """Return how often 1, 2 and 3 modes are found in `ROWS` rows, and how often the dip rejects."""
    rng = np.random.default_rng(spp)
    modes, p = [], []
    for _ in range(4):  # 8192 samples of all rows are more than need be held at once
        found = chd.modality(draw(rng, (ROWS // 4, spp)))
        modes.append(found.modes)
        p.append(found.dip_p_value)
    modes = np.concatenate(modes)
    return *(np.mean(modes == k) for k in (1, 2, 3)), np.mean(np.concatenate(p) < 0.05)


def two_log_modes(separation, weight):
    def draw(rng, size):
        return np.exp(rng.normal(size=size) + separation * (rng.random(size) < weight))

    return draw


@pytest.mark.parametrize("spp", SPP)
@pytest.mark.parametrize("laws", [HARD_EDGED, CLAMPED], ids=["hard edges", "clamps"])
def test_ends_are_no_modes(as_benchmark, laws, spp):
    """At most 5 % of rows, but for what chance adds to 5 % of 400 in one case of 1000."""
    print(f"\n{'one mode':34}{'spp':>6}{'> 1 mode':>10}{'dip':>7}")
    wrong = []
    for name, draw in laws.items():
        one, *_, dip = shares(draw, spp)
        wrong += [1 - one, dip]
        print(f"{name:34}{spp:6}{100 * (1 - one):9.1f}%{100 * dip:6.1f}%")
    assert max(wrong) <= stats.binom.isf(1e-3, ROWS, 0.05) / ROWS


@pytest.mark.parametrize("spp", POWER_SPP)
def test_two_log_modes_are_found(as_benchmark, spp):
    print(f"\n{'two modes':34}{'spp':>6}{'found':>8}")
    for separation in SEPARATIONS:
        for weight in WEIGHTS:
            _, two, _, _ = shares(two_log_modes(separation, weight), spp)
            name = f"{separation:g} sigma apart, weight {weight:g}"
            print(f"{name:34}{spp:6}{100 * two:7.1f}%")
            if (separation, weight, spp) == (3.0, 0.5, 512):
                assert two >= 0.95
