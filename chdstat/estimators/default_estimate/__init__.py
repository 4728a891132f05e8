"""Parts of the default estimate of `chdstat.estimators.estimates`.

`candidates` computes the candidate images, `weighting_network` weights them, `mean_weights`
determines how much of the mean each pixel keeps, and `lost_light` gives back the light that is then
missing. `error` estimates the error of what they make.
"""

from chdstat.estimators.default_estimate import (
    candidates,
    error,
    lost_light,
    mean_weights,
    weighting_network,
)

__all__ = ["candidates", "error", "lost_light", "mean_weights", "weighting_network"]
