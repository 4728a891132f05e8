"""
Fireflies in a hall of columns
==============================

One pixel of a render is ten times as bright as its neighbours. Is something different there, or did
the same distribution just yield a rare sample?

With `Shorter and longer paths <plot_07_path_lengths.html>`_ this is the paper's study of the hall.
"""

# %%
# The small yellow lamps of the hall are hard to find for a path. `chdstat.summarize` keeps the mean
# of each batch of 32 samples: many small renders of one view.

# sphinx_gallery_panel = 1, 3
import chdstat as chd
from chdstat import viz
from chdstat.rendering.recipes import find_recipe
from chdstat.studies.claims.whole_image import brightest_firefly

samples = chd.render("gallery", spp=128, size=(48, 48), seed=1, backend="scalar")
batches = chd.summarize(samples)["batch_means"].values
y, x, batch = brightest_firefly(batches.mean(axis=2))
firefly, neighbour = batches[y, x, :, batch], batches[y - 1, x, :, batch]
print(f"RGB of the firefly at row {y}, column {x}: {firefly.round(2)}")
print(f"RGB of the pixel above it: {neighbour.round(2)}")

# %%
# Their distributions
# -------------------
#
# We draw many more samples of both pixels and compare their red channels.

pair = {"firefly": (y, x), "neighbour": (y - 1, x)}
x = chd.rendering.render_pixels("gallery", list(pair.values()), spp=8192, size=(48, 48), seed=2)
red = x[:, 0]
viz.firefly_pair(batches[..., batch], pair, dict(zip(pair, red, strict=True)))

# %%
# The two histograms are almost the same. With 8192 samples each, so are the means: the firefly was
# one rare sample that could as well have come next door.

for name, of_pixel in zip(pair, red, strict=True):
    print(f"{name:10} mean {of_pixel.mean():.3f}, largest sample {of_pixel.max():.0f}")

# %%
# Other regions of the hall
# -------------------------
#
# The image is the mean of all samples; the distributions are of 1024 samples of one pixel each.

regions = find_recipe("gallery").regions
marks = [viz.Mark(r.name, *r.pixels(48, 48), r.center(48, 48)) for r in regions]
pixels = [mark.pixel for mark in marks]
x = chd.rendering.render_pixels("gallery", pixels, spp=1024, size=(48, 48), seed=3)
panels = [viz.Panel.of(mark.name, x[i]) for i, mark in enumerate(marks)]
notes = [region.phenomenon.replace("-", " ") for region in regions]
viz.region_study(batches.mean(axis=-1), marks, panels, notes=notes)

# %%
# **Next:** `A map of patterns <plot_15_patterns.html>`_ marks pixels that one sample dominates, and
# `Robust estimators in place of the mean <plot_19_estimators.html>`_ compares estimators that
# reweigh such samples.
