"""Progressive estimator: a network that learns weights for the octaves of a pixel's samples.

`Progressive` is the estimator, `Estimates` what it returns; `Stream` feeds it samples as they are
rendered.
"""

from __future__ import annotations

from chdstat.estimators.progressive.dataset import Profile
from chdstat.estimators.progressive.inputs import Estimates
from chdstat.estimators.progressive.model import Progressive
from chdstat.estimators.progressive.stream import Stream

__all__ = ["Estimates", "Profile", "Progressive", "Stream"]
