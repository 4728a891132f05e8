"""
Which paths make the noise?
===========================

A pixel is noisy, and its distribution has two modes. Which of its paths are to blame?
"""

# %%
# With ``by_depth``, every sample is rendered again with its path cut after two, three and four
# segments. The random numbers are the same, and so are the paths: the differences are the light
# that each sample gathers by paths of one length. The maps show shares of the variance, in per
# cent.

# sphinx_gallery_panel = 1, 1
import chdstat as chd
from chdstat import viz

samples = chd.render("bathroom", spp=64, size=(64, 64), backend="scalar", by_depth=4)
found = chd.patterns.attribute(samples)

figure = viz.map_grid(4, columns=4)
shares = found["variance_share"].transpose("segments", "y", "x")
for ax, name, share in zip(figure.axes, found["paths"].values, shares, strict=True):
    viz.value_map(100 * share, title=str(name), limits=(0, 100), ax=ax)
figure

# %%
# Where the sun or the window shines, direct light makes the variance; elsewhere, light that has
# been reflected before. The shares of a pixel add up to 100 %.

average = {
    str(name): float(share)
    for name, share in zip(found["paths"].values, shares.mean(("y", "x")), strict=True)
}
for name, share in average.items():
    print(f"{name:24}{share:5.0%} of the variance, on average")
direct = shares.isel(segments=0)
sentence = (
    f"In {float((direct > 0.5).mean()):.0%} of the pixels, direct light makes most of the "
    f"variance; averaged over the image it makes {average['emitted and direct']:.0%}, and paths "
    f"of more than 4 segments make {average['more than 4 segments']:.0%}."
)
print(sentence)

# %%
# A single pixel says it of its modes and its tail, too:

pixel = samples.pixel(38, 48)
for row in pixel.light:
    parts = ", ".join(f"{share:.0%} {name}" for name, share in list(row.items())[2:])
    print(f"{row['of']:9}{parts}")

# %%
# **Next:** `Bring your own samples <plot_5_own_samples.html>`_. The how-to page on `noisy pixels
# <../../how-to/noisy-pixel.html>`_ asks what else they tell.
