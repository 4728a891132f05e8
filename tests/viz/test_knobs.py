"""Figures of a knob and of intervals: they show the numbers that they are given."""

from __future__ import annotations

import numpy as np
import pytest

from chdstat import viz
from chdstat.errors import InputError
from chdstat.metrics import Interval


def interval(*values):
    array = np.array(values)
    return Interval(array, np.full_like(array, 0.01), array - 0.02, array + 0.02)


@pytest.fixture
def measures():
    return {
        "mse_ratio": interval(0.6, 0.65, 0.8),
        "relmse_ratio": interval(0.4, 0.3, 0.2),
        "bias": interval(0.0, -0.02, -0.05),
        "improved": interval(0.6, 0.65, 0.66),
    }


def test_the_curve_runs_through_both_errors(measures):
    figure = viz.tradeoff([0, 0.5, 1], measures)
    curve = figure.axes[0].lines[0]
    assert curve.get_xdata().tolist() == [0.6, 0.65, 0.8]
    assert curve.get_ydata().tolist() == [0.4, 0.3, 0.2]
    assert [text.get_text() for text in figure.axes[0].texts] == ["0", "0.5", "1"]
    assert figure.axes[1].lines[0].get_ydata().tolist() == [0.0, -0.02, -0.05]
    assert figure.axes[0].get_legend() is None


def test_others_and_limits_are_named(measures):
    figure = viz.tradeoff([0, 0.5, 1], measures, others={"elek": (0.9, 0.7)}, limits=(0.5, 0.1))
    named = [text.get_text() for text in figure.axes[0].get_legend().get_texts()]
    assert named == ["elek", "limit"]


def test_a_place_of_the_knob_without_a_number_is_left_out(measures):
    measures["bias"] = interval(np.nan, -0.02, -0.05)
    viz.tradeoff([0, 0.5, 1], measures).canvas.draw()


def test_a_knob_without_a_place_is_refused():
    with pytest.raises(InputError, match="at least one place"):
        viz.tradeoff([], {})


@pytest.mark.parametrize("measured", [(0.5, 0.9), (0.02, 0.3), (np.nan, np.nan)])
def test_coverage_shows_what_was_measured_beside_what_was_stated(measured):
    figure = viz.map_grid([viz.coverage([0.5, 0.9], {"ours": measured}, title="Coverage")])
    axes = figure.axes[0]
    figure.canvas.draw()
    assert axes.lines[1].get_ydata() == pytest.approx(measured, nan_ok=True)
    assert axes.get_xlim()[0] == axes.get_ylim()[0] < 0.5
