"""Figures of one scene, for its report and in a study, and an estimate without a reference.

`scene_figures` follows the case study of Elek et al. 2019: regions with their CHDs, batches and
their means, the brightest firefly, shorter paths, shapes. In practice there is no reference image:
`SelfTraining.of` trains on the first samples of a scene alone, and measures the errors of the
estimate, its certainty and its intervals against all other samples.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, Self

import numpy as np
import numpy.typing as npt

from chdstat import viz
from chdstat._core.arrays import is_bad, luminance
from chdstat._core.image_scales import display_stops
from chdstat.comparison import Comparison, compare
from chdstat.estimators import Estimator, Progressive
from chdstat.estimators.progressive import Estimates
from chdstat.patterns import Atlas
from chdstat.rendering.recipes import Region
from chdstat.reporting.figures import marks_of, panel_of
from chdstat.reporting.typst import number, percent
from chdstat.samples import Samples
from chdstat.studies.claims import SceneData
from chdstat.studies.claims.fireflies import BRIGHTER
from chdstat.summary.histograms import histogram

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.figure import Figure

__all__ = ["LEVELS", "SelfTraining", "panels_of", "scene_figures"]

LEVELS = (0.5, 0.8, 0.9, 0.95)
"""Probabilities that intervals state."""
_SPP = 64
"""Samples that are improved without a reference."""


@dataclass(frozen=True)
class SelfTraining:
    """An estimate without a reference, and how it was comparison.

    Attributes
    ----------
    comparison
        Of the mean and the estimate from the same samples.
    estimates
        The estimate of the whole image, with its certainty and the interval of 90 %.
    coverage
        Share of the intervals that hold the reference, at `LEVELS`, by what estimated.
    iterations
        Minibatches of the training.
    """

    comparison: Comparison
    estimates: Estimates
    coverage: Mapping[str, tuple[float, ...]]
    iterations: int

    @classmethod
    def of(
        cls,
        samples: Samples,
        comparison: Comparison,
        *,
        iterations: int | None,
        progress: bool | None,
    ) -> Self | None:
        """Train on the first samples; None where they are too few, or nobody compared ours.

        Parameters
        ----------
        samples, comparison
            The scene, and how estimators compare on it.
        iterations
            Minibatches of the training; None takes the estimator's own number.
        progress
            As for `chdstat.compare`.
        """
        supervised = comparison.models.get("progressive")
        if not isinstance(supervised, Progressive) or samples.spp < 2 * _SPP:
            return None
        features = samples.features
        few = samples.read(ss=slice(0, _SPP))
        model = Progressive(inputs=["features", "neighbours"] if features else ["neighbours"])
        model.train(
            Samples.from_array(few, features=features, axes="yxcs"),
            reference=False,
            iterations=iterations,
            progress=progress,
        )
        ours = Estimator(
            "self_trained",
            partial(model.predict, trust=1.0),
            "this library",
            joint_channels=True,
            uses_neighbours=True,
            uses_features=True,
        )
        found = compare(samples, ["mean", ours], n=_SPP, max_batches=1, progress=progress)
        first = samples.read(ss=slice(0, comparison.n))
        by_level = {
            level: model.estimate(few, features=features, level=level, trust=1.0)
            for level in LEVELS
        }
        return cls(
            comparison=found,
            estimates=by_level[0.9],
            coverage={
                f"{_SPP} spp, without a reference": coverage(by_level.__getitem__, found),
                f"{comparison.n} spp, with one": coverage(
                    lambda level: supervised.estimate(first, level=level, trust=1.0), comparison
                ),
            },
            iterations=int(model.history.iteration[-1]),
        )

    def content(self) -> dict[str, Any]:
        """Return its numbers, ready for JSON."""
        _, row = self.comparison.table()
        shares = [percent(measured[LEVELS.index(0.9)]) for measured in self.coverage.values()]
        return {
            "n": self.comparison.n,
            "iterations": self.iterations,
            "mse_ratio": number(row["mse_ratio"]),
            "relmse_ratio": number(row["relmse_ratio"]),
            "improved": percent(row["improved"]),
            "bias": percent(row["bias"], sign=True),
            "at_90": shares[0],
            "at_90_supervised": shares[1],
        }

    def figure(self) -> Figure:
        """Draw mean, estimate and reference; certainty, width and coverage of the intervals."""
        found = self.estimates
        with np.errstate(divide="ignore", invalid="ignore"):
            width = np.abs(found.high - found.low).mean(axis=-1) / found.radiance.mean(axis=-1)
        width[~np.isfinite(width)] = np.nan
        mean, ours = self.comparison.estimates
        exposure = display_stops(self.comparison.reference)
        images = {
            f"Mean of {self.comparison.n} samples": mean,
            "Self-trained": ours,
            "Reference": self.comparison.reference,
        }
        height, size = found.certainty.shape
        return viz.map_grid(
            [
                *(viz.image_map(x, title=t, exposure=exposure) for t, x in images.items()),
                viz.value_map(found.certainty, title="Certainty", limits=(0, 1)),
                viz.value_map(width, title="Width of the interval ÷ estimate", limits=(0, 3)),
                viz.coverage(LEVELS, self.coverage, title="Intervals that hold the reference"),
            ],
            columns=3,
            aspect=height / size,
        )


def coverage(estimate: Callable[[float], Estimates], comparison: Comparison) -> tuple[float, ...]:
    """Return how often the reference lies in an interval of each level, over the test pixels."""
    usable = comparison.test_pixels & np.isfinite(comparison.first_reference).all(axis=-1)
    reference = comparison.first_reference[usable].astype(np.float32)
    found = [estimate(level) for level in LEVELS]
    return tuple(
        float(((x.low[usable] <= reference) & (reference <= x.high[usable])).mean()) for x in found
    )


Floats = npt.NDArray[np.float64]

_BATCH, _BATCHES = 32, 64
"""As in the first figure of Elek et al. 2019."""
_PIXELS = 5
_BINS = 40
_USUAL = 3
"""Batches that tell what is usual for a pixel."""
_SIMILAR = 1.5
"""Ratio up to which two pixels are about the same."""
_DECADES = np.linspace(-5, 5, 101)


def panels_of(evidence: SceneData) -> list[viz.Panel]:
    """Return the CHD of the pixel in the middle of each region."""
    return [panel_of(evidence.samples, mark) for mark in _marks(evidence)]


def scene_figures(
    evidence: SceneData, panels: Sequence[viz.Panel], *, atlas: Atlas | None = None
) -> dict[str, Figure]:
    """Draw the study figures of a scene, by name; what it has not is left out.

    Parameters
    ----------
    evidence
        The scene.
    panels
        `panels_of` it.
    atlas
        Shapes that recur.
    """
    marks = _marks(evidence)
    drawn: dict[str, Figure] = {}
    if marks:
        drawn["regions"] = viz.region_study(
            evidence.summary["mean"].values,
            marks,
            panels,
            notes=[_note(region, evidence.summary) for region in evidence.regions],
        )
    drawn["batches"] = _batches(evidence.samples, marks[:_PIXELS])
    firefly = _firefly(evidence)
    if firefly is not None:
        drawn["firefly"] = firefly
    if evidence.shorter is not None:
        drawn["paths"] = _paths(evidence)
    if atlas is not None:
        drawn["atlas"] = viz.atlas(atlas)
    return drawn


def _marks(evidence: SceneData) -> list[viz.Mark]:
    return marks_of(evidence.regions, evidence.samples)


def _note(region: Region, summary: xr.Dataset) -> str:
    null = summary["null_share"].values
    here = float(null[region.pixels(*null.shape)].mean())
    kind = region.phenomenon.replace("-", " ")
    return f"{kind}, {percent(here)} null" if kind != region.name else f"{percent(here)} null"


def _batches(samples: Samples, marks: Sequence[viz.Mark]) -> Figure:
    height, width = samples.shape[:2]
    middle = viz.Mark("middle of the image", slice(0), slice(0), (height // 2, width // 2))
    panels = [_batch_panel(samples, mark) for mark in (marks or [middle])]
    size, number_ = _batch_shape(samples)
    return viz.batch_histograms(panels, number=number_, size=size)


def _batch_shape(samples: Samples) -> tuple[int, int]:
    """Return size and number of batches: 64 of 32 samples, or as many as there are."""
    size = min(_BATCH, samples.spp)
    return size, min(_BATCHES, samples.spp // size)


def _batch_panel(samples: Samples, mark: viz.Mark) -> viz.BatchPanel:
    """Count the luminance of each batch of a pixel, and of their means."""
    x = samples[mark.pixel].astype(np.float64)
    light = np.where(is_bad(x).any(axis=0), 0.0, np.asarray(luminance(np.where(is_bad(x), 0, x))))
    size, count = _batch_shape(samples)
    rows = light[: size * count].reshape(count, size)
    means = rows.mean(axis=1)
    # A firefly must not squeeze all others into the first bin; the axis says where it ends.
    top = float(np.quantile(rows, 0.99)) or float(rows.max()) or 1.0
    edges = np.linspace(0, max(top, 1.5 * float(light.mean())), _BINS + 1)
    counts = np.stack([np.histogram(row, edges)[0] for row in rows])
    low, high = float(means.min()), float(means.max())
    mean_edges = np.linspace(low, high if high > low else low + 1, _BINS // 2 + 1)
    mean_counts = np.histogram(means, mean_edges)[0]
    return viz.BatchPanel(mark.name, edges, counts, mean_edges, mean_counts, float(light.mean()))


def _firefly(evidence: SceneData) -> Figure | None:
    """Draw the brightest firefly and the pixel above it, which sees about the same."""
    summary, samples = evidence.summary, evidence.samples
    batches = np.asarray(luminance(summary["batch_means"].values.astype(np.float64)))
    found = _brightest(batches)
    if found is None:
        return None
    y, x, batch = found
    pixels = {"firefly": (y, x), "neighbour": (y - 1, x)}
    x_of = {name: samples[pixel] for name, pixel in pixels.items()}
    channel = x_of["firefly"].shape[0] // 2
    linear, log = (
        {n: _curve(v[channel], scale) for n, v in x_of.items()} for scale in ("linear", "log")
    )
    estimate = summary["batch_means"].values[..., batch]
    notes = {n: number(float(batches[pixel][batch])) for n, pixel in pixels.items()}
    return viz.firefly_pair(estimate, pixels, linear, log, notes=notes)


def _brightest(batches: Floats) -> tuple[int, int, int] | None:
    """Return row, column and batch of the brightest firefly; None without any.

    A firefly is an estimate well above what is usual for its pixel and for the pixel above it,
    which are about the same: else it is an edge.
    """
    if batches.shape[0] < 2 or batches.shape[2] < _USUAL or not np.isfinite(batches).all():
        return None
    usual = np.median(batches, axis=-1)
    lower, upper = usual[1:], usual[:-1]
    high, low = np.maximum(lower, upper), np.minimum(lower, upper)
    similar = (low > 0) & (high <= _SIMILAR * low)
    ratio = np.where(similar, batches[1:].max(axis=-1) / np.where(similar, high, 1), 0)
    if ratio.max() < BRIGHTER:
        return None
    y, x = (int(i) for i in np.unravel_index(int(ratio.argmax()), ratio.shape))
    return y + 1, x, int(batches[y + 1, x].argmax())


def _curve(x: npt.NDArray[Any], scale: Any) -> viz.Curve:
    counted = histogram(x, scale=scale)
    return viz.Curve(counted.edges, counted.density)


def _paths(evidence: SceneData) -> Figure:
    long, short = evidence.summary, evidence.shorter_summary
    if short is None or evidence.shorter is None:
        message = "expected a scene with shorter paths"
        raise ValueError(message)
    names = [f"up to {_depth(s)} segments" for s in (evidence.shorter, evidence.samples)]
    images = dict(zip(names, (short["mean"].values, long["mean"].values), strict=True))
    log = {
        region.name: {
            name: _pooled(found, region) for name, found in zip(names, (short, long), strict=True)
        }
        for region in evidence.regions
    }
    return viz.view_pair(images, log)


def _depth(samples: Samples) -> str:
    depth = int(dict(samples.attrs["integrator"]).get("max_depth", -1))
    return "∞" if depth < 0 else str(depth)


def _pooled(found: xr.Dataset, region: Region) -> viz.Curve:
    """Return the density per decade of the positive samples of a region, all channels together."""
    counts = found["log_counts"].values
    here = counts[region.pixels(*counts.shape[:2])].sum(axis=(0, 1, 2), dtype=np.float64)
    width = _DECADES[1] - _DECADES[0]
    with np.errstate(divide="ignore", invalid="ignore"):
        return viz.Curve(10**_DECADES, here / (here.sum() * width))
