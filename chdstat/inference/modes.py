"""Modality: whether the samples of a pixel come from one kind of light path or from several.

`modality` looks at the positive samples in the log domain in two ways: Hartigan's dip test, which
assumes nothing but continuity and has calibrated p-values but little power; and mixtures of
log-normal or gamma components: the number of modes, their places and their separation.

The dip is the distance of the samples from the closest unimodal distribution. Its p-values are
interpolated in a table of the null distribution, for any number of samples from 20, and for all
rows at once.

Both take samples for continuous ones, so that equal samples are separated first, evenly and in the
same way whatever is beside them. A few values that many samples share are lights seen from
everywhere, and move by less than the precision of float32. Samples that lie on many steps have been
rounded, to integers or to the few bits of a file: a step is no mode, and its samples are spread
over what was rounded to it, but never across a gap that is wider than the steps beside it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar, cast

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Counts, Floats, Mask, chunks
from chdstat._core.display import Card, Width, each, reasons, with_error, written
from chdstat._core.positive import PositivePart
from chdstat._core.statistic import RADIANCE, Result, Statistic, result, variable
from chdstat.errors import Reason
from chdstat.fit.atoms import before_clamps, distinct_values, split, with_rows
from chdstat.fit.em import Solution
from chdstat.fit.mixtures import ChosenMixtures, Mixture, MixtureFit
from chdstat.fit.peaks import LEAST_WEIGHT, best_peaks, unimodal_scores
from chdstat.fit.search import Piece
from chdstat.inference.dip import dip_p, dips
from chdstat.summary.runner import Source, of_source, run

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.figure import Figure


__all__ = [
    "MODES",
    "ModalMixture",
    "Modality",
    "Modes",
    "modality",
]

MODES = 3
"""Most modes, and most components of a mixture, that are looked for."""


@result
class Modality(Result):
    """Modes of the positive part; arrays of the batch's shape, NaN where `reason` says why.

    Attributes
    ----------
    dip, dip_p_value
        Hartigan's dip, in [1/(2n), 1/4], and its p-value under unimodality, at least 1e-5. Where
        the hypothesis is true, p is uniform for uniform samples and larger for others.
    tied_share
        Share of samples that are equal to another one. Ties are separated by less than float32
        can tell, as the test is one of continuous samples. Rounded samples, of which 8 % or more
        tie at other values than the three most frequent ones, lights of at least 8 % and three
        samples each, are spread half-way to their neighbours first: a step is no mode. A gap three
        times as wide as both gaps beside it is no step, and no sample is spread into it.
    modes
        1 to 3: the clearly separated maxima of the best mixture's density of log radiance: a
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
        beyond the modes there are. The radiance is that of the sample nearest to the maximum: no
        mode lies where there are no samples.
    ashman_d, ashman_d_se
        ``sqrt(2) |m1 - m2| / sqrt(s1^2 + s2^2)`` of neighbouring modes, with means and standard
        deviations of log radiance, shape (..., 2), and its standard error, from the information of
        the mixture; NaN where a mode is too narrow for one. Above 2, the two are cleanly separated.
        ``1.96`` errors hold the separation of true mixtures in 90 % and more of those that are
        found.
    delta_bic
        BIC of the best distribution of one mode minus that of the best mixture of two or more
        components: positive where a mixture is better, for tails and skewed shapes, too, which are
        no modes. The n of its log n are the positive samples, on both sides: nulls are no part of
        modes. Each end of a uniform distribution counts as two parameters.
    n
        Positive samples.
    reason
        `Reason` codes.
    """

    dip: Floats = variable("Hartigan's dip of log10 radiance")
    dip_p_value: Floats = variable("p-value of unimodality", pooled=True)
    tied_share: Floats = variable("share of positive samples equal to another one")
    modes: npt.NDArray[np.int8] = variable("modes of the best mixture in log10 radiance")
    places: Floats = variable("modes, log10 of radiance in W sr-1 m-2", "mode")
    weights: Floats = variable("mass of the modes", "mode")
    ashman_d: Floats = variable("separation of neighbouring modes, Ashman's D", "pair")
    ashman_d_se: Floats = variable("standard error of the separation", "pair")
    delta_bic: Floats = variable(
        "BIC of the best distribution of one mode minus that of the best mixture"
    )
    n: Counts
    reason: npt.NDArray[np.int8] = variable("why no modes were counted")
    _drawn: ClassVar[str] = "modes, and the share of each"

    def _card(self) -> Card:
        facts = {
            "modes": self.modes,
            f"at log10 of {RADIANCE}": self.places,
            "share of each": self.weights,
            "separation": each(with_error, self.ashman_d, self.ashman_d_se),
            "p-value of the dip": self.dip_p_value,
            "n": written(self.n),
            "not counted": reasons(self.reason),
        }
        return Card("Modality", facts)

    def plot(self, *, width: Width = "column", fig: Figure | None = None) -> Figure:
        """Draw where the modes are, as `chdstat.viz.mode_stems`.

        Raises
        ------
        InputError
            If there are more than six rows.
        """
        from chdstat import viz

        ax = None if fig is None else fig.subplots()
        return cast("Figure", viz.mode_stems(self, width=width, ax=ax).figure)


_MINIMUM = 20
_LEVEL = 0.05
"""Level of the dip test at which a uniform distribution is not considered any more."""
_CERTAIN = 0.01
"""Level at which no distribution of one mode is: the dip test holds its level for all of them."""


@dataclass(frozen=True)
class Modes(Statistic[Modality]):
    """The modes of the positive samples in the log domain, see `modality`."""

    result: ClassVar = Modality
    description: ClassVar = "counting modes"

    def measure(
        self,
        part: PositivePart,
        also: Callable[[Piece, list[Solution]], None] = lambda *_: None,
    ) -> Modality:
        """Look for modes of each row; `also` gets the mixtures."""
        reason = part.reason(_MINIMUM)
        ok = reason == Reason.OK
        tied_share = np.where(ok, _tied_shares(part), np.nan)
        steps = _on_steps(part, tied_share)
        smooth = _spread_steps(part, steps) if steps.any() else part
        dip, p_value = _dips_of_part(smooth, ok, (tied_share > 0) & ~steps)
        # Uniform samples are what the dip test takes for granted: where it speaks against them, a
        # few modes side by side are not to be mistaken for them.
        bounded = p_value >= _LEVEL
        rival = unimodal_scores(part, ok, bounded)
        if steps.any():
            # Fits to samples as they were rounded do not compare with those to what was spread.
            of_steps = PositivePart.of(smooth.x[steps])
            rival[steps] = unimodal_scores(of_steps, ok[steps], bounded[steps])
        count, (place, weight, ashman_d, error), delta_bic = best_peaks(
            smooth, ok, rival, MODES, doubtful=p_value >= _CERTAIN, also=also
        )
        return Modality(
            dip=dip,
            dip_p_value=p_value,
            tied_share=tied_share,
            modes=count,
            places=_at_samples(part, place) / np.log(10),
            weights=weight,
            ashman_d=ashman_d[..., : MODES - 1],
            ashman_d_se=error[..., : MODES - 1],
            delta_bic=delta_bic,
            n=part.n,
            reason=reason,
        )


@dataclass(frozen=True)
class ModalMixture(MixtureFit):
    """The best log-normal mixtures that the search for modes comes by, at hardly any further cost.

    The mixtures are those of `chdstat.fit.mixture` with ``effort='fast'``, with two exceptions:
    they need 20 positive samples, as modes do; and three components are not tried, and have no BIC,
    where two are worse than one or than the best distribution of one mode.
    """

    binned: ClassVar = False

    def measure(self, part: Any) -> Mixture:
        """Return the mixtures of each row; its modes are then found, too."""
        atoms = split(part)
        reason = atoms.reason(part, _MINIMUM)
        atoms = replace(atoms, rest=before_clamps(part, atoms, "lognormal"))
        chosen, apart = ChosenMixtures(part, atoms, reason, MODES), atoms.tied.reshape(-1)

        def enter(piece: Piece, solutions: list[Solution]) -> None:
            at = np.flatnonzero(~apart[piece.rows])
            chosen.enter(piece.take(at), [solution.take(at) for solution in solutions])

        part.found[Modes()] = Modes().measure(part, enter)
        chosen.search_rest("lognormal", "fast")
        return chosen.result("lognormal")


@of_source
def modality(
    x: Source, *, null: npt.ArrayLike | None = None, progress: bool | None = None
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
    return run(Modes(), x, null=null, progress=progress)


def _at_samples(part: PositivePart, place: Floats) -> Floats:
    """Return the log radiance of the sample nearest to each ascending place, shape (..., mode).

    Each mode has samples of its own, those nearer to it than to another mode.
    """
    n = part.n[..., np.newaxis]

    def below(bound: Floats) -> Counts:
        low, high = np.broadcast_arrays(0, np.broadcast_to(n, bound.shape))
        for _ in range(part.x.shape[-1].bit_length()):
            middle = (low + high) // 2
            at = np.minimum(middle, part.x.shape[-1] - 1)
            less = (np.take_along_axis(part.log_sorted, at, axis=-1) < bound) & (middle < high)
            low, high = np.where(less, middle + 1, low), np.where(less, high, middle)
        return np.asarray(low)

    middle = below((place[..., :-1] + place[..., 1:]) / 2)
    middle = np.where(np.isnan(place[..., 1:]), n, middle)
    first, stop = np.append(0 * n, middle, axis=-1), np.append(middle, n, axis=-1)
    behind = below(place)
    left, right = (
        np.take_along_axis(part.log_sorted, np.maximum(np.clip(i, first, stop - 1), 0), axis=-1)
        for i in (behind - 1, behind)
    )
    nearest = np.where(place - left < right - place, left, right)
    return np.where(np.isnan(place), np.nan, nearest)


_LIGHTS, _LEAST_OF_LIGHT = 3, 3
"""Values, at most, that samples share for another reason than rounding, and samples of each."""


def _tied_shares(part: PositivePart) -> Floats:
    """Return the share of positive samples equal to another one, shape (...); NaN without any."""
    samples = part.x.shape[-1]
    ascending, n = part.sorted.reshape(-1, samples), part.n.reshape(-1)
    tied = np.empty(len(n))
    for piece in chunks(len(n), samples):
        equal = ascending[piece, 1:] == ascending[piece, :-1]
        equal &= np.arange(1, samples) < n[piece, np.newaxis]
        first = equal.copy()  # of two or more
        first[:, 1:] &= ~equal[:, :-1]
        tied[piece] = np.count_nonzero(equal, axis=-1) + np.count_nonzero(first, axis=-1)
    return np.asarray((tied / n).reshape(part.n.shape))


def _on_steps(part: PositivePart, tied_share: Floats) -> Mask:
    """Say which rows hold rounded samples, shape (...).

    They are those of which 8 % or more, the smallest mode that is counted, tie at other values than
    lights: the three most frequent ones, if they hold 8 % and three samples each.
    """
    samples = part.x.shape[-1]
    steps = np.zeros(part.n.size, dtype=bool)
    rows = np.flatnonzero(tied_share.reshape(-1) > LEAST_WEIGHT)
    for piece in chunks(len(rows), samples):
        at = rows[piece]
        ascending, n = part.sorted.reshape(-1, samples)[at], part.n.reshape(-1)[at]
        _, counts, _ = distinct_values(ascending, n)
        counts = np.where(counts > 1, counts, 0)
        least = LEAST_WEIGHT * n
        lights = np.sort(counts, axis=-1)[:, -_LIGHTS:]
        lights[lights < np.maximum(least, _LEAST_OF_LIGHT)[:, np.newaxis]] = 0
        steps[at] = counts.sum(axis=-1) - lights.sum(axis=-1) >= least
    return steps.reshape(part.n.shape)


def _spread_steps(part: PositivePart, steps: Mask) -> PositivePart:
    """Return the part with the samples of the rows on `steps` spread over them."""
    moved = _without_ties(part.sorted[steps], part.n[steps], rounded=True)
    valid = part.valid[steps]
    return with_rows(part, np.flatnonzero(steps), np.where(valid, moved, 0), valid)


def _without_ties(ascending: npt.NDArray[Any], n: Counts, *, rounded: bool = False) -> Floats:
    """Return samples, ascending and padded with infinity, without ties.

    Those of a tie are spread evenly over half a float32 spacing to either side, or, where they were
    `rounded`, half-way to the next values, as far as these are a step away.
    """
    exact = ascending.astype(np.float64)
    value, count, run = distinct_values(exact, n)
    spacing = np.spacing(np.where(np.isnan(value), 1, value).astype(np.float32))
    down = up = spacing.astype(np.float64)
    if rounded:
        steps = _steps(value)
        below, above = steps[:, :-1], steps[:, 1:]
        # The outer steps are as wide on both sides, within positive numbers.
        down = np.where(below > 0, below, np.maximum(down, np.minimum(above, value)))
        up = np.where(above > 0, above, np.maximum(up, below))
    of_value = (count.cumsum(axis=-1) - count, count, value - down / 2, (down + up) / 2)
    first, equal, lowest, width = (np.take_along_axis(v, run, axis=-1) for v in of_value)
    share = (np.arange(exact.shape[-1]) - first + 0.5) / equal
    return np.where(equal > 1, lowest + share * width, exact)


_WIDER = 3.0
"""A gap so many times as wide as both gaps beside it is no step, but lies between two clusters."""


def _steps(value: Floats) -> Floats:
    """Return the steps between ascending values, and 0 where a gap is none, as before the first.

    The values, shape (row, value), are padded with NaN; the result has one column more. Gaps are
    compared as they are, and as ratios: rounded floats, and powers, have steps that grow.
    """
    gaps = np.zeros((2, len(value), value.shape[-1] + 1))
    for gap, x in zip(gaps, (value, np.log(value)), strict=True):
        gap[:, 1:-1] = np.where(value[:, 1:] < np.inf, np.diff(x, axis=-1), 0)
    for _ in range(2):  # A gap beside one that is no step has to compare with the other side.
        beside = np.maximum(gaps[..., :-2], gaps[..., 2:])
        gaps[..., 1:-1] *= (gaps[..., 1:-1] <= _WIDER * beside).any(axis=0)
    return np.asarray(gaps[0])


def _dips_of_part(part: PositivePart, usable: Mask, tied: Mask) -> tuple[Floats, Floats]:
    """Return dips of log radiance and p-values; NaN where not usable.

    Samples of `tied` rows are separated: the test is one of continuous samples.
    """
    dip, p = np.full((2, part.n.size), np.nan)
    samples, n, tied = part.x.shape[-1], part.n.reshape(-1), tied.reshape(-1)
    ascending = part.sorted.reshape(-1, samples)
    log_sorted = part.log_sorted.reshape(-1, samples)
    rows = np.flatnonzero(usable)
    for piece in chunks(len(rows), samples):
        at = rows[piece]
        log, move = log_sorted[at], tied[at]
        log[move] = np.log(_without_ties(ascending[at[move]], n[at[move]]))
        dip[at] = dips(log, n[at])
    p[rows] = dip_p(dip[rows], n[rows])
    return dip.reshape(part.n.shape), p.reshape(part.n.shape)
