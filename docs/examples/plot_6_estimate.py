"""
Better pixels from the same samples
===================================

A render has no reference: its samples are all there is. `chdstat.estimators.Progressive` learns
from splits of them how far each kind of sample is to be believed, and says how sure it is.
"""

# %%
# A few samples, and many to judge by
# -----------------------------------
#
# The first 64 samples of each pixel are the render. The others play no part but at the end, where
# their mean is the reference.

import numpy as np

import chdstat as chd
from chdstat import viz
from chdstat.estimators import Progressive

samples = chd.render("bathroom", spp=512, size=(48, 48), seed=6, backend="scalar")
few = samples.read(ss=slice(0, 64))
mean = few.mean(axis=-1)
reference = samples.read(ss=slice(64, 512)).mean(axis=-1)

# %%
# Learn from the image itself
# -----------------------------
#
# Half of a pixel's samples are looked at, and the mean of the other half is what is asked for. It
# is noisy, but its expectation is the truth, and that is what a network learns under a squared
# error. `chdstat.estimators.self_trained` does all of this in one call; here the model is kept, to
# ask it more. Few minibatches keep the example short: 2000 are the default.

model = Progressive(inputs=["features", "neighbours"])
model.train(
    chd.Samples.from_array(few, features=samples.features),
    reference=False,
    iterations=500,
    progress=False,
)
found = model.estimate(few, features=samples.features, level=0.9)

# %%
# Look at both
# ------------
#
# Under one exposure, with squared errors on one scale.

images = {"mean of 64": mean, "self-trained": found.radiance, "reference": reference}
errors = {
    name: ((image - reference) ** 2).mean(axis=-1)
    for name, image in images.items()
    if name != "reference"
}
viz.side_by_side(images, errors=errors)

# %%
# In numbers: the errors, and what they cost in energy.

for name, error in errors.items():
    bias = (images[name] - reference).mean() / reference.mean()
    print(f"{name:12} MSE {error.mean():.4f}, bias {bias:+.1%}")
print(f"improved: {np.mean(errors['self-trained'] < errors['mean of 64']):.0%} of the pixels")

# %%
# How sure it is
# --------------
#
# The certainty is the weight of what was learned beside the mean; the interval is meant to hold the
# truth with a probability of 90 %. Without a reference it is an upper bound learned from held-out
# pixels, not calibrated, so count how often it holds what the other samples say.

width = (found.high - found.low).mean(axis=-1) / found.radiance.mean(axis=-1)
figure = viz.map_grid(2, columns=2)
left, right = figure.axes
viz.value_map(found.certainty, title="Certainty", limits=(0, 1), ax=left)
viz.value_map(width, title="Width of the interval ÷ estimate", ax=right)
figure

# %%

inside = (found.low <= reference) & (reference <= found.high)
print(f"{inside.mean():.0%} of the intervals of 90 % hold the reference")

# %%
# As samples come in
# ------------------
#
# An estimator that was trained with a reference takes any number of samples, and tends to their
# mean as they become many: its certainty falls.

known = Progressive().train(samples, sizes=(8, 32, 128), iterations=200, progress=False)
for n in (4, 16, 64, 256):
    certainty = known.estimate(samples.read(ss=slice(0, n))).certainty
    print(f"{n:4} samples: certainty {certainty.mean():.2f}")
