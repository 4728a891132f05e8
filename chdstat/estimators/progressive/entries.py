"""Rows of the progressive estimator in the registry, for comparisons and the command line."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import as_pixels
from chdstat.estimators.progressive.auxiliary import Features
from chdstat.estimators.progressive.model import Progressive
from chdstat.estimators.registry import LearnedEstimator, register, register_learned
from chdstat.estimators.rows import reordered
from chdstat.samples import Samples

__all__ = ["self_trained"]

_SOURCE = "this library, after Zirr et al. 2018, doi:10.1111/cgf.13335"
_PIXELS = 8192


def _train(samples: Samples, **options: Any) -> Progressive:
    return Progressive().train(samples, **options)


def _train_with_features(samples: Samples, **options: Any) -> Progressive:
    return Progressive(inputs=["features"]).train(samples, **options)


def _train_with_direct(samples: Samples, **options: Any) -> Progressive:
    return Progressive(inputs=["direct"]).train(samples, **options)


for _name, _label, _function, _balance in (
    ("progressive", "progressive (ours)", _train, 0.5),
    ("progressive_mse", "progressive, for MSE", _train, 0.0),
    ("progressive_relmse", "progressive, for relMSE", _train, 1.0),
    ("progressive_features", "progressive, with features", _train_with_features, 0.5),
    ("progressive_direct", "progressive, with direct light apart", _train_with_direct, 0.5),
):
    register_learned(
        LearnedEstimator(
            _name,
            _function,
            _SOURCE,
            inputs=None,
            pixels=_PIXELS,
            label=_label,
            place=9,
            default=_name == "progressive",
            options={"balance": _balance},
            uses_features=_function is _train_with_features,
            joint_channels=True,
            uses_direct=_function is _train_with_direct,
        )
    )


@register(
    "self_trained",
    source="this library, after Lehtinen et al. 2018",
    label="self-trained (ours)",
    place=9,
    minimum_samples=4,
    uses_neighbours=True,
    joint_channels=True,
    uses_features=True,
    learns=True,
)
def self_trained(
    x: npt.ArrayLike,
    *,
    features: Features | None = None,
    seed: int = 0,
    iterations: int | None = None,
    progress: bool | None = False,
) -> npt.NDArray[np.float32]:
    """Train a progressive estimator on an image's own samples, and estimate from all of them.

    No reference and no second render is needed. It learns from splits of each pixel's samples, so
    that the truth is the expectation of what it learns from, with features and neighbours
    for inputs. In which order the samples come makes no difference.

    Parameters
    ----------
    x
        Samples, shape (y, x, channel, sample), at least 4.
    features
        First-hit features of the image, as of `Samples.features`.
    seed, iterations, progress
        As for `Progressive.train`.

    Returns
    -------
    ndarray
        Estimates, shape (y, x, channel), in the unit of `x`.

    Raises
    ------
    InputError
        If `x` is no image, or has less than 4 samples.

    References
    ----------
    J. Lehtinen et al., "Noise2Noise: learning image restoration without clean data", ICML 2018.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> image = rng.exponential(size=(16, 16, 3, 16))
    >>> self_trained(image, iterations=5).shape
    (16, 16, 3)
    """
    samples = as_pixels(x, minimum=2, image=True)
    image = Samples.from_array(reordered(samples)[0], features=features, axes="yxcs")
    model = Progressive(inputs=["features", "neighbours"] if features else ["neighbours"])
    model.train(image, seed=seed, iterations=iterations, progress=progress)
    return model.predict(image.read(), features=features, trust=1.0)
