"""Sights: what an estimator looks at beside the samples of a pixel, and whether it is all there."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import numpy.typing as npt

from chdstat._arrays import as_samples
from chdstat.errors import InputError
from chdstat.estimators.progressive.lessons import Scenery, scenery_of
from chdstat.estimators.progressive.profiles import Profile
from chdstat.samples import Samples

__all__ = ["Sights"]

Array = npt.NDArray[Any]
Features = Mapping[str, Array]


@dataclass(frozen=True)
class Sights:
    """What an estimator looks at; each is a parameter of `Progressive`, which explains it."""

    features: bool = False
    neighbours: bool = False
    direct: bool = False

    def names(self) -> list[str]:
        """Return the names of what it looks at."""
        return [field.name for field in fields(self) if getattr(self, field.name)]

    def check_lesson(
        self, pictures: Sequence[Samples], *, reference: bool, split_options: tuple[Any, Any]
    ) -> None:
        """Refuse what it cannot learn from; pixels and sizes are `split_options`.

        Raises
        ------
        InputError
            If there is no picture, or an option does not fit the others.
        """
        if not pictures:
            message = "training needs at least one picture, got none"
            raise InputError(message)
        if reference and self.neighbours:
            message = "neighbours=True learns without a reference: train(samples, reference=False)"
            raise InputError(message)
        if reference:
            return
        if split_options != (None, None):
            message = "pixels and sizes are for training with a reference; without one, all train"
            raise InputError(message)
        if len(pictures) > 1:
            message = (
                "several pictures are for training with a reference; without one, give the one "
                "picture that is to be improved"
            )
            raise InputError(message)

    def features_of(self, samples: Samples) -> Features | None:
        """Return the first-hit features of a picture, None where it does not look at them.

        Raises
        ------
        InputError
            If they are wanted and missing.
        """
        if not self.features:
            return None
        if not samples.features:
            message = "this picture has no first-hit features; render it, or pass features=False"
            raise InputError(message)
        return samples.features

    def direct_of(self, direct: npt.ArrayLike | None, shape: tuple[int, ...]) -> Array | None:
        """Return the direct part of samples of a shape, None where it does not look at it.

        Raises
        ------
        InputError
            If it is wanted, and missing or of another shape.
        """
        if not self.direct:
            return None
        if direct is None:
            message = (
                "the model looks at direct light; pass direct=, the direct part of the samples, as "
                "Samples.direct of a picture that was rendered with direct=True"
            )
            raise InputError(message)
        part = as_samples(direct, name="direct")
        if part.shape != shape:
            message = f"direct must have the shape of the samples, {shape}, got {part.shape}"
            raise InputError(message)
        return part

    def check_profile(self, profile: Profile, parts: int) -> None:
        """Refuse profiles that do not tell what it looks at, `parts` parts of each sample.

        Raises
        ------
        InputError
            If it looks at neighbours, or profiles have other parts.
        """
        if self.neighbours:
            message = "an estimator that looks at neighbours needs the samples, not their profiles"
            raise InputError(message)
        if profile.parts != parts:
            message = f"the model looks at {parts} part(s) of a sample, got {profile.parts}"
            raise InputError(message)

    def scenery(
        self,
        features: Features | None,
        shape: tuple[int, ...],
        profile: Profile | None,
        *,
        described: int,
    ) -> Scenery:
        """Return what it sees of pixels beside their samples.

        Parameters
        ----------
        features
            Of the picture.
        shape
            Of the pixels.
        profile
            Of the picture, where it looks at neighbours.
        described
            Numbers that it expects to describe a pixel.

        Raises
        ------
        InputError
            If the pixels are no picture where they must be, or features are not as in its training.
        """
        count = int(np.prod(shape))
        found = Scenery.nothing(count)
        if self.features or self.neighbours:
            if len(shape) != 2:
                message = (
                    f"features belong to a picture (y, x, channel, sample), got pixels {shape}"
                )
                raise InputError(message)
            found = scenery_of(features if self.features else None, (shape[0], shape[1]), profile)
        if found.described.shape[1] != described:
            message = (
                f"the model looks at {described} numbers of the first hit, but these features give "
                f"{found.described.shape[1]}; pass features= as it was trained with"
            )
            raise InputError(message)
        return found
