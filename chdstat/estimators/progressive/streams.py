"""Stream: samples as they are rendered, kept as profiles, with an estimate at any time."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from chdstat._arrays import as_samples
from chdstat.errors import InputError
from chdstat.estimators.classical import mean_of_good
from chdstat.estimators.progressive.exposure import picture_unit
from chdstat.estimators.progressive.first_hit import Features
from chdstat.estimators.progressive.model import Progressive
from chdstat.estimators.progressive.profiles import Profile
from chdstat.estimators.progressive.results import Estimates

__all__ = ["Stream"]


class Stream:
    """Estimates that get better with every batch, in memory that does not grow.

    A pixel takes 24 octaves of 4 numbers (of RGB), however many samples there are.

    Parameters
    ----------
    model
        A trained estimator that looks at no neighbours.
    features
        First-hit features of the picture, where it looks at these.
    unit
        Mean radiance of the picture; None measures it on the first batch.

    Examples
    --------
    >>> import chdstat as chd
    >>> rng = np.random.default_rng(0)
    >>> rendered = rng.exponential(size=(16, 16, 1, 64))
    >>> model = Progressive().train(chd.Samples.from_array(rendered), iterations=10, progress=False)
    >>> stream = Stream(model)
    >>> for first in range(0, 64, 16):
    ...     stream.update(rendered[..., first : first + 16])
    >>> int(stream.count[0, 0]), stream.estimate().radiance.shape
    (64, (16, 16, 1))
    """

    def __init__(
        self, model: Progressive, *, features: Features | None = None, unit: float | None = None
    ) -> None:
        self.model = model
        self.features = features
        self._unit = unit
        self._profile: Profile | None = None

    @property
    def count(self) -> npt.NDArray[np.int64]:
        """Good samples so far, shape (...)."""
        return self._state.count

    @property
    def nbytes(self) -> int:
        """Bytes that are kept."""
        return 0 if self._profile is None else self._profile.bins.nbytes + self.count.nbytes

    def update(self, x: npt.ArrayLike) -> None:
        """Add samples (..., channel, sample) of the same pixels as before.

        Raises
        ------
        InputError
            If these are other pixels, or `x` has no channels.
        """
        samples = as_samples(x)
        if samples.ndim < 2:
            message = f"x must have shape (..., channel, sample), got {samples.shape}"
            raise InputError(message)
        shape, channels = samples.shape[:-2], samples.shape[-2]
        if self._profile is None:
            unit = picture_unit(mean_of_good(samples)) if self._unit is None else self._unit
            self._profile = Profile.empty(shape, channels, unit=unit)
        kept = self._profile
        if (kept.count.shape, kept.channels) != (shape, channels):
            message = (
                f"the stream holds pixels {kept.count.shape} with {kept.channels} channels, got "
                f"samples of shape {samples.shape}"
            )
            raise InputError(message)
        kept.add(Profile.of(samples, unit=kept.unit))

    def mean(self) -> npt.NDArray[np.floating[Any]]:
        """Return the sample mean so far, shape (..., channel)."""
        return self._state.mean()

    def estimate(self, *, balance: float = 0.5, level: float = 0.9) -> Estimates:
        """Estimate from all samples so far; see `Progressive.estimate`."""
        return self.model.of_profile(
            self._state, features=self.features, balance=balance, level=level
        )

    @property
    def _state(self) -> Profile:
        if self._profile is None:
            message = "the stream has no samples yet; call update(samples)"
            raise InputError(message)
        return self._profile
