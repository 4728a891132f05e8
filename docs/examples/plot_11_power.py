"""
How many samples does a test need?
==================================

A test that does not reject says little unless it would have rejected something else. How many
samples do the tests of normality and of fit need to detect the shapes that CHDs have?
"""

# %%
# Four shapes that are close to Gaussian after their transform: a gamma body is skewed to the dark
# side on a log scale, a narrow log-normal one to the bright side on a linear scale, two close modes
# merge into a flat top, and Student's t has slightly heavy tails on both sides.

import numpy as np

import chdstat as chd
from chdstat import viz
from chdstat.fit.goodness_of_fit import FIT_TESTS
from chdstat.inference import TESTS
from chdstat.inference.findings import PlotData

rng = np.random.default_rng(5)
shapes = {
    "gamma body, on logs": ("log", lambda size: rng.gamma(8.0, size=size)),
    "log-normal body, linear": ("linear", lambda size: rng.lognormal(0, 0.12, size=size)),
    "two modes, on logs": ("log", lambda size: rng.lognormal(rng.choice([-1.1, 1.1], size=size))),
    "heavy tails, on logs": ("log", lambda size: np.exp(rng.standard_t(8, size=size))),
}

# %%
# Tests of normality
# ------------------
#
# The power is the share of rejections at a level of 5 %. Samples lie on the last axis, so that 300
# repeats are one call.

LEVEL, REPEATS = 0.05, 300
sizes = 2 ** np.arange(5, 12)


def power(draw, transform):
    p = [
        chd.gaussianity(draw((REPEATS, n)), transform=transform, test=tuple(TESTS)).p_value
        for n in sizes
    ]
    return dict(zip(TESTS, (np.array(p) < LEVEL).mean(axis=1).T, strict=True))


def panel(sizes, shares):
    curves = {test: (np.log2(sizes), share) for test, share in shares.items()}
    return PlotData("curves", curves, "log2 of the samples", "share of rejections")


viz.finding_plots(
    {name: panel(sizes, power(draw, transform)) for name, (transform, draw) in shapes.items()}
)

# %%
# Shapiro-Wilk is among the best against every shape, and is the default for averages in
# `chdstat.inference.gaussianity_of_means`. D'Agostino is good against two modes. Anderson-Darling
# is close to these where the departure is in the middle, less so where it is in the tails.
#
# A negative control: logarithms of log-normal samples are Gaussian, and each test should reject 5 %
# of them, whatever the number of samples. With 300 repeats, this is known to 1.3 %.

for test, shares in power(lambda size: rng.lognormal(size=size), "log").items():
    print(f"{test:17}", "  ".join(f"{share:.3f}" for share in shares))

# %%
# Tests of fit
# ------------
#
# `chdstat.fit.goodness` asks whether samples are of a family whose parameters are estimated from
# them. The first panel is again a negative control.

few = sizes[:5]
bodies = {
    "gamma, as gamma": ("gamma", lambda size: rng.gamma(2.0, size=size)),
    "gamma, as log-normal": ("lognormal", lambda size: rng.gamma(2.0, size=size)),
    "heavy tenth, as Weibull": (
        "weibull",
        lambda size: rng.exponential(np.where(rng.random(size) < 0.1, 4.0, 1.0)),
    ),
}


def fit_power(draw, family):
    p = [chd.fit.goodness(draw((80, n)), family, resamples=59).p_value for n in few]
    return dict(zip(FIT_TESTS, (np.array(p) <= LEVEL).mean(axis=1).T, strict=True))


viz.finding_plots(
    {name: panel(few, fit_power(draw, family)) for name, (family, draw) in bodies.items()}
)

# %%
# Anderson-Darling comes first, most clearly where the difference lies in a tail. Chi-square ignores
# where in its bin a sample lies, and comes last.
#
# **Next:** `A map of patterns <plot_15_patterns.html>`_
