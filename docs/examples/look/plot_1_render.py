"""
Render an image and keep every sample
=====================================

A path tracer draws many radiance samples for each pixel and keeps only their average. What is in
an image before that average is taken?
"""

# %%
# The built-in bathroom is lit through one window. `chdstat.render` returns every sample of every
# pixel, with what the camera rays hit first. The ``scalar`` backend runs on every machine and
# always draws the same samples; the default picks the fastest backend that works on yours.

# sphinx_gallery_panel = 1, 2
import tempfile

import chdstat as chd
from chdstat import viz

samples = chd.render("bathroom", spp=24, size=(128, 128), seed=1, backend="scalar")
samples

# %%
# Samples lie on the last axis, after rows, columns and channels. Indexing with a row and a column
# gives one pixel, ``read`` gives all of them, and the image is their average.

pixel = samples[84, 108]
image = samples.read().mean(axis=-1)
print(pixel.shape, image.shape)
print("mean of the pixel:", pixel.mean(axis=-1).round(2))
print("its first green samples:", pixel[1, :8].round(2))

# %%
# Statistics of every pixel
# -------------------------
#
# `chdstat.summarize` reads the samples once and returns an `xarray.Dataset`: moments, histograms,
# and the share of *null* samples, which are exactly black in all channels because their path met
# no light.

summary = chd.summarize(samples)
noise = (summary["variance"] ** 0.5 / summary["mean"]).mean("channel")

figure = viz.map_grid(3)
left, middle, right = figure.axes
viz.image_map(image, title=f"Mean of {samples.spp} samples", ax=left)
viz.value_map(summary["null_share"], title="Share of null samples", limits=(0, 1), ax=middle)
viz.value_map(noise, title="Standard deviation ÷ mean", limits=(0, 5), ax=right)
figure

# %%
# The share of nulls and the noise have their own structure, which the average does not show: the
# mirror and the sunlit tub are quieter than the walls.

nulls = summary["null_share"]
sentence = (
    f"Of the samples behind this image, {float(nulls.mean()):.0%} are exactly black, and in "
    f"{float((nulls > 0.5).mean()):.0%} of the pixels more than half are: the average shows "
    f"neither. In the median pixel, a single sample misses by {float(noise.median()):.1f} times "
    f"the mean."
)
print(sentence)

# %%
# Samples on disk
# ---------------
#
# Large renders go to a store: name a folder with ``out=``. A render that was interrupted resumes
# when it is called again, and asking for more samples appends them.

with tempfile.TemporaryDirectory() as folder:
    path = f"{folder}/box.zarr"
    for spp in (16, 32):
        chd.render("cornell-box", spp=spp, size=(32, 32), out=path, backend="scalar")
        print(chd.open(path).spp, "spp")

# %%
# **Next:** `Look at the distribution of a pixel <plot_2_look.html>`_ shows the distributions
# behind these numbers.
