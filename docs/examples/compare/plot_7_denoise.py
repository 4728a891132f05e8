"""
Denoise from the mean, or from a robust estimate?
=================================================

An image denoiser usually starts from the mean of the samples. Does it do better from a robust
estimate of the same samples?
"""

# %%
# `chdstat.io.denoise` calls Open Image Denoise, which comes with the library. Here are the mean of
# 32 samples, and an estimate that pools pixels of similar distributions, each before and after it.

# sphinx_gallery_panel = 1, 4
import chdstat as chd
from chdstat import viz
from chdstat.io import denoise

samples = chd.render("bathroom", spp=128, size=(96, 96), seed=1, backend="scalar")
few = samples.read(ss=slice(0, 32))
features = {name: samples.features[name] for name in ("albedo", "normal")}
mean, shared = chd.estimators.mean(few), chd.estimators.shared_shape(few)
images = {
    "mean": mean,
    "shared shape": shared,
    "mean of 128": samples.read().mean(axis=-1),
    "mean, denoised": denoise(mean, **features),
    "shared, denoised": denoise(shared, **features),
    "128, denoised": denoise(samples.read().mean(axis=-1), **features),
}
viz.side_by_side(images, columns=3)

# %%
# A robust estimate takes light from outliers, which the denoiser could otherwise spread over their
# surroundings. It may also take light that is true. Errors say what is left of either, in batches
# of 32:

names = ["mean", "mean + OIDN features", "shared_shape", "shared_shape + OIDN features"]
found = chd.compare(samples, names, max_batches=2, progress=False)
found

# %%
# As a sentence, with what the intervals allow:


def told(x):
    """Return a number with its interval."""
    return f"{x.value:.2g} ({x.low:.2g} to {x.high:.2g})"


error = found.measures["relmse_ratio"]
plain, better = error[1, -1], error[3, -1]
word = (
    "a smaller error than" if better.high < plain.low
    else "a larger error than" if better.low > plain.high
    else "an error that the intervals do not tell from that of"
)  # fmt: skip
sentence = (
    f"The denoiser lowers the relative squared error to {told(plain)} times that of the mean of 32 "
    f"samples; from the shared shape it ends at {told(better)}, {word} the denoised mean."
    if plain.high < 1
    else f"The denoised mean has {told(plain)} times the relative squared error of the mean, from "
    f"the shared shape it is {told(better)}."
)
print(sentence)

# %%
# **Next:** `Are two renders the same? <../contrast/plot_1_two_renders.html>`_
