"""
Denoise from a better start
===========================

An image denoiser usually starts from the mean of the samples. Does it do better from a robust
estimate of the same samples?
"""

# %%
# `chdstat.io.denoise` calls Open Image Denoise, which comes with the library.

# sphinx_gallery_panel = 1, 4
import chdstat as chd
from chdstat import viz
from chdstat.io import denoise

samples = chd.render("bathroom", spp=256, size=(64, 64), seed=1, backend="scalar")
few = samples.read(ss=slice(0, 32))
reference = samples.read().mean(axis=-1)
features = {name: samples.features[name] for name in ("albedo", "normal")}

# %%
# The mean and an estimate that pools pixels of similar distributions, each before and after the
# denoiser.

mean, shared = chd.estimators.mean(few), chd.estimators.shared_shape(few)
images = {
    "mean": mean,
    "mean, denoised": denoise(mean, **features),
    "shared shape": shared,
    "shared shape, denoised": denoise(shared, **features),
    "mean of 256": reference,
}
viz.side_by_side(images)

# %%
# The denoiser gains from the better start: what is an outlier to the estimator is no longer a
# bright spot that the denoiser spreads over its surroundings. In numbers, from batches of 32:

names = ["mean", "mean + OIDN features", "shared_shape", "shared_shape + OIDN features"]
chd.compare(samples, names, max_batches=4, progress=False)

# %%
# **Next:** `Put claims about a scene to the test <plot_26_claims.html>`_ returns to the
# distributions.
