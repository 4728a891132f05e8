"""Estimators: from a few samples of a pixel to its radiance.

All take samples on the last axis, ``x (..., sample) -> (...)``, and leave bad samples out. `mean`
is the baseline. `MLP` is the network of the paper. The others are order statistics and
M-estimators; means of buckets, reweighted means and bootstrap means; estimators that remove
outliers; and estimators that share samples between similar pixels.

`names` lists the registered estimators, the mean first. `lookup` says where an estimator comes from
and what it needs. ``estimators.<name>`` is its function.
"""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Callable
from typing import Any

import numpy.typing as npt

from chdstat.estimators.elek2019 import MLP, PRESETS, Preset
from chdstat.estimators.estimates import (
    Combination,
    CombinationStream,
    estimate,
)
from chdstat.estimators.neighbourhood import Fireflies
from chdstat.estimators.registry import (
    Estimates,
    Estimator,
    LearnedEstimator,
    Model,
    lookup,
    names,
    register,
    register_learned,
)
from chdstat.estimators.training import History, load_model, train_model

__all__ = [
    "MLP",
    "PRESETS",
    "Combination",
    "CombinationStream",
    "Estimates",
    "Estimator",
    "Fireflies",
    "History",
    "LearnedEstimator",
    "Model",
    "Preset",
    "estimate",
    "load_model",
    "lookup",
    "names",
    "register",
    "register_learned",
    "train_model",
]
for _module in pkgutil.iter_modules(__path__):
    importlib.import_module(f"{__name__}.{_module.name}")  # which registers its estimators
__all__ += [n for n in names() if isinstance(lookup(n), Estimator) and n not in __all__]


def __getattr__(name: str) -> Callable[..., npt.NDArray[Any]]:
    entry = lookup(name) if name in names() else None
    if isinstance(entry, Estimator):
        return entry.function
    message = f"module 'chdstat.estimators' has no attribute {name!r}"
    raise AttributeError(message)


def __dir__() -> list[str]:
    return sorted(__all__)
