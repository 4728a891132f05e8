"""Light that one render aims at and the other meets by chance: when a difference is no evidence."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import chdstat as chd
from chdstat.inference import contrast
from chdstat.inference.rare_light import RareLight

EDGE, SPP = 32, 48


def light() -> np.ndarray:
    """Return means (y, x, 1): dim in one corner, bright in the other."""
    ramp = np.linspace(-2.5, 0, EDGE)
    return 10 ** (ramp[:, np.newaxis] + ramp)[..., np.newaxis] / 4


def aimed(seed: int, mean: np.ndarray) -> chd.Samples:
    """Return samples that aim at the light: all carry some of it."""
    x = np.random.default_rng(seed).gamma(4.0, size=(EDGE, EDGE, 1, SPP)) / 4
    return chd.Samples.from_array(x * mean[..., np.newaxis])


def met(seed: int, mean: np.ndarray, size: float = 8.0) -> chd.Samples:
    """Return samples that meet it by chance, and are then this large."""
    hits = np.random.default_rng(seed).random((EDGE, EDGE, 1, SPP)) < mean[..., np.newaxis] / size
    return chd.Samples.from_array(size * hits)


def test_right_renders_do_not_differ():
    """At most 2 of 10 pairs are told to differ: more is a chance of 1 in 87 if 1 in 20 of them is.

    Without the rule, all of them are.
    """
    outcomes = []
    for seed in range(10):
        given = met(seed, light()), aimed(100 + seed, light())
        outcomes.append(contrast(*given[:: 1 - 2 * (seed % 2)]))
    assert sum(found.outcome == "differ" for found in outcomes) <= 2
    unsure = [found for found in outcomes if found.outcome == "cannot tell"]
    for found in unsure:
        assert "so rare" in found.why or "rarely" in found.why
        assert found.spp_needed is None or found.spp_needed > SPP


def test_a_few_calm_pixels_around_do_not_tell_how_rare_the_rest_of_the_light_is():
    """At most 2 of 6 pairs are told to differ: more is a chance of 1 in 450 if 1 in 20 of them is.

    By the calm pixels alone, 4 are.
    """
    square, outcomes = np.s_[2:6, 18:22], []
    for seed in range(2, 8):
        x = met(seed, light()).read().copy()
        x[square] = aimed(30 + seed, light()).read()[square]
        outcomes.append(contrast(chd.Samples.from_array(x), aimed(60 + seed, light())).outcome)
    assert outcomes.count("differ") <= 2


def test_lost_light_is_found_however_rare_samples_are():
    assert contrast(met(1, 0.4 * light()), aimed(2, light())).outcome == "differ"
    square = light()
    square[20:30, 4:14] = 0
    assert contrast(aimed(1, square), aimed(2, light())).outcome == "differ"
    assert contrast(aimed(1, 0.95 * light()), aimed(2, light())).outcome == "differ"


@pytest.mark.parametrize(("deficit", "expected"), [(2.0, 0.25), (16.0, 2.0), (32.0, None)])
def test_a_difference_is_worth_so_many_samples(deficit, expected):
    """A black window of 2 x 2 pixels beside pixels with samples of size 8."""
    mean_a, spread_a = np.full((30, 30, 1), 0.08), np.full((30, 30, 1), 0.64)
    mean_a[10:12, 10:12] = spread_a[10:12, 10:12] = 0
    mean_b = np.full((30, 30, 1), deficit / 4 / SPP)
    maps = {"mean_a": mean_a, "mean_b": mean_b, "spread_a": spread_a, "spread_b": 1e-6 * mean_b}
    found = RareLight(maps, (SPP, SPP))
    unmet = found.in_window(slice(10, 12), slice(10, 12), 0)
    assert found.in_pixels()[10, 10, 0]
    if expected is None:
        assert unmet is None
    else:
        assert unmet.render == 0
        assert unmet.expected == pytest.approx(expected)
        assert unmet.needed(SPP) == pytest.approx(SPP * 3 / expected, abs=2, rel=0.01)
    # Nothing is explained if B meets its light there as rarely, or lacks less than half of it.
    spread_b = 8 * mean_b
    same = RareLight({**maps, "spread_b": spread_b}, (SPP, SPP))
    assert same.in_window(slice(10, 12), slice(10, 12), 0) is None
    mean_a[10:12, 10:12] = 0.6 * mean_b[10:12, 10:12]
    assert RareLight(maps, (SPP, SPP)).in_window(slice(10, 12), slice(10, 12), 0) is None


def test_words_name_the_direction_that_was_tested():
    """Calm pixels of B are 7 % darker; a few bright samples of a noisy block hide that."""
    rng = np.random.default_rng(4)
    x, y = rng.gamma(4.0, size=(2, EDGE, EDGE, 1, 64)) / 4
    y *= 0.93
    for samples in (x, y):
        samples[12:20, 12:20] = 30 * rng.lognormal(0.0, 2.0, size=(8, 8, 1, 64))
    y[14, 15, 0, 7] += 1e5
    found = contrast(chd.Samples.from_array(x), chd.Samples.from_array(y))
    assert found.outcome == "differ"
    assert found.window_brighter == "A"
    if found.window_loss > 0:
        assert "darker" in found.conclusion
    of_whole = replace(found, window=(0, 0, EDGE, EDGE))
    assert "render B is darker by pixels of little noise" in of_whole.conclusion
    assert "brighter" in of_whole.conclusion
