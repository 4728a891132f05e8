"""Network of the progressive estimator: what it computes, how it is trained, its estimates.

Its inputs are the profile of a pixel and its auxiliary features. It predicts a weight for each
octave of the pixel's own samples, for each band of its neighbourhood, and an offset.
The proposal g is the radiance under these weights: all weights 1 and no offset give the mean. The
estimate is ``mean + (g - mean) / (1 + N / n0)``: n0, which the network predicts, too, is the number
of samples that its experience is worth. So the estimate tends to the mean as N grows.

There are two estimates from the same hidden layers, one for each of the losses. It is what Zirr et
al. 2018, doi:10.1111/cgf.13335, do with the layers of their cascade, by weights that are learned,
as kernels are by Bako et al. 2017, doi:10.1145/3072959.3073708.

In training, squared errors are divided by a power of ``y^2 + 0.01 m^2``, m being the image's mean.
With a reference, y is the reference, and the powers 0 and 1 make the two estimates minimise MSE and
relMSE. Without one, y is the estimate itself, held fixed: then the weight says which pixels matter,
and the minimiser remains the mean of the target, whatever its noise (the relative loss of Lehtinen
et al. 2018, "Noise2Noise: learning image restoration without clean data").
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Self

import numpy as np
import numpy.typing as npt
import torch
from torch import nn
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from chdstat._core.arrays import spans
from chdstat._core.executor import cores, in_order
from chdstat.estimators.progressive.dataset import OCTAVES, Floats, Indices, Profile, TrainingSet
from chdstat.estimators.progressive.error_model import BRIGHTNESS, FLOOR, LOSSES, error_terms
from chdstat.estimators.progressive.inputs import (
    BANDS,
    RADII,
    Auxiliary,
    EstimateOptions,
    Estimates,
    InputConfig,
    some_rows,
)
from chdstat.estimators.progressive.shrinkage import shares_at
from chdstat.estimators.training import descend, threads

if TYPE_CHECKING:
    from chdstat.estimators.progressive.training import Learned

__all__ = [
    "Network",
    "Output",
    "estimate_pixels",
    "group_weights",
    "learn",
    "new_network",
    "weighted_losses",
]

_FAINT = 1e-3
"""Radiance share, in units of the image's, below which differences hardly show."""
_LARGEST_WORTH = 12.0
"""log2 of the most samples that experience may be worth."""
_DARKEST = 1e-3
"""Mean radiance of a channel, in units of the image's, below which it counts as this: relative
errors of a channel that is black would outweigh all others."""
_WITH_REFERENCE = (0.0, 1.0)
_WITHOUT = (0.5, 0.75)
"""Powers of the squared radiance in the loss of each output. Without a reference they only say
which pixels matter; at the ends few bright or many dark ones do, and both errors are larger."""
_MINIBATCH = 1024
_LEARNING_RATE = 2e-3
"""At the start; it falls as a cosine to 0."""
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
_ROWS = 4096
"""Pixels at once: their profiles and hidden layers stay in the cache."""

Array = npt.NDArray[np.float32]
Output = tuple[torch.Tensor, torch.Tensor, torch.Tensor]
"""Estimates, one for each of the losses, shape (row, loss, channel), and means of the samples,
shape (row, channel), in units of the image's radiance; certainty, the weight of the proposal beside
the mean, 0 to 1, shape (row, loss)."""


class Network(nn.Module):
    """Dense network from the inputs of pixels to estimates of their radiance.

    Parameters
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

    Attributes
    ----------
    shape
        The parameters by name, as model files hold them.
    shrinkage
        How far estimates are followed, sizes and shares as of `shrinkage.measure_shrinkage`;
        certainty falls likewise. None follows them all the way.
    """

    def __init__(
        self,
        channels: int,
        described: int = 0,
        *,
        neighbours: bool = False,
        parts: int = 1,
        width: int = 128,
        layers: int = 3,
    ) -> None:
        super().__init__()
        self.shape = {
            "channels": channels,
            "described": described,
            "neighbours": neighbours,
            "parts": parts,
            "width": width,
            "layers": layers,
        }
        self.channels, self.described, self.neighbours = channels, described, neighbours
        self.shrinkage: tuple[Floats, Floats] | None = None
        pools = len(RADII) if neighbours else 0
        # Of octaves, offsets, the worth of the experience, bands around, and similar pixels.
        self.outputs = (OCTAVES * parts, channels, 1, pools * BANDS, int(neighbours))
        around = pools * (BANDS * (1 + channels) + 1) + channels * neighbours
        inputs = OCTAVES * parts * (1 + channels) + 1 + described + around
        sizes = [inputs] + [width] * layers
        self.hidden = nn.ModuleList(nn.Linear(a, b) for a, b in pairwise(sizes))
        self.answer = nn.Linear(sizes[-1], len(LOSSES) * sum(self.outputs))
        # All weights begin near 1: training starts from the mean.
        nn.init.zeros_(self.answer.weight)
        nn.init.zeros_(self.answer.bias)

    def forward(self, profile: Profile, auxiliary: Auxiliary) -> Output:
        """Estimate under every loss from profiles of pixels, and what is known of them beside."""
        samples = np.maximum(profile.count, 1).astype(np.float32)
        bins = self._tensor(profile.bins / samples[:, np.newaxis, np.newaxis])
        count, radiance = self._tensor(samples), bins[..., 1:]
        given = {name: self._tensor(array) for name, array in auxiliary.items()}
        inputs = [_compressed(bins).flatten(1), (torch.log2(count) / 4 - 1.25)[:, None]]
        if self.described:
            inputs.append(given["described"])
        if self.neighbours:
            inputs += [_compressed(given["bands"]).flatten(1), torch.log1p(given["weight"])]
            inputs.append(0.2 * torch.log1p(given["shared"].clamp(min=0) / _FAINT))
        hidden = torch.cat(inputs, dim=1)
        for layer in self.hidden:
            hidden = torch.relu_(layer(hidden))
        outputs = self.answer(hidden).unflatten(1, (len(LOSSES), -1))
        own, offset, worth, around, similar = outputs.split(self.outputs, dim=-1)
        proposal = torch.exp(own.clamp(-8, 3)) @ radiance + torch.exp((offset - 5).clamp(-12, 4))
        if self.neighbours:
            weights = torch.exp((around - 3).clamp(-10, 2))
            proposal = proposal + weights @ given["bands"][..., 1:].flatten(1, 2)
            proposal = proposal + torch.exp((similar - 1).clamp(-10, 2)) * given["shared"][:, None]
        worth = torch.exp2((2 * worth + 5).clamp(-4, _LARGEST_WORTH))
        certainty = worth / (worth + count[:, None, None])
        mean = radiance.sum(dim=1)
        means = mean[:, None].expand_as(proposal)
        estimate, certainty = torch.lerp(means, proposal, certainty), certainty[..., 0]
        if self.shrinkage is not None:
            shares = self._tensor(shares_at(*self.shrinkage, samples))
            share = (shares * group_weights(means, estimate - means)).sum(dim=-1)
            estimate = torch.lerp(means, estimate, share[..., None])
            certainty = certainty * share.clamp(max=1)
        return estimate, mean, certainty

    def _tensor(self, array: npt.NDArray[Any]) -> torch.Tensor:
        return torch.from_numpy(np.asarray(array, np.float32)).to(self.answer.weight.device)

    def at_spp(self, spp: int) -> Self:
        """Return the same network, which follows all estimates as far as those of `spp` samples."""
        found = copy.copy(self)
        if self.shrinkage is not None:
            found.shrinkage = np.ones(1), shares_at(*self.shrinkage, np.array([spp]))
        return found

    def load_arrays(self, arrays: dict[str, npt.NDArray[np.float32]]) -> None:
        """Take over weights by name.

        Raises
        ------
        ValueError
            If one is missing, of another shape, or not finite.
        """
        if not all(np.isfinite(array).all() for array in arrays.values()):
            message = "weights must be finite"
            raise ValueError(message)
        try:
            self.load_state_dict({k: torch.from_numpy(v) for k, v in arrays.items()})
        except RuntimeError as error:
            raise ValueError(str(error)) from error

    def to_arrays(self) -> dict[str, npt.NDArray[np.float32]]:
        """Return the weights by name."""
        return {name: w.detach().cpu().numpy().copy() for name, w in self.state_dict().items()}


def _compressed(bins: torch.Tensor) -> torch.Tensor:
    """Return shares and radiance so that rare and bright samples do not outweigh all others.

    Negative radiance looks like none.
    """
    bins = bins.clamp(min=0)
    # The shares go through the logarithm, too, as one loop over all is faster than one with gaps.
    legible = torch.log1p(bins / _FAINT).mul_(0.2)
    legible[..., 0] = bins[..., 0].sqrt()
    return legible


def group_weights(mean: torch.Tensor, move: torch.Tensor) -> torch.Tensor:
    """Return how far each pixel belongs to each group, shape (..., group), which sums to 1.

    Groups are levels of the mean, first of pixels that are brightened, then of those that are
    darkened.

    Parameters
    ----------
    mean, move
        Shape (..., channel), in units of the image's radiance.
    """
    octave = torch.log2(mean.mean(dim=-1).clamp(min=1e-12))
    levels = torch.as_tensor(BRIGHTNESS, dtype=mean.dtype, device=mean.device)
    place = octave.clamp(levels[0], levels[-1])
    near = (1 - (place[..., None] - levels).abs() / 2).clamp(min=0)
    up = (move.mean(dim=-1) > 0)[..., None]
    return torch.cat([near * up, near * ~up], dim=-1)


def learn(
    network: Network,
    training_set: TrainingSet,
    train: Indices,
    validation: Indices,
    *,
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
        Called after every iteration.

    Returns
    -------
    ndarray
        Rows of `History`; the baseline is the sample mean under the same loss.
    """
    iterations = training_set.iterations
    network.to("cuda" if torch.cuda.is_available() else "cpu").train()
    keep = min(_KEEP, max(0.0, 1 - 1 / (_AVERAGED * iterations)))
    average = AveragedModel(network, multi_avg_fn=get_ema_multi_avg_fn(keep))  # type: ignore[no-untyped-call]
    losses_of = weighted_losses(training_set, network.answer.weight.device)

    def drawn(pixels: Indices, n: int, rows: int, own: np.random.Generator) -> tuple[Any, ...]:
        chosen, places = training_set.draw(pixels, n, rows, own)
        size = int(training_set.counts[places].sum())
        return (*training_set.minibatch(chosen, places), size)

    def losses(model: nn.Module, minibatch: tuple[Any, ...]) -> tuple[torch.Tensor, torch.Tensor]:
        profile, auxiliary, target, size = minibatch
        return losses_of(model(profile, auxiliary), target, size)

    # The same splits for every record, at the middle number of samples.
    middle = sorted(training_set.sizes)[len(training_set.sizes) // 2]
    held_out = drawn(validation, middle, _VALIDATION_ROWS, rng)
    own, sizes = rng.spawn(1)[0], rng.choice(training_set.sizes, iterations).tolist()
    # Each is drawn while the one before it trains; one worker, so that they come in order.
    minibatches = in_order(lambda n: drawn(train, n, _MINIBATCH, own), sizes, workers=1)
    history = []
    with threads(max(1, cores() - 1)):
        for iteration, seen in descend(
            list(network.parameters()),
            (losses(network, minibatch) for minibatch in minibatches),
            iterations=iterations,
            every=max(_APART, iterations // _RECORDS),
            learning_rate=_LEARNING_RATE,
            annealed=True,
            largest_gradient=_LARGEST_GRADIENT,
            after_step=lambda: average.update_parameters(network),
            advance=advance,
        ):
            with torch.inference_mode():
                outside, of_mean = map(float, losses(average.module, held_out))
            fit, baseline = np.mean([[float(loss) for loss in pair] for pair in seen], axis=0)
            history.append((iteration, fit, outside, baseline, of_mean))
    network.load_state_dict(average.module.state_dict())
    network.to("cpu").eval()
    return np.array(history)


def new_network(training_set: TrainingSet, inputs: InputConfig, *, seed: int) -> Network:
    """Return an untrained network for the pixels of a training set."""
    auxiliary = training_set.auxiliary
    described = auxiliary["described"].shape[1] if "described" in auxiliary else 0
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        channels = training_set.scenes[0]["samples_shape"][2]
        return Network(channels, described, neighbours=inputs.neighbours, parts=inputs.parts)


def weighted_losses(
    training_set: TrainingSet, place: torch.device
) -> Callable[[Output, Array, int], tuple[torch.Tensor, torch.Tensor]]:
    """Return the loss of a network, in units of what the mean of as many samples loses on average.

    It takes the output of the network, the target (row, channel), and how many samples were learned
    from, and returns the loss of both estimates together, and that of the mean.
    """
    mean, variance = training_set.mean, training_set.variance
    floor = FLOOR * np.maximum(mean.mean(axis=0), _DARKEST) ** 2
    powers = _WITH_REFERENCE if training_set.reference else _WITHOUT
    scales = np.array([(variance / (mean**2 + floor) ** power).mean() for power in powers])
    scales = np.where(scales > 0, scales, 1.0)
    dark = torch.from_numpy(floor.astype(np.float32)).to(place)

    def losses_of(output: Output, target: Array, size: int) -> tuple[torch.Tensor, torch.Tensor]:
        estimate, of_samples, _ = output
        wanted = torch.from_numpy(target).to(place)
        truth = wanted if training_set.reference else estimate.mean(dim=1).detach()
        weight = torch.stack(
            [
                size / scale / (truth**2 + dark) ** power
                for power, scale in zip(powers, scales, strict=True)
            ],
            dim=1,
        )
        errors = estimate - wanted[:, None], (of_samples - wanted)[:, None]
        loss, baseline = ((weight * error**2).mean() for error in errors)
        return loss, baseline

    return losses_of


def estimate_pixels(
    learned: Learned,
    profile_of: Callable[[slice], Profile],
    auxiliary: Auxiliary,
    shape: tuple[int, ...],
    options: EstimateOptions,
) -> Estimates:
    """Estimate from profiles of many pixels, block by block on all cores.

    Where the network overflows, it is the mean of the profile.

    Parameters
    ----------
    learned
        What estimates, and what knows how large its errors are.
    profile_of
        Returns the profiles of some of the pixels, counted along the flat image.
    auxiliary, shape
        What is known of all pixels beside, and their shape.
    options
        How to estimate.
    """
    share, loss_weight, level, spp = options
    network = learned.network.to("cuda" if torch.cuda.is_available() else "cpu")
    network = network if spp is None else network.at_spp(spp)
    error_model, rows = learned.error_model, int(np.prod(shape))
    radiance = np.empty((rows, network.channels), np.float32)
    low, high = (np.full_like(radiance, np.nan) for _ in range(2))
    certainty = np.empty(rows, np.float32)

    def enter(part: slice) -> None:
        profile = profile_of(part)
        with torch.inference_mode():
            output = network(profile, some_rows(auxiliary, part))
            estimates, mean, sure = output
            mixed = torch.lerp(estimates[:, 0], estimates[:, 1], loss_weight)
            estimate = torch.lerp(mean, mixed, share).cpu().numpy()
            trust = share * torch.lerp(sure[:, 0], sure[:, 1], loss_weight)
        unit = np.float32(profile.unit)
        certainty[part] = trust.cpu().numpy()
        with np.errstate(over="ignore", invalid="ignore"):
            radiance[part] = estimate * unit
            if level is not None:
                noise = profile.variance_of_mean()
                whole, means, certain = (t.cpu().numpy().astype(np.float64) for t in output)
                terms = error_terms(np.moveaxis(whole, 1, 0), means, certain.T, noise)
                variance = error_model.variance(terms, loss_weight)
                if share < 1:  # what the mean errs, for the rest of the way
                    variance = variance + (1 - share) * noise
                given = estimate.astype(np.float64), variance, profile.count
                for end, tail in ((low, (1 - level) / 2), (high, (1 + level) / 2)):
                    found = error_model.quantile(*given, loss_weight=loss_weight, level=tail)
                    end[part] = found.astype(np.float32) * unit
            lost = (profile.count == 0) | ~np.isfinite(radiance[part]).all(axis=-1)
            if lost.any():
                for array in (radiance, low, high):
                    array[part][lost] = profile[lost].mean()
                certainty[part][lost] = 0

    with threads(1):
        for _ in in_order(enter, spans(rows, _ROWS)):
            pass
    radiance, low, high = (a.reshape(*shape, network.channels) for a in (radiance, low, high))
    return Estimates(radiance, certainty.reshape(shape), low, high, level or np.nan)
