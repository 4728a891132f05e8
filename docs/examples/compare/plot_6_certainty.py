"""
How sure is an estimate?
========================

An estimate comes with a certainty and an interval. Can they be trusted?
"""

# %%
# We estimate the bathroom from the first 32 samples of each pixel, without a reference. Certainty
# is the weight of all candidates but the mean. The interval is meant to contain the truth with a
# probability of 90 %. At the right, the mean of 1024 other samples stands for the truth: bright
# are pixels whose intervals miss it.

# sphinx_gallery_panel = 1, 2
import numpy as np

import chdstat as chd
from chdstat import viz

few = chd.render("bathroom", spp=32, size=(64, 64), seed=6, backend="scalar")
found = chd.estimate(few, level=0.9, progress=False)
reference = chd.render("bathroom", spp=1024, size=(64, 64), seed=7).read()
reference = reference.mean(axis=-1, dtype=float)
inside = ((found.low <= reference) & (reference <= found.high)).mean(axis=-1)
width = (found.high - found.low).mean(axis=-1) / found.radiance.mean(axis=-1)

figure = viz.map_grid(4, columns=4)
image, certainty, wide, missed = figure.axes
viz.image_map(found.radiance, title="Estimate of 32 samples", ax=image)
viz.value_map(found.certainty, title="Certainty", limits=(0, 1), ax=certainty)
viz.value_map(width, title="Width ÷ estimate", limits=(0, 3), ax=wide)
viz.value_map(1 - inside, title="Truth missed", limits=(0, 1), ax=missed)
figure

# %%
# How often do they hold?
# -----------------------
#
# Pixels that lie side by side miss together, so that the share is averaged over blocks of eight by
# eight pixels, and their spread says how well it is known.

blocks = inside.reshape(8, 8, 8, 8).mean(axis=(1, 3)).ravel()
share, error = blocks.mean(), blocks.std(ddof=1) / np.sqrt(blocks.size)
low, high = share - 1.96 * error, share + 1.96 * error
verdict = (
    "more often than stated" if low > 0.9
    else "less often than stated" if high < 0.9
    else "as often as stated, as far as this image tells"
)  # fmt: skip
sentence = (
    f"The 90 % intervals of the estimate contain the truth in {share:.1%} of the pixels "
    f"({low:.1%} to {high:.1%}, over blocks): {verdict}."
)
print(sentence)

# %%
# Against a mean of a hundred samples, even perfect intervals would seem to miss far more than they
# do, because that mean has an error of its own.
#
# **Next:** `Denoise from the mean, or from a robust estimate? <plot_7_denoise.html>`_
