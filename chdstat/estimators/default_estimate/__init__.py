"""Parts of the default estimate, which `chdstat.estimators.estimates` puts together.

`candidates` makes the images that are weighted, `weighting_network` weights them, and
`mean_weights` says how much of the mean each pixel keeps.
"""

from chdstat.estimators.default_estimate import candidates, mean_weights, weighting_network

__all__ = ["candidates", "mean_weights", "weighting_network"]
