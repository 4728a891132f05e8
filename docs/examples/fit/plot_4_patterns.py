"""
A map of patterns
=================

Which kinds of distributions occur in an image, and where?
"""

# %%
# `chdstat.classify` says which pixels are null-heavy, long-tailed, bimodal, multimodal, constant or
# dominated by a firefly, and whether gamma or log-normal describes them well.

import chdstat as chd
from chdstat import viz
from chdstat.patterns import PATTERNS

samples = chd.render("bathroom", spp=192, size=(48, 48), seed=4, backend="scalar")
patterns = chd.classify(samples)
for pattern in PATTERNS:
    share = float(patterns[pattern.name].mean())
    print(f"{pattern.name:17} {share:4.0%}  {pattern.meaning}")

# %%
# Each flag is a statistic that is large enough to matter; where the rule says so, a test corrected
# for the number of pixels must agree. Flags do not exclude each other, and the label is the first
# that holds.

figure = viz.map_grid(2, columns=2)
left, right = figure.axes
viz.categorical_map(patterns["label"], title="Label", ax=left)
viz.value_map(patterns["null_heavy_statistic"], title="Share of nulls", limits=(0, 1), ax=right)
figure

# %%
# The window is constant: every sample of it is the same sky. Pixels with two modes gather on the
# floor and in the tub, where part of the paths see the sun.
#
# Do the labels mean something?
# -----------------------------
#
# Labels that are noise look like the same labels shuffled. Kappa measures the agreement of
# neighbours: 0 for shuffled labels, 1 if all neighbours agree. A label is a hard decision, so that
# pixels near a threshold differ from their neighbours although their distributions do not.

shares = {p.name: float(patterns[p.name].mean()) for p in PATTERNS}
agreement = patterns["label_agreement"]
print(
    "neighbours with the same label: {observed:.0%}, shuffled {by_chance:.0%}, "
    "kappa {kappa:.2f}".format(**agreement.attrs)
)
sentence = (
    f"Every pixel gets the name of its pattern: {shares['null_heavy']:.0%} of this bathroom are "
    f"null-heavy, {shares['firefly_dominated']:.0%} rest on one sample, and "
    f"{shares['bimodal']:.0%} are bimodal. Neighbours agree in "
    f"{agreement.attrs['observed']:.0%} of the pairs, where shuffled labels would agree in "
    f"{agreement.attrs['by_chance']:.0%}."
)
print(sentence)

# %%
# **Next:** `An atlas of distributions <plot_5_atlas.html>`_, which needs no thresholds.
