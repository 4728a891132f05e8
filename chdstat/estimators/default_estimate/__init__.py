"""Parts of the default estimate of `chdstat.estimators.estimates`.

`candidates` computes the candidate images, `weighting_network` weights them, and `mean_weights`
determines how much of the mean each pixel keeps.
"""

from chdstat.estimators.default_estimate import candidates, mean_weights, weighting_network

__all__ = ["candidates", "mean_weights", "weighting_network"]
