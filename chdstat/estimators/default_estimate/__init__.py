"""Parts of the default estimate of `chdstat.estimators.estimates`.

`candidates` computes the candidate images and `weighting_network` mixes a proposal of them;
`weights` determines how much of its mean each pixel keeps, `light` gives back the light that is
then missing, and `error` says how far image and pixels may be from the truth.
"""

from chdstat.estimators.default_estimate import (
    candidates,
    error,
    light,
    weighting_network,
    weights,
)

__all__ = ["candidates", "error", "light", "weighting_network", "weights"]
