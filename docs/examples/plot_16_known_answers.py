"""
How often are the flags right?
==============================

On a render nobody knows the true pattern of a pixel. How reliable are the flags of
`chdstat.classify` on distributions whose patterns are known?
"""

# %%
# `chdstat.patterns.random_chds` draws distributions with every pattern and their combinations. It
# leaves out zones around the thresholds, where neither answer would be wrong.

import numpy as np

import chdstat as chd
from chdstat import viz
from chdstat.patterns import PATTERNS, flag_scores, random_chds

sizes = 2 ** np.arange(6, 11)
chds = random_chds(200, seed=31)
scores = [flag_scores(chds, int(n)) for n in sizes]

# %%
# F1 is the harmonic mean of precision, the share of flags that are right, and recall, the share of
# patterns that are flagged.

f1 = {p.name: [score[p.name].f1 for score in scores] for p in PATTERNS}
viz.curves(sizes, {"F1 of each flag": f1})

# %%
# A share of nulls is clear from few samples; a constant or a dominating firefly is a matter of
# definition. Tails and modes need more samples. Whether a body is gamma-like or log-normal-like
# needs most, unless it is wide.

for n, of_flags in zip(sizes, np.transpose(list(f1.values())), strict=True):
    print(f"{n:5} samples: mean F1 {of_flags.mean():.2f}, worst {of_flags.min():.2f}")

# %%
# An image of known distributions
# -------------------------------
#
# `chdstat.simulate` makes an image in which every pixel has one known distribution, for tests of
# your own.

samples = chd.simulate("lognormal", shape=(16, 16), spp=512)
print(chd.classify(samples)["lognormal_like"].mean().item())

# %%
# **Next:** `An atlas of distributions <plot_17_atlas.html>`_.
