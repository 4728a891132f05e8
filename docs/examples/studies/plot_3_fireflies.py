"""
Fireflies in a hall of columns
==============================

One pixel of a render is far brighter than its neighbours. Is something different there, or did the
same distribution just yield a rare sample?

With `Shorter and longer paths <../contrast/plot_2_path_lengths.html>`_ this is the paper's study of
the hall.
"""

# %%
# The small yellow lamps of the hall are hard to find for a path. `chdstat.summarize` keeps the mean
# of each batch of 32 samples: many small renders of one view. We take the brightest firefly of all,
# and draw many more samples of it and of the pixel above. Here are their red channels.

# sphinx_gallery_panel = 1, 3
import numpy as np

import chdstat as chd
from chdstat import viz
from chdstat.rendering.recipes import find_recipe
from chdstat.studies.claims.whole_image import brightest_firefly

samples = chd.render("gallery", spp=96, size=(64, 64), seed=1, backend="scalar")
batches = chd.summarize(samples)["batch_means"].values
row, column, batch = brightest_firefly(batches.mean(axis=2))
pair = {"firefly": (row, column), "neighbour": (row - 1, column)}
x = chd.rendering.render_pixels("gallery", list(pair.values()), spp=8192, size=(64, 64), seed=2)
red = x[:, 0].astype(float)
viz.firefly_pair(batches[..., batch], pair, dict(zip(pair, red, strict=True)))

# %%
# Were the pixel special, its mean would be, too:

means = red.mean(axis=-1)
errors = red.std(axis=-1, ddof=1) / np.sqrt(red.shape[-1])
seen = [batches[y, x, 0, batch] for y, x in pair.values()]
for name, mean, error, of_pixel in zip(pair, means, errors, red, strict=True):
    print(f"{name:10} mean {mean:.3f} ± {error:.3f}, largest sample {of_pixel.max():.0f}")

ratio = means[0] / means[1]
factor = np.exp(1.96 * np.hypot(*(errors / means)))  # from the errors of both logarithms
low, high = ratio / factor, ratio * factor
seen_ratio = seen[0] / seen[1]
sentence = (
    f"In one render of 32 samples this pixel is {seen_ratio:.0f} times as bright as the one "
    f"above it; over 8192 samples of each it is {ratio:.2f} times as bright (95 % interval "
    f"{low:.2f} to {high:.2f})"
    + (
        ": the firefly was chance"
        if not low <= seen_ratio <= high
        else ", which does not tell whether the firefly was chance"
    )
    + ("; a difference within that interval is not ruled out." if low < 1 < high else ".")
)
print(sentence)

# %%
# Other regions of the hall
# -------------------------
#
# The image is the mean of all samples after a denoiser; the distributions are of 1024 samples of
# one pixel each.

regions = find_recipe("gallery").regions[:7]
names = [region.name.replace("-", " ") for region in regions]
marks = [
    viz.Mark(name, *r.pixels(64, 64), r.center(64, 64))
    for name, r in zip(names, regions, strict=True)
]
pixels = [mark.pixel for mark in marks]
x = chd.rendering.render_pixels("gallery", pixels, spp=1024, size=(64, 64), seed=3)
panels = [viz.Panel.of(name, x[i]) for i, name in enumerate(names)]
notes = [region.phenomenon.replace("-", " ") for region in regions]
features = {name: samples.features[name] for name in ("albedo", "normal")}
image = chd.io.denoise(samples.read().mean(axis=-1), **features)
viz.region_study(image, marks, panels, notes=notes)

# %%
# **Next:** `A map of patterns <../fit/plot_4_patterns.html>`_ marks pixels that one sample
# dominates, and `Robust estimators in place of the mean <../compare/plot_1_robust.html>`_ compares
# estimators that reweigh such samples.
