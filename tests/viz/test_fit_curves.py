"""Curves of results: what they draw is what the result says."""

from __future__ import annotations

import numpy as np
import pytest

import chdstat as chd
from chdstat import viz
from chdstat.errors import InputError
from tests.viz.figures import texts

RNG = np.random.default_rng(0)
TWO = np.where(RNG.random(800) < 0.25, 0, RNG.lognormal(np.repeat([0, 3], 400), 0.4))


@pytest.mark.parametrize("fit", [chd.fit.gamma, chd.fit.mixture])
def test_the_area_below_a_fit_is_the_share_of_positive_samples(fit):
    found = fit(TWO)
    ax = viz.fit_curve(found)
    x, y = ax.lines[0].get_data()
    assert np.trapezoid(y, np.log10(x)) == pytest.approx(1 - found.zero_share, rel=0.01)
    if fit is chd.fit.mixture:
        parts = np.nansum([line.get_ydata() for line in ax.lines[1:]], axis=0)
        np.testing.assert_allclose(parts, y)
    assert f"{100 * found.zero_share:.0f}\N{NO-BREAK SPACE}% at 0" in texts(ax.figure)


def test_a_power_law_is_a_line_of_its_slope():
    found = chd.fit.tail_index(RNG.pareto(1.25, size=(2, 4000)) + 1)
    ax = viz.tail_curve(found)
    for i, line in enumerate(ax.lines[::2]):
        x, y = np.log(line.get_data())
        slope = (y[-1] - y[-2]) / (x[-1] - x[-2])
        assert slope == pytest.approx(-1 / found.xi[i], rel=0.1)
        assert np.exp(y[0]) == pytest.approx(found.share[i])


def test_modes_stand_where_they_are():
    found = chd.modality(TWO)
    (stems,) = viz.mode_stems(found).collections
    places = [segment[0, 0] for segment in stems.get_segments()]
    np.testing.assert_allclose(places, 10 ** found.places[:2])


def test_a_notebook_shows_the_curves_of_few_rows():
    few = np.stack([TWO, 2 * TWO])
    for of in (chd.fit.lognormal, chd.fit.mixture, chd.fit.tail_index, chd.modality):
        assert "data:image/png" in of(few)._repr_html_()
    many = chd.fit.lognormal(np.stack([TWO] * 7))
    assert "data:image/png" not in many._repr_html_()
    with pytest.raises(InputError, match="at most 6 rows to draw, got 7"):
        many.plot()
    dark = chd.fit.gamma(np.zeros(9))
    assert "not fitted" in texts(dark.plot())
    assert "scale       —\n" in repr(dark)


def test_numbers_have_their_units():
    assert "W sr-1 m-2" in repr(chd.fit.gamma(TWO))
    assert "ln(W sr-1 m-2)" in repr(chd.fit.lognormal(TWO))
    assert "W sr-1 m-2" in repr(chd.fit.tail_index(TWO))
    assert "at log10 of W sr-1 m-2" in repr(chd.modality(TWO))
