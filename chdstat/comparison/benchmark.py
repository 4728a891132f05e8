"""Benchmark: estimators on several scenes and numbers of samples, against converged references.

`bench` answers the questions of a paper on a new estimator: is it better than the others, on every
scene, at every number of samples, and at equal time? Its `Bench` holds a `Case` for each scene and
number of samples. `compare` measures more on one image, and needs no reference besides its samples.
"""

from __future__ import annotations

import hashlib
import importlib.util
import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from chdstat._core.arrays import Array, Seed, seed_number, whole
from chdstat._core.display import Card, Shown, latex, number, percent
from chdstat._core.files import checked_target, replacing
from chdstat._core.image_scales import relative_scale
from chdstat._core.resampling import Blocks, Interval, interval_of
from chdstat._core.work import track
from chdstat.comparison.entries import Entry, choose, estimate_by, notes, takes, without_denoiser
from chdstat.errors import InputError, check_option
from chdstat.estimators.registry import LearnedEstimator
from chdstat.io import read_exr
from chdstat.rendering import render, render_batches
from chdstat.samples import Samples, is_store
from chdstat.samples import open as open_samples
from chdstat.summary import summarize

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["ERRORS", "FORMATS", "Bench", "Case", "bench", "flip"]

Scenes = str | Path | Samples | Sequence[str | Path | Samples] | Mapping[str, Any]
Images = Mapping[str, Mapping[str, Any]]

_NAMES = {"mse": "MSE", "relmse": "relMSE", "smape": "SMAPE", "flip": "FLIP"}
_HAS_FLIP = importlib.util.find_spec("flip_evaluator") is not None
ERRORS = tuple(name for name in _NAMES if name != "flip" or _HAS_FLIP)
"""Errors that are added up over pixels; FLIP where its package is installed."""
FORMATS = (".csv", ".tex", ".json", ".pdf")
"""File formats of a benchmark."""
_LEAST = 1e-3
"""Least ratio of errors, and one over the largest: minus the noise of the reference, an error may
be 0 or less."""
_SIZE = (128, 128)
_REFERENCE_SPP = 2048
_BATCH = 64
_APART = 2**30
"""Added to the seed of a reference, so that it shares no random number with the samples."""
_FIREFLY = 3.0
_CROP = 128
"""Largest edge, in pixels, of the images that are kept for display."""
_SMALL = 16
"""Edge, in pixels, of the image that is estimated before time is measured."""


def flip(image: Array, reference: Array) -> Array:
    """Return the FLIP error of every pixel of linear radiance, shape (y, x), from 0 to 1.

    HDR-FLIP with its defaults: 67 pixels per degree, exposures from the reference.

    References
    ----------
    P. Andersson, J. Nilsson, P. Shirley and T. Akenine-Möller, "Visualizing errors in rendered high
    dynamic range images", Eurographics Short Papers 2021, doi:10.2312/egs.20211015.
    """
    evaluator: Any = importlib.import_module("flip_evaluator")
    shape = (*reference.shape[:2], 3)
    shown = (
        np.array(np.broadcast_to(np.maximum(x, 0), shape), np.float32, order="C")
        for x in (reference, image)
    )
    found, _, _ = evaluator.evaluate(*shown, "HDR", applyMagma=False, computeMeanError=False)
    return np.asarray(found, np.float64).reshape(shape[:2])


def _numbers(name: str, found: Interval[float]) -> dict[str, float]:
    return {name: found.value, f"{name}_low": found.low, f"{name}_high": found.high}


@dataclass(frozen=True)
class Case:
    """One scene at one number of samples.

    Attributes
    ----------
    scene, spp
        Name of the scene, and number of samples.
    blocks
        Blocks of its pixels.
    errors
        Sums of the errors of `ERRORS` over each block, by estimator, shape (block, measure).
    bias, fireflies
        By estimator: the mean error divided by the mean reference; the share of pixels at least two
        stops too bright, as in `chdstat.compare`.
    seconds
        Time of each estimate, by estimator; NaN for finished images.
    render_seconds
        Time to render the samples; NaN if unknown.
    images
        By estimator, and last the "reference": the centre of the first render's image, at most 128
        x 128 pixels of linear radiance, (y, x, channel). Only kept for the smallest number of
        samples, where differences are largest.
    """

    scene: str
    spp: int
    blocks: Blocks
    errors: Mapping[str, Array]
    bias: Mapping[str, float]
    fireflies: Mapping[str, float]
    seconds: Mapping[str, float]
    render_seconds: float
    images: Mapping[str, Array] = field(default_factory=dict)

    @staticmethod
    def average(cases: Sequence[Case]) -> Case:
        """Average the cases of several renders of a scene."""

        def mean(field: str) -> Any:
            values = [getattr(case, field) for case in cases]
            return {name: np.mean([value[name] for value in values], axis=0) for name in values[0]}

        fields = {field: mean(field) for field in ("errors", "bias", "fireflies", "seconds")}
        render_seconds = float(np.mean([case.render_seconds for case in cases]))
        return replace(cases[0], **fields, render_seconds=render_seconds)

    def ratios(self, name: str, baseline: str, measure: str, weights: Array) -> Array:
        """Return the ratio of the errors of two estimators, for weighted blocks."""
        k = ERRORS.index(measure)
        one, other = (weights @ self.errors[n][:, k] for n in (name, baseline))
        # Where neither is above 0, nothing is known.
        ratio = np.maximum(one, _LEAST * other) / np.maximum(other, _LEAST * one)
        return np.where(np.maximum(one, other) > 0, ratio, np.nan)

    def ratio(self, name: str, baseline: str, measure: str) -> Interval[float]:
        """Return that ratio with its interval over blocks."""
        ratios = partial(self.ratios, name, baseline, measure)
        return interval_of(ratios, self.blocks, bounds=(0, np.inf))

    def row(self, name: str, baseline: str) -> dict[str, Any]:
        """Return the row of an estimator."""
        pixels = len(self.blocks.of_pixel)
        means = dict(zip(ERRORS, self.errors[name].sum(axis=0) / pixels, strict=True))
        found: dict[str, Any] = {"scene": self.scene, "spp": self.spp, "estimator": name, **means}
        for measure in ERRORS:
            found |= _numbers(f"{measure}_ratio", self.ratio(name, baseline, measure))
        # The error of a mean is inversely proportional to the time.
        longer = 1 + self.seconds[name] / self.render_seconds
        return found | {
            "mse_equal_time": found["mse_ratio"] * longer,
            "bias": self.bias[name],
            "fireflies": self.fireflies[name],
            "seconds": self.seconds[name],
        }


@dataclass(frozen=True, repr=False)
class Bench(Shown):
    """Errors of estimators on several scenes.

    Attributes
    ----------
    estimators
        Names of the estimators, in the given order.
    baseline
        Name of the estimator by whose errors all are divided.
    cases
        A `Case` for each scene and number of samples.
    left_out
        Names from `chdstat.comparison.DEFAULT_ESTIMATORS` that do not apply, with the reason.
    """

    estimators: tuple[str, ...]
    baseline: str
    cases: tuple[Case, ...]
    left_out: Mapping[str, str] = field(default_factory=dict)

    def table(self) -> list[dict[str, Any]]:
        """Return a row for each scene, number of samples and estimator.

        A row has the errors and their ratios to the baseline, with 95 % intervals over blocks of
        pixels; ``mse_equal_time``, the ratio of the MSE times the time to render and estimate over
        the time to render; bias; fireflies; and seconds.
        """
        return [
            case.row(name, self.baseline)
            for case in self.cases
            for name in self.estimators
            if name in case.errors
        ]

    @cached_property
    def _regions(self) -> tuple[Blocks, dict[str, slice]]:
        """Blocks of all scenes, and the slice of each scene, whose cases share its blocks."""
        first = {case.scene: case.blocks for case in self.cases}
        ends = np.cumsum([0, *map(len, first.values())])
        places = {name: slice(ends[i], ends[i + 1]) for i, name in enumerate(first)}
        return Blocks.join(list(first.values())), places

    def _average(
        self,
        name: str,
        of_case: Callable[[Case, Array], Array],
        bounds: tuple[float, float],
        change: Callable[[Array], Array] = np.asarray,
    ) -> Interval[float]:
        """Average a statistic of weighted blocks over the cases of an estimator."""
        blocks, places = self._regions

        def statistic(weights: Array) -> Array:
            found = [
                of_case(case, weights[:, places[case.scene]])
                for case in self.cases
                if name in case.errors
            ]
            return change(np.mean(found, axis=0))

        return interval_of(statistic, blocks, bounds=bounds)

    def geometric_mean(self, name: str, measure: str = "mse") -> Interval[float]:
        """Return the geometric mean, over all cases, of the ratios of an error to the baseline's.

        The 95 % interval is over blocks of pixels of these scenes; other scenes may differ by more.
        """

        def logarithm(case: Case, weights: Array) -> Array:
            return np.log(case.ratios(name, self.baseline, measure, weights))

        return self._average(name, logarithm, (0, np.inf), np.exp)

    def rank(self, name: str, measure: str = "mse") -> Interval[float]:
        """Return the average rank among the estimators over all cases, 1 for the least error."""
        k = ERRORS.index(measure)

        def rank(case: Case, weights: Array) -> Array:
            own = weights @ case.errors[name][:, k]
            others = [weights @ e[:, k] for n, e in case.errors.items() if n != name]
            return sum((own > other for other in others), np.ones(len(weights)))

        return self._average(name, rank, (1, len(self.estimators)))

    def summary(self) -> list[dict[str, Any]]:
        """Return a row for each estimator, over all cases.

        A row has the geometric means of the ratios of errors and the average rank by MSE, each with
        its 95 % interval; ``worst``, the largest ratio of the MSE in any case; ``bias``, the
        largest absolute bias in any case, with its sign; ``fireflies``, the average share; and the
        number of cases.
        """
        rows = []
        for name in self.estimators:
            intervals = {measure: self.geometric_mean(name, measure) for measure in ERRORS}
            intervals["rank"] = self.rank(name)
            cases = [case for case in self.cases if name in case.errors]
            row: dict[str, Any] = {"estimator": name}
            for what, found in intervals.items():
                row |= _numbers(what, found)
            row["worst"] = max(case.ratio(name, self.baseline, "mse").value for case in cases)
            row["bias"] = max((case.bias[name] for case in cases), key=abs)
            row["fireflies"] = float(np.mean([case.fireflies[name] for case in cases]))
            row["cases"] = len(cases)
            rows.append(row)
        return rows

    @property
    def notes(self) -> dict[str, str]:
        """Notes for a reader of the table, as in a `Comparison`."""
        own = {name: sum(name in case.errors for case in self.cases) for name in self.estimators}
        every = len(self.cases)
        absent = {name: f"in {every - n} of {every} cases" for name, n in own.items() if n < every}
        return notes(self.estimators, left_out={**self.left_out, **absent})

    def _card(self) -> Card:
        scenes, spp = {c.scene: None for c in self.cases}, {c.spp: None for c in self.cases}
        facts = {"scenes": ", ".join(scenes), "spp": ", ".join(map(str, spp))}
        facts |= self.notes
        if not _HAS_FLIP:
            facts["FLIP"] = "not measured; pip install 'chdstat[flip]' adds it"
        title = f"Benchmark: errors over those of {self.baseline}"
        rows = self.shown(intervals=("mse", "relmse"))
        for row in rows:  # fits a page; SMAPE is in files and in `summary`
            del row[_NAMES["smape"]]
        return Card(title, facts, rows)

    def shown(self, *, intervals: Sequence[str] = ERRORS) -> list[dict[str, str]]:
        """Return the summary as text under titles, with intervals for some of the measures."""

        def ratio(row: Mapping[str, Any], measure: str) -> str:
            ends = f" [{row[f'{measure}_low']:.2f}, {row[f'{measure}_high']:.2f}]"
            return f"{row[measure]:.2f}{ends if measure in intervals else ''}"

        return [
            {
                "estimator": row["estimator"],
                **{_NAMES[measure]: ratio(row, measure) for measure in ERRORS},
                "bias": percent(row["bias"], sign=True),
                "fireflies": percent(row["fireflies"]),
                "rank": f"{row['rank']:.1f}",
                "worst": number(row["worst"]),
            }
            for row in self.summary()
        ]

    def to_dict(self) -> dict[str, Any]:
        """Return everything as plain values."""
        return {"baseline": self.baseline, "summary": self.summary(), "cases": self.table()}

    def to_dataframe(self) -> pd.DataFrame:
        """Return the rows of `table` as a pandas data frame."""
        import pandas as pd

        return pd.DataFrame(self.table())

    def to_latex(self) -> str:
        """Return the summary as a LaTeX table, which needs the package booktabs."""
        return latex(self.shown())

    def save(self, path: str | Path) -> Path:
        """Write `table` to a .csv, the summary to a .tex, both to a .json file, or a .pdf.

        The PDF has both, curves of the errors and images of every scene.

        Raises
        ------
        InputError
            If the path has another ending, or cannot be written to.
        """
        target = checked_target(path, *FORMATS)
        if target.suffix == ".pdf":
            from chdstat.reporting.documents import bench_document, typeset

            return typeset(bench_document(self), target)
        if target.suffix == ".csv":
            text = str(self.to_dataframe().to_csv(index=False))
        elif target.suffix == ".tex":
            text = self.to_latex()
        else:
            text = json.dumps(self.to_dict(), indent=1)
        with replacing(target) as file:
            file.write_text(text, encoding="utf-8")
        return target


def bench(
    scenes: Scenes,
    estimators: Sequence[str | Entry] | None = None,
    *,
    spp: Sequence[int] = (16, 64),
    seeds: int = 1,
    seed: Seed = 0,
    size: tuple[int, int] | None = None,
    references: Mapping[str, Any] | None = None,
    reference_spp: int = _REFERENCE_SPP,
    images: Images | None = None,
    baseline: str | None = None,
    folder: str | Path | None = None,
    progress: bool | None = None,
) -> Bench:
    r"""Measure estimators on several scenes, against references from other samples.

    Let p be an estimate, y its reference with variance v, and m the mean reference of the scene.
    ``mse`` is :math:`\overline{(p - y)^2 - v}`, ``relmse`` is :math:`\overline{((p - y)^2 - v) /
    (y^2 + 0.01\, m^2)}`, and ``smape`` is :math:`\overline{2 |p - y| / (|p| + |y| + 0.01\, m)}`.
    The noise of the reference is subtracted from ``mse`` and ``relmse``, but not from ``smape``. If
    ``flip-evaluator`` is installed (``pip install chdstat[flip]``), ``flip`` measures how visible
    the differences are (Andersson et al. 2021, doi:10.2312/egs.20211015). Pixels without a
    reference do not count; where an estimate is no number, it counts as black.

    Parameters
    ----------
    scenes
        Names, XML files, stores or `Samples`, one or several; a mapping names them. Scenes are
        rendered; from stores and `Samples`, the first samples are taken.
    estimators
        As for `chdstat.compare`; None takes those of `chdstat.comparison.DEFAULT_ESTIMATORS` that
        train nothing. Estimators that train on a reference are refused: make an `Estimator` of the
        trained model. An estimator that needs more samples than a number of `spp` has no row there.
    spp
        Numbers of samples to estimate from.
    seeds
        Number of renders of each scene; errors are averaged over them.
    seed
        Seed of the first render.
    size
        (width, height) of rendered scenes; None takes 128 x 128.
    references
        By scene: a converged image as an EXR file or an array (y, x, channel), or more samples as
        `Samples` or a store. The noise of an image is unknown and stays part of the errors. By
        default, scenes are rendered with another seed, and given samples use the rest of their
        samples as reference. If a reference has the seed of the samples, its first samples are left
        out, too.
    reference_spp
        Samples of a rendered reference.
    images
        Finished images of other programs, by name and scene, each the path of an EXR file; with
        several `spp`, a mapping from `spp` to paths.
    baseline
        Name of the estimator by whose errors all are divided; None takes the sample mean, or the
        first estimator if that is missing.
    folder
        Folder that keeps rendered samples and references for a second run; None keeps nothing.
    progress
        Show a progress bar; None shows it on a terminal.

    Returns
    -------
    Bench

    Raises
    ------
    InputError
        If a name or a number is wrong, the sizes of an image and its scene differ, an estimator
        trains, or there are too few samples.

    Examples
    --------
    >>> import chdstat as chd
    >>> found = bench(["cornell-box"], ["mean", "median"], spp=[8], size=(24, 24),
    ...               reference_spp=256, progress=False)
    >>> [row["estimator"] for row in found.summary()], found.summary()[0]["mse"]
    (['mean', 'median'], 1.0)
    """
    numbers, seeds = sorted({whole("spp", n, least=1) for n in spp}), whole("seeds", seeds, least=1)
    chosen = choose(estimators, numbers)
    for name, entry in chosen.entries.items():
        if isinstance(without_denoiser(entry), LearnedEstimator):
            message = f"{name!r} trains against a reference; give an Estimator of a trained model"
            raise InputError(message)
    names = [*chosen.entries, *(images or {})]
    if len(set(names)) < len(names):
        message = f"estimators and images must have different names, got {names}"
        raise InputError(message)
    baseline = baseline or ("mean" if "mean" in names else names[0])
    check_option("baseline", baseline, names)
    if baseline in chosen.entries and not takes(chosen.entries[baseline], numbers[0]):
        message = f"the baseline, {baseline}, takes more than {numbers[0]} samples; give more spp"
        raise InputError(message)
    if isinstance(scenes, (str, Path, Samples)):
        scenes = [scenes]
    named = scenes if isinstance(scenes, Mapping) else {_name(scene): scene for scene in scenes}
    if not named:
        message = "a benchmark needs at least one scene, got none"
        raise InputError(message)
    source = _Inputs(numbers, seed_number(seed), seeds, size or _SIZE, reference_spp, folder)
    cases: list[Case] = []
    with track("benchmark", len(named) * seeds, unit="render", show=progress) as advance:
        for name, scene in named.items():
            parts: list[list[Case]] = []
            truth = source.reference(name, scene, (references or {}).get(name))
            for i in range(seeds):
                samples = source.samples(name, scene, i)
                if not (cases or parts):  # networks are loaded before time is measured
                    small = samples.isel(y=slice(_SMALL), x=slice(_SMALL))
                    for entry in chosen.entries.values():
                        estimate_by(entry, small.read(), features=small.features)
                parts.append(_measured(chosen.entries, images or {}, numbers, truth, samples, name))
                advance(1)
            cases += [Case.average([part[k] for part in parts]) for k in range(len(numbers))]
    return Bench(tuple(names), baseline, tuple(cases), chosen.left_out)


def _name(scene: Any) -> str:
    if isinstance(scene, Samples):
        return scene.name
    path = Path(str(scene))
    return path.parent.name if path.stem == "scene" else path.stem


@dataclass(frozen=True)
class _Inputs:
    """Renders or reads the samples and references of scenes."""

    numbers: Sequence[int]
    seed: int
    seeds: int
    size: tuple[int, int]
    reference_spp: int
    folder: str | Path | None

    def samples(self, name: str, scene: Any, i: int) -> Samples:
        held = _held(scene)
        if held is not None:
            if self.seeds > 1 or held.spp < self.numbers[-1]:
                message = (
                    f"{name} has {held.spp} samples per pixel of one render; give seeds=1 and spp "
                    "of at most that, or a scene that can be rendered"
                )
                raise InputError(message)
            return held.first(self.numbers[-1])
        out = None
        if self.folder is not None:
            Path(self.folder).mkdir(parents=True, exist_ok=True)
            out = Path(self.folder) / f"{name}-{self.seed + i}.zarr"
        found = render(
            scene, spp=self.numbers[-1], size=self.size, seed=self.seed + i, out=out, progress=False
        )
        return found.first(self.numbers[-1])

    def reference(self, name: str, scene: Any, given: Any) -> tuple[Array, Array]:
        """Return a reference (y, x, channel) and its variance, 0 if unknown."""
        more, held = _held(given), _held(scene)
        if more is not None:
            seed, own = more.attrs.get("seed"), range(self.seed, self.seed + self.seeds)
            same = seed in own if held is None else seed == held.attrs.get("seed")
            # Sample i of both would have the same random numbers: those after them judge.
            first = self.numbers[-1] if same and seed is not None else 0
            if more.spp < 2 * first:
                message = (
                    f"the reference of {name} has its seed, {seed}, and {more.spp} samples per "
                    f"pixel; give one of another seed, or of {2 * first} samples or more"
                )
                raise InputError(message)
            return _mean(more.isel(sample=slice(first, None)))
        if given is not None:
            named = isinstance(given, str | Path)
            image = np.asarray(read_exr(given).image if named else given, np.float64)
            return image, np.zeros_like(image)
        if held is not None:
            if held.spp < 2 * self.numbers[-1]:
                message = (
                    f"{name} has {held.spp} samples per pixel, too few for a reference of those "
                    f"after the first {self.numbers[-1]}; give one in references"
                )
                raise InputError(message)
            return _mean(held.isel(sample=slice(self.numbers[-1], None)))
        batches = render_batches(
            scene,
            spp=self.reference_spp,
            batch=min(_BATCH, max(1, self.reference_spp // 2)),
            size=self.size,
            seed=self.seed + _APART,
            progress=False,
        )
        kept = None
        if self.folder is not None:
            # Another scene of this name, or other settings, gets another file.
            about = [batches.attrs[k] for k in ("scene_hash", "scene_code", "size", "spp", "seed")]
            digest = hashlib.sha256(repr(about).encode()).hexdigest()[:8]
            kept = Path(self.folder) / f"{name}-reference-{digest}.npz"
        if kept is not None and kept.exists():
            held_images = np.load(kept)
            return held_images["image"], held_images["variance"]
        means = np.stack([batch.mean(axis=-1, dtype=np.float64) for batch in batches])
        image, variance = means.mean(axis=0), means.var(axis=0, ddof=1) / len(means)
        if kept is not None:
            kept.parent.mkdir(parents=True, exist_ok=True)
            with replacing(kept) as file, file.open("wb") as stream:
                np.savez(stream, image=image, variance=variance)
        return image, variance


def _held(given: Any) -> Samples | None:
    """Return existing samples, given directly or as a store."""
    if isinstance(given, Samples):
        return given
    return open_samples(given) if is_store(given) else None


def _mean(samples: Samples) -> tuple[Array, Array]:
    found = summarize(samples, progress=False)
    return found["mean"].values, np.square(found["standard_error"].values)


def _measured(
    entries: Mapping[str, Entry],
    images: Images,
    numbers: Sequence[int],
    truth: tuple[Array, Array],
    samples: Samples,
    scene: str,
) -> list[Case]:
    """Return a case for each number of samples."""
    reference, variance = truth
    if reference.shape != samples.shape[:3]:
        message = (
            f"the reference of {scene} has shape {reference.shape}, its samples {samples.shape[:3]}"
        )
        raise InputError(message)
    known = np.asarray(np.isfinite(reference + variance).all(axis=-1))
    if not known.any():
        message = f"the reference of {scene} has no pixel with two good samples"
        raise InputError(message)
    mean = abs(float(reference[known].mean()))
    weight = 1 / relative_scale(reference, mean)
    blocks, cases = Blocks.grid(*known.shape)[known.ravel()], []
    for n in numbers:
        few = samples.first(n)
        found: dict[str, tuple[Array, float]] = {}
        for name, entry in entries.items():
            if takes(entry, n):
                start = time.perf_counter()
                image = estimate_by(entry, few.read(), features=few.features)
                found[name] = image, time.perf_counter() - start
        for name, of_scene in images.items():
            if scene in of_scene:
                found[name] = _finished(of_scene[scene], n, len(numbers), reference.shape), np.nan
        errors, bias, fireflies = {}, {}, {}
        for name, (image, _) in found.items():
            image = np.where(np.isfinite(image), image, 0).astype(np.float64)
            apart = image - reference
            squared = np.square(apart) - variance
            relative = 2 * np.abs(apart) / (np.abs(image) + np.abs(reference) + 0.01 * mean)
            each = [x.mean(axis=2) for x in (squared, squared * weight, relative)]
            if "flip" in ERRORS:
                shown = (np.where(known[..., np.newaxis], x, 0) for x in (image, reference))
                each.append(flip(*shown))
            errors[name] = blocks.sums(np.stack(each, axis=-1)[known])
            bias[name] = float(apart[known].mean() / mean)
            fireflies[name] = float((apart * np.sqrt(weight) > _FIREFLY)[known].mean())
        cases.append(
            Case(
                scene,
                n,
                blocks,
                errors,
                bias,
                fireflies,
                {name: seconds for name, (_, seconds) in found.items()},
                float(few.attrs.get("render_seconds") or np.nan),
                _middles(found, reference) if n == numbers[0] else {},
            )
        )
    return cases


def _middles(found: Mapping[str, tuple[Array, float]], reference: Array) -> dict[str, Array]:
    """Return the parts of the estimates and of the reference that `Case.images` keeps."""
    starts = [max(0, edge - _CROP) // 2 for edge in reference.shape[:2]]
    middle = tuple(slice(start, start + _CROP) for start in starts)
    images = {name: image for name, (image, _) in found.items()} | {"reference": reference}
    return {name: image[middle].astype(np.float32) for name, image in images.items()}


def _finished(given: Any, n: int, numbers: int, shape: tuple[int, ...]) -> Array:
    if not isinstance(given, Mapping):
        if numbers > 1:
            message = "of several spp, give the finished images of each: {spp: path}"
            raise InputError(message)
        given = {n: given}
    if n not in given:
        message = f"a finished image of {n} spp is missing, there are {sorted(given)}"
        raise InputError(message)
    image = read_exr(given[n]).image
    if image.shape != shape:
        message = f"{given[n]} has shape {image.shape}, its scene {shape}"
        raise InputError(message)
    return image
