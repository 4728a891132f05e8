"""Results of tail fits: one frozen type, and its variables over an image."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from chdstat._multiplicity import q_values
from chdstat._positive import Counts, Floats, Mask
from chdstat._reasons import flag_attributes

if TYPE_CHECKING:
    import xarray as xr

    from chdstat.samples import Mapped

__all__ = ["Tail", "finish_tail", "tail_variables"]

_RADIANCE = "W sr-1 m-2"
_LABELS = {
    "tail_index": ("generalised Pareto tail index xi", "1"),
    "tail_index_se": ("standard error of the tail index", "1"),
    "tail_interval": ("interval of the tail index", "1"),
    "tail_p_value": ("p-value of a tail index at most the tested one", "1"),
    "tail_p_exponential": ("p-value of a tail no heavier than a gamma distribution's", "1"),
    "tail_q_value": ("q-value of a tail index at most the tested one", "1"),
    "tail_q_exponential": ("q-value of a tail no heavier than a gamma distribution's", "1"),
    "tail_index_far": ("tail index of the largest samples alone", "1"),
    "tail_interval_far": ("interval of the tail index of the largest samples alone", "1"),
    "tail_scale": ("generalised Pareto scale", _RADIANCE),
    "tail_threshold": ("radiance above which the tail begins", _RADIANCE),
    "tail_n": ("samples above the threshold", "1"),
    "tail_share": ("share of the positive samples above the threshold", "1"),
    "tail_hill": ("Hill estimate of the tail index", "1"),
    "tail_hill_interval": ("interval of the Hill estimate", "1"),
    "tail_hill_n": ("samples of the Hill estimate", "1"),
    "tail_variance_suspect": ("xi >= 1/2: do not trust the sample variance", "1"),
    "tail_variance_trusted": ("no look at the tail speaks against a finite variance", "1"),
    "tail_variance_unidentified": ("the samples cannot tell whether the variance is finite", "1"),
}
_INTERVALS = ("tail_interval", "tail_interval_far", "tail_hill_interval")


@dataclass(frozen=True)
class Tail:
    """Tail of the positive part; arrays of the batch's shape, (...), NaN where `reason` says why.

    Attributes
    ----------
    xi, standard_error
        Tail index and its asymptotic standard error, ``(1 + xi) / sqrt(n)``, but at least
        ``0.9 / sqrt(n)``, as simulations say of bounded tails.
    interval
        Low and high end for xi, shape (..., 2).
    xi_far, interval_far
        Tail index of the `FAR` largest samples alone, and its interval: if a few samples are of a
        heavier tail than the rest, these tell. `interval` does not know of them.
    p_value
        One-sided, of the hypothesis that the tail index is at most `tested`.
    p_exponential
        One-sided, of the hypothesis that the tail is no heavier than that of an exponential, or of
        a gamma distribution whose logarithms vary as much as the samples' do.
    tested, level
        That index, and the level of the intervals.
    scale, threshold
        Generalised Pareto scale, and radiance above which the tail begins.
    n, share
        Excesses that were used, and their share of the positive samples.
    hill, hill_interval, hill_n
        Hill's estimate, for power laws only, since it is positive for every tail; its interval,
        shape (..., 2); the excesses that it was made of.
    variance_suspect
        Where xi >= 1/2: the variance may be infinite, the sample variance is not to be trusted, nor
        is any error bar made of it.
    variance_trusted
        Where the upper end of the interval is below 1/2, and neither the largest candidate nor the
        `FAR` largest samples are heavier than those of a gamma distribution; nor do fewer than 512
        samples vary more than those of one.
    variance_unidentified
        Where neither holds: the samples cannot tell whether their variance is finite.
    reason
        `Reason` codes; where it is not `OK`, none of the three holds.
    """

    xi: Floats
    standard_error: Floats
    interval: Floats
    xi_far: Floats
    interval_far: Floats
    p_value: Floats
    p_exponential: Floats
    tested: float
    level: float
    scale: Floats
    threshold: Floats
    n: Counts
    share: Floats
    hill: Floats
    hill_interval: Floats
    hill_n: Counts
    variance_suspect: Mask
    variance_trusted: Mask
    variance_unidentified: Mask
    reason: npt.NDArray[np.int8]


def tail_variables(tail: Tail) -> Mapped:
    """Return tails over (y, x, channel), or over (y, x), as variables for `Samples.map`."""
    values = {
        "tail_index": tail.xi,
        "tail_index_se": tail.standard_error,
        "tail_interval": tail.interval,
        "tail_index_far": tail.xi_far,
        "tail_interval_far": tail.interval_far,
        "tail_p_value": tail.p_value,
        "tail_p_exponential": tail.p_exponential,
        "tail_scale": tail.scale,
        "tail_threshold": tail.threshold,
        "tail_n": tail.n,
        "tail_share": tail.share,
        "tail_hill": tail.hill,
        "tail_hill_interval": tail.hill_interval,
        "tail_hill_n": tail.hill_n,
        "tail_variance_suspect": tail.variance_suspect,
        "tail_variance_trusted": tail.variance_trusted,
        "tail_variance_unidentified": tail.variance_unidentified,
        "tail_reason": tail.reason,
    }
    first = ("channel",) if tail.n.ndim == 3 else ()
    return {
        name: ((*first, "bound") if name in _INTERVALS else first, value)
        for name, value in values.items()
    }


def finish_tail(dataset: xr.Dataset) -> xr.Dataset:
    """Add the q-values over the image, and set long names, units and flag meanings."""
    for name in ("value", "exponential"):
        p = dataset[f"tail_p_{name}"]
        dataset = dataset.assign({f"tail_q_{name}": p.copy(data=q_values(p.to_numpy()))})
    for name, (long_name, units) in _LABELS.items():
        dataset[name].attrs.update(long_name=long_name, units=units)
    dataset["tail_reason"].attrs.update(
        long_name="why there is no tail index", units="1", **flag_attributes()
    )
    return dataset.assign_coords(bound=np.array(["low", "high"], dtype=object))
