"""
A map of patterns
=================

The same few kinds of distributions recur over an image. `chdstat.classify` says which pixels are
null-heavy, long-tailed, bimodal or constant, and which family fits the rest.
"""

# %%
# Render, then classify every pixel
# ---------------------------------
#
# Statistics of a single pixel need many samples; 512 are few for a tail, but enough for a map.
# The result is a Dataset: open *Data variables* to see what there is, with its explanation.

import chdstat as chd
from chdstat import viz
from chdstat.patterns import PATTERNS

samples = chd.render("bathroom", spp=512, size=(64, 64), seed=4, backend="scalar")
patterns = chd.classify(samples)
patterns

# %%
# What the flags say
# ------------------
#
# Each flag is a statistic, a test that is corrected for the number of pixels, and an effect that is
# large enough to matter. The table `chdstat.patterns.PATTERNS` explains them.

for pattern in PATTERNS:
    share = float(patterns[pattern.name].mean())
    print(f"{pattern.name:10} {share:4.0%}  {pattern.meaning}")

# %%
# The map
# -------
#
# Flags do not exclude each other; the label is the first that holds.

label = patterns["label"]
meanings = [name.replace("_", " ") for name in label.attrs["flag_meanings"].split()]
names = dict(zip(label.attrs["flag_values"], meanings, strict=True))
viz.map_grid(
    [
        viz.categorical_map(label, names, title="Label"),
        viz.value_map(patterns["null_heavy_statistic"], title="Share of nulls", limits=(0, 1)),
        viz.value_map(patterns["bimodal_statistic"], title="Hartigan's dip"),
    ]
)

# %%
# The window is constant: every sample of it is the same sky. Away from it, most paths are null, and
# where they are not, a gamma distribution is more often the better one of the two families. Bimodal
# pixels gather where part of the paths see the sun, as at the edges of its light. The dip alone
# does not set the flag: it is noisy where few samples are positive, and its p-value knows that.
