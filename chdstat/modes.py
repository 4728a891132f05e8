"""Modes: whether the samples of a pixel come from one kind of light path or from two.

`modality` looks at the positive samples in the log10 domain, in two ways: Hartigan's dip test,
which assumes nothing but continuity and has calibrated p-values, and a mixture of two Gaussians,
which says where the modes are and how far apart.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, overload

import diptest
import numpy as np
import numpy.typing as npt

from chdstat._arrays import generator
from chdstat._bimodal import BINS, TwoGaussians, fit_two, log_histogram
from chdstat._multiplicity import q_values
from chdstat._positive import Counts, Floats, Mask, PositivePart
from chdstat._reasons import Reason, flag_attributes
from chdstat.samples import Mapped, Samples

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["Modality", "modality", "modality_of_part"]

_MINIMUM = 20
_P_FLOOR = 1e-5
"""Smallest p-value told: the table of the dip was simulated a million times."""
_PARAMETERS = 3
"""What two Gaussians have more than one: a weight, a mean and a deviation."""
_STRONG = 10.0
"""Difference of BIC that is very strong evidence (Kass and Raftery 1995)."""
_LABELS = {
    "dip": "Hartigan's dip of log10 radiance",
    "dip_p_value": "p-value of unimodality",
    "dip_q_value": "q-value of unimodality over the image",
    "tied_share": "share of positive samples equal to another one",
    "modes": "modes of the Gaussian mixture in log10 radiance",
    "delta_bic": "BIC of one Gaussian minus that of two",
    "ashman_d": "separation of the two Gaussians, Ashman's D",
    "weights": "weights of the two Gaussians",
    "means": "means of the two Gaussians, log10 of radiance in W sr-1 m-2",
    "deviations": "standard deviations of the two Gaussians, in decades",
}


@dataclass(frozen=True)
class Modality:
    """Modes of the positive part; arrays of the batch's shape, NaN where `reason` says why.

    Attributes
    ----------
    dip, dip_p_value
        Hartigan's dip, in [1/(2n), 1/4], and its p-value under unimodality, at least 1e-5.
    tied_share
        Share of samples that are equal to another one. Ties were moved apart at random by less than
        float32 can tell, as the test is one of continuous samples.
    modes
        1 or 2: 2 where two Gaussians are much better than one (`delta_bic` > 10) and their sum
        falls, between its two maxima, below half of the lower one: a flat top is one mode. 0 where
        `reason` says why.
    delta_bic
        BIC of one Gaussian minus that of two. Positive for skewed samples, too.
    ashman_d
        ``sqrt(2) |m1 - m2| / sqrt(s1^2 + s2^2)``; above 2, the two are cleanly apart.
    weights, means, deviations
        Of the two Gaussians in log10 of radiance, shape (..., 2), the darker one first.
    n
        Positive samples.
    reason
        `Reason` codes.
    """

    dip: Floats
    dip_p_value: Floats
    tied_share: Floats
    modes: npt.NDArray[np.int8]
    delta_bic: Floats
    ashman_d: Floats
    weights: Floats
    means: Floats
    deviations: Floats
    n: Counts
    reason: npt.NDArray[np.int8]


@overload
def modality(
    x: Samples, *, seed: int | np.random.Generator | None = ..., progress: bool | None = None
) -> xr.Dataset: ...
@overload
def modality(
    x: npt.ArrayLike,
    *,
    null: npt.ArrayLike | None = None,
    seed: int | np.random.Generator | None = ...,
) -> Modality: ...
def modality(
    x: Samples | npt.ArrayLike,
    *,
    null: npt.ArrayLike | None = None,
    seed: int | np.random.Generator | None = 0,
    progress: bool | None = None,
) -> Modality | xr.Dataset:
    """Test whether the positive samples have one mode or more in the log10 domain.

    The dip is the largest distance between the distribution function of the samples and the closest
    unimodal one. The mixture is fitted by expectation-maximisation to 100 bins of log10 radiance.

    Parameters
    ----------
    x, null, progress
        As for `chdstat.fit.fit`.
    seed
        Of what moves ties apart.

    Returns
    -------
    Modality or xarray.Dataset
        `Modality` for an array. For `Samples`, its fields over (y, x, channel) and (y, x, channel,
        component), and ``dip_q_value``, by Benjamini and Hochberg over the image.

    References
    ----------
    Hartigan and Hartigan, "The dip test of unimodality", 1985, doi:10.1214/aos/1176346577. Ashman,
    Bird and Zepf, "Detecting bimodality in astronomical datasets", 1994, doi:10.1086/117248.

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> indirect, direct = rng.lognormal(-4, 0.5, size=300), rng.lognormal(1, 0.3, size=300)
    >>> result = modality(np.concatenate([indirect, direct]))
    >>> int(result.modes), float(result.dip_p_value), result.weights.round(2)
    (2, 1e-05, array([0.5, 0.5]))
    """
    if not isinstance(x, Samples):
        return modality_of_part(PositivePart.of(x, null=null), seed=seed)
    rng = generator(seed)

    def of_block(block: npt.NDArray[np.float32]) -> Mapped:
        return _variables(modality_of_part(PositivePart.of_pixels(block), seed=rng))

    return _finish(x.map(of_block, description="counting modes", progress=progress))


def modality_of_part(part: PositivePart, *, seed: int | np.random.Generator | None = 0) -> Modality:
    """Test samples that are already split."""
    reason = part.reason(_MINIMUM)
    ok = reason == Reason.OK
    ascending, n = part.sorted[ok], part.n[ok]
    tied_share = _tied_share(ascending, n)
    dip, p_value = _dips(_untied(ascending, n, tied_share > 0, generator(seed)))
    counts, low, width = log_histogram(ascending, n)
    two = fit_two(counts)
    gain = 2 * (two.log_likelihood - two.log_likelihood_of_one)
    delta_bic = gain - _PARAMETERS * np.log(n)
    modes = np.zeros(ok.shape, dtype=np.int8)
    modes[ok] = np.where((delta_bic > _STRONG) & _valley(two), 2, 1)
    return Modality(
        dip=_spread_out(dip, ok),
        dip_p_value=_spread_out(p_value, ok),
        tied_share=_spread_out(tied_share, ok),
        modes=modes,
        delta_bic=_spread_out(delta_bic, ok),
        ashman_d=_spread_out(_ashman(two), ok),
        weights=_spread_out(two.weights, ok),
        means=_spread_out(low[:, np.newaxis] + width[:, np.newaxis] * two.means, ok),
        deviations=_spread_out(width[:, np.newaxis] * two.deviations, ok),
        n=part.n,
        reason=reason,
    )


def _spread_out(values: Floats, ok: Mask) -> Floats:
    """Put the values of usable rows where they belong, NaN elsewhere."""
    whole = np.full((*ok.shape, *values.shape[1:]), np.nan)
    whole[ok] = values
    return whole


def _tied_share(ascending: npt.NDArray[Any], n: Counts) -> Floats:
    equal = ascending[:, 1:] == ascending[:, :-1]
    tied = np.zeros(ascending.shape, dtype=bool)
    tied[:, 1:] = equal
    tied[:, :-1] |= equal
    tied &= np.arange(ascending.shape[-1]) < n[:, np.newaxis]
    return np.asarray(np.count_nonzero(tied, axis=-1) / n)


def _untied(
    ascending: npt.NDArray[Any], n: Counts, tied: Mask, rng: np.random.Generator
) -> list[Floats]:
    """Return log10 of the samples of each row, ascending, ties moved by half a float32 spacing."""
    rows = []
    for samples, count, has_ties in zip(ascending, n, tied, strict=True):
        row = samples[:count].astype(np.float64)
        if has_ties:
            spacing = np.spacing(row.astype(np.float32)).astype(np.float64)
            row = np.sort(row + spacing * (rng.random(count) - 0.5))
        rows.append(np.log10(row))
    return rows


def _dips(rows: list[Floats]) -> tuple[Floats, Floats]:
    # The package has no batch form: the dip of a row is a sequential algorithm.
    dips = [diptest.diptest(row, sort_x=False) for row in rows]
    dip, p_value = np.array(dips, dtype=np.float64).reshape(-1, 2).T
    return dip, np.maximum(p_value, _P_FLOOR)


def _ashman(two: TwoGaussians) -> Floats:
    apart = np.abs(np.diff(two.means, axis=-1)[:, 0])
    return np.asarray(np.sqrt(2) * apart / np.sqrt((two.deviations**2).sum(axis=-1)))


def _valley(two: TwoGaussians) -> Mask:
    """Say whether the mixture falls below half its lower maximum, between the two means."""
    share = np.linspace(0, 1, BINS + 1)
    places = two.means[:, :1] + share * np.diff(two.means, axis=-1)
    z = (places[:, np.newaxis] - two.means[..., np.newaxis]) / two.deviations[..., np.newaxis]
    heights = (two.weights / two.deviations)[..., np.newaxis]
    density = (heights * np.exp(-0.5 * z**2)).sum(axis=1)
    bottom = density.argmin(axis=-1)[:, np.newaxis]
    sides = np.arange(BINS + 1) <= bottom, np.arange(BINS + 1) >= bottom
    lower_top = np.minimum(*(np.where(side, density, 0).max(axis=-1) for side in sides))
    return np.asarray(density.min(axis=-1) < 0.5 * lower_top)


def _variables(result: Modality) -> Mapped:
    pairs = ("weights", "means", "deviations")
    names = [name for name in (*_LABELS, "reason") if hasattr(result, name)]
    return {
        name: (("channel", "component") if name in pairs else ("channel",), getattr(result, name))
        for name in names
    }


def _finish(dataset: xr.Dataset) -> xr.Dataset:
    p_value = dataset["dip_p_value"]
    dataset = dataset.assign(dip_q_value=p_value.copy(data=q_values(p_value.to_numpy())))
    for name, long_name in _LABELS.items():
        dataset[name].attrs.update(long_name=long_name, units="1")
    dataset["reason"].attrs.update(
        long_name="why no modes were counted", units="1", **flag_attributes()
    )
    return dataset.assign_coords(component=["darker", "brighter"])
