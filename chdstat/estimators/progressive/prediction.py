"""Prediction: a trained network on samples or profiles of many pixels, block by block on all cores.

`PredictionInput` holds samples with all that goes with them, checked once. How far it pays to go
from the mean to the estimate is measured here, too: between the two halves of the samples.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Self, TypeVar

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import as_pixels, generator, spans, warn_left_out
from chdstat._core.executor import in_order
from chdstat._core.image_scales import mean_radiance
from chdstat.errors import InputError
from chdstat.estimators.order import mean_of_good
from chdstat.estimators.progressive.dataset import AuxiliaryFeatures, shared_estimates
from chdstat.estimators.progressive.error_model import error_terms_of
from chdstat.estimators.progressive.inputs import LOSSES, Architecture, InputConfig
from chdstat.estimators.progressive.learned import Estimates, Learned
from chdstat.estimators.progressive.profile import ConstantPixels, Profile
from chdstat.estimators.progressive.shrinkage import Move, shrinkage_factor
from chdstat.estimators.rows import reordered

if TYPE_CHECKING:
    import torch

    from chdstat.estimators.progressive.network import NetworkOutput

__all__ = [
    "PredictionInput",
    "estimate_input",
    "estimate_profiles",
    "share_of_input",
    "share_of_profiles",
    "with_constants",
]

Array = npt.NDArray[Any]
Features = Mapping[str, Array]


@dataclass(frozen=True)
class PredictionInput:
    """Samples to estimate from, with all that goes with them.

    Attributes
    ----------
    samples
        Shape (..., channel, sample).
    features
        First-hit features of the image.
    direct
        Direct part of the samples, of their shape; None where it is no input.
    balance
        From 0, the least MSE, to 1, the least relMSE.
    unit
        Mean radiance of the image that the samples belong to.
    whole
        Whether they are the image, in which its unit was measured.
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
        """Check samples for an estimator with these inputs and channels.

        Raises
        ------
        InputError
            If the samples have another shape, the direct part is missing, or the balance is out of
            range.
        """
        samples = as_pixels(x)
        warn_left_out(samples, channel_axis=-2, within="chdstat.estimators")
        _check_input(channels, samples.shape[-2], balance)
        part = inputs.direct_of(direct, samples.shape)
        measured = mean_radiance(samples) if unit is None else unit
        return cls(samples, features, part, balance, measured, whole=unit is None)

    def halves(self) -> tuple[Self, Self]:
        """Return the same for two halves of the samples, whatever their order."""
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
        """Return the same for at most that many pixels, each for itself."""
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
        self, inputs: InputConfig, shape: Architecture
    ) -> tuple[AuxiliaryFeatures, npt.NDArray[np.float32] | None]:
        """Return what a network sees beside the samples, and estimates from similar pixels.

        Raises
        ------
        InputError
            If the samples are no image where they must be, or features are not as in training.
        """
        profile, shared = None, None
        if inputs.neighbours:
            as_pixels(self.samples, image=True)
            profile = Profile.of(self.samples, unit=self.unit)
            shared = shared_estimates(self.samples) / np.float32(self.unit)
        auxiliary = inputs.auxiliary(self.features, self.shape, profile, described=shape.described)
        return auxiliary, shared

    @property
    def _rows(self) -> Array:
        return self._flat(self.samples)

    def _flat(self, x: Array) -> Array:
        return x.reshape(-1, *x.shape[-2:])


def _check_input(channels: int, given: int, balance: float) -> None:
    """Refuse samples of other channels than a network's, and a balance out of range.

    Raises
    ------
    InputError
        If either is so.
    """
    if given != channels:
        message = (
            f"the model was trained on samples with {channels} channels, got {given}; "
            "train one for these"
        )
        raise InputError(message)
    if not 0 <= balance <= 1:
        message = f"balance must lie between 0 (MSE) and 1 (relMSE), got {balance}"
        raise InputError(message)


_Half = TypeVar("_Half")

_MEASURED = 2**14
"""Pixels that trust is measured on, where each is estimated for itself: more tell little more."""
_FEWEST_HALVES = 4
"""Samples that trust is measured with: two halves, one of them cut in two."""
_ROWS = 4096
"""Pixels at once: their profiles and hidden layers stay in the cache."""

_FEWEST_EQUAL = 2
"""Samples of a pixel before it counts as constant."""

Floats32 = npt.NDArray[np.float32]
Floats = npt.NDArray[np.floating[Any]]


def estimate_input(
    learned: Learned,
    inputs: InputConfig,
    given: PredictionInput,
    share: float,
    *,
    level: float | None,
) -> Estimates:
    """Estimate from samples, with a share of the way from the mean; see `_estimate_blocks`."""
    auxiliary, shared = given.seen(inputs, learned.network.architecture)
    found = _estimate_blocks(
        learned,
        given.profile,
        auxiliary,
        shared,
        shape=given.shape,
        share=share,
        balance=given.balance,
        level=level,
    )
    return with_constants(_with_means(found, given.samples), ConstantPixels.of(given.samples))


def estimate_profiles(
    learned: Learned,
    inputs: InputConfig,
    profile: Profile,
    share: float,
    *,
    features: Features | None,
    balance: float,
    level: float | None,
) -> Estimates:
    """Estimate from profiles, with a share of the way from the mean; see `_estimate_blocks`.

    Raises
    ------
    InputError
        If the profiles are not those of the inputs, or the balance is out of range.
    """
    architecture = learned.network.architecture
    _check_input(architecture.channels, profile.channels, balance)
    inputs.check_profile(profile, architecture.parts)
    pixels = profile.count.shape
    rows = profile.reshape(-1)
    return _estimate_blocks(
        learned,
        lambda part: rows[part],
        inputs.auxiliary(features, pixels, None, described=architecture.described),
        None,
        shape=pixels,
        share=share,
        balance=balance,
        level=level,
    )


def share_of_input(learned: Learned, inputs: InputConfig, given: PredictionInput) -> float:
    """Return how far it pays to go from the mean to the estimate, from halves of the samples."""
    count = given.samples.shape[-1]
    if count < _FEWEST_HALVES:
        return 0.0
    if not (inputs.features or inputs.neighbours):
        given = given.some(_MEASURED)
    # As far as all samples will be trusted, half of them are.
    fixed = replace(learned, trust=learned.trust.fixed(count))
    return _share_between(
        given.halves(),
        lambda half: estimate_input(fixed, inputs, half, 1.0, level=None),
        lambda half, radiance, other: Move.between(
            half.samples, radiance, other.samples, unit=given.unit
        ),
    )


def share_of_profiles(
    learned: Learned,
    inputs: InputConfig,
    halves: Sequence[Profile],
    *,
    features: Features | None,
    balance: float,
) -> float:
    """Return how far it pays to go from the mean to the estimate, from profiles of two halves."""
    count = sum(int(half.count.max(initial=0)) for half in halves)
    if count < _FEWEST_HALVES:
        return 0.0
    fixed = replace(learned, trust=learned.trust.fixed(count))
    return _share_between(
        halves,
        lambda half: estimate_profiles(
            fixed, inputs, half, 1.0, features=features, balance=balance, level=None
        ),
        Move.of_profiles,
    )


def _share_between(
    halves: Sequence[_Half],
    estimate: Callable[[_Half], Estimates],
    move: Callable[[_Half, Array, _Half], Move],
) -> float:
    """Compare the estimate from each half of the samples with the other half."""
    found = [estimate(half).radiance for half in halves]
    return shrinkage_factor(
        move(half, radiance, other)
        for half, radiance, other in zip(halves, found, halves[::-1], strict=True)
    )


def _estimate_blocks(
    learned: Learned,
    profile_of: Callable[[slice], Profile],
    auxiliary: AuxiliaryFeatures,
    shared: Floats32 | None,
    *,
    shape: tuple[int, ...],
    share: float,
    balance: float,
    level: float | None,
) -> Estimates:
    """Estimate from profiles.

    Parameters
    ----------
    learned
        The network.
    profile_of
        Returns the profiles of some of the rows.
    auxiliary
        What is known of the rows beside.
    shared
        Estimates from similar pixels, shape (row, channel), in units of the profiles'.
    shape
        Of the pixels that the rows are.
    share
        Of the way from the mean to the estimate, 0 to 1.
    balance
        0 for the first of the losses, 1 for the second.
    level
        Probability of the interval; None leaves it out (NaN).
    """
    import torch

    from chdstat.estimators.progressive.network import ShrunkNetwork, device, encode, threads

    rows, channels = int(np.prod(shape)), learned.network.architecture.channels
    radiance = np.empty((rows, channels), np.float32)
    low, high = (np.full_like(radiance, np.nan) for _ in range(2))
    certainty = np.empty(rows, np.float32)
    place = device()
    network = ShrunkNetwork(learned.network.to(place), learned.trust)

    def enter(part: slice) -> None:
        profile = profile_of(part)
        here = np.zeros((len(profile.count), 0), np.float32) if shared is None else shared[part]
        with torch.inference_mode():
            output = network(encode(profile, auxiliary[part], here, place))
            mixed = torch.lerp(output.estimate[:, 0], output.estimate[:, 1], balance)
            estimate = torch.lerp(output.mean, mixed, share)
            trust = share * torch.lerp(output.certainty[:, 0], output.certainty[:, 1], balance)
        unit, count = np.float32(profile.unit), profile.count
        certainty[part] = trust.cpu().numpy()
        with np.errstate(over="ignore", invalid="ignore"):
            radiance[part] = estimate.cpu().numpy() * unit
            if level is not None:
                variance = _variance(learned, output, profile, balance, share)
                ends = _interval(learned, estimate, variance, profile.count, balance, level)
                low[part], high[part] = (end * unit for end in ends)
            lost = (count == 0) | ~np.isfinite(radiance[part]).all(axis=-1)
            if lost.any():
                for array in (radiance, low, high):
                    array[part][lost] = profile[lost].mean()
                certainty[part][lost] = 0

    with threads(1):
        for _ in in_order(enter, spans(rows, _ROWS)):
            pass
    return Estimates(
        radiance=radiance.reshape(*shape, channels),
        certainty=certainty.reshape(shape),
        low=low.reshape(*shape, channels),
        high=high.reshape(*shape, channels),
        level=np.nan if level is None else level,
    )


def _with_means(found: Estimates, samples: npt.NDArray[Any]) -> Estimates:
    """Put the mean of good samples where a profile overflows or has no sample good as a whole."""
    lost = ~np.isfinite(found.radiance).all(axis=-1)
    if lost.any():
        with np.errstate(over="ignore"):
            mean = mean_of_good(samples[lost]).astype(np.float32)
        found.radiance[lost] = found.low[lost] = found.high[lost] = mean
        found.certainty[lost] = 0
    return found


def with_constants(found: Estimates, constant: ConstantPixels) -> Estimates:
    """Put the mean where all samples of a pixel are the same light: there is no noise to remove.

    In an image without any light nothing is known of its unit, either: it stays black. The
    interval is kept, and widened to hold the mean: what few samples say may still be wrong.
    """
    if constant.count < _FEWEST_EQUAL:
        return found
    same = constant.same & (constant.first.any(axis=-1) | (not constant.lit))
    if same.any():
        with np.errstate(over="ignore"):
            mean = constant.first[same].astype(np.float32)
        found.radiance[same], found.certainty[same] = mean, 0
        found.low[same] = np.minimum(found.low[same], mean)
        found.high[same] = np.maximum(found.high[same], mean)
    return found


def _variance(
    learned: Learned, output: NetworkOutput, profile: Profile, balance: float, share: float
) -> Floats:
    """Return the expected squared error, shape (row, channel).

    Where the estimate is not followed all the way, what the mean errs is added for the rest of it.
    """
    error_terms = np.stack([error_terms_of(output, profile, loss) for loss in range(len(LOSSES))])
    rest = (1 - share) * profile.variance_of_mean() if share < 1 else 0
    return np.asarray(learned.error_model.variance(error_terms, balance) + rest)


def _interval(
    learned: Learned,
    estimate: torch.Tensor,
    variance: Floats,
    count: npt.NDArray[np.int64],
    balance: float,
    level: float,
) -> tuple[Floats32, Floats32]:
    """Return the ends of the interval around an estimate."""
    middle = estimate.cpu().numpy().astype(np.float64)
    low, high = (
        learned.error_model.quantile(middle, variance, count, balance=balance, level=tail)
        for tail in ((1 - level) / 2, (1 + level) / 2)
    )
    return low.astype(np.float32), high.astype(np.float32)
