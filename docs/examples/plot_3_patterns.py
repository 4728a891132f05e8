"""
A map of patterns
=================

The same few kinds of distributions recur over an image. `chdstat.classify` says which pixels are
null-heavy, long-tailed, bimodal, multimodal, constant or dominated by a firefly, and whether gamma
or log-normal describes the rest.
"""

# %%
# Render, then classify every pixel
# ---------------------------------
#
# Statistics of a single pixel need many samples; 512 are few for a tail, but enough for a map.
# The result is a Dataset: open *Data variables* to see what there is, with its explanation.

import numpy as np
from matplotlib.figure import Figure

import chdstat as chd
from chdstat import viz
from chdstat.patterns import PATTERNS, flag_scores, random_chds

samples = chd.render("bathroom", spp=512, size=(64, 64), seed=4, backend="scalar")
patterns = chd.classify(samples)
patterns

# %%
# What the flags say
# ------------------
#
# Each flag is a statistic and an effect that is large enough to matter; where the rule says so, a
# test that is corrected for the number of pixels must agree. The table `chdstat.patterns.PATTERNS`
# explains them, and `chdstat.patterns.Thresholds` sets when an effect counts.

for pattern in PATTERNS:
    share = float(patterns[pattern.name].mean())
    print(f"{pattern.name:17} {share:4.0%}  {pattern.meaning}")

# %%
# The map
# -------
#
# Flags do not exclude each other; the label is the first that holds.

label = patterns["label"]
meanings = [name.replace("_", " ") for name in label.attrs["flag_meanings"].split()]
names = dict(zip(label.attrs["flag_values"], meanings, strict=True))
figure = viz.map_grid(3)
left, middle, right = figure.axes
viz.categorical_map(label, names, title="Label", ax=left)
viz.value_map(patterns["null_heavy_statistic"], title="Share of nulls", limits=(0, 1), ax=middle)
tail = patterns["long_tail_statistic"]
viz.value_map(tail, title=r"Tail index $\xi$", limits=(-0.25, 0.75), ax=right)
figure

# %%
# The window is constant: every sample of it is the same sky. Away from it, most paths are null in
# most pixels. Bimodal pixels gather on the floor and the tub, where part of the paths see the sun.
# The tail index of a single pixel is uncertain, by a tenth or two with so few positive samples; the
# flag asks that it is significantly above 0.
#
# Do the labels mean something?
# -----------------------------
#
# Labels that are noise look like the same labels shuffled. Agreement with the neighbours is kappa:
# 0 for shuffled labels, 1 if all neighbours agree; z counts standard deviations from shuffled.
# Labels are a hard decision, so that pixels near a threshold differ from their neighbours although
# their distributions do not: look at the statistics, too. Where
# Ashman's D is grey there is one mode; where it is below 2, modes overlap, and set no flag.

agreement = patterns["label_agreement"]
print("pairs of neighbours with one label: {observed:.0%}".format(**agreement.attrs))
print("of shuffled labels: {by_chance:.0%}".format(**agreement.attrs))
print("kappa {kappa:.2f}, z {z:.0f}".format(**agreement.attrs))
figure = viz.map_grid(3)
left, middle, right = figure.axes
viz.value_map(agreement, title="Neighbours that agree", limits=(0, 1), ax=left)
largest = patterns["firefly_dominated_statistic"]
viz.value_map(largest, title="Share of the largest sample", limits=(0, 0.5), ax=middle)
viz.value_map(patterns["bimodal_statistic"], title="Ashman's D of modes", limits=(0, 6), ax=right)
figure

# %%
# How often are the flags right?
# ------------------------------
#
# On a render, nobody knows. `chdstat.patterns.random_chds` draws distributions that have every
# pattern and their combinations, with a documented zone around each threshold left out, where there
# is nothing to tell. F1 is the harmonic mean of precision and recall.

sizes = 2 ** np.arange(6, 13)
population = random_chds(400, seed=31)
scores = [flag_scores(population, int(n)) for n in sizes]
f1 = {pattern.name: [score[pattern.name].f1 for score in scores] for pattern in PATTERNS}
macro = np.mean(list(f1.values()), axis=0)

colors = dict(zip(f1, viz.PALETTE, strict=True))
with viz.style():
    figure = Figure(figsize=(6.7, 2.9), layout="constrained")
    axes = figure.subplots()
    for (name, values), mark in zip(f1.items(), "os^vDP*X", strict=True):
        label = name.replace("_", " ")
        axes.plot(sizes, values, marker=mark, markersize=4, color=colors[name], label=label)
    axes.plot(sizes, macro, color="black", linewidth=2, label="mean")
    axes.set_xscale("log", base=2)
    axes.set_xticks(sizes, [str(n) for n in sizes])
    axes.minorticks_off()
    axes.set(xlabel="samples that are not null", ylabel="F1", ylim=(0.4, 1.02))
    figure.legend(loc="outside right center")
figure

# %%
# The mean hides that flags differ. Shares of nulls are told from few samples, fireflies and
# constants are so by definition. Tails need more: of 64 samples, 24 at most are in the tail. And
# whether a body is log-normal or gamma is hard to say of 128 samples, unless it is wide.

for n, value in zip(sizes, macro, strict=True):
    print(f"{n:5} samples: {value:.3f}")
