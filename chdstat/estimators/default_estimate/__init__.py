"""Parts of the default estimate, which `chdstat.estimators.estimates` puts together.

`candidates` makes the images that are weighted, `weighting_network` weights them, and
`mean_weights` says how much of the mean each pixel keeps.
"""

from chdstat.estimators.default_estimate.candidates import candidates
from chdstat.estimators.default_estimate.mean_weights import weight_of_mean
from chdstat.estimators.default_estimate.weighting_network import WeightingNetwork

__all__ = ["WeightingNetwork", "candidates", "weight_of_mean"]
