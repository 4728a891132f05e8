import matplotlib.pyplot as plt

import chdstat as chd
from chdstat import viz
from chdstat.patterns import CHDS, PATTERNS

shown = {
    "null_heavy": "null-heavy",
    "long_tail": "long-tail",
    "bimodal": "bimodal",
    "multimodal": "multimodal",
    "gamma_like": "gamma",
    "lognormal_like": "lognormal",
    "firefly_dominated": "firefly",
    "constant": "constant",
}
short = {
    "null_heavy": "nulls",
    "long_tail": "misses",
    "bimodal": "D",
    "multimodal": "second D",
    "gamma_like": "z",
    "lognormal_like": "z",
    "firefly_dominated": "largest sample",
    "constant": "log spread",
}
fig, axes = plt.subplots(2, 4, figsize=(6.7, 2.8), layout="constrained")
for ax, pattern in zip(axes.flat, PATTERNS, strict=True):
    x = CHDS[shown[pattern.name]].draw(samples=1024, seed=2)
    found = chd.classify(x[None])  # of one channel
    assert found.flags[pattern.name]
    viz.chd_axes(chd.histogram(x), names=["samples"], ax=ax)
    value = f"{short[pattern.name]} {found.statistics[pattern.name]:.2g}"
    ax.set_title(pattern.name.replace("_", "-"), loc="left", fontweight="bold")
    ax.set_xlabel(value)
fig
