"""Benchmark: estimators on several scenes and numbers of samples, against converged references.

`bench` answers the questions of a paper on a new estimator: is it better than the others, on every
scene, at every number of samples, and at equal time? Its `Bench` holds a `Case` for each scene and
number of samples, measured as `compare` does. `compare` measures one image, and needs no reference
besides its samples.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from chdstat._core.arrays import Array, Seed, plain, seed_number, whole
from chdstat._core.display import Card, Tabled, number, percent
from chdstat._core.files import replacing
from chdstat._core.progress import portion, track
from chdstat._core.resampling import Blocks, Interval, interval_of
from chdstat.comparison.estimator_choice import (
    Entry,
    choose,
    estimate_by,
    notes,
    takes,
    without_denoiser,
)
from chdstat.comparison.finished_images import Truth
from chdstat.comparison.judges import PARTS, PartialSums
from chdstat.comparison.metrics import (
    HAS_FLIP,
    SUMS,
    columns_of,
    errors_of,
    exposures,
    flip,
    legend,
    measures_of,
    moved,
    ranked,
    shown_ratio,
)
from chdstat.errors import InputError, check_option
from chdstat.estimators.registry import LearnedEstimator, title_of
from chdstat.io import read_exr
from chdstat.rendering import render, render_batches
from chdstat.samples import Samples, is_store
from chdstat.samples import open as open_samples
from chdstat.scenes.scene import scene_name

if TYPE_CHECKING:
    import pandas as pd

Scenes = str | Path | Samples | Sequence[str | Path | Samples] | Mapping[str, Any]
Images = Mapping[str, Mapping[str, Any]]

_NAMES = {"mse": "MSE", "relmse": "relMSE", "flip": "FLIP"}
_ERRORS = tuple(name for name in _NAMES if name != "flip" or HAS_FLIP)
"""Errors that are divided by those of the baseline; FLIP where its package is installed."""
_LEAST = 1e-3
"""Least ratio of errors, and one over the largest: without the noise of the reference, the error of
a replicate may be 0 or less."""
_SIZE = (128, 128)
_REFERENCE_SPP = 2048
_BATCH = 64
_APART = 2**30
"""Added to the seed of a reference, so that it shares no random number with the samples."""
_SMALL = 16
"""Edge, in pixels, of the image that is estimated before time is measured."""


def _numbers(name: str, found: Interval[float]) -> dict[str, float]:
    return {name: found.value, f"{name}_low": found.low, f"{name}_high": found.high}


@dataclass(frozen=True)
class Case:
    """One scene at one number of samples.

    Attributes
    ----------
    scene, spp
        Name of the scene, and number of samples.
    estimators
        Names of the estimators that take so many samples.
    blocks
        Blocks of its pixels.
    sums
        Sums of `chdstat.comparison.metrics.SUMS` over each block, shape (block, sum, estimator,
        channel).
    flips
        Sums of FLIP over each block, against the reference and against each half of its samples,
        shape (block, 3, estimator); NaN without `flip-evaluator`.
    exposures
        Least and largest exposure of FLIP, in stops.
    seconds
        Time of each estimate, shape (estimator,); NaN for finished images.
    render_seconds
        Time to render the samples; NaN if unknown.
    """

    scene: str
    spp: int
    estimators: tuple[str, ...]
    blocks: Blocks
    sums: Array
    flips: Array
    exposures: tuple[float, float]
    seconds: Array
    render_seconds: float

    @staticmethod
    def average(cases: Sequence[Case]) -> Case:
        """Average the cases of several renders of a scene."""
        averaged: dict[str, Any] = {
            name: np.mean([getattr(case, name) for case in cases], axis=0)
            for name in ("sums", "flips", "seconds", "render_seconds")
        }
        return replace(cases[0], **averaged)

    def ratios(self, name: str, baseline: str, measure: str, weights: Array) -> Array:
        """Return the ratio of the errors of two estimators, for weighted blocks."""
        one, other = (weights @ self._errors(n, measure) for n in (name, baseline))
        # Where neither is above 0, nothing is known.
        ratio = np.maximum(one, _LEAST * other) / np.maximum(other, _LEAST * one)
        return np.where(np.maximum(one, other) > 0, ratio, np.nan)

    def _errors(self, name: str, measure: str) -> Array:
        """Return the sums of an error over each block, shape (block,)."""
        k = self.estimators.index(name)
        if measure == "flip":
            return np.asarray(self.flips[:, 0, k])
        column = {"mse": "squared", "relmse": "relative"}[measure]
        return np.asarray(self.sums[:, SUMS.index(column), k].mean(axis=-1))

    def measures(self, baseline: str) -> dict[str, dict[str, float]]:
        """Return all measures by estimator, with their intervals, as columns of a table.

        Those of `chdstat.compare`, with the baseline in place of the sample mean, and FLIP.
        """
        base = self.estimators.index(baseline)
        sums = np.concatenate([self.sums[:, :, [base]], self.sums], axis=2)
        found = {n: of[:, -1] for n, of in measures_of(sums, seed=0).items()}
        return {
            name: {column: float(values[k]) for column, (values, _) in columns_of(found).items()}
            | (self._flip(name, baseline) if HAS_FLIP else {})
            for k, name in enumerate(self.estimators)
        }

    def _flip(self, name: str, baseline: str) -> dict[str, float]:
        """Return FLIP and its ratio to that of the baseline; NaN if the reference decides it."""
        own, others = (
            self.flips[:, :, self.estimators.index(n)].sum(axis=0) for n in (name, baseline)
        )
        found = Interval.unknown()
        with np.errstate(divide="ignore", invalid="ignore"):
            if not moved(own[1:] / others[1:], own[0] / others[0]).any():
                ratios = partial(self.ratios, name, baseline, "flip")
                found = interval_of(ratios, self.blocks, bounds=(0, np.inf))
        return {"flip": float(own[0]) / len(self.blocks.of_pixel)} | _numbers("flip_ratio", found)


@dataclass(frozen=True, repr=False)
class Bench(Tabled):
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

        A row has the measures of `chdstat.compare` with 95 % intervals over blocks of pixels, with
        the baseline in place of the sample mean; FLIP and its ratio; ``mse_equal_time``, the ratio
        of the MSE times the time to render and estimate over the time to render; and seconds. What
        the reference cannot tell is NaN.
        """
        return [row for rows in self._rows for row in rows.values()]

    def to_dataframe(self) -> pd.DataFrame:
        """Return what one reads as a `pandas.DataFrame`: of each scene, the smallest error first.

        ``estimator`` is the title of each, and ``name`` what one types; `table` has every measure.
        """
        return super().to_dataframe()

    def _shown_rows(self) -> list[dict[str, Any]]:
        return ranked(self.table())

    @cached_property
    def _rows(self) -> list[dict[str, dict[str, Any]]]:
        """Rows of every case, by estimator."""
        found = []
        for case in self.cases:
            measures, rows = case.measures(self.baseline), {}
            for name, seconds in zip(case.estimators, case.seconds.tolist(), strict=True):
                row: dict[str, Any] = {"scene": case.scene, "spp": case.spp, "estimator": name}
                # The error of a mean is inversely proportional to the time.
                equal_time = measures[name]["mse_ratio"] * (1 + seconds / case.render_seconds)
                own = {"mse_equal_time": equal_time, "seconds": seconds}
                rows[name] = row | measures[name] | own
            found.append(rows)
        return found

    @cached_property
    def _regions(self) -> tuple[Blocks, dict[str, slice]]:
        """Blocks of all scenes, and the slice of each scene, whose cases share its blocks."""
        first = {case.scene: case.blocks for case in self.cases}
        ends = np.cumsum([0, *map(len, first.values())])
        places = {name: slice(ends[i], ends[i + 1]) for i, name in enumerate(first)}
        return Blocks.join(list(first.values())), places

    def _average(
        self,
        cases: Sequence[Case],
        of_case: Callable[[Case, Array], Array],
        bounds: tuple[float, float],
        change: Callable[[Array], Array] = np.asarray,
    ) -> Interval[float]:
        """Average a statistic of weighted blocks over cases."""
        if not cases:
            return Interval.unknown()
        blocks, places = self._regions

        def statistic(weights: Array) -> Array:
            found = [of_case(case, weights[:, places[case.scene]]) for case in cases]
            return change(np.mean(found, axis=0))

        return interval_of(statistic, blocks, bounds=bounds)

    def told(self, name: str, measure: str) -> list[Case]:
        """Return the cases in which the ratio of an error to the baseline's is known."""
        ratio = f"{measure}_ratio"
        pairs = zip(self.cases, self._rows, strict=True)
        return [case for case, rows in pairs if name in rows and np.isfinite(rows[name][ratio])]

    def geometric_mean(self, name: str, measure: str = "mse") -> Interval[float]:
        """Return the geometric mean of the ratios of an error to the baseline's.

        It is over the cases in which the ratio is known. The 95 % interval is over blocks of pixels
        of these scenes; other scenes may differ by more.
        """

        def logarithm(case: Case, weights: Array) -> Array:
            return np.log(case.ratios(name, self.baseline, measure, weights))

        return self._average(self.told(name, measure), logarithm, (0, np.inf), np.exp)

    def rank(self, name: str, measure: str = "mse") -> Interval[float]:
        """Return the average rank among the estimators over all cases, 1 for the least error."""

        def rank(case: Case, weights: Array) -> Array:
            own = weights @ case._errors(name, measure)
            others = [weights @ case._errors(n, measure) for n in case.estimators if n != name]
            return sum((own > other for other in others), np.ones(len(weights)))

        return self._average(self.told(name, measure), rank, (1, len(self.estimators)))

    def summary(self) -> list[dict[str, Any]]:
        """Return a row for each estimator, over all cases.

        A row has the geometric means of the ratios of errors and the average rank by MSE, each with
        its 95 % interval; ``worst``, the largest ratio of the MSE in any case; ``bias``, the
        largest absolute bias in any case, with its sign; ``fireflies``, the average share; the
        number of ``cases``; and, of these, the numbers in which the reference can tell the ratio,
        ``mse_cases`` and so on.
        """
        table = []
        for name in self.estimators:
            intervals = {measure: self.geometric_mean(name, measure) for measure in _ERRORS}
            intervals["rank"] = self.rank(name)
            rows = [of_case[name] for of_case in self._rows if name in of_case]
            row: dict[str, Any] = {"estimator": name}
            for what, found in intervals.items():
                row |= _numbers(what, found)
            known = [r["mse_ratio"] for r in rows if np.isfinite(r["mse_ratio"])]
            row["worst"] = max(known, default=np.nan)
            row["bias"] = max((r["bias"] for r in rows), key=abs)
            row["fireflies"] = float(np.mean([r["fireflies"] for r in rows]))
            row["cases"] = len(rows)
            table.append(row | {f"{m}_cases": len(self.told(name, m)) for m in _ERRORS})
        return table

    @property
    def notes(self) -> dict[str, str]:
        """Notes for a reader of the table, as in a `Comparison`; what cannot be told; exposures."""
        own = {
            name: sum(name in case.estimators for case in self.cases) for name in self.estimators
        }
        every = len(self.cases)
        absent = {name: f"in {every - n} of {every} cases" for name, n in own.items() if n < every}
        found = notes(self.estimators, left_out={**self.left_out, **absent})
        untold = {
            _NAMES[m]: max(own[n] - len(self.told(n, m)) for n in self.estimators) for m in _ERRORS
        }
        if lost := [f"{name} in {n} of {every} cases" for name, n in untold.items() if n]:
            found["the reference cannot tell"] = ", ".join(lost)
        if HAS_FLIP:
            stops = {case.scene: case.exposures for case in self.cases}
            each = (f"{scene} {a:.1f} to {b:.1f}" for scene, (a, b) in stops.items())
            found["exposures of FLIP"] = f"{', '.join(each)} stops"
        return found

    def _card(self) -> Card:
        scenes, spp = {c.scene: None for c in self.cases}, {c.spp: None for c in self.cases}
        facts = {"scenes": ", ".join(scenes), "spp": ", ".join(map(str, spp))}
        cells = (text for row in self.shown() for text in row.values())
        facts |= self.notes | legend(cells, self.baseline)
        if not HAS_FLIP:
            facts["FLIP"] = "not measured; pip install 'chdstat[flip]' adds it"
        of = title_of(self.baseline)
        return Card(f"Benchmark: errors over those of {of}", facts, self.shown())

    def shown(self) -> list[dict[str, str]]:
        """Return the summary as text under titles, with 95 % intervals of the ratios."""
        return [
            {
                "estimator": title_of(row["estimator"]),
                **{_NAMES[measure]: shown_ratio(row, measure) for measure in _ERRORS},
                "bias": percent(row["bias"], sign=True),
                "fireflies": percent(row["fireflies"]),
                "rank": f"{row['rank']:.1f}",
                "worst": number(row["worst"]),
            }
            for row in self.summary()
        ]

    def to_dict(self) -> dict[str, Any]:
        """Return everything as plain values."""
        found: dict[str, Any] = plain({"summary": self.summary(), "cases": self.table()})
        return {"baseline": self.baseline} | found


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
    progress: bool = True,
) -> Bench:
    """Measure estimators on several scenes, against references from other samples.

    The measures are those of `chdstat.compare`, without the noise of the reference. If
    ``flip-evaluator`` is installed (``pip install chdstat[flip]``), ``flip`` measures how visible
    the differences are (Andersson et al. 2021, doi:10.2312/egs.20211015), at exposures that follow
    from the lit part of the reference and stand in the notes. It is not known where references of
    half of the samples give another ratio. Pixels without a reference do not count; where an
    estimate is no number, it counts as black.

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
        Show progress: a bar in a terminal or notebook, elsewhere a line every ten seconds.

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
                with portion(1, advance):
                    samples = source.samples(name, scene, i)
                    if not (cases or parts):  # networks are loaded before time is measured
                        small = samples.isel(y=slice(_SMALL), x=slice(_SMALL))
                        for entry in chosen.entries.values():
                            _estimated(entry, small)
                    inputs = images or {}, numbers, truth, samples, name, baseline
                    parts.append(_measured(chosen.entries, *inputs))
            cases += [Case.average([part[k] for part in parts]) for k in range(len(numbers))]
    return Bench(tuple(names), baseline, tuple(cases), chosen.left_out)


def _estimated(entry: Entry, samples: Samples) -> Array:
    """Return the image that an estimator makes of samples and what is known beside them."""
    return estimate_by(entry, samples.read(), features=samples.features, film=samples.film)


def _name(scene: Any) -> str:
    if isinstance(scene, Samples):
        return scene.name
    return scene_name(Path(str(scene)))


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
        found = render(scene, spp=self.numbers[-1], size=self.size, seed=self.seed + i, out=out)
        return found.first(self.numbers[-1])

    def reference(self, name: str, scene: Any, given: Any) -> Truth:
        """Return the reference of a scene."""
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
            return _truth(name, more.isel(sample=slice(first, None)))
        if given is not None:
            named = isinstance(given, str | Path)
            image = np.asarray(read_exr(given).image if named else given, np.float64)
            return Truth.of_parts(np.stack([image] * PARTS))
        if held is not None:
            if held.spp < 2 * self.numbers[-1]:
                message = (
                    f"{name} has {held.spp} samples per pixel, too few for a reference of those "
                    f"after the first {self.numbers[-1]}; give one: references="
                )
                raise InputError(message)
            return _truth(name, held.isel(sample=slice(self.numbers[-1], None)))
        batches = render_batches(
            scene,
            spp=self.reference_spp,
            batch=min(_BATCH, max(1, self.reference_spp // PARTS)),
            size=self.size,
            seed=self.seed + _APART,
        )
        kept = None
        if self.folder is not None:
            # Another scene of this name, or other settings, gets another file.
            about = [batches.attrs[k] for k in ("scene_hash", "scene_code", "size", "spp", "seed")]
            digest = hashlib.sha256(repr(about).encode()).hexdigest()[:8]
            kept = Path(self.folder) / f"{name}-reference-{digest}.npz"
        if kept is not None and kept.exists():
            return Truth.of_parts(np.load(kept)["parts"])
        means = np.stack([batch.mean(axis=-1, dtype=np.float64) for batch in batches])
        if len(means) < PARTS:
            message = f"a reference needs at least {PARTS} samples per pixel, got {len(means)}"
            raise InputError(message)
        parts = np.stack([means[k::PARTS].mean(axis=0) for k in range(PARTS)])
        if kept is not None:
            kept.parent.mkdir(parents=True, exist_ok=True)
            with replacing(kept) as file, file.open("wb") as stream:
                np.savez(stream, parts=parts)
        return Truth.of_parts(parts)


def _held(given: Any) -> Samples | None:
    """Return existing samples, given directly or as a store."""
    if isinstance(given, Samples):
        return given
    return open_samples(given) if is_store(given) else None


def _truth(name: str, samples: Samples) -> Truth:
    return Truth.of(name, PartialSums.of(samples))


def _measured(
    entries: Mapping[str, Entry],
    images: Images,
    numbers: Sequence[int],
    truth: Truth,
    samples: Samples,
    scene: str,
    baseline: str,
) -> list[Case]:
    """Return a case for each number of samples."""
    reference = truth.judge
    shape = reference.mean.shape
    if shape != samples.shape[:3]:
        message = f"the reference of {scene} has shape {shape}, its samples {samples.shape[:3]}"
        raise InputError(message)
    known = np.asarray(np.isfinite(reference.mean).all(axis=-1))
    if not known.any():
        message = f"the reference of {scene} has no pixel that is a number"
        raise InputError(message)
    at = reference[known]
    scene_mean = at.mean.mean(axis=0)
    blocks, cases = Blocks.grid(*known.shape)[known.ravel()], []
    shown_truths = [np.nan_to_num(image) for image in (reference.mean, *truth.halves)]
    stops = exposures(shown_truths[0])
    for n in numbers:
        few = samples.first(n)
        found: dict[str, tuple[Array, float]] = {}
        for name, entry in entries.items():
            if takes(entry, n):
                start = time.perf_counter()
                with portion(1 / (len(entries) * len(numbers) + 1)):  # and a part to render
                    image = _estimated(entry, few)
                found[name] = image, time.perf_counter() - start
        for name, of_scene in images.items():
            if scene in of_scene:
                found[name] = _finished(of_scene[scene], n, len(numbers), shape), np.nan
        shown = {
            name: np.where(known[..., np.newaxis] & np.isfinite(image), image, 0).astype(np.float64)
            for name, (image, _) in found.items()
        }
        base = shown[baseline][known]
        sums = [
            blocks.sums(errors_of(image[known], base, at, scene_mean=scene_mean))
            for image in shown.values()
        ]
        flips = [np.full((len(blocks), len(shown_truths)), np.nan) for _ in shown]
        if HAS_FLIP:
            each = ([flip(image, y, stops=stops) for y in shown_truths] for image in shown.values())
            flips = [blocks.sums(np.stack(of, axis=-1)[known]) for of in each]
        case = Case(
            scene,
            n,
            estimators=tuple(found),
            blocks=blocks,
            sums=np.stack(sums, axis=2),
            flips=np.stack(flips, axis=2),
            exposures=stops,
            seconds=np.array([taken for _, taken in found.values()]),
            render_seconds=float(few.attrs.get("render_seconds") or np.nan),
        )
        cases.append(case)
    return cases


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
