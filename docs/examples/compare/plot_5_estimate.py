"""
A better image without a reference
==================================

A render has no reference: its samples are all there is. How do these say which of several images is
nearest to the truth?
"""

# %%
# The first 32 samples of each pixel are the render. All others only judge it at the end.
#
# `chdstat.estimate` weights candidates pixel by pixel: the mean, a mean over pixels of similar
# distributions, and what a denoiser makes of both. Candidates made of one half of the samples are
# compared with the mean of the other half. That mean is noisy, but its expectation is the truth.
# Mean, estimate and the mean of all samples, under one exposure:

# sphinx_gallery_panel = 1, 2
import chdstat as chd
from chdstat import viz

samples = chd.render("night-room", spp=160, size=(80, 80), seed=6, backend="scalar")
few = samples.first(32)
found = chd.estimate(few, progress=False)
mean = few.read().mean(axis=-1)
viz.side_by_side(
    {"mean of 32": mean, "estimate": found.radiance, "mean of all": samples.read().mean(axis=-1)}
)

# %%
# How much closer it is, `chdstat.compare` measures against the other samples, without their noise:


def told(x):
    """Return a number with its interval."""
    return f"{x.value:.2g} ({x.low:.2g} to {x.high:.2g})"


judged = chd.compare(samples, ["mean", "combination"], max_batches=1, progress=False)
error = judged.measures["relmse_ratio"][1, -1]
verdict = (
    "closer to the truth than" if error.high < 1
    else "farther from the truth than" if error.low > 1
    else "not surely closer to the truth than"
)  # fmt: skip
sentence = (
    f"From the same 32 samples, without a reference, the estimate is {verdict} their mean: its "
    f"relative squared error is {told(error)} times that of the mean."
)
print(sentence)
judged

# %%
# The weights of the candidates, which sum to 1 in every pixel:

weights = found.weights
names = {"denoised with features shared_shape": "shared shape, denoised with features"}
figure = viz.map_grid(len(weights), columns=3)
for ax, (name, weight) in zip(figure.axes, weights.items(), strict=False):
    title = names.get(name, name).replace("_", " ")
    viz.value_map(weight, title=title, limits=(0, 1), ax=ax)
figure

# %%
# The command line writes an EXR with the estimate, its interval and its certainty:
# ``chdstat estimate night-room -o night.exr``.
#
# **Next:** `How sure is an estimate? <plot_6_certainty.html>`_
