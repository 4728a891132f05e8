"""Modality: whether the samples of a pixel come from one kind of light path or from several.

`modality` looks at the positive samples in the log domain in two ways. Hartigan's dip test assumes
nothing but continuity and has calibrated p-values, but little power. Mixtures of log-normal or
gamma components give the number of modes, their places and their separation.

The dip is the distance of the samples from the closest unimodal distribution. Its p-values are
interpolated in a table of the null distribution, from 20 samples on.

Both methods assume continuous samples, so that equal samples are separated first, evenly, and
independently of other rows. There are two cases. If a few values are shared by many samples, they
are lights that are seen directly; their samples move by less than the precision of float32. If
samples lie on many steps, they were rounded, to integers or to the few bits of a file. A step is
not a mode: its samples are spread over the interval that was rounded to it, but never across a gap
that is wider than the steps beside it.

Samples that a clamp set to its value, at either end, are left out first: a distribution that is cut
off has as many modes as its rest. They count for the mode beside the clamp.

From 20 samples on, p-values (`_dip_p`) are interpolated between quantiles of sqrt(n) times the dip
of uniform samples, simulated by tools/make_dip_table.py.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import numpy.typing as npt
from diptest import dipstat

from chdstat._core.arrays import Counts, Floats, Mask, chunks
from chdstat._core.display import Card, Width, as_p, each, number, reasons, with_error, written
from chdstat._core.doors import draw
from chdstat._core.positive import PositivePart
from chdstat._core.statistic import RADIANCE, Quantity, Result, Statistic, result, variable
from chdstat.errors import Reason
from chdstat.fit.atoms import before_clamps, clamped, distinct_values, split, with_rows
from chdstat.fit.em import Solution
from chdstat.fit.family import take_part
from chdstat.fit.mixtures import ChosenMixtures, Mixture, MixtureFit
from chdstat.fit.peaks import LEAST_WEIGHT, best_peaks, unimodal_scores
from chdstat.fit.search import Piece
from chdstat.inference.normality import QUANTILES, interpolated_p
from chdstat.summary.runner import Source, of_source, run

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.figure import Figure

# --- the dip --------------------------------------------------------------------------------------


def dips(ascending: Floats, n: Counts) -> Floats:
    """Return the dips of rows of samples, in [1 / (2 n), 1/4], shape (row,).

    Parameters
    ----------
    ascending
        Samples, shape (row, sample), ascending; infinite after the first `n` of a row.
    n
        Samples of each row, at least 1, shape (row,).

    References
    ----------
    Hartigan and Hartigan, "The dip test of unimodality", 1985, doi:10.1214/aos/1176346577.

    Examples
    --------
    >>> rows = np.array([[0.0, 1.0, 2.0, 3.0], [0.0, 0.1, 3.0, 3.1]])
    >>> dips(rows, np.array([4, 4])).round(4)
    array([0.125 , 0.2417])
    """
    rows = zip(ascending, n, strict=True)
    found = np.array([dipstat(row[:count], sort_x=False) for row, count in rows]).reshape(len(n))
    # Of equal or evenly spaced samples, it is 0 there.
    return np.asarray(np.maximum(found, 1 / (2 * n)))


_FLOOR = 1e-5
"""Smallest p-value: the table ends at 1e-4, simulated with up to a million dips."""


def _dip_p(dip: Floats, n: Counts) -> Floats:
    """Return p-values of dips of `n` samples under uniform samples, shape (row,), at least 1e-5.

    Asymptotically, uniform samples have the largest dips of all unimodal distributions (Hartigan
    and Hartigan 1985, doi:10.1214/aos/1176346577).

    Examples
    --------
    >>> _dip_p(np.array([0.02, 0.05]), np.array([200, 200])).round(2)
    array([0.89, 0.  ])
    """
    return interpolated_p(np.sqrt(n) * dip, n, QUANTILES["dip"], _FLOOR)


# --- modality -------------------------------------------------------------------------------------


MODES = 3
"""Most modes, and most components of a mixture."""
SEPARATE = 2.0
"""Ashman's D from which neighbouring modes stand out of each other."""


@result
class Modality(Result):
    """Modes of the positive part; arrays of the batch's shape, NaN where `reason` says why.

    Attributes
    ----------
    dip, dip_p_value
        Hartigan's dip, in [1/(2n), 1/4], and its p-value under unimodality, at least 1e-5. Under
        unimodality, p is uniform for uniform samples and larger for others.
    tied_share
        Share of the samples that equal another one. Before the test, which assumes continuous
        samples, ties are separated by less than float32 can tell. Rounded samples are spread
        half-way to their neighbours first, since a step is not a mode. Samples count as rounded if
        8 % or more tie at values other than lights: the three most frequent values with at least
        8 % and three samples each. A gap three times as wide as both gaps beside it is not a step,
        and no sample is spread into it.
    modes
        Number of modes, 1 to 3; 0 where `reason` says why. A mode is a clearly separated maximum of
        the best mixture's density of log radiance: a component with at least 8 % of the samples,
        and a valley of at least 2 % of its height between it and every higher one.

        The best mixture has the smallest BIC of those with 1 to 3 log-normal or gamma components.
        There is one mode if a distribution with one mode has a smaller BIC still:

        - gamma, log-normal, Weibull, Burr, Pareto above a floor or its mirror image below a
          ceiling;
        - unless the dip test rejects it at 5 %: uniform or log-uniform;
        - unless the dip test rejects one mode at 1 %: gamma above a floor or below a ceiling, and
          any density that is log-concave in log radiance or in the logarithm of the distance from
          an end.
    places, weights
        Radiance of the modes as log10, and the mass of each, shape (..., 3), the darkest first; NaN
        where there are fewer modes. The radiance is that of the sample nearest to the maximum, so
        that no mode lies where there are no samples. Clamped samples have no part in the search for
        modes, nor in the dip; their mass is that of the mode beside the clamp.
    ashman_d, ashman_d_se
        Ashman's D, ``sqrt(2) |m1 - m2| / sqrt(s1^2 + s2^2)``, of neighbouring modes, with means and
        standard deviations of log radiance, shape (..., 2). Above 2, the modes are cleanly
        separated. Its standard error comes from the information of the mixture; NaN where a mode is
        too narrow. ``1.96`` errors hold the separation in 90 % or more of the true mixtures whose
        modes are found.
    delta_bic
        BIC of the best distribution with one mode minus that of the best mixture with two or more
        components. It is positive where a mixture is better, which may also be due to tails or
        skewness rather than modes. The n of log n counts the positive samples for both: nulls are
        not part of modes. Each end of a uniform distribution counts as two parameters.
    n
        Number of positive samples.
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

    def clear(self, ashman_d: float = SEPARATE) -> Counts:
        """Return how many modes stand out, shape (...); 0 where modes are not known.

        These are the modes that a pattern counts: neighbours are apart by Ashman's D or more.
        """
        apart = np.count_nonzero(self.ashman_d >= ashman_d, axis=-1)
        return np.where(self.modes > 0, 1 + apart, 0)

    def in_words(self, row: int) -> str:
        """Return the modes of a row, and how many of them stand out."""
        modes, clear = int(self.modes[row]), int(self.clear()[row])
        if not modes or clear == modes:
            return str(modes or "—")
        return f"{modes}, {clear} of them clear" if clear > 1 else f"{modes} that overlap"

    def plot(self, *, width: Width = "column", fig: Figure | None = None) -> Figure:
        """Draw where the modes are, as `chdstat.viz.mode_stems`.

        Raises
        ------
        InputError
            If there are more than six rows.
        """
        return draw(self, width=width, fig=fig)


_MINIMUM = 20
_COMPONENTS = "lognormal", "gamma"
"""Families of the components whose tails may be cut off by a clamp."""
_LEVEL = 0.05
"""Level of the dip test at which uniform distributions are ruled out."""
_CERTAIN = 0.01
"""Level at which all distributions with one mode are: the test holds its level for each."""


@dataclass(frozen=True)
class Modes(Statistic[Modality]):
    """The modes of the positive samples in the log domain, see `modality`."""

    result: ClassVar = Modality
    description: ClassVar = "counting modes"
    quantities: ClassVar = (
        Quantity("modes", lambda found, i: found.in_words(i), brief="modes"),
        Quantity("dip of log radiance", lambda found, i: number(found.dip[i])),
        Quantity("p of one mode (dip test)", lambda found, i: as_p(found.dip_p_value[i])),
    )

    def measure(
        self,
        part: PositivePart,
        also: Callable[[Piece, list[Solution]], None] = lambda *_: None,
    ) -> Modality:
        """Find the modes of each row; `also` is called with the mixtures."""
        reason = part.reason(_MINIMUM)
        ok = reason == Reason.OK
        tied_share = np.where(ok, _tied_shares(part), np.nan)
        inside, cut = _without_clamps(part, ok)
        still_tied = tied_share if inside is part else np.where(ok, _tied_shares(inside), np.nan)
        steps = _on_steps(inside, still_tied)
        smooth = _spread_steps(inside, steps) if steps.any() else inside
        dip, p_value = _dips_of_part(smooth, ok, (still_tied > 0) & ~steps)
        # The dip test has uniform samples as its null. Where it rejects them, a few modes side by
        # side must not be mistaken for a uniform distribution.
        bounded = p_value >= _LEVEL
        rival = unimodal_scores(part, ok, bounded)
        changed = steps | cut.any(axis=0)
        if changed.any():
            # Fits to all samples, as they are, do not compare with fits to these.
            of_changed = PositivePart.of(smooth.x[changed])
            rival[changed] = unimodal_scores(of_changed, ok[changed], bounded[changed])
        count, (place, weight, ashman_d, error), delta_bic = best_peaks(
            smooth, ok, rival, MODES, doubtful=p_value >= _CERTAIN, also=also
        )
        # Clamped samples belong to the mode beside the clamp.
        n = np.maximum(part.n, 1)
        weight *= (1 - cut.sum(axis=0) / n)[..., np.newaxis]
        weight[..., 0] += cut[0] / n
        brightest = np.arange(MODES) == count[..., np.newaxis] - 1
        weight += brightest * (cut[1] / n)[..., np.newaxis]
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
    """The best log-normal mixtures that the search for modes finds, at hardly any further cost.

    They are the mixtures of `chdstat.fit.mixture` with ``effort='fast'``, with two exceptions. They
    need 20 positive samples, as modes do. Three components are not tried, and have no BIC, where
    two are worse than one, or worse than the best distribution with one mode.
    """

    binned: ClassVar = False

    def measure(self, part: Any) -> Mixture:
        """Return the mixtures of each row; this also finds the modes."""
        atoms = split(part)
        reason = atoms.reason(_MINIMUM)
        chosen = ChosenMixtures(before_clamps(atoms, "lognormal"), reason, MODES)
        apart = atoms.tied.reshape(-1)

        def enter(piece: Piece, solutions: list[Solution]) -> None:
            at = np.flatnonzero(~apart[piece.rows])
            chosen.enter(piece.take(at), [solution.take(at) for solution in solutions])

        part.found[Modes()] = Modes().measure(part, enter)
        chosen.search_rest("lognormal", "fast")
        return chosen.result("lognormal")


@of_source
def modality(
    x: Source, *, null: npt.ArrayLike | None = None, progress: bool = True
) -> Modality | xr.Dataset:
    """Count the modes of the positive samples in the log domain, and test whether there is one.

    The dip is the largest distance between the distribution function of the samples and the closest
    unimodal one. The modes are those of a fitted mixture; `Modality` says what counts as a mode.

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

    Each mode has its own samples: those nearer to it than to another mode.
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


def _without_clamps(part: PositivePart, usable: Mask) -> tuple[PositivePart, Counts]:
    """Return the part without clamped samples, and how many were at the floor and at the top.

    The counts have the shape (2, ...). Rows of which fewer than `_MINIMUM` samples would be left
    stay as they are.
    """
    cut = np.zeros((2, part.n.size), dtype=np.int64)
    rows = np.flatnonzero(usable)
    ascending, last = part.sorted.reshape(-1, part.x.shape[-1]), part.n.reshape(-1)[rows] - 1
    # An atom has three samples or more.
    at_floor = ascending[rows, 0] == ascending[rows, np.minimum(last, 2)]
    at_top = ascending[rows, last] == ascending[rows, last - 2]
    rows = rows[at_floor | at_top]
    if not rows.size:
        return part, cut.reshape(2, *part.n.shape)
    some = take_part(part, rows)
    atoms = split(some)
    at_end = np.stack([clamped(atoms, *_COMPONENTS, floor=floor) for floor in (True, False)])
    held = np.count_nonzero(at_end, axis=-1)
    stays = some.n - held.sum(axis=0) < _MINIMUM
    at_end[:, stays], held[:, stays] = False, 0
    cut[:, rows] = held
    cut = cut.reshape(2, *part.n.shape)
    gone = np.asarray(cut.any(axis=0))
    if not gone.any():
        return part, cut
    here = held.any(axis=0)
    inside = some.positive[here] & ~at_end[:, here].any(axis=0)
    return with_rows(part, gone, np.where(inside, some.x[here], 0), inside), cut


_LIGHTS, _LEAST_OF_LIGHT = 3, 3
"""Most values that samples share for another reason than rounding, and fewest samples of each."""


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
    """Return which rows hold rounded samples, shape (...).

    In these rows, at least 8 % of the samples, the smallest mode that counts, tie at values other
    than lights. Lights are the three most frequent values, if they hold 8 % and three samples each.
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
    """Return the part with the samples of the rows on `steps` spread over their steps."""
    moved = _without_ties(part.sorted[steps], part.n[steps], rounded=True)
    valid = part.valid[steps]
    return with_rows(part, steps, np.where(valid, moved, 0), valid)


def _without_ties(ascending: npt.NDArray[Any], n: Counts, *, rounded: bool = False) -> Floats:
    """Separate ties in ascending samples, which are padded with infinity.

    Tied samples are spread evenly over half a float32 spacing to either side. If they were
    `rounded`, they are spread half-way to the next values, as far as these are a step away.
    """
    exact = ascending.astype(np.float64)
    value, count, run = distinct_values(exact, n)
    # That of float32, also beyond its range.
    down = up = np.ldexp(1.0, np.frexp(np.where(np.isnan(value), 1, value))[1] - 24)
    if rounded:
        steps = _steps(value)
        below, above = steps[:, :-1], steps[:, 1:]
        # The outermost steps have the same width on both sides, within positive numbers.
        down = np.where(below > 0, below, np.maximum(down, np.minimum(above, value)))
        up = np.where(above > 0, above, np.maximum(up, below))
    of_value = (count.cumsum(axis=-1) - count, count, value - down / 2, (down + up) / 2)
    first, equal, lowest, width = (np.take_along_axis(v, run, axis=-1) for v in of_value)
    share = (np.arange(exact.shape[-1]) - first + 0.5) / equal
    return np.where(equal > 1, lowest + share * width, exact)


_WIDER = 3.0
"""A gap this many times as wide as both gaps beside it is no step: it separates two clusters."""


def _steps(value: Floats) -> Floats:
    """Return the steps between ascending values; 0 before the first, and for gaps that are no step.

    The values, shape (row, value), are padded with NaN; the result has one column more. Gaps are
    compared as they are, and as ratios, since the steps of rounded floats and of powers grow.
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

    Samples of `tied` rows are separated: the test assumes continuous samples.
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
    p[rows] = _dip_p(dip[rows], n[rows])
    return dip.reshape(part.n.shape), p.reshape(part.n.shape)
