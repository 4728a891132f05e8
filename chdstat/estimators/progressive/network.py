"""Dense network that weighs the octaves of a pixel's luminance.

Its inputs are the profile of a pixel and its auxiliary features. It predicts a weight for each
octave of the pixel's own samples, for each band of its neighbourhood, and an offset.
The proposal g is the radiance under these weights: all weights 1 and no offset give the mean. The
estimate is ``mean + (g - mean) / (1 + N / n0)``: n0, which the network predicts, too, is the number
of samples that its experience is worth. So the estimate tends to the mean as N grows.

There are two estimates from the same hidden layers, one for each `LOSSES`.

It is what Zirr et al. 2018, doi:10.1111/cgf.13335, do with the layers of their cascade, by weights
that are learned, as kernels are by Bako et al. 2017, doi:10.1145/3072959.3073708.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt
import torch
from torch import nn

from chdstat.estimators.progressive.auxiliary import BANDS
from chdstat.estimators.progressive.dataset import AuxiliaryFeatures
from chdstat.estimators.progressive.inputs import LEVELS, LOSSES, Architecture
from chdstat.estimators.progressive.learned import Trust
from chdstat.estimators.progressive.profile import Profile

__all__ = [
    "Network",
    "NetworkInput",
    "NetworkOutput",
    "ShrunkNetwork",
    "device",
    "encode",
    "group_weights",
    "threads",
]

_FAINT = 1e-3
"""Radiance share, in units of the image's, below which differences hardly show."""
_LARGEST_WORTH = 12.0
"""log2 of the most samples that experience may be worth."""


@dataclass(frozen=True)
class NetworkInput:
    """Inputs of the network for some pixels; all radiance in units of the image's.

    Attributes
    ----------
    bins
        Share of the samples in each octave, then the radiance in each channel, divided by the
        number of samples; shape (row, octave, 1 + channel), the octaves of all parts.
    count
        Samples, shape (row,).
    described
        Of the first hit, shape (row, number).
    bands, weight
        Of the neighbourhood, shape (row, radius, band, 1 + channel) and (row, radius).
    shared
        Estimates from similar pixels around, shape (row, channel).
    """

    bins: torch.Tensor
    count: torch.Tensor
    described: torch.Tensor
    bands: torch.Tensor
    weight: torch.Tensor
    shared: torch.Tensor


@dataclass(frozen=True)
class NetworkOutput:
    """Estimates of the network for pixels, in units of the image's radiance.

    Attributes
    ----------
    estimate
        For each of `LOSSES`, shape (row, loss, channel).
    mean
        Of the samples, shape (row, channel).
    certainty
        Weight of the proposal beside the mean, 0 to 1, shape (row, loss).
    """

    estimate: torch.Tensor
    mean: torch.Tensor
    certainty: torch.Tensor


class Network(nn.Module):
    """Dense network from the inputs of pixels to estimates of their radiance."""

    def __init__(self, architecture: Architecture) -> None:
        super().__init__()
        self.architecture = architecture
        sizes = [architecture.inputs] + [architecture.width] * architecture.layers
        self.hidden = nn.ModuleList(nn.Linear(a, b) for a, b in pairwise(sizes))
        self.answer = nn.Linear(sizes[-1], len(LOSSES) * architecture.outputs)
        # All weights begin near 1: training starts from the mean.
        nn.init.zeros_(self.answer.weight)
        nn.init.zeros_(self.answer.bias)

    def forward(self, given: NetworkInput) -> NetworkOutput:
        """Estimate under every loss."""
        hidden = self._encoded(given)
        for layer in self.hidden:
            hidden = torch.relu_(layer(hidden))
        radiance = given.bins[..., 1:]
        mean = radiance.sum(dim=1)
        channels, pools = self.architecture.channels, self.architecture.pools
        outputs = self.answer(hidden).unflatten(1, (len(LOSSES), -1))
        sizes = (
            self.architecture.octaves,
            channels,
            1,
            pools * BANDS,
            int(self.architecture.neighbours),
        )
        own, offset, worth, around, others = outputs.split(sizes, dim=-1)
        proposal = torch.exp(own.clamp(-8, 3)) @ radiance + torch.exp((offset - 5).clamp(-12, 4))
        if pools:
            weights = torch.exp((around - 3).clamp(-10, 2))
            proposal = proposal + weights @ given.bands[..., 1:].flatten(1, 2)
            proposal = proposal + torch.exp((others - 1).clamp(-10, 2)) * given.shared[:, None]
        samples = torch.exp2((2 * worth + 5).clamp(-4, _LARGEST_WORTH))
        certainty = samples / (samples + given.count[:, None, None])
        estimate = torch.lerp(mean[:, None].expand_as(proposal), proposal, certainty)
        return NetworkOutput(estimate, mean, certainty[..., 0])

    def _encoded(self, given: NetworkInput) -> torch.Tensor:
        parts = [_compressed(given.bins).flatten(1), (torch.log2(given.count) / 4 - 1.25)[:, None]]
        if self.architecture.described:
            parts.append(given.described)
        if self.architecture.neighbours:
            parts += [_compressed(given.bands).flatten(1), torch.log1p(given.weight)]
            parts.append(0.2 * torch.log1p(given.shared.clamp(min=0) / _FAINT))
        return torch.cat(parts, dim=1)

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


class ShrunkNetwork(nn.Module):
    """A network whose estimates are followed as far as they pay; its certainty falls likewise.

    Parameters
    ----------
    network
        The network.
    trust
        How far.
    """

    def __init__(self, network: Network, trust: Trust) -> None:
        super().__init__()
        self.network, self.trust, self.architecture = network, trust, network.architecture

    def forward(self, given: NetworkInput) -> NetworkOutput:
        """Estimate under every loss."""
        found = self.network(given)
        mean = found.mean[:, None].expand_as(found.estimate)
        shares = torch.from_numpy(self.trust.at(given.count.cpu().numpy())).to(mean)
        share = (shares * group_weights(mean, found.estimate - mean)).sum(dim=-1)
        estimate = torch.lerp(mean, found.estimate, share[..., None])
        return NetworkOutput(estimate, found.mean, found.certainty * share.clamp(max=1))


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
    levels = torch.as_tensor(LEVELS, dtype=mean.dtype, device=mean.device)
    place = octave.clamp(levels[0], levels[-1])
    near = (1 - (place[..., None] - levels).abs() / 2).clamp(min=0)
    up = (move.mean(dim=-1) > 0)[..., None]
    return torch.cat([near * up, near * ~up], dim=-1)


def encode(
    profile: Profile, auxiliary: AuxiliaryFeatures, shared: npt.NDArray[np.float32], place: str
) -> NetworkInput:
    """Return the inputs of a network; rows of `auxiliary` are those of the profiles."""
    count = np.maximum(profile.count, 1).astype(np.float32)
    bins = profile.bins / count[:, np.newaxis, np.newaxis]
    arrays = (bins, count, auxiliary.described, auxiliary.bands, auxiliary.weight, shared)
    return NetworkInput(*(torch.from_numpy(np.asarray(a, np.float32)).to(place) for a in arrays))


def device() -> str:
    """Return where torch computes: a GPU where it finds one."""
    return "cuda" if torch.cuda.is_available() else "cpu"


@contextlib.contextmanager
def threads(count: int) -> Iterator[None]:
    """Let torch use so many threads while the context lasts."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)
