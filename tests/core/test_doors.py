"""Doors: every result that can be asked for its plot draws it, and nothing is loaded before."""

import subprocess
import sys

import numpy as np
import pytest

import chdstat as chd
from chdstat import viz
from chdstat._core.display import Shown
from chdstat._core.doors import Door, draw
from chdstat.errors import InputError


def kinds(of: type) -> set[type]:
    return {of} | {kind for below in of.__subclasses__() for kind in kinds(below)}


def test_every_result_with_a_plot_is_drawn():
    _ = chd.bench, chd.report, viz
    plotted = {k for k in kinds(Shown) if hasattr(k, "plot") and not k.__name__.startswith("_")}
    assert {"Tail", "Fit", "Contrast", "Breakdown"} <= {kind.__name__ for kind in plotted}
    for kind in plotted:
        with pytest.raises((AttributeError, InputError)):  # of the result, which is empty
            draw(object.__new__(kind))


def test_a_result_draws_though_nothing_else_is_imported():
    code = (
        "import sys, numpy as np\n"
        "from chdstat.fit import gamma\n"
        "found = gamma(np.random.default_rng(0).gamma(2.0, size=64))\n"
        "assert 'chdstat.viz' not in sys.modules\n"
        "print(len(found.plot().axes))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "1"


def test_a_figure_is_drawn_into_if_one_is_given():
    found = chd.fit.gamma(np.random.default_rng(0).gamma(2.0, size=64))
    figure = found.plot()
    assert found.plot(fig=figure) is figure
    assert len(figure.axes) == 2


def test_what_nobody_draws_is_refused_by_name():
    with pytest.raises(InputError, match=r"can be drawn, .*Tail.*, got ndarray"):
        draw(np.ones(3))


def test_an_implementation_of_a_subclass_comes_first():
    told: Door[str] = Door("tell", "told")
    told.register(int, lambda _: "a number")
    told.register(bool, lambda _: "a truth")
    assert (told(1), told(True)) == ("a number", "a truth")
