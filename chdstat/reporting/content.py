"""Content of the report on a scene: from results to words and tables, ready for JSON."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple, Self

import numpy as np

from chdstat._core.display import number, percent
from chdstat._core.resampling import Interval, mean_of, median_of
from chdstat.analysis import Overview, overview
from chdstat.comparison import Comparison
from chdstat.comparison.tables import shown_ratio
from chdstat.estimators import MLP
from chdstat.patterns import PATTERNS
from chdstat.patterns.attribution import By, attribute
from chdstat.reporting.figures import Results
from chdstat.reporting.result_tables import (
    atlas_content,
    estimator_table,
    family_table,
    finding_content,
    fit_content,
    label_of,
    pattern_table,
    region_table,
    remake_note,
)
from chdstat.samples import Samples
from chdstat.samples.samples import provenance
from chdstat.studies.claims import SceneData
from chdstat.viz.estimators import called
from chdstat.viz.maps import names_of

if TYPE_CHECKING:
    import xarray as xr

__all__ = [
    "PUBLISHED_SIZE",
    "PUBLISHED_SPP",
    "abstract",
    "analysis_content",
    "headlines",
    "key_figures",
    "scene_content",
]


PUBLISHED_SPP, PUBLISHED_SIZE = 2000, 800
"""Samples per pixel, and pixels along each edge, of the images of Elek et al. 2019."""


# --- the first page -----------------------------------------------------------------------------

_NOISIEST = 0.1
"""Share of the pixels that are called the noisiest."""
_LIT = 0.01
"""Part of the squared mean radiance of the image that keeps relative variances finite, as in the
relative squared error of `chdstat.compare`."""


class KeyFigure(NamedTuple):
    """A number of the first page, with its interval."""

    value: str
    label: str
    interval: str


class Headline(NamedTuple):
    """A finding of the first page: one sentence, and what stands behind it."""

    finding: str
    because: str


@dataclass(frozen=True)
class _Noise:
    """Where the noise of an image is.

    Attributes
    ----------
    noisiest
        Share of the relative variance that the noisiest tenth of the pixels holds.
    label
        The primary pattern whose pixels hold most of it.
    share, pixels
        How much these hold, and what share of the image they are.
    """

    noisiest: float
    label: str
    share: float
    pixels: float

    @classmethod
    def of(cls, dataset: xr.Dataset) -> Self:
        """Return where the relative variance of luminance is, as relMSE weighs it."""
        mean = dataset["luminance_mean"].values
        spread = dataset["coefficient_of_variation"].values * mean
        typical = float(mean[np.isfinite(mean)].mean()) if np.isfinite(mean).any() else math.nan
        with np.errstate(divide="ignore", invalid="ignore"):
            variance = spread**2 / (mean**2 + _LIT * typical**2)
        variance = np.where(np.isfinite(variance), variance, 0.0)
        total = float(variance.sum()) or math.nan
        ordered = np.sort(variance, axis=None)[::-1]
        count = max(1, round(_NOISIEST * ordered.size))
        labels, words = dataset["label"].values, names_of(dataset["label"])
        held = {code: float(variance[labels == code].sum()) for code in words}
        most = max(held, key=lambda code: held[code])
        return cls(
            noisiest=float(ordered[:count].sum()) / total,
            label=words[most],
            share=held[most] / total,
            pixels=float((labels == most).mean()),
        )


def abstract(found: Results) -> list[str]:
    """Return the report in four sentences."""
    height, width, _, spp = found.data.samples.shape
    sentences = [
        f"This report looks at the {spp} samples of radiance that each of the {width} × {height} "
        f"pixels of {found.data.samples.name} received before they are averaged.",
        *_on_noise(found),
    ]
    best = _best(found.comparison)
    if best is not None and found.comparison is not None:
        sentences.append(
            f"From {found.comparison.n} samples, {label_of(best['estimator'])} estimates best, "
            f"with {number(best['relmse_ratio'])} times the relative and "
            f"{number(best['mse_ratio'])} times the squared error of the sample mean."
        )
    else:
        sentences.append("There are too few samples to compare estimators.")
    return sentences


def _on_noise(found: Results) -> list[str]:
    """Return two sentences on how much the samples vary, and where."""
    scene, noise = found.scene, _Noise.of(found.data.analysis)
    where = (
        f"The noisiest tenth of the pixels holds {percent(noise.noisiest)} of the relative "
        f"variance; {_pixels(noise.label)} hold {percent(noise.share)} of it."
    )
    return [
        f"In the median pixel their standard deviation is {number(scene.variation[1])} times their "
        f"mean, and {percent(scene.null_share)} of all samples carry no light.",
        where if math.isfinite(noise.share) else "The samples of no pixel vary.",
    ]


def analysis_content(samples: Samples, dataset: xr.Dataset) -> dict[str, Any]:
    """Return what a report says of an analysis: sentences, findings, families and patterns.

    `dataset` is what `chdstat.analyze` returned for the samples.
    """
    scene = overview(dataset)
    data = SceneData(samples.name, samples, given=dataset)
    found = Results(data, scene, None, (), None)
    return {
        "sentences": [
            f"{samples.name}: {samples.shape[1]} × {samples.shape[0]} pixels with {samples.spp} "
            "samples each.",
            *_on_noise(found),
            _bad_samples(scene),
        ],
        "findings": [f"{h.finding} {h.because}" for h in headlines(found)],
        "families": family_table(dataset),
        "patterns": pattern_table(scene),
    }


def key_figures(found: Results) -> list[KeyFigure]:
    """Return four numbers with 95 % intervals, three of the samples and one of the estimators."""
    dataset = found.data.analysis
    blocks = found.data.whole().blocks
    null = mean_of(dataset["null_share"].values.reshape(-1), blocks)
    variation = median_of(dataset["coefficient_of_variation"].values.reshape(-1), blocks)
    tails = mean_of(dataset["long_tail"].values.reshape(-1).astype(float), blocks)
    shown = [
        KeyFigure(percent(null.value), "of the samples are null", _between(null, percent)),
        KeyFigure(
            number(variation.value),
            "standard deviation over mean, median pixel",
            _between(variation, number),
        ),
        KeyFigure(percent(tails.value), "of the pixels have a long tail", _between(tails, percent)),
    ]
    best = _best(found.comparison)
    if best is not None and found.comparison is not None:
        name, n = label_of(best["estimator"]), found.comparison.n
        low, high = number(best["relmse_ratio_low"]), number(best["relmse_ratio_high"])
        shown.append(
            KeyFigure(
                f"{number(best['relmse_ratio'])}×",
                f"relative squared error of {name} over that of the mean of {n} samples",
                f"{low} to {high}",
            )
        )
    return shown


def headlines(found: Results) -> list[Headline]:
    """Return at most six findings in plain words: what is noisy, why, what helps, by how much."""
    scene, noise = found.scene, _Noise.of(found.data.analysis)
    rows = [
        *_where_noise_is(noise),
        *_which_paths(found.data),
        Headline(
            f"{percent(scene.null_share)} of all samples find no light.",
            f"In {percent(scene.patterns['null_heavy'])} of the pixels null samples are "
            "significantly more than half: better light sampling would help there.",
        ),
        *_trust(scene),
    ]
    if scene.patterns["firefly_dominated"] > 0 and noise.label != label_of("firefly_dominated"):
        rows.append(
            Headline(
                f"One sample decides {percent(scene.patterns['firefly_dominated'])} of the pixels.",
                f"There a single one of {scene.spp} samples carries so much of the mean that the "
                "pixel is a firefly, or would be one without it.",
            )
        )
    if found.comparison is not None:
        rows += _what_helps(found.comparison)
    return rows[:6]


def _where_noise_is(noise: _Noise) -> Iterator[Headline]:
    """Yield which pattern holds most of the noise; nothing where there is none."""
    if math.isfinite(noise.share):
        yield Headline(
            f"The largest part of the noise is in {_pixels(noise.label)}.",
            f"By the first pattern of each, they are {percent(noise.pixels)} of the image and "
            f"hold {percent(noise.share)} of its relative variance: "
            f"{_MEANING.get(noise.label, 'no pattern of the table applies')}.",
        )


def _which_paths(data: SceneData) -> Iterator[Headline]:
    """Yield which paths and lights make most of the variance, where samples are known by them."""
    if data.samples.depths:
        yield from _largest_part(data, "depth")
    if data.samples.lights:
        yield from _largest_part(data, "light")


def _largest_part(data: SceneData, by: By) -> Iterator[Headline]:
    light, blocks = attribute(data.samples, by=by, progress=False), data.whole().blocks
    known = np.isfinite(light["variance_share"].to_numpy()[..., 0]).ravel()
    if not known.any():
        return
    part = blocks[known]
    held = light["variance_share"].to_numpy().reshape(len(known), -1)[known]
    most = int(held.mean(axis=0).argmax())
    share = mean_of(held[:, most].astype(np.float64), part)
    mean = float(light["mean_share"].to_numpy().reshape(len(known), -1)[known, most].mean())
    name = str(light["paths" if by == "depth" else "light"].to_numpy()[most])
    if by == "light":
        who = f"Light from {name} makes" if most < held.shape[1] - 1 else "Other light makes"
    else:
        who = "Emitted and direct light makes" if most == 0 else f"Paths of {name} make"
    yield Headline(
        f"{who} the largest part of the variance.",
        f"In the average pixel that is {percent(share.value)} of it "
        f"[{_between(share, percent)}], and {percent(mean)} of the light.",
    )


def _pixels(label: str) -> str:
    """Return what to call the pixels of a primary label."""
    return f"{label} pixels" if label in _MEANING else f"pixels labelled '{label}'"


def _trust(scene: Overview) -> Iterator[Headline]:
    """Yield how far error bars can be trusted."""
    if not any(math.isfinite(share) for share in scene.averages.values()):
        return
    most = max(scene.averages)
    rejected = scene.averages[most]
    yield Headline(
        f"Averages of {most} samples are not Gaussian in {percent(rejected)} of the channels.",
        "There, error bars that presume it mislead. In "
        f"{percent(scene.doubtful_variance)} the estimated tail index is at least 1/2: the "
        "variance may be infinite, and no error bar holds.",
    )


def _what_helps(comparison: Comparison) -> Iterator[Headline]:
    best = _best(comparison)
    if best is None:
        return
    name = label_of(best["estimator"])
    if not best["relmse_ratio_high"] < 1:
        yield Headline(
            "No estimator is clearly better than the mean.",
            f"The best, {name}, has {shown_ratio(best, 'relmse_ratio')} times its relative "
            "squared error.",
        )
        return
    yield Headline(
        f"{name[0].upper()}{name[1:]} helps most.",
        f"From {comparison.n} samples it has {shown_ratio(best, 'relmse_ratio')} times the "
        f"relative and {shown_ratio(best, 'mse_ratio')} times the squared error of the mean, "
        f"and improves {percent(best['improved'])} of the estimates, with a bias of "
        f"{percent(best['bias'], sign=True)}.",
    )


def _between(interval: Interval[float], write: Callable[[float], str]) -> str:
    known = math.isfinite(interval.low) and math.isfinite(interval.high)
    return f"{write(interval.low)} to {write(interval.high)}" if known else ""


def _best(comparison: Comparison | None) -> dict[str, Any] | None:
    """Return the row of the estimator with the least relative squared error; None without any.

    Those that raise the squared error stand back, as they buy the one error with the other.
    """
    rows = [] if comparison is None else comparison.table()
    rows = [row for row in rows if row["estimator"] != "mean"]
    rows = [row for row in rows if not row["mse_ratio_low"] > 1] or rows
    return min(rows, key=lambda row: row["relmse_ratio"], default=None)


_MEANING = {called(p.name): p.meaning for p in PATTERNS}


# --- tables -------------------------------------------------------------------------------------


def scene_content(found: Results) -> dict[str, Any]:
    """Return the entries of the report, by their names, ready for JSON."""
    data, scene, dataset = found.data, found.scene, found.data.analysis
    prefix = "threshold_"
    entries = {
        "title": data.samples.name,
        "remake": remake_note([data.samples]),
        "spp": data.samples.spp,
        "luminance": data.samples.shape[2] == 3,
        "abstract": abstract(found),
        "key_figures": [figure._asdict() for figure in key_figures(found)],
        "findings": [headline._asdict() for headline in headlines(found)],
        "claims": [finding_content(finding) for finding in found.claims],
        "provenance": list(provenance(data.samples.attrs, data.samples.shape).items()),
        "regions": region_table(data),
        "families": family_table(dataset),
        "fit": fit_content(scene),
        "patterns": pattern_table(scene),
        "alpha": percent(float(dataset.attrs["false_discovery_rate"])),
        "thresholds": {
            str(name).removeprefix(prefix): number(float(value))
            for name, value in dataset.attrs.items()
            if str(name).startswith(prefix)
        },
        "n_means": int(dataset.attrs.get("n_means", 0)),
        "agreement": number(scene.label_agreement),
        "bad_samples": _bad_samples(scene),
        "deviations": _deviations(found),
    }
    if found.atlas is not None:
        entries["atlas"] = atlas_content(found.atlas)
    if found.comparison is not None:
        entries["estimators"] = estimator_table(found.comparison)
    return entries


def _bad_samples(scene: Overview) -> str:
    total = scene.pixels * scene.spp
    if scene.bad_samples:
        return f"{scene.bad_samples} of {total} samples are NaN or infinite."
    return f"None of {total} samples is NaN or infinite."


def _deviations(found: Results) -> list[str]:
    """Return what was not done as Elek et al. 2019 did it, in words."""
    height, width, _, spp = found.data.samples.shape
    there = []
    if spp < PUBLISHED_SPP:
        there.append(f"{spp} samples per pixel in place of {PUBLISHED_SPP}")
    if max(height, width) < PUBLISHED_SIZE:
        there.append(f"{width} × {height} pixels in place of {PUBLISHED_SIZE} × {PUBLISHED_SIZE}")
    for model in [] if found.comparison is None else found.comparison.models.values():
        if isinstance(model, MLP):
            done, published = int(model.history.iteration[-1]), model.config.iterations
            if done < published:
                there.append(f"{done} minibatches train its network in place of {published}")
            used = len(model.train_pixels)
            if used < model.config.pixels:
                there.append(f"{used} pixels train it in place of {model.config.pixels}")
    return there
