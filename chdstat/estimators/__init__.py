"""Estimators: from a few samples of a pixel to its radiance.

All take samples on the last axis, ``x (..., sample) -> (...)``, and leave bad samples out. `mean`
is the baseline; `median_of_means` survives fireflies; `MLP` learns from the scene. `names` lists
what is registered and `lookup` says where it comes from; ``estimators.<name>`` is the function.
"""

from __future__ import annotations

from typing import Any

from chdstat.estimators.classical import mean
from chdstat.estimators.mlp import MLP
from chdstat.estimators.presets import PRESETS, Preset
from chdstat.estimators.registry import (
    Estimator,
    LearnedEstimator,
    Model,
    lookup,
    names,
    register,
    register_learned,
)
from chdstat.estimators.robust import median_of_means
from chdstat.estimators.training import History

__all__ = [
    "MLP",
    "PRESETS",
    "Estimator",
    "History",
    "LearnedEstimator",
    "Model",
    "Preset",
    "lookup",
    "mean",
    "median_of_means",
    "names",
    "register",
    "register_learned",
]


def __getattr__(name: str) -> Any:
    entry = lookup(name) if name in names() else None
    if isinstance(entry, Estimator):
        return entry.function
    message = f"module 'chdstat.estimators' has no attribute {name!r}"
    raise AttributeError(message)
