"""Explained: how much of the variance map first-hit features can predict."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from chdstat.findings.evidence import Evidence
from chdstat.findings.resampling import Spread, interval_of

__all__ = ["Explained", "explained_by_features"]

Floats = npt.NDArray[np.float64]

_FOLDS = 4
_ACROSS = 8
_FEATURES = ("albedo", "normal", "depth")
_ROUNDS = 60
_RELIABLE = 0.2
"""Share of the variation that must repeat between halves of the samples, to be explained at all."""


@dataclass(frozen=True)
class Explained:
    """What features explain of log variance.

    Attributes
    ----------
    share
        Cross-validated R^2 over the share that is not noise; below 0 where features mislead.
    reliability
        That share: correlation between two halves of the samples, stepped up to all of them.
    """

    share: Spread
    reliability: float


def explained_by_features(evidence: Evidence, batches: Floats, *, level: float) -> Explained | None:
    """Predict log variance from albedo, normal and depth in blocks that are held out.

    Parameters
    ----------
    evidence
        With the features; None is returned without them.
    batches
        Means of batches, shape (pixel, batch).
    level
        Coverage of the interval.

    References
    ----------
    Roberts et al., "Cross-validation strategies for data with temporal, spatial, hierarchical, or
    phylogenetic structure", 2017, doi:10.1111/ecog.02881: blocks. Spearman, "The proof and
    measurement of association between two things", 1904, doi:10.2307/1412159: attenuation. Ke et
    al., "LightGBM", 2017: the boosted trees that scikit-learn follows.
    """
    features = _features(evidence)
    if features is None:
        return None
    halves = [_log_variance(batches[:, i::2]) for i in (0, 1)]
    target = (halves[0] + halves[1]) / 2
    known = np.isfinite(target) & np.isfinite(features).all(axis=1)
    if np.count_nonzero(known) < 100 or not np.ptp(target[known]):
        return Explained(Spread.unknown(level=level), float("nan"))
    r = float(np.corrcoef(halves[0][known], halves[1][known])[0, 1])
    reliability = 2 * r / (1 + r)
    if not reliability > _RELIABLE:
        return Explained(Spread.unknown(level=level), reliability)
    whole = evidence.whole(across=_ACROSS).blocks
    # Blocks of one fold do not touch.
    fold = ((whole.of_pixel % _ACROSS + 2 * (whole.of_pixel // _ACROSS)) % _FOLDS)[known]
    y, blocks = target[known], whole[known]
    left, right = _errors(features[known], y, fold)
    error, total = blocks.sums(left), blocks.sums(right)
    share = interval_of(
        lambda w: (1 - (w @ error) / (w @ total)) / reliability, blocks, level=level
    )
    return Explained(share, reliability)


def _features(evidence: Evidence) -> Floats | None:
    found = [evidence.feature(name) for name in _FEATURES]
    if any(f is None for f in found):
        return None
    columns = [f.reshape(len(evidence.whole()), -1) for f in found if f is not None]
    return np.concatenate(columns, axis=1)


def _log_variance(batches: Floats) -> Floats:
    with np.errstate(divide="ignore"):
        logs = np.log(batches.var(axis=1, ddof=1))
    return np.asarray(np.where(np.isfinite(logs), logs, np.nan))


def _errors(x: Floats, y: Floats, fold: npt.NDArray[np.int64]) -> tuple[Floats, Floats]:
    """Return squared errors of predictions, and those of the mean of the same training pixels."""
    from sklearn.ensemble import HistGradientBoostingRegressor

    left, right = np.zeros_like(y), np.zeros_like(y)
    for k in range(_FOLDS):
        if (held := fold == k).any():
            model = HistGradientBoostingRegressor(
                max_iter=_ROUNDS, min_samples_leaf=20, early_stopping=False, random_state=0
            )
            guess = model.fit(x[~held], y[~held]).predict(x[held])
            left[held], right[held] = (y[held] - guess) ** 2, (y[held] - y[~held].mean()) ** 2
    return left, right
