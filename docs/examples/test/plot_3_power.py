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
    "log-normal, linear": ("linear", lambda size: rng.lognormal(0, 0.12, size=size)),
    "two modes, on logs": ("log", lambda size: rng.lognormal(rng.choice([-1.1, 1.1], size=size))),
    "heavy tails, on logs": ("log", lambda size: np.exp(rng.standard_t(8, size=size))),
}

# %%
# Tests of normality
# ------------------
#
# The power is the share of rejections at a level of 5 %. Samples lie on the last axis, so that 200
# repeats are one call.

CALLED = {
    "anderson-darling": "Anderson-Darling",
    "shapiro-wilk": "Shapiro-Wilk",
    "dagostino": "D'Agostino",
    "kolmogorov-smirnov": "Kolmogorov-Smirnov",
    "cramer-von-mises": "Cramér-von Mises",
}
LEVEL, REPEATS = 0.05, 200
sizes = 2 ** np.arange(5, 12)


def power(draw, transform):
    p = [
        chd.gaussianity(draw((REPEATS, n)), transform=transform, test=tuple(TESTS)).p_value
        for n in sizes
    ]
    return dict(zip(TESTS, (np.array(p) < LEVEL).mean(axis=1).T, strict=True))


def panel(sizes, shares):
    curves = {CALLED.get(test, test): (np.log2(sizes), y) for test, y in shares.items()}
    return PlotData("curves", curves, "log2 of the samples", "share of rejections")


powers = {name: power(draw, transform) for name, (transform, draw) in shapes.items()}
viz.finding_plots({name: panel(sizes, shares) for name, shares in powers.items()})

# %%
# Which test is best depends on the shape; Shapiro-Wilk is the default for averages in
# `chdstat.inference.gaussianity_of_means`.

needed = {}
for name, shares in powers.items():
    enough = np.flatnonzero(np.asarray(shares["shapiro-wilk"]) > 0.9)
    needed[name] = str(sizes[enough[0]]) if enough.size else f"more than {sizes[-1]}"
sentence = (
    "A test that does not reject proves little from few samples: to find nine in ten departures, "
    f"Shapiro-Wilk needs {needed['gamma body, on logs']} samples of a gamma body, "
    f"{needed['two modes, on logs']} of two close modes and {needed['heavy tails, on logs']} of "
    "slightly heavy tails."
)
print(sentence)

# %%
# A negative control: logarithms of log-normal samples are Gaussian, and each test should reject 5 %
# of them, whatever the number of samples.

print(f"standard error of each share: {np.sqrt(LEVEL * (1 - LEVEL) / REPEATS):.3f}")

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
    "two parts, as Weibull": (
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
# Chi-square ignores where in its bin a sample lies.
#
# **Next:** `Do surface features tell where the noise is? <plot_4_features.html>`_
