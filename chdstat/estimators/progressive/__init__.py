"""Progressive estimator: a network that learns weights for the octaves of a pixel's samples."""

from __future__ import annotations

from chdstat.estimators.progressive.model import Progressive

__all__ = ["Progressive"]
