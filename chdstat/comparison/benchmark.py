"""Benchmark: estimators on several scenes and numbers of samples, against converged references.

`bench` answers what a paper on a new estimator has to: is it better than the others, on every
scene, at every number of samples, and at equal time? `compare` asks more of one image, and needs no
reference beside its samples.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from chdstat._core.arrays import Array, Seed, seed_number, whole
from chdstat._core.files import replacing
from chdstat._core.resampling import Blocks
from chdstat._core.work import track
from chdstat.comparison.candidates import Entry, choose, estimate_by, takes, without_denoiser
from chdstat.comparison.cases import MEASURES, Bench, Case, flip
from chdstat.errors import InputError
from chdstat.estimators.registry import LearnedEstimator
from chdstat.io import read_exr
from chdstat.rendering import render, render_batches
from chdstat.samples import Samples, is_store
from chdstat.samples import open as open_samples
from chdstat.summary import summarize

__all__ = ["bench"]

Scenes = Sequence[str | Path | Samples] | Mapping[str, Any]
Images = Mapping[str, Mapping[str, Any]]

_SIZE = (128, 128)
_REFERENCE_SPP = 2048
_BATCH = 64
_APART = 2**30
"""Added to the seed of a reference, so that it shares no random number with what it judges."""
_FIREFLY = 3.0
_CROP = 128
"""Largest edge in pixels of the images that are kept to be shown."""
_SMALL = 16
"""Edge in pixels of what is estimated before time is taken."""


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
    r"""Measure estimators on several scenes, against references of other samples.

    With p an estimate, y its reference of variance v, and m the mean reference of the scene:
    ``mse`` is :math:`\overline{(p - y)^2 - v}`, ``relmse``
    :math:`\overline{((p - y)^2 - v) / (y^2 + 0.01\, m^2)}`, without the noise of the reference, and
    ``smape`` :math:`\overline{2 |p - y| / (|p| + |y| + 0.01\, m)}`, with it. Where
    ``flip-evaluator`` is installed (``pip install chdstat[flip]``), ``flip`` is what an observer
    sees of the differences (Andersson et al. 2021, doi:10.2312/egs.20211015).

    Parameters
    ----------
    scenes
        Names, XML files, stores or `Samples`; a mapping gives them names of your own. Scenes are
        rendered, of samples the first are taken.
    estimators
        As for `chdstat.compare`; None takes those of `chdstat.comparison.DEFAULT_ESTIMATORS` that
        train nothing, and says which were left out. One that trains against a reference has no
        place here: make an `Estimator` of what it has learned. One that takes more samples than a
        number of `spp` has no row there.
    spp
        Numbers of samples that are estimated from.
    seeds
        Renders of each scene, over which errors are averaged.
    seed
        Of the first of them.
    size
        (width, height) of rendered scenes; None takes 128 x 128.
    references
        By scene: a converged image as an EXR file or an array (y, x, channel), or more samples as
        `Samples` or a store. The noise of an image is unknown, and part of the errors. Without one,
        scenes are rendered with another seed, and of samples those that are left over are taken.
    reference_spp
        Samples of a rendered reference.
    images
        Finished images of any other program, by name and scene, each the path of an EXR file; with
        several `spp`, a mapping from these to paths.
    baseline
        What errors are divided by; None takes the sample mean, or the first where it is missing.
    folder
        Where rendered samples and references are kept, so that a second run has them; None keeps
        nothing.
    progress
        Show a progress bar; None shows it on a terminal.

    Returns
    -------
    Bench

    Raises
    ------
    InputError
        If a name or a number is wrong, an image has another size than its scene, an estimator
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
    names = _order(list(chosen.entries), images)
    baseline = baseline or ("mean" if "mean" in names else names[0])
    if baseline not in names:
        message = f"baseline must be one of {', '.join(names)}; got {baseline!r}"
        raise InputError(message)
    if baseline in chosen.entries and not takes(chosen.entries[baseline], numbers[0]):
        message = f"the baseline, {baseline}, takes more than {numbers[0]} samples; give more spp"
        raise InputError(message)
    named = scenes if isinstance(scenes, Mapping) else {_name(scene): scene for scene in scenes}
    source = _Inputs(numbers, seed_number(seed), seeds, size or _SIZE, reference_spp, folder)
    cases: list[Case] = []
    with track("benchmark", len(named) * seeds, unit="render", show=progress) as advance:
        for name, scene in named.items():
            parts: list[list[Case]] = []
            truth = source.reference(name, scene, (references or {}).get(name))
            measure = partial(_measured, chosen.entries, images or {}, numbers, truth)
            for i in range(seeds):
                samples = source.samples(name, scene, i)
                if not (cases or parts):  # networks are loaded before time is taken
                    small = samples.isel(y=slice(_SMALL), x=slice(_SMALL))
                    for entry in chosen.entries.values():
                        estimate_by(entry, small.read(), features=small.features)
                parts.append(measure(samples, name))
                advance(1)
            cases += [Case.average([part[k] for part in parts]) for k in range(len(numbers))]
    return Bench(tuple(names), baseline, tuple(cases), chosen.left_out)


def _order(names: list[str], images: Images | None) -> list[str]:
    found = [*names, *(images or {})]
    if len(set(found)) < len(found):
        message = f"estimators and images must have different names, got {found}"
        raise InputError(message)
    return found


def _name(scene: Any) -> str:
    if isinstance(scene, Samples):
        return scene.name
    path = Path(str(scene))
    return path.parent.name if path.stem == "scene" else path.stem


@dataclass(frozen=True)
class _Inputs:
    """Where samples and references come from."""

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
        """Return a reference (y, x, channel) and its variance, 0 where that is unknown."""
        more = _held(given)
        if more is not None:
            return _mean(more)
        if given is not None:
            named = isinstance(given, str | Path)
            image = np.asarray(read_exr(given).image if named else given, np.float64)
            return image, np.zeros_like(image)
        held = _held(scene)
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
            # Another scene of this name, or other settings, have another file.
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
            with replacing(kept) as partial, partial.open("wb") as stream:
                np.savez(stream, image=image, variance=variance)
        return image, variance


def _held(given: Any) -> Samples | None:
    """Return samples that are there, be they given or in a store."""
    if isinstance(given, Samples):
        return given
    return open_samples(given) if is_store(given) else None


def _mean(samples: Samples) -> tuple[Array, Array]:
    found = summarize(samples, progress=False)
    return found["mean"].values, found["variance"].values / samples.spp


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
    mean = abs(float(reference.mean()))
    weight = 1 / (np.square(reference) + 0.01 * mean**2)
    blocks, cases = Blocks.grid(*reference.shape[:2]), []
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
            apart = np.nan_to_num(image.astype(np.float64)) - reference
            squared = np.square(apart) - variance
            relative = 2 * np.abs(apart) / (np.abs(image) + np.abs(reference) + 0.01 * mean)
            each = [x.mean(axis=2) for x in (squared, squared * weight, relative)]
            if "flip" in MEASURES:
                each.append(flip(image, reference))
            errors[name] = blocks.sums(np.stack(each, axis=-1).reshape(-1, len(MEASURES)))
            bias[name] = float(apart.mean() / mean)
            fireflies[name] = float((apart * np.sqrt(weight) > _FIREFLY).mean())
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
    """Return what `Case.images` keeps of the estimates, and of the reference."""
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
