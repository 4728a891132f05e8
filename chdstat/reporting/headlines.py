"""Headlines: what a report says first, in sentences that their intervals allow.

Each is a finding in plain words with its evidence. A finding claims no more than the intervals of
its evidence: where one holds 1 or 0, it says that this cannot be told.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from typing import Any

from chdstat._core.display import about, capital, listed, percent, with_interval
from chdstat._core.resampling import Interval, mean_of
from chdstat.analysis import NoiseShares, Overview, noise_intervals
from chdstat.comparison import Comparison
from chdstat.comparison.estimator_choice import DEFAULT_ESTIMATE
from chdstat.comparison.metrics import Effect, effect_of, is_told, ratio_in_words
from chdstat.estimators import Combination
from chdstat.patterns import Label
from chdstat.patterns.attribution import largest_part
from chdstat.patterns.clamping import clamped_share
from chdstat.samples import Samples
from chdstat.studies.claims import SceneData
from chdstat.studies.scene_data import WithinPixels
from chdstat.studies.studies import SceneStudy
from chdstat.viz.styling import called

FEW_SAMPLES, FEW_PIXELS = 32, 64
"""Fewest samples for describing distributions, and fewest pixels for drawing maps."""
LITTLE = 5e-4
"""Share below which a number counts as none."""
_MANY_NULLS = 0.25
"""Share of null samples from which a report mentions them."""
_CLAMPED = 1e-3
"""Share of the light that a clamp takes from which a report mentions it."""
_ERRORS = 0.2, 0.1, 0.05, 0.02, 0.01, 0.005, 0.002, 0.001
"""Relative errors for which a report says the number of samples."""
_MATTERS = 0.1
"""Share of the noise from which a gain is worth a word."""
_MOST = 6
"""Most findings."""

_Headline = tuple[str, str]
"""A finding, and its evidence."""


def headlines(found: SceneStudy, estimate: Combination | None) -> list[dict[str, str]]:
    """Return at most six findings in plain words, each with its evidence.

    They say what is noisy, why, what helps, and by how much.
    """
    scene, noise, data = found.overview, found.noise, found.data
    if scene.spp < FEW_SAMPLES:
        rows = [
            (
                f"{scene.spp} samples per pixel tell no distribution.",
                f"From {FEW_SAMPLES} on, a report describes where the noise is and why, from "
                f"{2 * FEW_SAMPLES} on, what helps against it.",
            )
        ]
    else:
        rows = [*_where_noise_is(data, scene, noise), *_which_paths(data)]
        within = data.within_pixels if noise else None
        matters = within is not None and within.share.low > _MATTERS
        rows += _of_strata(within) if matters else []
        rows += [] if noise.label == "null_heavy" else _nulls(scene)
        rows += [*_clamp(data.samples), *_trust(scene), *_fireflies(data, scene, noise)]
        rows += [] if matters else _of_strata(within)
    helps = [] if found.comparison is None else [*_what_helps(found.comparison)]
    harms = (
        [] if found.comparison is None else [*where_it_harms(found.comparison, scene.pixels, noise)]
    )
    rows = rows[: _MOST - len(helps) - len(harms)]
    if estimate is not None and len(rows) + len(helps) + len(harms) < _MOST:
        rows += _how_many_samples(estimate)
    rows += [*helps, *harms]
    return [dict(zip(("finding", "because"), row, strict=True)) for row in rows]


# --- where the noise is ---------------------------------------------------------------------------


def _where_noise_is(data: SceneData, scene: Overview, noise: NoiseShares) -> Iterator[_Headline]:
    """Yield which pattern holds most of the noise, and what it means."""
    if scene.bad_samples == scene.pixels * scene.spp:
        yield "No sample is a number.", "All are NaN or infinite: nothing can be said of the image."
    elif not noise:
        yield "Nothing is noisy here.", "The samples of no pixel vary."
    elif len(noise.share) == 1:
        which = "The pixel is" if scene.pixels == 1 else "All pixels are"
        meaning, cure = _meaning(noise.label, data)
        yield f"{which} {called(noise.label)}.", f"{meaning}. What helps: {cure}."
    else:
        yield _largest_noise(data, noise)


def _largest_noise(data: SceneData, noise: NoiseShares) -> _Headline:
    """Return which of several patterns holds most of the noise, if that is sure."""
    first, second, *_ = noise.share
    found = noise_intervals(data.analysis, noise, data.whole().blocks)
    share = {label: found.share[label].shown(percent) for label in (first, second)}
    size = {label: percent(noise.pixels[label]) for label in (first, second)}
    (meaning, cure), (_, other_cure) = _meaning(first, data), _meaning(second, data)
    if found.lead.low > 0:
        return (
            f"The largest part of the noise is in {pixels_of(first)}.",
            f"They are {size[first]} of the image and hold {share[first]} of its relative "
            f"variance. {meaning}. What helps: {cure}.",
        )
    one = pixels_of(first)
    return (
        "No pattern surely holds the largest part of the noise.",
        f"{capital(one)} hold {share[first]} of the relative variance in {size[first]} "
        f"of the image, {pixels_of(second)} {share[second]} in {size[second]}. What helps in the "
        f"former: {cure}; in the latter: {other_cure}.",
    )


def _meaning(label: str, data: SceneData) -> tuple[str, str]:
    """Return what a pattern means, and what helps."""
    about_it = Label[label.upper()]
    return capital(about_it.meaning), about_it.cure_by(data.samples.attrs)


def pixels_of(label: str) -> str:
    """Return the name of the pixels of a primary label."""
    own = label not in {"black", "undetermined", "other"}
    return f"{called(label)} pixels" if own else f"pixels labelled '{called(label)}'"


def _nulls(scene: Overview) -> Iterator[_Headline]:
    if scene.null_share == 1:
        yield "No sample finds light.", "The scene has no emitter, or the camera sees none of it."
    elif scene.null_share >= _MANY_NULLS:
        yield (
            f"{percent(scene.null_share)} of all samples find no light.",
            "They cost as much as the others: sampling the lights better would help.",
        )


def _fireflies(data: SceneData, scene: Overview, noise: NoiseShares) -> Iterator[_Headline]:
    flags = data.analysis["firefly_dominated"].values.reshape(-1).astype(float)
    if flags.any() and noise.label != "firefly_dominated":
        share = mean_of(flags, data.whole().blocks).shown(percent)
        yield (
            f"In {share} of the pixels, one sample decides at {scene.spp} spp.",
            "It carries so much of their sum that their mean is too bright with it, or too dark "
            "without it.",
        )


def _which_paths(data: SceneData) -> Iterator[_Headline]:
    """Yield which paths and lights cause most of the variance, if samples are split by them."""
    samples = data.samples
    known = {"depth": samples.depths, "light": samples.lights}
    for by in ("depth", "light"):
        part = largest_part(samples, data.whole().blocks, by=by) if known[by] else None
        if part is None:
            continue
        if by == "light":
            who = "other light" if part.place < 0 else f"light from {part.name}"
        else:
            who = f"paths of {part.name}" if part.place else "emitted and direct light"
        plural = by == "depth" and bool(part.place)
        yield (
            f"{capital(who)} make{'' if plural else 's'} the largest part of the variance."
            if part.lead.low > 0
            else f"Whether {who} or other light makes the largest part of the variance cannot be "
            "told.",
            f"In the average pixel, {'they make' if plural else 'it makes'} "
            f"{part.share.shown(percent)} of it, and {percent(part.mean)} of the light.",
        )


def _of_strata(known: WithinPixels | None) -> Iterator[_Headline]:
    """Yield how much of the noise strata over the pixel could take at most, if that is known."""
    if known is None or not math.isfinite(known.share.high):
        return
    share, most = known.share.shown(percent), percent(max(known.share.high, 0.0))
    if known.share.low > _MATTERS:
        finding, share = f"Strata over the pixel could take {share} of the noise.", "So much"
    elif known.share.high < _MATTERS:
        finding = f"Strata over the pixel would take little of the noise: at most {most}."
    else:
        finding = f"Strata over the pixel would take at most {most} of the noise."
    where = ""
    if known.pixels >= LITTLE:
        where = (
            f" In {percent(known.pixels)} of the pixels, as at edges, it is most of the variance "
            f"that samples show; they hold {percent(known.held)} of the noise."
        )
    yield (
        finding,
        f"{share} of the relative variance is the picture changing within pixels. A stratum of the "
        f"pixel for each sample takes that away; the rest is of paths, or of details "
        f"much finer than a pixel.{where}",
    )


def _clamp(samples: Samples) -> Iterator[_Headline]:
    """Yield how much light the clamp of the scene file takes, if it has one that matters."""
    level, share = clamped_share(samples) or (0.0, 0.0)
    if share >= _CLAMPED:
        yield (
            f"The clamp of the file takes up to {percent(share)} of the light.",
            f"It is off here. At {level:g}, as in the file, it makes the image darker, most "
            "where it is noisy. Each contribution of a path is clamped, so that the loss may be "
            "smaller.",
        )


def _trust(scene: Overview) -> Iterator[_Headline]:
    """Yield how far error bars can be trusted, if averages were tested."""
    if not any(math.isfinite(share) for share in scene.averages.values()):
        return
    most = max(scene.averages)
    rejected = scene.averages[most]
    yield (
        f"Averages of {most} samples are not Gaussian in {percent(rejected)} of the channels.",
        "Error bars that assume Gaussian averages mislead there. In "
        f"{percent(scene.doubtful_variance)} of the channels, the error bar of {scene.spp} spp is "
        "said to fail, by the pixels around, too; in "
        f"{percent(scene.unidentified_variance)}, the samples do not tell.",
    )


def _how_many_samples(estimate: Combination) -> Iterator[_Headline]:
    """Yield the samples per pixel at which the default estimate has a smaller, round error."""
    error = estimate.error
    smaller = [e for e in _ERRORS if e < 0.8 * error.relative and e < error.interval[0]][:2]
    needed = [(f"{100 * e:g}\N{NO-BREAK SPACE}%", error.spp_in_words(e)) for e in smaller]
    if needed:
        also = "".join(f"; for {error}, you need {spp}" for error, spp in needed[1:])
        yield (
            "For an error of {} you need {}.".format(*needed[0]),
            f"From all {estimate.spp} samples, the default estimate has a relative error, the root "
            f"of its relMSE, of {error.in_words()}{also}. Fireflies that no sample has shown yet "
            "would need more.",
        )


# --- what helps -----------------------------------------------------------------------------------

_WORDS = {"mse_ratio": "squared", "relmse_ratio": "relative"}
"""Errors over those of the mean, in words."""


def _what_helps(comparison: Comparison) -> Iterator[_Headline]:
    """Yield what the default estimate gains over the mean, and which estimator gains more."""
    rows = {row["estimator"]: row for row in comparison.table()}
    own = rows.pop(DEFAULT_ESTIMATE, None)
    rows.pop("mean", None)
    if own is not None:
        yield gain(own, "the default estimate", comparison.n)
    # Estimators that increase the squared error come last: they trade one error for another.
    known = [row for row in rows.values() if math.isfinite(row["relmse_ratio"])]
    known = [row for row in known if effect_of(row, "mse_ratio") != "higher"] or known
    best = min(known, key=lambda row: row["relmse_ratio"], default=None)
    if best is not None and (own is None or _surely_below(best, own)):
        yield gain(best, called(best["estimator"]), comparison.n)


def _surely_below(one: Mapping[str, Any], other: Mapping[str, Any]) -> bool:
    """Return whether the interval of a relative error lies below that of another."""
    return bool(one["relmse_ratio_high"] < other["relmse_ratio_low"])


def gain(row: Mapping[str, Any], name: str, n: int) -> _Headline:
    """Return the gain of an estimator over the mean of n samples, as a finding.

    Examples
    --------
    >>> row = {"mse_ratio": 1.02, "mse_ratio_low": 0.951, "mse_ratio_high": 1.15}
    >>> row |= {f"relmse_ratio{end}": value for end, value in zip(("", "_low", "_high"), [1.0] * 3)}
    >>> row |= {"relmse_ratio_low": 0.93, "relmse_ratio_high": 1.08}
    >>> row |= dict.fromkeys(["bias", "improved_low", "improved_high"], math.nan)
    >>> finding, because = gain(row, "the default estimate", 32)
    >>> finding
    'The default estimate does not help measurably.'
    >>> because.partition(";")[0]
    "From 32 samples, its squared error is 1.02 [0.95, 1.15] times the mean's"
    """
    effects = {name: effect_of(row, name) for name in _WORDS}
    errors = [
        f"its {word} error is {ratio_in_words(row, ratio)} times the mean's"
        if is_told(row, ratio)
        else f"the samples do not tell its {word} error over the mean's"
        for ratio, word in {"mse_ratio": "squared", "relmse_ratio": "relative squared"}.items()
    ]
    if effects["mse_ratio"] == "lower" and row["mse_ratio"] > 0:
        ratio, least = row["mse_ratio"], row["mse_ratio_low"]
        most = n / least if least > 0 else math.inf
        samples = about(n / ratio, n / row["mse_ratio_high"], most, "samples")
        errors[0] += f", as of a mean of {samples}"
    told = f"From {n} samples, {errors[0]}; {errors[1]}."
    if not any(is_told(row, ratio) for ratio in _WORDS):
        told = f"The other samples do not tell its errors from {n} samples over those of the mean."
    evidence = [told, *_beside(row)]
    return f"{_effects_in_words(name, effects)}.", " ".join(evidence)


def _effects_in_words(name: str, effects: Mapping[str, Effect]) -> str:
    """Return what an estimator does to both errors, as far as their intervals say so."""
    by = {kind: [_WORDS[n] for n, e in effects.items() if e == kind] for kind in effects.values()}
    verbs = {"lower": "lowers", "higher": "raises"}
    parts = [
        f"{verb} the {' and the '.join(by[kind])} error"
        for kind, verb in verbs.items()
        if kind in by
    ]
    if parts:
        return f"{capital(name)} {', but '.join(parts)}"
    if "cannot tell" in by:
        return f"Whether {name} helps cannot be told"
    return f"{capital(name)} does not help measurably"


def _beside(row: Mapping[str, Any]) -> Iterator[str]:
    """Yield what is known of the bias of an estimator, and of how many estimates it improves."""
    low, high = row["improved_low"], row["improved_high"]
    if low > 0.5 or high < 0.5:
        most = "most" if low > 0.5 else "fewer than half"
        ends = Interval(math.nan, low, high).ends(percent)
        yield f"It improves {most} of the estimates, {ends}."
    if math.isfinite(row["bias"]):
        yield f"Its bias is {bias_in_words(row)}."


def bias_in_words(row: Mapping[str, Any]) -> str:
    """Return the bias of an estimator with its interval."""
    value, low, high = (row[f"bias{end}"] for end in ("", "_low", "_high"))
    return with_interval(value, low, high, partial(percent, sign=True))


# --- where it harms -------------------------------------------------------------------------------


def rows_by_label(
    comparison: Comparison | None, noise: NoiseShares, pixels: int
) -> dict[str, list[dict[str, Any]]]:
    """Return the measures of all estimators by label, of labels with enough pixels and noise."""
    by_label = None if comparison is None else comparison.breakdown
    rows: dict[str, list[dict[str, Any]]] = {}
    for row in [] if by_label is None else by_label.table():
        label = row["label"]
        enough = noise.pixels.get(label, 0) * pixels >= FEW_PIXELS
        if enough and noise.share.get(label, 0) >= LITTLE:
            rows.setdefault(label, []).append(row)
    return rows


def where_it_harms(comparison: Comparison, pixels: int, noise: NoiseShares) -> Iterator[_Headline]:
    """Yield in which pixels the default estimate is worse than the mean, and what is better."""
    worse = {}
    for label, rows in rows_by_label(comparison, noise, pixels).items():
        own = next((row for row in rows if row["estimator"] == DEFAULT_ESTIMATE), None)
        if own is not None and effect_of(own, "relmse_ratio") == "higher":
            worse[label] = _harm_in_words(own, rows)
    if worse:
        where = listed([pixels_of(label) for label in worse])
        evidence = "; ".join(f"in {pixels_of(label)} it is {said}" for label, said in worse.items())
        yield (
            f"The default estimate raises the relative error in {where}.",
            f"From {comparison.n} samples, over the mean's, {evidence}.",
        )


def _harm_in_words(own: Mapping[str, Any], rows: Sequence[Mapping[str, Any]]) -> str:
    """Return how large an error is, and that of the best estimator that is surely better."""
    better = [row for row in rows if row["estimator"] != "mean" and _surely_below(row, own)]
    better = [row for row in better if effect_of(row, "relmse_ratio") == "lower"]
    best = min(better, key=lambda row: row["relmse_ratio"], default=None)
    said = ratio_in_words(own, "relmse_ratio")
    if best is None:
        return f"{said}, and no estimator compared here is surely better than the mean"
    return f"{said}, that of {called(best['estimator'])} {ratio_in_words(best, 'relmse_ratio')}"


def row_of(comparison: Comparison | None, name: str) -> dict[str, Any] | None:
    """Return the row of an estimator, if its errors are known; else None."""
    rows = [] if comparison is None else comparison.table()
    known = (row for row in rows if row["estimator"] == name and is_told(row, "mse_ratio"))
    return next(known, None)
