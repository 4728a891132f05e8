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

samples = chd.render("bathroom", spp=64, size=(64, 64), seed=1, backend="scalar")
samples

# %%
# Samples lie on the last axis, after rows, columns and channels. Indexing with a row and a column
# gives one pixel, ``read`` gives all of them, and the image is their average.

pixel = samples[42, 54]
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
viz.image_map(image, title="Mean of 64 samples", ax=left)
viz.value_map(summary["null_share"], title="Share of null samples", limits=(0, 1), ax=middle)
viz.value_map(noise, title="Standard deviation ÷ mean", limits=(0, 6), ax=right)
figure

# %%
# Away from the window most samples of most pixels are null, and the standard deviation of a single
# sample is several times the mean. The mirror and the sunlit tub are quieter than the walls.
#
# Samples on disk
# ---------------
#
# Large renders go to a store: name a folder with ``out=``. A render that was interrupted resumes
# when it is called again, and asking for more samples appends them.

with tempfile.TemporaryDirectory() as folder:
    path = f"{folder}/box.zarr"
    for spp in (16, 32):
        chd.render("cornell-box", spp=spp, size=(32, 32), out=path, backend="scalar")
        print(chd.open(path))

# %%
# **Next:** `Look at the distribution of a pixel <plot_02_look.html>`_ shows the distributions
# behind these numbers.
