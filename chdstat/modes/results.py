"""Modality: what is said of the modes of one pixel, or of a whole batch."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from chdstat._multiplicity import q_values
from chdstat._positive import Counts, Floats
from chdstat._reasons import flag_attributes
from chdstat.samples import Mapped

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["MODES", "Modality", "finish_modality", "modality_variables"]

MODES = 3
"""Most modes, and most components of a mixture, that are looked for."""

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
    "delta_bic": "BIC of the best distribution of one mode minus that of the best mixture",
}
_DIMS = {
    "places": "mode",
    "weights": "mode",
    "ashman_d": "pair",
    "ashman_d_se": "pair",
}


@dataclass(frozen=True)
class Modality:
    """Modes of the positive part; arrays of the batch's shape, NaN where `reason` says why.

    Attributes
    ----------
    dip, dip_p_value
        Hartigan's dip, in [1/(2n), 1/4], and its p-value under unimodality, at least 1e-5. Where
        the hypothesis is true, p is uniform for uniform samples and larger for others.
    tied_share
        Share of samples that are equal to another one. Ties are moved apart by less than float32
        can tell, as the test is one of continuous samples. Rounded samples, of which 8 % or more
        tie at other values than the three most frequent ones, are spread half-way to their
        neighbours first: a step is no mode.
    modes
        1 to 3: the maxima of the best mixture's density of log radiance that stand apart: a
        component of at least 8 % of the samples, with a valley of at least 2 % of its height
        between it and every higher one. The best mixture has the smallest BIC of 1 to 3 log-normal
        or gamma components; there is one mode where a distribution of one mode has a smaller one
        still: gamma, log-normal, Weibull, Burr, Pareto above a floor or below a ceiling, and,
        unless the dip test rejects them at 5 %, uniform or log-uniform; or, unless it rejects all
        of one mode at 1 %, gamma above a floor or below a ceiling, and any density that is
        log-concave in log radiance or in the logarithm of the distance from either end. 0 where
        `reason` says why.
    places, weights
        Radiance of the modes as log10, and the mass of each, shape (..., 3), the darkest first; NaN
        beyond the modes there are.
    ashman_d, ashman_d_se
        ``sqrt(2) |m1 - m2| / sqrt(s1^2 + s2^2)`` of neighbouring modes, with means and standard
        deviations of log radiance, shape (..., 2), and its standard error, from the information of
        the mixture; NaN where a mode is too narrow for one. Above 2, the two are cleanly apart.
        ``1.96`` errors hold the separation of true mixtures in 90 % and more of those that are
        found.
    delta_bic
        BIC of the best distribution of one mode minus that of the best mixture of two or more
        components: positive where a mixture is better, for tails and skewed shapes, too, which are
        no modes. The n of its log n are the positive samples, on both sides: nulls say nothing of
        modes. Each end of a uniform distribution counts as two parameters.
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
        if name in dataset:
            dataset[name].attrs.update(long_name=long_name, units="1")
    dataset["reason"].attrs.update(
        long_name="why no modes were counted", units="1", **flag_attributes()
    )
    return dataset
