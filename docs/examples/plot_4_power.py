"""
Which test sees what
====================

A test that does not reject says little unless it would have rejected something else. How many
samples does each of the three tests of `chdstat.gaussianity` need, against shapes that CHDs have?
And those of `chdstat.fit.goodness`?
"""

# %%
# Four shapes, each close to Gaussian after its transform
# -------------------------------------------------------
#
# A gamma body looks skewed to the left on a log scale, a narrow log-normal one to the right on a
# linear scale. Two equal modes two deviations apart just merge into one flat top, and Student's t
# with eight degrees of freedom has a slightly heavy tail on both sides of the log scale.

import numpy as np
from matplotlib.figure import Figure

import chdstat as chd
from chdstat import viz
from chdstat.inference import TESTS

rng = np.random.default_rng(5)
shapes = {
    "gamma body, on logs": ("log", lambda size: rng.gamma(8.0, size=size)),
    "log-normal body, linear": ("linear", lambda size: rng.lognormal(0, 0.12, size=size)),
    "two modes, on logs": ("log", lambda size: rng.lognormal(rng.choice([-1.1, 1.1], size=size))),
    "heavy tail, on logs": ("log", lambda size: np.exp(rng.standard_t(8, size=size))),
}

# %%
# The power is the share of rejections. The samples lie on the last axis, so that 400 repeats are
# one call, and the three tests share their work.

LEVEL, REPEATS = 0.05, 400
sizes = 2 ** np.arange(5, 12)


def power(draw, transform, n):
    found = chd.gaussianity(draw((REPEATS, n)), transform=transform, test=tuple(TESTS))
    return (found.p_value < LEVEL).mean(axis=0)


curves = {
    name: np.array([power(draw, transform, n) for n in sizes])
    for name, (transform, draw) in shapes.items()
}

# %%
# First, what they should not see: the logarithms of log-normal samples. All three reject as often
# as they were told to, whatever the number of samples; with 400 repeats, 0.05 is known to 0.011.

null = np.array([power(lambda size: rng.lognormal(size=size), "log", n) for n in sizes])
print("n".rjust(5), *(f"{test:>17}" for test in TESTS))
for n, shares in zip(sizes, null, strict=True):
    print(f"{n:5}", *(f"{share:17.3f}" for share in shares))

# %%
# Power curves
# ------------
#
# Each test has a colour and a mark of its own.

marks = dict(zip(TESTS, "osD", strict=True))
colors = dict(zip(TESTS, (viz.PALETTE[i] for i in (4, 5, 2)), strict=True))
with viz.style():
    figure = Figure(figsize=(6.7, 4.4), layout="constrained")
    for axes, (name, curve) in zip(
        figure.subplots(2, 2, sharex=True, sharey=True).flat, curves.items(), strict=True
    ):
        for test, values in zip(TESTS, curve.T, strict=True):
            axes.plot(
                sizes, values, marker=marks[test], markersize=3.5, color=colors[test], label=test
            )
        axes.axhline(LEVEL, color="#888888", linewidth=0.8, linestyle=":")
        axes.set_xscale("log", base=2)
        axes.set_xticks(sizes, [str(n) for n in sizes])
        axes.minorticks_off()
        axes.set(title=name, ylim=(0, 1.03))
    for axes in figure.axes[2:]:
        axes.set_xlabel("samples")
    for axes in figure.axes[::2]:
        axes.set_ylabel("share of rejections")
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=3)
figure

# %%
# Shapiro-Wilk is among the best against every shape. D'Agostino weighs both sides of the kurtosis
# alike, which helps against two modes. Anderson-Darling is close to these in the middle of a
# distribution, less so in its tails.
#
# So take Shapiro-Wilk where samples are few; it is the default for the averages of
# `chdstat.inference.gaussianity_of_means`. How many samples give a power of 80 %?

for name, curve in curves.items():
    enough = [sizes[c > 0.8][0] if (c > 0.8).any() else "more" for c in curve.T]
    print(f"{name:24}", "  ".join(f"{t} {n}" for t, n in zip(TESTS, enough, strict=True)))

# %%
# Tests of fit
# ------------
#
# The four tests of `chdstat.fit.goodness` ask whether samples are of a family whose parameters are
# estimated from them; their p-values come from a bootstrap. Again a negative control first: gamma
# samples, tested as such, are rejected at the level.

from chdstat.fit.goodness_of_fit import FIT_TESTS

ROWS = 200
fit_sizes = sizes[:5]
bodies = {
    "gamma, as gamma": ("gamma", lambda size: rng.gamma(2.0, size=size)),
    "gamma, as log-normal": ("lognormal", lambda size: rng.gamma(2.0, size=size)),
    "exponential with a heavier tenth, as Weibull": (
        "weibull",
        lambda size: rng.exponential(np.where(rng.random(size) < 0.1, 4.0, 1.0)),
    ),
}


def fit_power(draw, family, n):
    found = chd.fit.goodness(draw((ROWS, n)), family, resamples=99)
    return (found.p_value <= LEVEL).mean(axis=0)


fit_curves = {
    name: np.array([fit_power(draw, family, n) for n in fit_sizes])
    for name, (family, draw) in bodies.items()
}
with viz.style():
    figure = Figure(figsize=(6.7, 2.6), layout="constrained")
    for axes, (name, curve) in zip(
        figure.subplots(1, 3, sharey=True), fit_curves.items(), strict=True
    ):
        for i, (test, values) in enumerate(zip(FIT_TESTS, curve.T, strict=True)):
            color = viz.PALETTE[(7, 2, 4, 5)[i]]
            axes.plot(fit_sizes, values, marker="vDos"[i], markersize=3.5, color=color, label=test)
        axes.axhline(LEVEL, color="#888888", linewidth=0.8, linestyle=":")
        axes.set_xscale("log", base=2)
        axes.set_xticks(fit_sizes, [str(n) for n in fit_sizes])
        axes.minorticks_off()
        axes.set(ylim=(0, 1.03), xlabel="samples")
        axes.set_title(name.replace(", ", ",\n"))
    figure.axes[0].set_ylabel("share of rejections")
    figure.legend(*axes.get_legend_handles_labels(), loc="outside upper center", ncols=4)
figure

# %%
# Anderson-Darling comes first, most clearly where the difference lies in a tail. Chi-square throws
# away where in its cell a sample lies, and comes last.
