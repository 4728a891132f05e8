"""
How heavy are the tails?
========================

In which pixels do rare bright samples carry so much light that error bars fail?
"""

# %%
# The scene has a glass ball and a gold ring under a small lamp, which throw caustics that a path
# tracer finds only by chance.

# sphinx_gallery_panel = 2, 2
import chdstat as chd
from chdstat import viz

samples = chd.render("caustic", spp=192, size=(64, 64), seed=1, backend="scalar")
tail = chd.fit.tail_index(samples)

# %%
# The tail index ξ is fitted to the largest samples of a pixel alone. It is 0 for tails like those
# of a gamma distribution, and positive for power laws. From 1/2 on the variance is infinite.

xi = tail["tail_index"].sel(channel="G")
figure = viz.map_grid(2, columns=2)
left, right = figure.axes
larger = chd.render("caustic", spp=12, size=(128, 128), seed=2, backend="scalar")
seen = {name: larger.features[name] for name in ("albedo", "normal")}
viz.image_map(chd.io.denoise(larger.read().mean(axis=-1), **seen), title="The scene", ax=left)
viz.value_map(xi, title="Tail index ξ of green", limits=(-0.5, 1.0), ax=right)
figure

# %%
# Grey pixels have too few samples in their tail for an answer. The index of so few samples says
# little about the error bar of their mean, though. Whether that one holds is said by the pixels
# around, too, which have drawn what one pixel may have missed.

suspect = tail["tail_variance_suspect"].sel(channel="G")
unidentified = tail["tail_variance_unidentified"].sel(channel="G")
sentence = (
    f"In {float(suspect.mean()):.0%} of the pixels of this scene, the error bar of "
    f"{samples.spp} samples fails: a caustic that a path seldom finds carries more light than "
    f"the samples show. In another {float(unidentified.mean()):.0%} it holds in 80 to 90 of 100 "
    f"renders instead of 95."
)
print(sentence)
figure = viz.map_grid(2, columns=2)
left, right = figure.axes
own, around = (tail[name].sel(channel="G") for name in ("tail_coverage_own", "tail_coverage"))
viz.value_map(own, title="Error bars that hold, alone", limits=(0.4, 1.0), ax=left)
viz.value_map(around, title="with the pixels around", limits=(0.4, 1.0), ax=right)
figure

# %%
# One pixel with its interval
# ---------------------------
#
# From few samples the index of a pixel is uncertain. More samples narrow its interval. This pixel
# is on a white square of the board.

for spp in (256, 4096, 32768):
    some = chd.rendering.render_pixels("caustic", [(52, 30)], spp=spp, size=(64, 64), seed=2)[:, 1]
    fit = chd.fit.tail_index(some)
    low, high = fit.interval[0]
    print(f"{spp:6} samples: ξ {fit.xi[0]:5.2f}, 95 % interval {low:5.2f} to {high:.2f}")

# %%
# **Next:** `Are the samples Gaussian on some scale? <../test/plot_1_gaussianity.html>`_ turns from
# the tail to the body of the distributions.
