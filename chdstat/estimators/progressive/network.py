"""Network of the progressive estimator.

Its inputs are the profile of a pixel and the numbers that describe its first hit. It predicts a
weight for each octave of the pixel's samples, and an offset. The proposal g is the radiance under
these weights: all weights 1 and no offset give the mean. The estimate is ``mean + (g - mean) / (1 +
N / n0)``, which tends to the mean as N grows. The network also predicts n0, the number of samples
that its training is worth.

The same hidden layers produce two estimates, one for each loss: squared errors, and squared errors
divided by ``y^2 + 0.01 m^2`` with the reference y and the image's mean m. Zirr et al. 2018,
doi:10.1111/cgf.13335, weight the layers of their cascade by a formula; here the weights are
learned, as Bako et al. 2017, doi:10.1145/3072959.3073708, learn kernels.
"""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import torch
from torch import nn

from chdstat._core.arrays import Image, Reals, spans
from chdstat._core.work import in_order
from chdstat.estimators.progressive.errors import BRIGHTNESS, LOSSES, error_terms, shares_at
from chdstat.estimators.progressive.inputs import OCTAVES, Profile
from chdstat.estimators.registry import Estimates
from chdstat.estimators.training import threads

if TYPE_CHECKING:
    from chdstat.estimators.progressive.learning import Learned

__all__ = ["Network", "Output", "estimate_pixels", "group_weights"]

_FAINT = 1e-3
"""Radiance, in units of the image's, below which differences hardly count."""
_LARGEST_WORTH = 12.0
"""log2 of the largest n0."""
_ROWS = 4096
"""Pixels at once: their profiles and hidden layers stay in the cache."""

Output = tuple[torch.Tensor, torch.Tensor, torch.Tensor]
"""Estimates for each loss, shape (row, loss, channel), and means of the samples, shape (row,
channel), in units of the image's radiance; certainty, the weight of the proposal against the mean,
0 to 1, shape (row, loss)."""


class Network(nn.Module):
    """Dense network that estimates the radiance of pixels.

    Parameters
    ----------
    channels
        Channels of a sample.
    described
        Numbers that describe the first hit; 0 without features.
    width, layers
        Neurons of a hidden layer, and number of hidden layers.

    Attributes
    ----------
    shape
        The parameters of the constructor by name, as in model files.
    shrinkage
        Sizes and shares from `errors.reference_shares`: how far estimates are followed. Certainty
        is scaled likewise. None follows them entirely.
    """

    def __init__(
        self,
        channels: int,
        described: int = 0,
        *,
        width: int = 128,
        layers: int = 3,
    ) -> None:
        super().__init__()
        self.shape = {
            "channels": channels,
            "described": described,
            "width": width,
            "layers": layers,
        }
        self.channels, self.described = channels, described
        self.shrinkage: tuple[Reals, Reals] | None = None
        # Outputs: weights of octaves, offsets, and n0.
        self.outputs = (OCTAVES, channels, 1)
        inputs = OCTAVES * (1 + channels) + 1 + described
        sizes = [inputs] + [width] * layers
        self.hidden = nn.ModuleList(nn.Linear(a, b) for a, b in pairwise(sizes))
        self.answer = nn.Linear(sizes[-1], len(LOSSES) * sum(self.outputs))
        # All weights start near 1, so training starts from the mean.
        nn.init.zeros_(self.answer.weight)
        nn.init.zeros_(self.answer.bias)

    def forward(self, profile: Profile, described: Image | None) -> Output:
        """Estimate for each loss from profiles of pixels and the numbers of their first hits."""
        samples = np.maximum(profile.count, 1).astype(np.float32)
        bins = self._tensor(profile.bins / samples[:, np.newaxis, np.newaxis])
        count, radiance = self._tensor(samples), bins[..., 1:]
        inputs = [_compressed(bins).flatten(1), (torch.log2(count) / 4 - 1.25)[:, None]]
        if described is not None:
            inputs.append(self._tensor(described))
        hidden = torch.cat(inputs, dim=1)
        for layer in self.hidden:
            hidden = torch.relu_(layer(hidden))
        outputs = self.answer(hidden).unflatten(1, (len(LOSSES), -1))
        own, offset, worth = outputs.split(self.outputs, dim=-1)
        proposal = torch.exp(own.clamp(-8, 3)) @ radiance + torch.exp((offset - 5).clamp(-12, 4))
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

    def load_arrays(self, arrays: dict[str, npt.NDArray[np.float32]]) -> None:
        """Load weights by name; RuntimeError if one is missing or has another shape."""
        self.load_state_dict({name: torch.from_numpy(array) for name, array in arrays.items()})

    def to_arrays(self) -> dict[str, npt.NDArray[np.float32]]:
        """Return the weights by name."""
        return {name: w.detach().cpu().numpy().copy() for name, w in self.state_dict().items()}


def _compressed(bins: torch.Tensor) -> torch.Tensor:
    """Compress shares and radiance, so that rare and bright samples do not outweigh all others.

    Negative radiance counts as 0.
    """
    bins = bins.clamp(min=0)
    # The shares go through the logarithm, too: one loop over all is faster than one with gaps.
    legible = torch.log1p(bins / _FAINT).mul_(0.2)
    legible[..., 0] = bins[..., 0].sqrt()
    return legible


def group_weights(mean: torch.Tensor, move: torch.Tensor) -> torch.Tensor:
    """Return the weight of each pixel in each group, shape (..., group), with the sum 1.

    The groups are levels of the mean, first for pixels that are brightened, then for pixels that
    are darkened.

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


def estimate_pixels(
    learned: Learned,
    rows: npt.NDArray[Any],
    described: Image | None,
    *,
    unit: float,
    loss_weight: float,
    level: float | None,
) -> Estimates:
    """Estimate pixels from their samples, block by block on all cores.

    The radiance of pixels without a good sample is NaN.

    Parameters
    ----------
    learned
        The trained network, and the model of its errors.
    rows
        Samples, shape (pixel, channel, sample).
    described
        Numbers that describe the first hit, shape (pixel, number); None without features.
    unit
        Mean radiance of the image.
    loss_weight, level
        As for `Progressive.estimate`.
    """
    network = learned.network.to("cuda" if torch.cuda.is_available() else "cpu")
    error_model = learned.error_model
    radiance = np.empty(rows.shape[:2], np.float32)
    low, high = (np.full_like(radiance, np.nan) for _ in range(2))
    certainty = np.empty(len(rows), np.float32)
    scale = np.float32(unit)

    def enter(part: slice) -> None:
        profile = Profile.of(rows[part], unit=unit)
        with torch.inference_mode():
            output = network(profile, None if described is None else described[part])
            estimates, _, sure = output
            estimate = torch.lerp(estimates[:, 0], estimates[:, 1], loss_weight).cpu().numpy()
            certainty[part] = torch.lerp(sure[:, 0], sure[:, 1], loss_weight).cpu().numpy()
        with np.errstate(over="ignore", invalid="ignore"):
            radiance[part] = estimate * scale
            if level is not None:
                whole, means, certain = (t.cpu().numpy().astype(np.float64) for t in output)
                own = means, certain.T, profile.variance_of_mean()
                terms = error_terms(np.moveaxis(whole, 1, 0), *own)
                variance = error_model.variance(terms, loss_weight)
                given = estimate.astype(np.float64), variance, profile.count
                for end, tail in ((low, (1 - level) / 2), (high, (1 + level) / 2)):
                    found = error_model.quantile(*given, loss_weight=loss_weight, level=tail)
                    end[part] = found.astype(np.float32) * scale
        radiance[part][profile.count == 0] = np.nan

    with threads(1):
        for _ in in_order(enter, spans(len(rows), _ROWS)):
            pass
    return Estimates(radiance, certainty, low, high, level or np.nan)
