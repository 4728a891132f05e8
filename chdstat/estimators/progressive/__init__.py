"""Progressive estimator: a network that learns weights for the octaves of a pixel's samples.

`Progressive` is the estimator, `Estimates` what it returns; `Stream` feeds it samples as they are
rendered, and `self_trained` trains it on the very image that it improves.
"""

from __future__ import annotations

from chdstat.estimators.progressive.entries import self_trained
from chdstat.estimators.progressive.learned import Estimates
from chdstat.estimators.progressive.model import Progressive
from chdstat.estimators.progressive.profile import Profile
from chdstat.estimators.progressive.stream import Stream

__all__ = ["Estimates", "Profile", "Progressive", "Stream", "self_trained"]
