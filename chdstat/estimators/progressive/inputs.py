"""Inputs of the progressive estimator: which ones it takes, and the network that they call for.

`InputConfig` says what is known of a pixel beside its samples, and refuses images where a part of
it is missing. `Architecture` follows from it: sizes of the layers, without the weights. Neither
needs torch, nor do the constants that training, estimation and model files share.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any, Literal, Self

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import as_samples
from chdstat.errors import InputError
from chdstat.estimators.progressive.auxiliary import BANDS, RADII
from chdstat.estimators.progressive.dataset import AuxiliaryFeatures, auxiliary_features
from chdstat.estimators.progressive.profile import OCTAVES, Profile
from chdstat.samples import Samples

__all__ = [
    "FLOOR",
    "GROUPS",
    "LEVELS",
    "LOSSES",
    "MOST_TRUST",
    "Architecture",
    "Input",
    "InputConfig",
]

Array = npt.NDArray[Any]
Features = Mapping[str, Array]
Input = Literal["features", "neighbours", "direct"]


LOSSES = ("mse", "relmse")
"""What the estimates of a network minimise."""
LEVELS = tuple(range(-8, 5, 2))
"""Levels of the mean, in octaves of the unit, that networks are trusted at."""
GROUPS = 2 * len(LEVELS)
"""Groups of pixels that a network is trusted in: of each level, brightened and darkened ones."""
MOST_TRUST = 1.5
"""Share of a move at most: beyond 1 where others are held back and the image would lose light."""
FLOOR = 0.01
"""Part of the squared mean radiance of the image that keeps relative errors finite."""


@dataclass(frozen=True)
class InputConfig:
    """What the estimator sees beside the samples of a pixel.

    Attributes
    ----------
    features
        Whether it sees what the camera rays hit: albedo, normal, depth and position.
    neighbours
        Whether it sees the pixels around: their profiles, and what `shared_patches` makes of those
        that are similar.
    direct
        Whether it sees direct and indirect light separately.
    """

    features: bool = False
    neighbours: bool = False
    direct: bool = False

    @classmethod
    def of(cls, names: Iterable[str]) -> Self:
        """Return the configuration with the inputs of these names.

        Raises
        ------
        InputError
            If there is no such input.

        Examples
        --------
        >>> InputConfig.of(["direct", "features"]).names
        ('features', 'direct')
        """
        given = {names} if isinstance(names, str) else set(names)
        known = {field.name for field in fields(cls)}
        if not given <= known:
            message = f"inputs must be among {sorted(known)}, got {sorted(map(str, given))}"
            raise InputError(message)
        return cls(**dict.fromkeys(given, True))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the inputs, in the order of the attributes."""
        return tuple(field.name for field in fields(self) if getattr(self, field.name))

    def check_training(self, images: Sequence[Samples], *, reference: bool) -> None:
        """Refuse what cannot be learned from.

        Raises
        ------
        InputError
            If there is no image, several without a reference, or neighbours with one.
        """
        if not images:
            message = "training needs at least one image, got none"
            raise InputError(message)
        if reference and self.neighbours:
            message = "neighbours are learned from without a reference; pass reference=False"
            raise InputError(message)
        if not reference and len(images) > 1:
            message = (
                f"without a reference, give the one image that is to be improved, got {len(images)}"
            )
            raise InputError(message)

    def features_of(self, samples: Samples) -> Features | None:
        """Return the first-hit features of an image, None where they are no input.

        Raises
        ------
        InputError
            If they are wanted and missing.
        """
        if not self.features:
            return None
        if not samples.features:
            message = (
                "this image has no first-hit features; render it, or leave 'features' out of inputs"
            )
            raise InputError(message)
        return samples.features

    def direct_of(self, direct: npt.ArrayLike | None, shape: tuple[int, ...]) -> Array | None:
        """Return the direct part of samples of a shape, None where it is no input.

        Raises
        ------
        InputError
            If it is wanted, and missing or of another shape.
        """
        if not self.direct:
            return None
        if direct is None:
            message = (
                "the model sees direct light; pass direct=, the direct part of the samples, as "
                "Samples.direct of an image that was rendered with direct=True"
            )
            raise InputError(message)
        part = as_samples(direct, name="direct")
        if part.shape != shape:
            message = f"direct must have the shape of the samples, {shape}, got {part.shape}"
            raise InputError(message)
        return part

    def check_profile(self, profile: Profile, parts: int) -> None:
        """Refuse profiles that do not hold the inputs, `parts` parts of each sample.

        Raises
        ------
        InputError
            If neighbours are an input, or profiles have other parts.
        """
        if self.neighbours:
            message = "an estimator that sees neighbours needs the samples, not their profiles"
            raise InputError(message)
        if profile.parts != parts:
            message = f"the model sees {parts} part(s) of a sample, got {profile.parts}"
            raise InputError(message)

    def auxiliary(
        self,
        features: Features | None,
        shape: tuple[int, ...],
        profile: Profile | None,
        *,
        described: int,
    ) -> AuxiliaryFeatures:
        """Return what is seen of pixels beside their samples.

        Parameters
        ----------
        features
            Of the image.
        shape
            Of the pixels.
        profile
            Of the image, where neighbours are an input.
        described
            Numbers that describe a pixel's first hit.

        Raises
        ------
        InputError
            If the pixels are no image where they must be, or features are not as in training.
        """
        found = AuxiliaryFeatures.nothing(int(np.prod(shape)))
        if self.features or self.neighbours:
            if len(shape) != 2:
                message = f"features belong to an image (y, x, channel, sample), got pixels {shape}"
                raise InputError(message)
            found = auxiliary_features(
                features if self.features else None, (shape[0], shape[1]), profile
            )
        if found.described.shape[1] != described:
            message = (
                f"the model sees {described} numbers of the first hit, but these features give "
                f"{found.described.shape[1]}; pass features= as it was trained with"
            )
            raise InputError(message)
        return found


@dataclass(frozen=True)
class Architecture:
    """Inputs and size of a network.

    Attributes
    ----------
    channels
        Channels of a sample.
    described
        Numbers that describe the first hit; 0 without features.
    neighbours
        Whether pixels around are inputs.
    parts
        Parts of a sample: 2 where direct and indirect light are separate inputs.
    width, layers
        Neurons of a hidden layer, and how many of these there are.
    """

    channels: int
    described: int = 0
    neighbours: bool = False
    parts: int = 1
    width: int = 128
    layers: int = 3

    @property
    def octaves(self) -> int:
        """Octaves of all parts."""
        return OCTAVES * self.parts

    @property
    def pools(self) -> int:
        """Windows around a pixel."""
        return len(RADII) if self.neighbours else 0

    @property
    def inputs(self) -> int:
        """Input neurons."""
        own = self.octaves * (1 + self.channels) + 1
        around = self.pools * (BANDS * (1 + self.channels) + 1)
        return own + self.described + around + self.channels * self.neighbours

    @property
    def outputs(self) -> int:
        """Output neurons for each loss: weights, offsets, and the worth of the experience."""
        return self.octaves + self.channels + 1 + self.pools * BANDS + int(self.neighbours)

    def to_dict(self) -> dict[str, Any]:
        """Return the fields, ready for JSON."""
        return asdict(self)
