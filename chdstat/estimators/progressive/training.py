"""Training, against a reference or against other samples of the same image.

Squared errors are divided by a power of ``y^2 + 0.01 m^2``, m being the image's mean. With a
reference, y is the reference, and the powers 0 and 1 make the two estimates minimise MSE and
relMSE. Without one, y is the estimate itself, held fixed: then the weight says which pixels matter,
and the minimiser remains the mean of the target, whatever its noise (the relative loss of Lehtinen
et al. 2018, "Noise2Noise: learning image restoration without clean data").

A tenth of the pixels is held out, to validate, to measure how far it pays to follow the network,
and to fit its error model.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from chdstat._core.arrays import generator, spans
from chdstat._core.executor import cores, in_order, track
from chdstat.errors import InputError
from chdstat.estimators.progressive.dataset import AuxiliaryFeatures, TrainingConfig, TrainingSet
from chdstat.estimators.progressive.error_model import ErrorModel, Floats, validation_batches
from chdstat.estimators.progressive.inputs import FLOOR, Architecture, InputConfig
from chdstat.estimators.progressive.learned import (
    Fingerprint,
    Learned,
    Origin,
    Trust,
    provenance_of,
)
from chdstat.estimators.progressive.network import (
    Network,
    NetworkOutput,
    ShrunkNetwork,
    device,
    encode,
    threads,
)
from chdstat.estimators.progressive.shrinkage import Move, keeping_mean, own_shares, reference_trust
from chdstat.estimators.progressive.splits import Minibatch, MinibatchSource

__all__ = ["learn", "measure_trust", "train_network"]

_DARKEST = 1e-3
"""Mean radiance of a channel, in units of the image's, below which it counts as this: relative
errors of a channel that is black would outweigh all others."""
_WITH_REFERENCE = (0.0, 1.0)
_WITHOUT = (0.5, 0.75)
"""Powers of the squared radiance in the loss of each output. Without a reference they only say
which pixels matter; at the ends few bright or many dark ones do, and both errors are larger."""
_VALIDATION = 0.1
"""Share of the pixels held out for validation, to measure how large the errors are."""
_VALIDATION_ALONE, _MOST_VALIDATION = 512, 0.25
"""Without a reference that takes at least so many, up to this share: what they measure is noisy."""
_FEWEST = 2
_RECORDS, _APART = 40, 10
"""Records of a training at most, and iterations from one to the next at least: each takes a few."""
_VALIDATION_ROWS = 4096
_ROWS_AT_ONCE = 1024
_LARGEST_GRADIENT = 10.0
"""Norm at which gradients are cut: a firefly shall not undo many steps, nor often be cut."""
_KEEP = 0.995
"""Of the average of the weights at each step, as Polyak and Juditsky 1992 average them: the targets
are noisy, and so is each step."""
_AVERAGED = 0.1
"""Share of the steps that the average covers at most: a short training would keep its beginning."""

Array = npt.NDArray[np.float32]
Pixels = npt.NDArray[np.int64]


def train_network(
    training_set: TrainingSet,
    origins: Sequence[Origin],
    *,
    inputs: InputConfig,
    seed: int,
    progress: bool | None,
) -> Learned:
    """Train a new network; pixels held out for validation tell how large its errors are.

    Parameters
    ----------
    training_set
        What to train with.
    origins
        The images that it was made of, at least one.
    inputs
        Of the estimator.
    seed
        Draws the first weights, the pixels held out, and the minibatches.
    progress
        Show a progress bar; None shows it on a terminal.

    Raises
    ------
    InputError
        If there are too few pixels.
    """
    count = len(training_set.pixels)
    if count < _FEWEST:
        message = (
            f"training needs at least {_FEWEST} pixels without a bad sample, got {count}; give a "
            "larger image"
        )
        raise InputError(message)
    rng = generator(seed).spawn(1)[0]
    order = rng.permutation(count)
    held_out = _validation_count(count, alone=not training_set.config.reference)
    auxiliary = training_set.auxiliary
    architecture = Architecture(
        channels=origins[0].shape[2],
        described=auxiliary.described.shape[1],
        neighbours=auxiliary.weight.shape[1] > 0,
        parts=training_set.splits.parts,
    )
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        network = Network(architecture)
    with track("training", training_set.config.iterations, unit="it", show=progress) as advance:
        history = learn(
            network,
            training_set,
            train=order[held_out:],
            validation=order[:held_out],
            rng=rng,
            advance=advance,
        )
    shrunk, trust = measure_trust(network, training_set, order[:held_out], rng)
    error_model = ErrorModel.learn(shrunk, training_set, pixels=order[:held_out], rng=rng)
    return Learned(
        network=network,
        error_model=error_model,
        unit=float(np.exp(np.mean(np.log([origin.unit for origin in origins])))),
        history=history,
        train_pixels=training_set.pixels,
        train_shape=(origins[0].shape[0], origins[0].shape[1]),
        provenance=provenance_of(origins, training_set, inputs=inputs, seed=seed, trust=trust),
        trust=trust,
        fingerprint=Fingerprint.of(training_set, origins[0].shape[2], generator(seed).spawn(2)[1]),
    )


def _validation_count(count: int, *, alone: bool) -> int:
    """Return how many of the pixels are held out."""
    usual = round(count * _VALIDATION)
    more = min(_VALIDATION_ALONE, round(count * _MOST_VALIDATION)) if alone else 0
    return max(1, usual, more)


def measure_trust(
    network: Network,
    training_set: TrainingSet,
    validation: npt.NDArray[np.int64],
    rng: np.random.Generator,
) -> tuple[ShrunkNetwork, Trust]:
    """Return a network that goes as far from the mean as it pays, and how far that is."""
    if training_set.config.reference:
        # Rare lamps and fireflies are in all pixels, hardly in a tenth of them.
        pixels = np.arange(len(training_set.pixels))
        trust = reference_trust(validation_batches(network, training_set, pixels=pixels, rng=rng))
    else:
        held_out = validation_batches(network, training_set, pixels=validation, rng=rng)
        shares = own_shares(map(Move.of, held_out))
        trust = keeping_mean(*shares, mean_change(network, training_set))
    return ShrunkNetwork(network, trust), trust


def mean_change(network: torch.nn.Module, training_set: TrainingSet) -> Floats:
    """Return what a network adds to the mean of all samples of pixels, shape (pixel, channel).

    It is the mean of what it adds under each loss, in units of the image's radiance, and nothing
    where all samples are the same light: there the mean is kept.
    """
    splits, found = training_set.splits, []
    for block in spans(len(splits), _ROWS_AT_ONCE):
        profile, shared = splits.whole(np.arange(block.start, block.stop))
        with torch.inference_mode():
            output = network(encode(profile, training_set.auxiliary[block], shared, "cpu"))
        found.append((output.estimate.mean(dim=1) - output.mean).numpy().astype(np.float64))
    noisy = splits.variance.any(axis=-1, keepdims=True)
    lit = splits.mean.any(axis=-1, keepdims=True)
    return np.where(noisy | ~lit, np.concatenate(found), 0)


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
    training_set
        What to train with.
    train, validation
        Indices of the pixels that train and of those held out for validation.
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
        Of the squared radiance that squared errors are divided by, shape (loss,).
    scale
        What one sample loses under each loss, shape (loss,).
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

    def __call__(self, output: NetworkOutput, part: Minibatch) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the loss of both estimates together, and that of the mean."""
        target = self._target(part)
        truth = target if self.reference else output.estimate.mean(dim=1).detach()
        weight = torch.stack(
            [
                part.size / scale / (truth**2 + self.floor) ** power
                for power, scale in zip(self.powers, self.scale, strict=True)
            ],
            dim=1,
        )
        errors = output.estimate - target[:, None], (output.mean - target)[:, None]
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
    """Return the loss and the baseline's over fixed splits; NaN where no pixel is held out."""
    with torch.inference_mode():
        found = [losses_of(_forward(network, part, auxiliary), part) for part in validation_parts]
    values = np.array([[float(value) for value in pair] for pair in found]).reshape(-1, 2)
    loss, baseline = values.mean(axis=0) if len(values) else (np.nan, np.nan)
    return float(loss), float(baseline)


def _validation_parts(
    splits: MinibatchSource, pixels: Pixels, config: TrainingConfig, rng: np.random.Generator
) -> list[Minibatch]:
    """Draw the splits of validation: the same for every record, at the middle number of samples."""
    size = sorted(config.sizes)[len(config.sizes) // 2]
    return [splits.draw(pixels, size, _VALIDATION_ROWS, rng)] if len(pixels) else []
