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
from chdstat.errors import Reason

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
    f"{samples.spp} samples fails, as far as these show: it is estimated to hold in fewer than 80 "
    f"of 100 renders instead of 95. In another {float(unidentified.mean()):.0%}, the samples do "
    f"not tell."
)
print(sentence)
figure = viz.map_grid(2, columns=2)
left, right = figure.axes
own, around = (tail[name].sel(channel="G") for name in ("tail_coverage_own", "tail_coverage"))
viz.value_map(own, title="Error bars that hold, alone", limits=(0.4, 1.0), ax=left)
viz.value_map(around, title="with the pixels around", limits=(0.4, 1.0), ax=right)
figure

# %%
# One pixel with more samples
# ---------------------------
#
# The index describes the tail that the samples reach. More of them may reach light that few paths
# find, and with it another tail. Its interval need not be narrower. This pixel is on a white square
# of the board.

settings = {"spp": 65536, "size": (64, 64), "seed": 2, "backend": "scalar"}
green = chd.rendering.render_pixels("caustic", [(52, 30)], **settings)[:, 1]
fits, largest = {}, {}
for spp in (256, 4096, 16384, 65536):
    some = green[:, :spp]
    fit = fits[spp] = chd.fit.tail_index(some)
    largest[spp] = some.max()
    (low, high), why = fit.interval[0], Reason(fit.reason[0]).name.lower()
    told = f"ξ {fit.xi[0]:.2f} ({low:.2f} to {high:.2f})" if fit.reason[0] == 0 else f"no ξ: {why}"
    print(f"{spp:6} samples, largest {largest[spp]:6.1f}: {told}")

# %%
# `edge` says that the largest samples are the edge of a mode, which no tail index describes.

known = [spp for spp, fit in fits.items() if fit.reason[0] == 0]
few, many = known[0], known[-1]
widths = [float(fits[spp].interval[0] @ [-1, 1]) for spp in (few, many)]
print(
    f"The interval is {widths[0]:.2f} wide with {few} samples and {widths[1]:.2f} with {many}; "
    f"their largest sample is {largest[many] / largest[few]:.0f} times as bright."
)

# %%
# **Next:** `Are the samples Gaussian on some scale? <../test/plot_1_gaussianity.html>`_ turns from
# the tail to the body of the distributions.
