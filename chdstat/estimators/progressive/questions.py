"""Questions: samples to estimate from, with all that goes with them, checked once."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from chdstat._arrays import as_pixels, generator, warn_left_out
from chdstat._image_scales import mean_radiance
from chdstat.errors import InputError
from chdstat.estimators._rows import reordered
from chdstat.estimators.progressive.inputs import InputConfig
from chdstat.estimators.progressive.lessons import Scenery, ask
from chdstat.estimators.progressive.profiles import Profile
from chdstat.estimators.progressive.shapes import Shape

__all__ = ["Question", "check_asked"]

Array = npt.NDArray[Any]
Features = Mapping[str, Array]


@dataclass(frozen=True)
class Question:
    """What a network is asked.

    Attributes
    ----------
    samples
        Shape (..., channel, sample).
    features
        First-hit features of the picture.
    direct
        Direct part of the samples, of their shape; None where it is no input.
    balance
        From 0, the least MSE, to 1, the least relMSE.
    unit
        Mean radiance of the picture that the samples belong to.
    whole
        Whether they are the picture, in which its unit was measured.
    """

    samples: Array
    features: Features | None
    direct: Array | None
    balance: float
    unit: float
    whole: bool

    @classmethod
    def of(
        cls,
        x: npt.ArrayLike,
        inputs: InputConfig,
        channels: int,
        *,
        features: Features | None,
        direct: npt.ArrayLike | None,
        balance: float,
        unit: float | None,
    ) -> Self:
        """Check what a user asks of an estimator with inputs, for samples of so many channels.

        Raises
        ------
        InputError
            If the samples have another shape, the direct part is missing, or the balance is out of
            range.
        """
        samples = as_pixels(x)
        warn_left_out(samples, channel_axis=-2, within="chdstat.estimators")
        check_asked(channels, samples.shape[-2], balance)
        part = inputs.direct_of(direct, samples.shape)
        measured = mean_radiance(samples) if unit is None else unit
        return cls(samples, features, part, balance, measured, whole=unit is None)

    def halves(self) -> tuple[Self, Self]:
        """Return the same question about two halves of the samples, whatever their order."""
        samples, *direct = reordered(self.samples, *([] if self.direct is None else [self.direct]))
        first, second = (
            replace(
                self,
                samples=samples[..., k::2],
                direct=direct[0][..., k::2] if direct else None,
            )
            for k in range(2)
        )
        return first, second

    def some(self, most: int) -> Self:
        """Return the same question about so many pixels at most, each for itself."""
        rows = self._rows
        if len(rows) <= most:
            return self
        chosen = np.sort(generator(0).choice(len(rows), most, replace=False))
        direct = None if self.direct is None else self._flat(self.direct)[chosen]
        return replace(self, samples=rows[chosen], direct=direct)

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the pixels."""
        return self.samples.shape[:-2]

    def profile(self, part: slice) -> Profile:
        """Return the profiles of some pixels, counted along the flat image."""
        return Profile.of(
            self._rows[part],
            unit=self.unit,
            direct=None if self.direct is None else self._flat(self.direct)[part],
        )

    def seen(
        self, inputs: InputConfig, shape: Shape
    ) -> tuple[Scenery, npt.NDArray[np.float32] | None]:
        """Return what a network sees beside the samples, and what alike pixels say.

        Raises
        ------
        InputError
            If the samples are no picture where they must be, or features are not as in training.
        """
        profile, alike = None, None
        if inputs.neighbours:
            as_pixels(self.samples, image=True)
            profile = Profile.of(self.samples, unit=self.unit)
            alike = ask(self.samples) / np.float32(self.unit)
        scenery = inputs.scenery(self.features, self.shape, profile, described=shape.described)
        return scenery, alike

    @property
    def _rows(self) -> Array:
        return self._flat(self.samples)

    def _flat(self, x: Array) -> Array:
        return x.reshape(-1, *x.shape[-2:])


def check_asked(channels: int, asked: int, balance: float) -> None:
    """Refuse samples of other channels than a network's, and a balance out of range.

    Raises
    ------
    InputError
        If either is so.
    """
    if asked != channels:
        message = (
            f"the model was trained on samples with {channels} channels, got {asked}; "
            "train one for these"
        )
        raise InputError(message)
    if not 0 <= balance <= 1:
        message = f"balance must lie between 0 (MSE) and 1 (relMSE), got {balance}"
        raise InputError(message)
