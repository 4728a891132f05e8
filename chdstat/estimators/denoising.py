"""Denoised: estimators whose image goes through Open Image Denoise, as contestants.

Use it to see whether a denoiser does better from a better start. ``compare(..., denoise=True)``
enters every contestant so; `denoised` enters one.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from chdstat.errors import InputError
from chdstat.estimators.registry import Estimator, LearnedEstimator, lookup
from chdstat.io import denoise
from chdstat.samples import Samples

__all__ = ["Denoised", "check_denoiser", "denoised", "through_denoiser", "variants"]

Array = npt.NDArray[Any]

_GUIDES = ("albedo", "normal")
"""First-hit features that the denoiser takes."""


@dataclass(frozen=True)
class Denoised:
    """An estimator followed by Open Image Denoise.

    Attributes
    ----------
    entry
        What estimates.
    features
        Whether the denoiser is given albedo and normal of the first hit.
    certainty
        Whether an estimate is kept as far as its model is certain of it.
    """

    entry: Estimator | LearnedEstimator
    features: bool = False
    certainty: bool = False

    @property
    def name(self) -> str:
        """What it is called by, such as "progressive + OIDN features"."""
        given = [what for what in ("features", "certainty") if getattr(self, what)]
        return " ".join([self.entry.name, "+ OIDN", *given])

    @property
    def uses_neighbours(self) -> bool:
        """A denoiser always looks across pixels."""
        return True

    def __call__(
        self,
        estimate: Callable[..., tuple[Array, Array | None]],
        features: Mapping[str, Array],
        x: npt.ArrayLike,
        **options: Any,
    ) -> Array:
        """Denoise what an estimator makes of an image's samples.

        Parameters
        ----------
        estimate
            Returns estimates (y, x, channel), and their certainty (y, x) or None.
        features
            First-hit features of the image.
        x
            Samples, shape (y, x, channel, sample).
        **options
            What else the estimator is told of them.
        """
        radiance, certainty = estimate(x, **options)
        return through_denoiser(
            radiance,
            features if self.features else {},
            certainty=certainty if self.certainty else None,
        )

    def check(self, samples: Samples) -> None:
        """Raise InputError where the denoiser is missing, or the image lacks what it takes."""
        check_denoiser(samples)
        if self.features and "albedo" not in samples.features:
            message = (
                f"{self.name!r} needs the albedo of the first hit, which this image lacks; it "
                f"has {sorted(samples.features) or 'none'}. Give denoised(..., features=False)"
            )
            raise InputError(message)


def denoised(
    estimator: str | Estimator | LearnedEstimator,
    *,
    features: bool = False,
    certainty: bool = False,
) -> Denoised:
    """Return an estimator followed by Open Image Denoise, for `chdstat.compare`.

    Where it learns, it shares the training of the estimator itself. Negative estimates count as 0.

    Parameters
    ----------
    estimator
        Name of a registered estimator, or an entry.
    features
        Give the denoiser albedo and normal of the first hit; the image must have them.
    certainty
        Mix with the estimate as far as it is certain, ``c estimate + (1 - c) denoised``; only for
        learned estimators whose models say so.

    Raises
    ------
    InputError
        If there is no such estimator, or `certainty` is asked of one that does not learn.

    References
    ----------
    A. T. Afra, "Intel Open Image Denoise", https://www.openimagedenoise.org. The blend: Firmino,
    Frisvad and Jensen 2022, "Progressive denoising of Monte Carlo rendered images", Computer
    Graphics Forum 41(2), doi:10.1111/cgf.14454.

    Examples
    --------
    >>> denoised("mean").name, denoised("progressive", features=True, certainty=True).name
    ('mean + OIDN', 'progressive + OIDN features certainty')
    """
    entry = lookup(estimator) if isinstance(estimator, str) else estimator
    if certainty and not isinstance(entry, LearnedEstimator):
        message = f"certainty=True is for estimators that learn, and {entry.name!r} does not"
        raise InputError(message)
    return Denoised(entry, features, certainty)


def through_denoiser(
    radiance: Array, features: Mapping[str, Array], *, certainty: Array | None = None
) -> Array:
    """Return estimates denoised, with albedo and normal where `features` have an albedo.

    Estimates of signed samples, and those of a network, may be negative. The denoiser takes no
    negative radiance: it counts as 0.
    """
    known = _GUIDES if "albedo" in features else ()
    guides: dict[str, Any] = {name: features[name] for name in known if name in features}
    start = np.where(radiance < 0, 0, radiance)
    return denoise(start, **guides, certainty=certainty)


def variants(
    entry: Estimator | LearnedEstimator, *, certain: bool, features: Mapping[str, Array]
) -> list[Denoised]:
    """Return every way to denoise an estimator that the image and its model allow."""
    return [
        Denoised(entry, guided, kept)
        for kept in ((False, True) if certain else (False,))
        for guided in ((False, True) if "albedo" in features else (False,))
    ]


def check_denoiser(samples: Samples) -> None:
    """Raise InputError where the denoiser is missing or takes no such image: before the work."""
    denoise(np.zeros((1, 1, samples.shape[2])))
