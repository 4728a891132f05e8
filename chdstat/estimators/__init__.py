"""Estimators: from a few samples of a pixel to its radiance.

All take samples on the last axis, ``x (..., sample) -> (...)``, and leave bad samples out. `mean`
is the baseline. `MLP` is the network of the paper, `Progressive` ours: from any number of samples,
with a certainty and an interval, and without a reference as `self_trained`. The others are

- order statistics: `median`, `trimmed_mean`, `winsorized_mean`;
- M-estimators: `huber`, `tukey`, `catoni`;
- buckets: `median_of_means`, `gmon_binary`, `gmon_adaptive`;
- reweighting: `bayesian_median_of_means`, `lee_valiant`; resampling: `jung2015`;
- shrinkage: `gmon_shrinkage`, `gamma_shrinkage`, `lognormal_shrinkage`, `mixture_shrinkage`, all by
  `james_stein`;
- with the channels together: `zirr2018_pixel` and the shrinkage; and with the pixels around:
  `zirr2018`, `decoro2010`;
- sharing statistics with alike pixels around: `delbracio2014`, `sakai2024`, `shared_patches`,
  `shared_shape`.

`mean_radiance` is the unit that `Progressive` measures an image in. `names` lists what is
registered, the mean first, and `lookup` says where it comes from and what it needs;
``estimators.<name>`` is the function.
"""

from __future__ import annotations

from typing import Any

# The order of import is the order of registration.
# isort: off
from chdstat.estimators.order import mean
from chdstat.estimators.order import median, trimmed_mean, winsorized_mean
from chdstat.estimators.m_estimators import catoni, huber, tukey
from chdstat.estimators.buckets import gmon_adaptive, gmon_binary, median_of_means
from chdstat.estimators.reweighting import bayesian_median_of_means, lee_valiant
from chdstat.estimators.reweighting import jung2015
from chdstat.estimators.shrinkage import gmon_shrinkage, james_stein
from chdstat.estimators.shrinkage import gamma_shrinkage, lognormal_shrinkage, mixture_shrinkage
from chdstat.estimators.cascades import Cascade, zirr2018, zirr2018_pixel
from chdstat.estimators.density import decoro2010
from chdstat.estimators.neighbourhood import delbracio2014, sakai2024
from chdstat.estimators.similar_pixels import Fireflies, shared_patches, shared_shape
from chdstat.estimators.mlp import MLP
from chdstat.estimators.training import PRESETS, Preset
from chdstat.estimators.progressive import Estimates, Profile, Progressive, Stream, self_trained
from chdstat.estimators.registry import (
    Estimator,
    LearnedEstimator,
    Model,
    lookup,
    names,
    register,
    register_learned,
)
from chdstat.estimators.training import History
from chdstat._core.image_scales import mean_radiance
# isort: on

__all__ = [
    "MLP",
    "PRESETS",
    "Cascade",
    "Estimates",
    "Estimator",
    "Fireflies",
    "History",
    "LearnedEstimator",
    "Model",
    "Preset",
    "Profile",
    "Progressive",
    "Stream",
    "bayesian_median_of_means",
    "catoni",
    "decoro2010",
    "delbracio2014",
    "gamma_shrinkage",
    "gmon_adaptive",
    "gmon_binary",
    "gmon_shrinkage",
    "huber",
    "james_stein",
    "jung2015",
    "lee_valiant",
    "lognormal_shrinkage",
    "lookup",
    "mean",
    "mean_radiance",
    "median",
    "median_of_means",
    "mixture_shrinkage",
    "names",
    "register",
    "register_learned",
    "sakai2024",
    "self_trained",
    "shared_patches",
    "shared_shape",
    "trimmed_mean",
    "tukey",
    "winsorized_mean",
    "zirr2018",
    "zirr2018_pixel",
]


def __getattr__(name: str) -> Any:
    entry = lookup(name) if name in names() else None
    if isinstance(entry, Estimator):
        return entry.function
    message = f"module 'chdstat.estimators' has no attribute {name!r}"
    raise AttributeError(message)
