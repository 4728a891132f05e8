"""Modes: whether the samples of a pixel come from one kind of light path, or from several.

`modality` looks at the positive samples in the log domain, in two ways: Hartigan's dip test,
which assumes nothing but continuity and has calibrated p-values but little power; and mixtures of
log-normal or gamma components, which say how many modes there are, where, and how far apart.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, overload

import numpy as np
import numpy.typing as npt

from chdstat._positive import PositivePart
from chdstat._reasons import Reason
from chdstat.fit._best_peaks import best_peaks
from chdstat.fit._chosen_mixtures import ChosenMixtures
from chdstat.fit._search import Found
from chdstat.fit._unimodal_bic import unimodal_scores
from chdstat.fit.mixture_results import Mixture
from chdstat.fit.results import Fit
from chdstat.modes._dip import dips_of_part
from chdstat.modes._ties import on_steps, spread, tied_shares
from chdstat.modes.results import MODES, Modality, finish_modality, modality_variables
from chdstat.samples import Mapped, Samples

if TYPE_CHECKING:
    import xarray as xr

__all__ = [
    "MODES",
    "Modality",
    "finish_modality",
    "mixture_and_modes_of_part",
    "modality",
    "modality_of_part",
    "modality_variables",
]

_MINIMUM = 20
_LEVEL = 0.05
"""Level of the dip test at which a uniform distribution is not considered any more."""
_CERTAIN = 0.01
"""Level at which no distribution of one mode is: the dip test holds its level for all of them."""


@overload
def modality(
    x: Samples,
    *,
    progress: bool | None = None,
) -> xr.Dataset: ...
@overload
def modality(
    x: npt.ArrayLike,
    *,
    null: npt.ArrayLike | None = None,
) -> Modality: ...
def modality(
    x: Samples | npt.ArrayLike,
    *,
    null: npt.ArrayLike | None = None,
    progress: bool | None = None,
) -> Modality | xr.Dataset:
    """Count the modes of the positive samples in the log domain, and test whether there is one.

    The dip is the largest distance between the distribution function of the samples and the closest
    unimodal one. The modes are those of a fitted mixture: see `Modality` for what counts as one.

    Parameters
    ----------
    x, null, progress
        As for `chdstat.fit.fit`.

    Returns
    -------
    Modality or xarray.Dataset
        `Modality` for an array. For `Samples`, its fields over (y, x, channel), (y, x, channel,
        mode) and (y, x, channel, pair), and ``dip_q_value``, by Benjamini and Hochberg over the
        image.

    References
    ----------
    Hartigan and Hartigan, "The dip test of unimodality", 1985, doi:10.1214/aos/1176346577. Ashman,
    Bird and Zepf, "Detecting bimodality in astronomical datasets", 1994, doi:10.1086/117248.
    Schwarz, "Estimating the dimension of a model", 1978, doi:10.1214/aos/1176344136.

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> indirect, direct = rng.lognormal(-4, 0.5, size=300), rng.lognormal(1, 0.3, size=300)
    >>> result = modality(np.concatenate([indirect, direct]))
    >>> int(result.modes), float(result.dip_p_value), result.weights.round(2)
    (2, 1e-05, array([0.5, 0.5, nan]))
    """
    if not isinstance(x, Samples):
        part = PositivePart.given(x, null=null)
        return modality_of_part(part)

    def of_block(block: npt.NDArray[np.float32]) -> Mapped:
        part = PositivePart.of_pixels(block)
        result = modality_of_part(part)
        return modality_variables(result)

    return finish_modality(
        x.map(of_block, logarithms=True, description="counting modes", progress=progress)
    )


def modality_of_part(
    part: PositivePart,
    *,
    fits: Iterable[Fit] | None = None,
) -> Modality:
    """Look for modes in samples that are already split.

    `fits` are the families of one mode to beat, for whoever has them.
    """
    return _modality(part, fits, lambda _: None)


def mixture_and_modes_of_part(
    part: PositivePart,
    *,
    fits: Iterable[Fit] | None = None,
) -> tuple[Mixture, Modality]:
    """Look for modes, and return the best log-normal mixtures, too, at hardly any further cost.

    The mixtures are those of `mixture_of_part` with ``effort='fast'``, with two exceptions: they
    need 20 positive samples, as modes do; and three components are not tried, and have no BIC,
    where two are worse than one or than the best distribution of one mode.
    """
    chosen = ChosenMixtures.of(part, part.reason(_MINIMUM), MODES)
    modality = _modality(part, fits, chosen.enter)
    return chosen.result("lognormal"), modality


def _modality(
    part: PositivePart,
    fits: Iterable[Fit] | None,
    also: Callable[[Found], None],
) -> Modality:
    reason = part.reason(_MINIMUM)
    ok = reason == Reason.OK
    tied_share = np.where(ok, tied_shares(part), np.nan)
    steps = on_steps(part, tied_share)
    smooth = spread(part, steps) if steps.any() else part
    dip, p_value = dips_of_part(smooth, ok, (tied_share > 0) & ~steps)
    # Uniform samples are what the dip test takes for granted: where it speaks against them, a few
    # modes side by side are not to be mistaken for them.
    bounded = p_value >= _LEVEL
    rival = unimodal_scores(part, ok, bounded, fits=fits)
    if steps.any():
        # Fits to samples as they were rounded do not compare with those to what was spread.
        of_steps = PositivePart.of(smooth.x[steps])
        rival[steps] = unimodal_scores(of_steps, ok[steps], bounded[steps])
    peaks = best_peaks(smooth, ok, rival, MODES, doubtful=p_value >= _CERTAIN, also=also)
    return Modality(
        dip=dip,
        dip_p_value=p_value,
        tied_share=tied_share,
        modes=peaks.count,
        places=peaks.place / np.log(10),
        weights=peaks.weight,
        ashman_d=peaks.ashman_d[..., : MODES - 1],
        ashman_d_se=peaks.ashman_d_se[..., : MODES - 1],
        delta_bic=peaks.delta_bic,
        n=part.n,
        reason=reason,
    )
