"""Modes: whether the samples of a pixel come from one kind of light path, or from several.

`modality` looks at the positive samples in the log domain, in two ways: Hartigan's dip test, which
assumes nothing but continuity and has calibrated p-values but little power, and mixtures of
log-normal or gamma components, which say how many modes there are, where, and how far apart.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any, overload

import diptest
import numpy as np
import numpy.typing as npt

from chdstat._arrays import generator
from chdstat._multiplicity import q_values
from chdstat._positive import Counts, Floats, PositivePart
from chdstat._reasons import Reason, flag_attributes
from chdstat.fit._best_peaks import best_peaks
from chdstat.fit.families import get_family
from chdstat.fit.mle import fit_part
from chdstat.samples import Mapped, Samples

if TYPE_CHECKING:
    import xarray as xr

__all__ = [
    "MODES",
    "Modality",
    "finish_modality",
    "modality",
    "modality_of_part",
    "modality_variables",
]

MODES = 3
"""Most modes, and most components of a mixture, that are looked for."""

_MINIMUM = 20
_P_FLOOR = 1e-5
"""Smallest p-value told: the table of the dip was simulated a million times."""
_SINGLE = ("gamma", "lognormal", "weibull", "burr")
"""Families of one mode that a mixture has to beat."""
_LABELS = {
    "dip": "Hartigan's dip of log10 radiance",
    "dip_p_value": "p-value of unimodality",
    "dip_q_value": "q-value of unimodality over the image",
    "tied_share": "share of positive samples equal to another one",
    "modes": "modes of the best mixture in log10 radiance",
    "places": "modes, log10 of radiance in W sr-1 m-2",
    "weights": "mass of the modes",
    "ashman_d": "separation of neighbouring modes, Ashman's D",
    "ashman_d_se": "standard error of the separation",
    "delta_bic": "BIC of the best single family minus that of the best mixture",
}
_DIMS = {"places": "mode", "weights": "mode", "ashman_d": "pair", "ashman_d_se": "pair"}


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
        1 to 3: the maxima of the best mixture's density of log radiance that stand apart: a
        component of at least 8 % of the samples, with a valley of at least 2 % of its height
        between it and every higher one. The best mixture has the smallest BIC of 1 to 3 log-normal
        or gamma components; there is one mode where a single family has a smaller one still. 0
        where `reason` says why.
    places, weights
        Radiance of the modes as log10, and the mass of each, shape (..., 3), the darkest first; NaN
        beyond the modes there are.
    ashman_d, ashman_d_se
        ``sqrt(2) |m1 - m2| / sqrt(s1^2 + s2^2)`` of neighbouring modes, with means and standard
        deviations of log radiance, shape (..., 2), and its standard error; above 2, the two are
        cleanly apart.
    delta_bic
        BIC of the best single family (gamma, log-normal, Weibull, Burr) minus that of the best
        mixture of two or more components: positive where a mixture is better, for tails and skewed
        shapes, too, which are no modes.
    n
        Positive samples.
    reason
        `Reason` codes.
    """

    dip: Floats
    dip_p_value: Floats
    tied_share: Floats
    modes: npt.NDArray[np.int8]
    places: Floats
    weights: Floats
    ashman_d: Floats
    ashman_d_se: Floats
    delta_bic: Floats
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
    """Count the modes of the positive samples in the log domain, and test whether there is one.

    The dip is the largest distance between the distribution function of the samples and the closest
    unimodal one. The modes are those of a fitted mixture: see `Modality` for what counts as one.

    Parameters
    ----------
    x, null, progress
        As for `chdstat.fit.fit`.
    seed
        Of what moves ties apart.

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
        return modality_of_part(PositivePart.of(x, null=null), seed=seed)
    # Tiles are worked on in any order: each begins with the same generator.
    root = int(generator(seed).integers(2**62))

    def of_block(block: npt.NDArray[np.float32]) -> Mapped:
        return modality_variables(modality_of_part(PositivePart.of_pixels(block), seed=root))

    return finish_modality(x.map(of_block, description="counting modes", progress=progress))


def modality_of_part(
    part: PositivePart,
    *,
    seed: int | np.random.Generator | None = 0,
    single_bic: Floats | None = None,
) -> Modality:
    """Look for modes in samples that are already split.

    `single_bic`, shape (...), is the smallest BIC of the single families, for whoever has it.
    """
    reason = part.reason(_MINIMUM)
    ok = reason == Reason.OK
    dip, p_value, tied_share = (np.full(ok.shape, np.nan) for _ in range(3))
    dip[ok], p_value[ok], tied_share[ok] = _dips(part.sorted[ok], part.n[ok], seed)
    peaks = best_peaks(part, ok, _single_bic(part) if single_bic is None else single_bic, MODES)
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


def modality_variables(result: Modality) -> Mapped:
    """Return modes over (y, x, channel), or over (y, x), as variables for `Samples.map`."""
    first = ("channel",) if result.n.ndim == 3 else ()
    names = [field.name for field in fields(result) if field.name != "n"]
    return {
        name: ((*first, _DIMS[name]) if name in _DIMS else first, getattr(result, name))
        for name in names
    }


def finish_modality(dataset: xr.Dataset) -> xr.Dataset:
    """Add the q-values over the image, and set long names, units and flag meanings."""
    p_value = dataset["dip_p_value"]
    dataset = dataset.assign(dip_q_value=p_value.copy(data=q_values(p_value.to_numpy())))
    for name, long_name in _LABELS.items():
        dataset[name].attrs.update(long_name=long_name, units="1")
    dataset["reason"].attrs.update(
        long_name="why no modes were counted", units="1", **flag_attributes()
    )
    return dataset


def _dips(
    ascending: npt.NDArray[Any], n: Counts, seed: int | np.random.Generator | None
) -> tuple[Floats, Floats, Floats]:
    """Return dips, their p-values and shares of ties of rows of samples, of which `n` count."""
    tied_share = _tied_share(ascending, n)
    rng = generator(seed)
    # The package has no batch form: the dip of a row is a sequential algorithm.
    rows = (row[:count] for row, count in zip(ascending, n, strict=True))
    apart = (
        _untied(row, rng) if tied else np.log10(row, dtype=np.float64)
        for row, tied in zip(rows, tied_share > 0, strict=True)
    )
    dips = [diptest.diptest(row, sort_x=False) for row in apart]
    dip, p_value = np.array(dips, dtype=np.float64).reshape(-1, 2).T
    return dip, np.maximum(p_value, _P_FLOOR), tied_share


def _tied_share(ascending: npt.NDArray[Any], n: Counts) -> Floats:
    tied = np.zeros(ascending.shape, dtype=bool)
    tied[:, 1:] = ascending[:, 1:] == ascending[:, :-1]
    tied[:, :-1] |= tied[:, 1:]
    tied &= np.arange(ascending.shape[-1]) < n[:, np.newaxis]
    return np.asarray(np.count_nonzero(tied, axis=-1) / n)


def _untied(row: npt.NDArray[Any], rng: np.random.Generator) -> Floats:
    """Return log10 of samples, ascending, each moved by up to half a float32 spacing."""
    exact = row.astype(np.float64)
    spacing = np.spacing(row.astype(np.float32)).astype(np.float64)
    return np.log10(np.sort(exact + spacing * (rng.random(len(row)) - 0.5)))


def _single_bic(part: PositivePart) -> Floats:
    values = np.stack([fit_part(part, get_family(name)).bic for name in _SINGLE])
    return np.asarray(np.where(np.isnan(values), np.inf, values).min(axis=0))
