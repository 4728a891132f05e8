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
- sharing statistics with similar pixels around: `delbracio2014`, `sakai2024`, `shared_patches`,
  `shared_shape`.

`mean_radiance` is the unit that `Progressive` measures an image in. `names` lists what is
registered, the mean first, and `lookup` says where it comes from and what it needs;
``estimators.<name>`` is the function of whatever is registered.
"""

from __future__ import annotations

from typing import Any

from chdstat._core.image_scales import mean_radiance
from chdstat.estimators.buckets import (
    bayesian_median_of_means,
    gmon_adaptive,
    gmon_binary,
    jung2015,
    lee_valiant,
    median_of_means,
)
from chdstat.estimators.mlp import MLP
from chdstat.estimators.neighbourhood import (
    Fireflies,
    delbracio2014,
    sakai2024,
    shared_patches,
    shared_shape,
)
from chdstat.estimators.order import (
    catoni,
    huber,
    mean,
    median,
    trimmed_mean,
    tukey,
    winsorized_mean,
)
from chdstat.estimators.outliers import Cascade, decoro2010, zirr2018, zirr2018_pixel
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
from chdstat.estimators.shrinkage import (
    gamma_shrinkage,
    gmon_shrinkage,
    james_stein,
    lognormal_shrinkage,
    mixture_shrinkage,
)
from chdstat.estimators.training import PRESETS, History, Preset

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
__all__ += [name for name in names("fixed") if name not in __all__]


def __getattr__(name: str) -> Any:
    entry = lookup(name) if name in names() else None
    if isinstance(entry, Estimator):
        return entry.function
    message = f"module 'chdstat.estimators' has no attribute {name!r}"
    raise AttributeError(message)
