"""
The paper's network
===================

Can a small network that sees 32 samples of one channel of one pixel, and nothing else, beat their
mean?

This is the model of Elek, Thomas and Forbes (2019), with the three figures of its evaluation.
"""

# %%
# We train on half of the pixels, each batch of 32 samples against the mean of all other samples of
# its pixel. The paper takes 2048 samples per pixel, 6400 pixels and 30,000 iterations; here are a
# few of each. `chdstat.compare` judges on the pixels that did not train: 25 of them, at random,
# from dark to bright. An estimate improves where its mark is closer to the black bar than the
# circle.

import chdstat as chd
from chdstat import viz

samples = chd.render("gallery", spp=256, size=(64, 64), seed=1, backend="scalar")
model = chd.estimators.MLP.preset("elek2019").train(samples, iterations=1000, progress=False)
found = chd.compare(samples, ["mean", "elek2019"], model=model, progress=False)
viz.pixel_estimates(found.draw_pixels(25)).figure

# %%
# Outliers of the mean are drawn towards the other pixels. In numbers, with what the errors cost in
# bias:

found

# %%
# As a sentence, with what the intervals allow:


def told(x):
    """Return a number with its interval."""
    return f"{x.value:.2g} ({x.low:.2g} to {x.high:.2g})"


mse, bias = (found.measures[name][1, -1] for name in ("mse_ratio", "bias"))
word = "lowers" if mse.high < 1 else "raises" if mse.low > 1 else "neither surely lowers nor raises"
off = "darkens" if bias.high < 0 else "brightens" if bias.low > 0 else "does not surely change"
sentence = (
    f"Trained on two thousand pixels of one scene, the paper's network {word} the squared error of "
    f"the mean ({told(mse)} times it) on pixels that it has not seen, and {off} the image "
    f"({100 * bias.value:+.0f} %, {100 * bias.low:+.0f} to {100 * bias.high:+.0f} %)."
)
print(sentence)

# %%
# The training
# ------------
#
# Dashed lines are the squared error of the sample mean. The loss on the training pixels falls
# below that on the validation pixels: a thousand pixels are few.

viz.training(model.history).figure

# %%
# The estimate
# ------------
#
# The mean of the first 32 samples, what the network makes of the same samples, and the mean of all.

mean, learned = found.estimates
viz.side_by_side({"mean of 32": mean, "network": learned, "mean of all": found.reference})

# %%
# ``chdstat train`` trains it on any store.
#
# **Next:** `A better image without a reference <plot_5_estimate.html>`_
