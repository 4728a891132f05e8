"""Inputs of the progressive estimator beside the samples of a pixel, and the estimates it returns.

`InputConfig` says which inputs there are. First hits describe the surface that a pixel shows. The
neighbourhood lends statistics: what rare samples may be worth, and what the light is like where a
pixel has seen none. Profiles around are averaged with weights that fall with the distance and with
how different the surfaces are; the pixel itself is left out, so that its neighbourhood is
independent of it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, Literal, NamedTuple, Self

import numpy as np
import numpy.typing as npt

from chdstat._core.display import Card, Shown, png
from chdstat._core.image_scales import tonemap
from chdstat.errors import InputError
from chdstat.estimators.neighbourhood import shared_patches
from chdstat.estimators.progressive.dataset import OCTAVES, Array, Profile
from chdstat.estimators.similarity import Window
from chdstat.estimators.validation import checked_direct
from chdstat.samples import Samples

__all__ = [
    "BANDS",
    "RADII",
    "Auxiliary",
    "EstimateOptions",
    "Estimates",
    "Features",
    "Input",
    "InputConfig",
    "keep_constants",
    "shared_estimates",
    "some_rows",
    "unchanged",
]

Auxiliary = Mapping[str, Array]
"""What is known of pixels beside their own samples, one row a pixel: ``described``, numbers of the
first hit (row, number); ``bands`` and ``weight`` of the neighbourhood, (row, radius, band, 1 +
channel) and (row, radius); ``shared``, estimates from similar pixels (row, channel)."""
Features = Mapping[str, npt.NDArray[Any]]
Input = Literal["features", "neighbours", "direct"]

RADII = (1, 3, 8)
"""Of the windows, in pixels."""
BANDS = 8
"""Parts of a pooled profile: of three octaves each, for an average needs fewer."""
_NAMES = ("albedo", "normal", "depth", "position")
_WAVES = 3
"""Octaves of sine and cosine of the position, so that light may vary faster than linearly."""
_DARK = 0.02
"""Albedo below which logarithms are cut."""
_ALBEDO, _COSINE, _PLANE = 0.05, 0.1, 0.02
"""Differences of albedo, 1 - cosine of the normals, and distance from the tangent plane over depth,
at which two surfaces count as unlike."""


@dataclass(frozen=True)
class InputConfig:
    """What the estimator takes beside the samples of a pixel.

    Attributes
    ----------
    features
        Whether it takes what the camera rays hit: albedo, normal, depth and position.
    neighbours
        Whether it takes the pixels around: their profiles, and the estimates of `shared_patches`
        from those that are similar.
    direct
        Whether it takes direct and indirect light separately.
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

    @property
    def parts(self) -> int:
        """Parts of a sample: 2 where direct and indirect light are separate inputs, else 1."""
        return 2 if self.direct else 1

    def features_of(self, samples: Samples) -> Features | None:
        """Return the first-hit features of an image, None where they are no input.

        Raises
        ------
        InputError
            If they are an input and missing.
        """
        if not self.features:
            return None
        if not samples.features:
            message = (
                "this image has no first-hit features; render it, or leave 'features' out of inputs"
            )
            raise InputError(message)
        return samples.features

    def direct_of(
        self, direct: npt.ArrayLike | None, shape: tuple[int, ...]
    ) -> npt.NDArray[Any] | None:
        """Return the direct part of samples of a shape, None where it is no input.

        Raises
        ------
        InputError
            If it is an input, and missing or of another shape.
        """
        if not self.direct:
            return None
        if direct is None:
            message = (
                "the model sees direct light; pass direct=, the direct part of the samples, as "
                "Samples.direct of an image that was rendered with direct=True"
            )
            raise InputError(message)
        return checked_direct(direct, shape)

    def auxiliary(
        self,
        features: Features | None,
        shape: tuple[int, ...],
        *,
        described: int | None = None,
        profile: Profile | None = None,
    ) -> dict[str, Array]:
        """Return the auxiliary features of pixels, one row a pixel.

        Parameters
        ----------
        features
            Of the image.
        shape
            Of the pixels.
        described
            Numbers of the first hit that the network takes; None for any.
        profile
            Of the image, where neighbours are an input.

        Raises
        ------
        InputError
            If the pixels are no image where they must be, or features are not as in training.
        """
        found = {}
        if (self.features or self.neighbours) and len(shape) != 2:
            message = f"features belong to an image (y, x, channel, sample), got pixels {shape}"
            raise InputError(message)
        known = features if self.features else None
        if known is not None:
            found["described"] = describe(known, shape).reshape(np.prod(shape), -1)
        if profile is not None:
            bands, weight = pool_around(profile, known)
            found["bands"] = bands.reshape(-1, *bands.shape[2:])
            found["weight"] = weight.reshape(-1, len(RADII))
        given = found["described"].shape[1] if "described" in found else 0
        if described not in (None, given):
            message = (
                f"the model sees {described} numbers of the first hit, but these features give "
                f"{given}; pass features= as it was trained with"
            )
            raise InputError(message)
        return found


@dataclass(frozen=True, repr=False)
class Estimates(Shown):
    """Estimates of a progressive estimator.

    Attributes
    ----------
    radiance
        Shape (..., channel), in the unit of the samples; NaN where no sample is good.
    certainty
        How far the estimate rests on what was learned, 0 to 1, shape (...): where it is 0, nothing
        was known of such a pixel, and the estimate is the mean of its samples.
    low, high
        Ends of the interval that contains the radiance with probability `level`, shape (...,
        channel).
    level
        Probability of the interval, on pixels like those that trained the network; of another
        scene it is not calibrated.
    """

    radiance: npt.NDArray[np.float32]
    certainty: npt.NDArray[np.float32]
    low: npt.NDArray[np.float32]
    high: npt.NDArray[np.float32]
    level: float

    def _card(self) -> Card:
        card = super()._card()
        if self.radiance.ndim != 3 or self.radiance.shape[-1] not in (1, 3):
            return card
        shown = {"estimate": png(tonemap(self.radiance)), "certainty": png(self.certainty)}
        return replace(card, images=shown)


class EstimateOptions(NamedTuple):
    """How to estimate.

    Attributes
    ----------
    share
        Of the way from the mean to the estimate, 0 to 1.
    loss_weight
        0 for the first of the losses, 1 for the second.
    level
        Probability of the interval; None leaves it out (NaN).
    spp
        Number of samples that estimates are followed as far as at; None for those that there are.
    """

    share: float
    loss_weight: float
    level: float | None = None
    spp: int | None = None


def shared_estimates(image: npt.NDArray[Any]) -> Array:
    """Return estimates from similar pixels around (pixel, channel), 0 where there are none."""
    estimates = np.nan_to_num(shared_patches(image), nan=0, posinf=0)
    return np.asarray(estimates.reshape(-1, estimates.shape[-1]), np.float32)


def some_rows(auxiliary: Auxiliary, rows: npt.NDArray[np.int64] | slice) -> dict[str, Array]:
    """Return the auxiliary features of some pixels."""
    return {name: array[rows] for name, array in auxiliary.items()}


def describe(features: Features, shape: tuple[int, ...]) -> Array:
    """Return numbers of about unit size for each pixel, shape (y, x, number).

    Albedo and its logarithm, the normal, the logarithm of the depth, and the position in units of
    its spread over the image with sine and cosine of it, as in Tancik et al. 2020, "Fourier
    features let networks learn high frequency functions in low dimensional domains".

    Parameters
    ----------
    features
        Albedo, normal, depth and position by name, shape (y, x) or (y, x, 3); those that are
        missing are left out.
    shape
        Height and width.

    Raises
    ------
    InputError
        If a feature has another shape.
    """
    numbers = [np.zeros((*shape, 0))]
    known = _checked(features, shape)
    if "albedo" in known:
        numbers += [known["albedo"], np.log(known["albedo"].clip(min=0) + _DARK)]
    if "normal" in known:
        numbers.append(known["normal"])
    if "depth" in known:
        numbers.append(_standard(np.log(known["depth"].clip(min=1e-6))))
    if "position" in known:
        position = _standard(known["position"])
        waves = [np.pi / 2 * 2**k * position for k in range(_WAVES)]
        numbers += [position, *map(np.sin, waves), *map(np.cos, waves)]
    return np.concatenate(numbers, axis=-1).astype(np.float32)


def _checked(features: Features, shape: tuple[int, ...]) -> dict[str, npt.NDArray[Any]]:
    """Return the features that there are, float64, finite, each of shape (y, x, number)."""
    found = {}
    for name in [name for name in _NAMES if name in features]:
        field = np.asarray(features[name], np.float64)
        if field.shape[:2] != shape or field.ndim not in (2, 3):
            message = f"feature {name!r} must have shape {shape} or {shape} x 3, got {field.shape}"
            raise InputError(message)
        found[name] = np.nan_to_num(np.atleast_3d(field), posinf=0, neginf=0)
    return found


def _standard(field: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Centre and scale a field (y, x, number); values far out, as those of the sky, are clipped."""
    flat = field.reshape(-1, field.shape[-1])
    low, high = np.quantile(flat, [0.01, 0.99], axis=0)
    inside = field.clip(low, high)
    return np.asarray((inside - inside.mean(axis=(0, 1))) / (inside.std(axis=(0, 1)) + 1e-6))


def pool_around(profile: Profile, features: Features | None) -> tuple[Array, Array]:
    """Pool the profiles around each pixel.

    Parameters
    ----------
    profile
        Of an image, shape (y, x).
    features
        First-hit features; those that are missing do not distinguish surfaces.

    Returns
    -------
    bands : ndarray
        Share of the samples in each band, then their radiance in each channel in units of the
        profile's; shape (y, x, radius, band, 1 + channel), 0 where nothing around is similar.
    weight : ndarray
        How many pixels' worth were pooled, shape (y, x, radius).
    """
    height, width = profile.count.shape
    known_features = _checked(features or {}, (height, width))
    fields = {name: field.astype(np.float32) for name, field in known_features.items()}
    count = np.maximum(profile.count, 1)[..., np.newaxis, np.newaxis]
    bands = (
        (profile.bins / count.astype(np.float32))
        .reshape(height, width, BANDS, OCTAVES // BANDS, -1)
        .sum(axis=3)
    )
    known = (profile.count > 0).astype(np.float32)[..., np.newaxis]
    # Single precision is plenty, at twice the speed.
    values: Any = np.concatenate([bands.reshape(height, width, -1) * known, known], axis=-1)
    compared: Any = (*np.indices((height, width), np.float32), *fields.values())
    pooled, weights = [], []
    for radius in RADII:
        reach = 2 * (radius / 1.5) ** 2

        def weigh(here: tuple[Any, ...], there: tuple[Any, ...], reach: float = reach) -> Any:
            distance = (here[0] - there[0]) ** 2 + (here[1] - there[1]) ** 2
            pairs = zip(fields, zip(here[2:], there[2:], strict=True), strict=True)
            return np.exp(-distance / reach - _dissimilarity(dict(pairs)))

        sums, _ = Window(weigh, compared, radius).sums(values)
        around = sums - values
        weight = np.maximum(around[..., -1:], 0)
        pooled.append(around[..., :-1] / np.maximum(weight, 1e-6))
        weights.append(weight[..., 0])
    stacked = np.stack(pooled, axis=2).reshape(height, width, len(RADII), BANDS, -1)
    return np.maximum(stacked, 0).astype(np.float32), np.stack(weights, axis=-1).astype(np.float32)


def _dissimilarity(pairs: Mapping[str, tuple[Any, Any]]) -> Any:
    """Return how unlike two surfaces are, 0 for the same, from features here and there."""
    total: Any = 0.0
    if "albedo" in pairs:
        here, there = pairs["albedo"]
        total = total + ((here - there) ** 2).sum(axis=-1) / _ALBEDO**2
    if "normal" in pairs:
        here, there = pairs["normal"]
        total = total + np.maximum(1 - (here * there).sum(axis=-1), 0) / _COSINE
        if {"position", "depth"} <= pairs.keys():
            across = ((pairs["position"][0] - pairs["position"][1]) * here).sum(axis=-1)
            total = total + (across / (_PLANE * pairs["depth"][0][..., 0] + 1e-6)) ** 2
    return total


def unchanged(first: npt.NDArray[Any], samples: npt.NDArray[Any]) -> npt.NDArray[np.bool_]:
    """Return which pixels have nothing but samples equal to their first, as lamps have.

    Parameters
    ----------
    first
        Shape (..., channel).
    samples
        Shape (..., channel, sample).
    """
    # The last one is another one in nearly all pixels; only the others are read as a whole.
    same = np.asarray((np.isfinite(first) & (samples[..., -1] == first)).all(axis=-1))
    same[same] = (samples[same] == first[same][..., np.newaxis]).all(axis=(-2, -1))
    return same


def keep_constants(
    found: Estimates, first: npt.NDArray[Any], same: npt.NDArray[np.bool_], *, lit: bool
) -> None:
    """Put the mean where all samples of a pixel are the same light: there is no noise to remove.

    In an image without any light (not `lit`) nothing is known of its unit, either: it stays black.
    The interval is kept, and widened to hold the mean: what few samples say may still be wrong.

    Parameters
    ----------
    found
        The estimates, which are changed.
    first, same
        The first sample of each pixel, shape (..., channel), and whether all others are equal to
        it, shape (...).
    """
    same = same & (first.any(axis=-1) | (not lit))
    if same.any():
        with np.errstate(over="ignore"):
            mean = first[same].astype(np.float32)
        found.radiance[same], found.certainty[same] = mean, 0
        found.low[same] = np.minimum(found.low[same], mean)
        found.high[same] = np.maximum(found.high[same], mean)
