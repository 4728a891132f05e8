"""Training: against a reference where there is one, or against the image's own other samples.

Squared errors are divided by a power of ``y^2 + 0.01 m^2``, m being the image's mean. With a
reference, y is the reference, and the powers 0 and 1 of the two answers make them minimise MSE and
relMSE. Without one, y is the estimate itself, held fixed: then the weight says which pixels matter,
and the minimiser remains the mean of the target, whatever its noise (the relative loss of Lehtinen
et al. 2018, "Noise2Noise: learning image restoration without clean data").
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from chdstat._core.executor import cores, in_order
from chdstat.estimators.progressive.dataset import AuxiliaryFeatures, TrainingConfig, TrainingSet
from chdstat.estimators.progressive.network import Network, NetworkInput, NetworkOutput, device
from chdstat.estimators.progressive.profile import Profile
from chdstat.estimators.progressive.splits import Minibatch, MinibatchSource

__all__ = ["FLOOR", "encode", "learn", "threads"]

FLOOR = 0.01
"""Part of the squared mean radiance of the image that keeps relative errors finite."""
_DARKEST = 1e-3
"""Mean radiance of a channel, in units of the image's, below which it counts as this: relative
errors of a channel that is black would outweigh all others."""
_WITH_REFERENCE = (0.0, 1.0)
_WITHOUT = (0.5, 0.75)
"""Powers of the squared radiance in the loss of each aim. Without a reference they only say which
pixels matter; at the ends few bright or many dark ones do, and both errors are larger."""
_RECORDS, _APART = 40, 10
"""Records of a training at most, and iterations from one to the next at least: each takes a few."""
_VALIDATION_ROWS = 4096
_LARGEST_GRADIENT = 10.0
"""Norm at which gradients are cut: a firefly shall not undo many steps, nor often be cut."""
_KEEP = 0.995
"""Of the average of the weights at each step, as Polyak and Juditsky 1992 average them: the targets
are noisy, and so is each step."""
_AVERAGED = 0.1
"""Share of the steps that the average covers at most: a short training would keep its beginning."""

Array = npt.NDArray[np.float32]
Pixels = npt.NDArray[np.int64]


def learn(
    network: Network,
    training_set: TrainingSet,
    *,
    train: Pixels,
    validation: Pixels,
    rng: np.random.Generator,
    advance: Callable[[float], None],
) -> npt.NDArray[np.float64]:
    """Train a network in place.

    Parameters
    ----------
    network
        Left with the average of its weights over the last steps.
    material
        What to train with.
    train, validation
        Indices of the pixels that train and of those that only watch.
    rng
        Draws minibatches.
    advance
        Told of every iteration.

    Returns
    -------
    ndarray
        Rows (iteration, train loss, validation loss, train baseline, validation baseline), where
        the baseline is the sample mean under the same loss.
    """
    splits, auxiliary, config = training_set.splits, training_set.auxiliary, training_set.config
    network.to(device()).train()
    keep = min(_KEEP, max(0.0, 1 - 1 / (_AVERAGED * config.iterations)))
    average = AveragedModel(network, multi_avg_fn=get_ema_multi_avg_fn(keep))  # type: ignore[no-untyped-call]
    optimiser = torch.optim.Adam(network.parameters(), lr=config.learning_rate, fused=True)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, config.iterations)
    losses_of = _Losses.of(splits, reference=config.reference)
    validation_parts = _validation_parts(splits, validation, config, rng)
    every, seen, history = max(_APART, config.iterations // _RECORDS), [], []
    with threads(max(1, cores() - 1)):
        parts = _minibatches(splits, train, config, rng)
        for iteration, part in enumerate(parts, 1):
            losses = losses_of(_forward(network, part, auxiliary), part)
            optimiser.zero_grad()
            losses[0].backward()  # type: ignore[no-untyped-call]
            torch.nn.utils.clip_grad_norm_(network.parameters(), _LARGEST_GRADIENT)
            optimiser.step()
            schedule.step()
            average.update_parameters(network)
            seen.append([float(value.detach()) for value in losses])
            if iteration % every == 0 or iteration == config.iterations:
                held_out = _validate(average.module, validation_parts, auxiliary, losses_of)
                fit, baseline = np.mean(seen, axis=0)
                history.append((iteration, fit, held_out[0], baseline, held_out[1]))
                seen.clear()
            advance(1)
    network.load_state_dict(average.module.state_dict())
    network.to("cpu").eval()
    return np.array(history)


def encode(
    profile: Profile, auxiliary: AuxiliaryFeatures, shared: Array, place: str
) -> NetworkInput:
    """Return what a network sees of pixels; rows of `scenery` are those of the profiles."""
    count = np.maximum(profile.count, 1).astype(np.float32)
    bins = profile.bins / count[:, np.newaxis, np.newaxis]
    arrays = (bins, count, auxiliary.described, auxiliary.bands, auxiliary.weight, shared)
    return NetworkInput(*(torch.from_numpy(np.asarray(a, np.float32)).to(place) for a in arrays))


def _minibatches(
    splits: MinibatchSource, train: Pixels, config: TrainingConfig, rng: np.random.Generator
) -> Iterator[Minibatch]:
    """Yield minibatches, each drawn while the one before it trains."""
    own = rng.spawn(1)[0]

    def draw(size: int) -> Minibatch:
        return splits.draw(train, size, config.minibatch, own)

    # One worker, so that the draws come in order.
    return in_order(draw, rng.choice(config.sizes, config.iterations).tolist(), workers=1)


@dataclass(frozen=True)
class _Losses:
    """The losses, in units of what the mean of as many samples loses on average.

    Attributes
    ----------
    floor
        Of squared radiance, shape (channel,).
    powers
        Of the squared radiance that squared errors are divided by, shape (aim,).
    scale
        What one sample loses under each aim, shape (aim,).
    reference
        Whether a target is as good as the truth.
    """

    floor: torch.Tensor
    powers: tuple[float, ...]
    scale: npt.NDArray[np.float64]
    reference: bool

    @classmethod
    def of(cls, splits: MinibatchSource, *, reference: bool) -> _Losses:
        mean, variance = splits.mean, splits.variance
        floor = FLOOR * np.maximum(mean.mean(axis=0), _DARKEST) ** 2
        powers = _WITH_REFERENCE if reference else _WITHOUT
        scale = np.array([(variance / (mean**2 + floor) ** power).mean() for power in powers])
        place = torch.from_numpy(floor.astype(np.float32)).to(device())
        return cls(place, powers, np.where(scale > 0, scale, 1.0), reference)

    def __call__(self, answer: NetworkOutput, part: Minibatch) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the loss of both estimates together, and that of the mean."""
        target = self._target(part)
        truth = target if self.reference else answer.estimate.mean(dim=1).detach()
        weight = torch.stack(
            [
                part.size / scale / (truth**2 + self.floor) ** power
                for power, scale in zip(self.powers, self.scale, strict=True)
            ],
            dim=1,
        )
        errors = answer.estimate - target[:, None], (answer.mean - target)[:, None]
        loss, baseline = ((weight * error**2).mean() for error in errors)
        return loss, baseline

    def _target(self, part: Minibatch) -> torch.Tensor:
        return torch.from_numpy(part.target).to(self.floor.device)


def _forward(
    network: torch.nn.Module, part: Minibatch, auxiliary: AuxiliaryFeatures
) -> NetworkOutput:
    place = next(network.parameters()).device.type
    return network(encode(part.profile, auxiliary[part.rows], part.shared, place))  # type: ignore[no-any-return]


def _validate(
    network: torch.nn.Module,
    validation_parts: Sequence[Minibatch],
    auxiliary: AuxiliaryFeatures,
    losses_of: _Losses,
) -> tuple[float, float]:
    """Return the loss and the baseline's over fixed splits; NaN where nothing watches."""
    with torch.inference_mode():
        found = [losses_of(_forward(network, part, auxiliary), part) for part in validation_parts]
    values = np.array([[float(value) for value in pair] for pair in found]).reshape(-1, 2)
    loss, baseline = values.mean(axis=0) if len(values) else (np.nan, np.nan)
    return float(loss), float(baseline)


def _validation_parts(
    splits: MinibatchSource, pixels: Pixels, config: TrainingConfig, rng: np.random.Generator
) -> list[Minibatch]:
    """Draw the splits that watch: the same for every record, at the middle number of samples."""
    size = sorted(config.sizes)[len(config.sizes) // 2]
    return [splits.draw(pixels, size, _VALIDATION_ROWS, rng)] if len(pixels) else []


@contextlib.contextmanager
def threads(count: int) -> Iterator[None]:
    """Let torch use so many threads while the context lasts."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)
