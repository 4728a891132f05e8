"""Curves: what is drawn over the histogram of a row of samples, and what a legend says of it.

`Curve` holds a fit with its misfit, or says in words why there is none. Which fit a pixel has is
the rule of `chdstat.patterns.Pixel.curve`; every figure and page draws by it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Floats
from chdstat._core.display import number, percent
from chdstat.fit.families import Fit, get_family
from chdstat.fit.mixtures import Mixture
from chdstat.summary.histograms import Scale

_POINTS = 512
"""Most samples at which a fit is compared with all of them."""
_WITHIN = 3e-3
"""Shift of the logarithm of radiance that is no misfit: three times the least width of a component,
and less than a figure shows."""
_LISTED = 3
"""Most components that are named: the heaviest."""


@dataclass(frozen=True)
class Curve:
    """What describes the positive samples of a row, as figures draw it.

    Attributes
    ----------
    fit
        A fit of one row; None where nothing is drawn.
    misfit
        Kolmogorov's distance between the fit and the samples: the largest error of the share of
        samples below any radiance. Of several fits that were tried in vain, it is the smallest.
    reason
        Why nothing is drawn, in words; "" where something is.

    Examples
    --------
    >>> import chdstat as chd
    >>> rng = np.random.default_rng(1)
    >>> samples = chd.Samples.from_array(rng.lognormal(-2.0, 0.5, size=(1, 1, 1, 4096)))
    >>> curve = samples.pixel(0, 0).curve(0)
    >>> curve.name, curve.words
    ('log-normal', 'log-normal (median 0.13, σ 0.50)')
    >>> chd.Samples.from_array(np.ones((1, 1, 1, 64))).pixel(0, 0).curve(0).words
    'constant samples'
    """

    fit: Fit | None = None
    misfit: float = float("nan")
    reason: str = ""

    @property
    def family(self) -> str:
        """Name of the family, or "mixture"; "" without a fit."""
        if isinstance(self.fit, Mixture):
            return "mixture"
        return "" if self.fit is None else self.fit.family

    @property
    def mixture(self) -> Mixture | None:
        """The fit, if it has several components or atoms."""
        found = self.fit if isinstance(self.fit, Mixture) else None
        return found if found and (found.k > 1 or found.atom_weights.any()) else None

    @property
    def name(self) -> str:
        """What describes the samples, in words; "" without a fit."""
        if self.mixture is None:
            return "" if self.fit is None else get_family(self.fit.family).label
        k, atoms = int(self.mixture.k), int(np.count_nonzero(self.mixture.atom_weights))
        words = f"{k} component{'s' * (k > 1)}"
        return words + (f" + {atoms} value{'s' * (atoms > 1)}" if atoms else "")

    @property
    def parameters(self) -> str:
        """Its parameters in words: of a mixture, where its components are and what they hold."""
        if self.fit is None:
            return ""
        family, found = get_family(self.fit.family), self.mixture
        if found is None:
            return family.words({n: float(np.ravel(v)[0]) for n, v in self.fit.parameters.items()})
        k, atoms = int(found.k), found.atom_weights > 0
        with np.errstate(all="ignore"):
            first = {name: value[:k] for name, value in found.parameters.items()}
            medians = family.distribution(first).ppf(0.5)
        shares = found.weights[:k] * (1 - found.atom_weights.sum())
        most = np.sort(np.argsort(-shares)[:_LISTED])
        words = [_held(shares[i], medians[i]) for i in most] + ["..."] * (k > _LISTED)
        at = zip(found.atom_weights[atoms], found.atoms[atoms], strict=True)
        return ", ".join([*words, *(f"{_held(*pair)} exactly" for pair in at)])

    @property
    def words(self) -> str:
        """Name and parameters, or why there is no curve."""
        if self.fit is None:
            return self.reason
        return (
            f"{self.name}: {self.parameters}"
            if self.mixture
            else f"{self.name} ({self.parameters})"
        )

    def density(self, x: npt.ArrayLike, width: float, scale: Scale) -> Floats:
        """Return what a histogram with bins of a width expects around each x.

        It is the share of the samples in such a bin around x, over its width, per unit of radiance
        or per decade: a component or an atom that is narrower than a bin is as high as its bar.
        As in a histogram, the samples are those that are neither null nor bad.

        Parameters
        ----------
        x
            Radiance, shape (point,).
        width
            Width of the bins, in radiance or in decades.
        scale
            Whether the bins divide the radiance or its logarithm evenly.
        """
        at, found = np.asarray(x, np.float64), self.fit
        if found is None:
            return np.full(at.shape, np.nan)
        half = 10 ** (width / 2) if scale == "log" else width / 2
        low, high = (at / half, at * half) if scale == "log" else (at - half, at + half)
        low, high = np.maximum(low, 0), np.maximum(high, 0)
        zero = found.n_null + found.n_zero
        among = found.n_zero + found.n_negative + found.n
        inside = (found.cdf(high) - found.cdf(low)) * (zero + found.n) / among
        with np.errstate(invalid="ignore", divide="ignore"):
            density = np.asarray(inside / (width if scale == "log" else high - low))
        return np.where(high > 0, density, 0.0)


def _held(share: float, radiance: float) -> str:
    return f"{percent(float(share))} at {number(float(radiance), 2)}"


def misfit(fit: Fit, ascending: npt.NDArray[np.floating]) -> float:
    """Return Kolmogorov's distance between a fit of one row and its positive samples.

    Samples may be moved by a third of a per cent first: values that are equal but for rounding, or
    components as narrow as these may be, are no misfit.

    Parameters
    ----------
    fit
        A fit of one row.
    ascending
        Its positive samples, ascending, shape (sample,).
    """
    n = len(ascending)
    x = ascending.astype(np.float64)
    at = x[(np.arange(min(n, _POINTS)) * n) // min(n, _POINTS)]
    below, up_to = (np.searchsorted(x, at, side) / n for side in ("left", "right"))
    zero = float(fit.zero_share)
    with np.errstate(all="ignore"):
        ends = (fit.cdf(at * np.exp(move)) for move in (-_WITHIN, _WITHIN))
        low, high = ((end - zero) / (1 - zero) for end in ends)
    return float(np.max(np.maximum(low - below, up_to - high)))
