"""
Are two renders the same?
=========================

A renderer was changed, and its image looks the same. Is it? `chdstat.contrast` tests pixels and
windows of all sizes, and says how large a loss it would have found.
"""

# %%
# A path tracer, the same with another seed, and one that leaves out long paths. Of shorter paths,
# single pixels show little at 48 samples, and windows much.

# sphinx_gallery_panel = 1, 2
import chdstat as chd
from chdstat import viz

view = {"spp": 48, "size": (64, 64), "backend": "scalar"}
samples = chd.render("cornell-box", seed=1, **view)
shorter = chd.render("cornell-box", seed=3, max_depth=4, **view)
found = chd.contrast(samples, shorter, distributions=True)
viz.contrast(found)

# %%
# A mean is not all: where paths are cut, the distributions differ too. Each map of p-values has one
# of q-values, which hold the share of false alarms over the image.

for name in ("q_value", "distribution_q_value"):
    print(f"{name:22}{float((found.maps[name] <= 0.05).mean()):4.0%} of the pixels are below 0.05")

# %%
# The negative control is a render with another seed:

again = chd.contrast(samples, chd.render("cornell-box", seed=2, **view))
print(again.conclusion)
loss = found.loss
sentence = (
    f"No pixel shows it, the whole image does: paths cut after four segments lose {loss.value:.1%} "
    f"of the light ({loss.low:.1%} to {loss.high:.1%})."
    if found.outcome == "differ" and not found.share
    else f"Paths cut after four segments lose {loss.value:.1%} of the light "
    f"({loss.low:.1%} to {loss.high:.1%})."
)
sentence += (
    f" Of another seed the test says: {again.outcome}; it would have found a loss of "
    f"{again.detectable['image']:.1%} of the image in nine of ten renders."
)
print(sentence)

# %%
# **Next:** `Shorter and longer paths <plot_2_path_lengths.html>`_ looks at what is lost. The
# `how-to page <../../how-to/contrast-renders.html>`_ is about equal seeds, converged images and the
# tests of a renderer.
