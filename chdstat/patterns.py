"""Patterns: which pixels are null-heavy, long-tailed, bimodal or constant, and what the rest is.

`PATTERNS` is the table: what a pattern means, its statistic, and the rule that turns it into a flag
at a threshold. `classify` applies them all to the luminance of each pixel.
"""

from __future__ import annotations

import enum
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any, overload

import numpy as np
import numpy.typing as npt

from chdstat._arrays import as_samples, generator, is_bad, is_null, luminance
from chdstat._multiplicity import q_values, wilson
from chdstat._pattern_table import PATTERNS, Pattern, Scores, Thresholds
from chdstat._positive import Floats, Mask, PositivePart
from chdstat._reasons import Reason, flag_attributes
from chdstat.errors import InputError
from chdstat.fit.families import FAMILIES
from chdstat.fit.selection import select_part
from chdstat.fit.tail import tail_of_part
from chdstat.modes import modality_of_part
from chdstat.samples import Mapped, Samples

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["PATTERNS", "Label", "Pattern", "Patterns", "Thresholds", "classify"]


class Label(enum.IntEnum):
    """What a pixel is first of all; the first that holds, from the top, but for UNDETERMINED."""

    UNDETERMINED = 0
    """Too few usable samples to say anything."""
    BLACK = 1
    """Every good sample is null."""
    CONSTANT = 2
    BIMODAL = 3
    LONG_TAIL = 4
    NULL_HEAVY = 5
    GAMMA_LIKE = 6
    """None of these, and a gamma distribution fits better than a log-normal one."""
    LOGNORMAL_LIKE = 7
    """None of these, and a log-normal distribution fits better than a gamma one."""


@dataclass(frozen=True)
class Patterns:
    """Patterns of pixels; arrays of the batch's shape.

    Attributes
    ----------
    flags
        By the name of the pattern: whether it holds.
    statistics
        By the name of the pattern: its statistic.
    p_values
        By the name of the pattern: of the hypothesis that it is absent.
    null_interval
        Wilson interval of the share of nulls, shape (..., 2).
    tail_index_se
        Standard error of the tail index.
    ashman_d
        Separation of the two Gaussians.
    family, family_margin
        Index of the best family in `chdstat.fit.families.FAMILIES`, -1 for none, and by how much
        its BIC is smaller than that of the runner-up.
    label
        `Label` codes.
    reason
        `Reason` codes of the positive part.
    """

    flags: Mapping[str, Mask]
    statistics: Mapping[str, Floats]
    p_values: Mapping[str, Floats]
    null_interval: Floats
    tail_index_se: Floats
    ashman_d: Floats
    family: npt.NDArray[np.int8]
    family_margin: Floats
    label: npt.NDArray[np.int8]
    reason: npt.NDArray[np.int8]


@overload
def classify(
    x: Samples,
    *,
    thresholds: Thresholds | None = None,
    seed: int | np.random.Generator | None = 0,
    progress: bool | None = None,
) -> xr.Dataset: ...
@overload
def classify(
    x: npt.ArrayLike,
    *,
    thresholds: Thresholds | None = None,
    seed: int | np.random.Generator | None = 0,
) -> Patterns: ...
def classify(
    x: Samples | npt.ArrayLike,
    *,
    thresholds: Thresholds | None = None,
    seed: int | np.random.Generator | None = 0,
    progress: bool | None = None,
) -> Patterns | xr.Dataset:
    """Say which patterns the sample distribution of each pixel shows.

    Each flag is a row of `PATTERNS`: a statistic, a p-value and an effect that is large enough. Of
    an image, the p-values of a pattern are corrected for the number of pixels (Benjamini and
    Hochberg); of an array, they are not: each pixel is tested at level `Thresholds.alpha`. Flags do
    not exclude each other; `label` is one of them, by the order of `Label`.

    Parameters
    ----------
    x
        Samples of an image, or an array of radiance, shape (..., channel, sample), with 1 or 3
        channels. Nulls and bad samples are told by whole samples.
    thresholds
        When a pattern counts; None for the defaults.
    seed
        Of what moves ties apart, see `chdstat.modality`.
    progress
        For `Samples`: show a progress bar; None shows it on a terminal.

    Returns
    -------
    Patterns or xarray.Dataset
        `Patterns` for an array. For `Samples`, over (y, x): for each pattern, the flag by its
        name, and with suffix its ``_statistic``, ``_p_value`` and ``_q_value``; and the other
        fields.

    Raises
    ------
    InputError
        If there are neither 1 nor 3 channels.

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> gray = rng.gamma(2.0, size=(4, 1, 1024))
    >>> gray[1, :, :700] = 0
    >>> gray[2, :, ::2] *= 1000
    >>> gray[3] = 1
    >>> [Label(code).name for code in classify(gray).label]
    ['GAMMA_LIKE', 'NULL_HEAVY', 'BIMODAL', 'CONSTANT']
    """
    thresholds = thresholds or Thresholds()
    if isinstance(x, Samples):
        return _classify_image(x, thresholds, seed, progress)
    array = as_samples(x)
    if array.ndim < 2:
        message = f"x must have shape (..., channel, sample), got {array.shape}"
        raise InputError(message)
    patterns = _score(array, thresholds, seed)
    return _decide(patterns, patterns.p_values, thresholds)


def _score(
    x: npt.NDArray[Any], thresholds: Thresholds, seed: int | np.random.Generator | None
) -> Patterns:
    """Measure every pattern; flags hold where the effect is large enough, not yet significant."""
    bad = is_bad(x).any(axis=-2)
    with np.errstate(invalid="ignore", over="ignore"):
        part = PositivePart.of(luminance(x), null=is_null(x), bad=bad)
    scores = Scores(
        part=part,
        tail=tail_of_part(part, tested=thresholds.tail_index),
        modes=modality_of_part(part, seed=seed),
        families=select_part(part, list(FAMILIES.values())),
    )
    return Patterns(
        flags={p.name: p.large_enough(scores, thresholds) for p in PATTERNS},
        statistics={p.name: p.measure(scores) for p in PATTERNS},
        p_values={p.name: p.test(scores, thresholds) for p in PATTERNS if p.test is not None},
        null_interval=wilson(part.n_null, part.n_good),
        tail_index_se=scores.tail.standard_error,
        ashman_d=scores.modes.ashman_d,
        family=scores.families.best,
        family_margin=scores.families.margin,
        label=np.zeros(part.n.shape, dtype=np.int8),
        reason=part.reason(),
    )


def _decide(
    patterns: Patterns, significance: Mapping[str, Floats], thresholds: Thresholds
) -> Patterns:
    """Keep the flags that are significant, and label the pixels."""
    flags = {
        name: flag & (significance[name] <= thresholds.alpha) if name in significance else flag
        for name, flag in patterns.flags.items()
    }
    label = _label_pixels(flags, patterns.family, patterns.reason)
    return replace(patterns, flags=flags, label=label)


def _label_pixels(
    flags: Mapping[str, Mask], family: npt.NDArray[np.int8], reason: npt.NDArray[np.int8]
) -> npt.NDArray[np.int8]:
    names = list(FAMILIES)
    cases = {
        Label.BLACK: reason == Reason.ALL_NULL,
        Label.CONSTANT: flags["constant"],
        Label.BIMODAL: flags["bimodal"],
        Label.LONG_TAIL: flags["long_tail"],
        Label.NULL_HEAVY: flags["null_heavy"],
        Label.GAMMA_LIKE: family == names.index("gamma"),
        Label.LOGNORMAL_LIKE: family == names.index("lognormal"),
    }
    codes = [np.int8(code) for code in cases]
    label = np.select(list(cases.values()), codes, np.int8(Label.UNDETERMINED))
    return np.asarray(label, dtype=np.int8)


def _classify_image(
    samples: Samples,
    thresholds: Thresholds,
    seed: int | np.random.Generator | None,
    progress: bool | None,
) -> xr.Dataset:
    rng = generator(seed)
    dataset = samples.map(
        lambda block: _variables(_score(block, thresholds, rng)),
        description="classifying",
        progress=progress,
    )
    flags = {pattern.name: dataset[pattern.name].to_numpy() for pattern in PATTERNS}
    for pattern in PATTERNS:
        if pattern.test is None:
            continue
        p_value = dataset[f"{pattern.name}_p_value"]
        q_value = q_values(p_value.to_numpy())
        flags[pattern.name] &= q_value <= thresholds.alpha
        dataset[f"{pattern.name}_q_value"] = p_value.copy(data=q_value)
        dataset[pattern.name] = dataset[pattern.name].copy(data=flags[pattern.name])
    label = _label_pixels(flags, dataset["family"].to_numpy(), dataset["reason"].to_numpy())
    dataset["label"] = dataset["label"].copy(data=label)
    return _describe(dataset).assign_attrs(
        {f"threshold_{k}": v for k, v in asdict(thresholds).items()}
    )


def _variables(patterns: Patterns) -> Mapped:
    of_patterns: dict[str, npt.NDArray[Any]] = {
        **patterns.flags,
        **{f"{name}_statistic": value for name, value in patterns.statistics.items()},
        **{f"{name}_p_value": value for name, value in patterns.p_values.items()},
    }
    others = ("tail_index_se", "ashman_d", "family", "family_margin", "label", "reason")
    single = {**of_patterns, **{name: getattr(patterns, name) for name in others}}
    return {
        **{name: ((), value) for name, value in single.items()},
        "null_interval": (("bound",), patterns.null_interval),
    }


def _describe(dataset: xr.Dataset) -> xr.Dataset:
    for pattern in PATTERNS:
        _explain(dataset, pattern.name, f"{pattern.meaning}: {pattern.rule}")
        dataset[pattern.name].attrs["source"] = pattern.source
        _explain(dataset, f"{pattern.name}_statistic", pattern.statistic)
        if pattern.test is not None:
            _explain(dataset, f"{pattern.name}_p_value", f"p-value of no {pattern.name}")
            _explain(dataset, f"{pattern.name}_q_value", f"q-value of no {pattern.name}")
    _explain(dataset, "null_interval", "Wilson interval of the share of null samples")
    _explain(dataset, "tail_index_se", "standard error of the tail index")
    _explain(dataset, "ashman_d", "separation of two Gaussians in log10 radiance, Ashman's D")
    _explain(dataset, "family", "family with the smallest BIC")
    _explain(dataset, "family_margin", "BIC of the runner-up minus that of the best family")
    _explain(dataset, "label", "what the pixel is first of all")
    _explain(dataset, "reason", "why there is no positive part to look at")
    dataset["family"].attrs.update(
        flag_values=[-1, *range(len(FAMILIES))], flag_meanings=" ".join(["none", *FAMILIES])
    )
    dataset["label"].attrs.update(flag_attributes(Label))
    dataset["reason"].attrs.update(flag_attributes())
    return dataset.assign_coords(bound=np.array(["low", "high"], dtype=object))


def _explain(dataset: xr.Dataset, name: str, text: str) -> None:
    dataset[name].attrs.update(long_name=text, units="1")
