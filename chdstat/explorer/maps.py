"""Maps: one number or label per pixel in the place of the image, computed when asked for.

`MAPS` is the table. The cheap ones come with the image (`chdstat.explorer.images`); the others
walk the store tile by tile, show what they have so far, and are kept in the cache.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import is_bad, luminance
from chdstat._core.reasons import Reason
from chdstat.errors import InputError
from chdstat.estimators import registry
from chdstat.explorer.estimators import fixed_names
from chdstat.explorer.images import Overall
from chdstat.explorer.palette import label_colors
from chdstat.explorer.sources import StoreSource
from chdstat.fit.families import FAMILIES, SELECTED
from chdstat.fit.selection import select_part
from chdstat.fit.tail import tail_of_part
from chdstat.inference import MORE_THAN_TESTED, N_MEANS, sizes_of_means
from chdstat.inference.normality_of_means import means_of_block
from chdstat.patterns.classification import (
    Label,
    finish_patterns,
    luminance_part,
    patterns_of_part,
    patterns_variables,
)

__all__ = ["IMAGES", "MAPS", "Map", "MapKind", "map_kind", "of_overall", "walk", "with_sizes"]

_ERROR = "error:"
_BATCH = 32
"""Samples of an estimate, in maps of errors."""
_MOST_BATCHES = 16
_DECADES = 8.0
"""Of a colour bar, at most."""
_OVER_MEAN = "log10, luminance"

Image = npt.NDArray[np.float32]
Step = Callable[[float, Image], None]


@dataclass(frozen=True)
class MapKind:
    """A row of `MAPS`.

    Attributes
    ----------
    name, title
        In the address, and for readers.
    unit
        Of the colour bar.
    names
        Of codes, for a map of labels; empty for a map of numbers.
    ordered
        Whether codes have an order, which their colours then show.
    log
        Whether the numbers are shown as their log10.
    limits
        Ends of the colour bar; None for percentiles of what there is.
    """

    name: str
    title: str
    unit: str = ""
    names: Mapping[int, str] = field(default_factory=dict)
    ordered: bool = False
    log: bool = False
    limits: tuple[float, float] | None = None


@dataclass(frozen=True)
class Map:
    """A map over the image.

    Attributes
    ----------
    kind
        What it shows.
    values
        Shape (y, x), float32; NaN where there is nothing to say.
    done
        Share of the image that is computed.
    """

    kind: MapKind
    values: Image
    done: float = 1.0

    @property
    def colors(self) -> list[str]:
        """Colours of the codes, in ascending order."""
        return label_colors(self.kind.names, ordered=self.kind.ordered)

    @property
    def limits(self) -> tuple[float, float]:
        """Ends of the colour bar."""
        if self.kind.limits is not None:
            return self.kind.limits
        finite = self.values[np.isfinite(self.values)]
        if not finite.size:
            return 0.0, 1.0
        low, high = (float(v) for v in np.percentile(finite, (1, 99)))
        if self.kind.log:  # a lamp has no variance but that of rounding
            low = max(low, high - _DECADES)
        return (low, high) if high > low else (low - 0.5, high + 0.5)


IMAGES = ("null_share", "variance", "variation", "relative_error", "bad_count")
"""Maps that come with the image, a scene's too."""

MAPS: dict[str, MapKind] = {
    kind.name: kind
    for kind in (
        MapKind("null_share", "Null share", "share of the good samples", limits=(0, 1)),
        MapKind("variance", "Variance of luminance", "log10, (W sr⁻¹ m⁻²)²", log=True),
        MapKind("variation", "Standard deviation over mean", _OVER_MEAN, log=True, limits=(-2, 2)),
        # One bright sample among nulls has an error as large as the mean.
        MapKind("relative_error", "Standard error over mean", _OVER_MEAN, log=True, limits=(-3, 0)),
        MapKind("bad_count", "Bad samples", "samples"),
        MapKind("tail_index", "Tail index", "generalised Pareto ξ, luminance", limits=(-0.5, 1)),
        MapKind(
            "finite_variance",
            "Is the variance finite?",
            "by the tail of luminance",
            {0: "suspect", 1: "samples cannot tell", 2: "yes"},
            ordered=True,
        ),
        MapKind("best_family", "Best family", "by BIC, luminance", dict(enumerate(SELECTED))),
        MapKind(
            "pattern",
            "Pattern",
            "primary label",
            {int(label): label.name.lower().replace("_", " ") for label in Label},
        ),
        MapKind("n_needed", "N needed for Gaussian averages", "samples, luminance"),
    )
}


def map_kind(name: str) -> MapKind:
    """Return what a map of that name shows; ``error:NAME`` is the error of an estimator.

    Raises
    ------
    InputError
        If there is no such map.
    """
    if name in MAPS:
        return MAPS[name]
    estimator = name.removeprefix(_ERROR)
    if name.startswith(_ERROR) and estimator in fixed_names():
        unit = f"log10 of MSE over that of the mean, N = {_BATCH}"
        return MapKind(name, f"Error of {estimator}", unit, limits=(-1, 1))
    message = f"no map is called {name!r}; there are {', '.join(MAPS)} and {_ERROR}ESTIMATOR"
    raise InputError(message)


def of_overall(overall: Overall, name: str) -> Map | None:
    """Return a map that comes with the image, None for one that does not."""
    if name not in IMAGES:
        return None
    kind = MAPS[name]
    values = getattr(overall, name)
    if kind.log:
        with np.errstate(divide="ignore", invalid="ignore"):
            values = np.where(values > 0, np.log10(values), np.nan).astype(np.float32)
    return Map(kind, values)


def walk(source: StoreSource, name: str, step: Step) -> Map:
    """Compute a map tile by tile.

    Parameters
    ----------
    source
        The store.
    name
        One of `MAPS`, or ``error:NAME``.
    step
        Told the share that is done and what there is; whatever it raises ends the walk.
    """
    kind = with_sizes(map_kind(name), source)
    values = np.full(source.size, np.nan, np.float32)
    tiles = list(source.tiles(16))

    def parts() -> Iterator[tuple[slice, slice, dict[str, Any]]]:
        for i, (ys, xs) in enumerate(tiles):
            step(i / len(tiles), values)
            block = source.read(ys, xs)
            variables = _variables(name, block)
            values[ys, xs] = variables["value"][1]
            yield ys, xs, variables

    if name != "pattern":
        for _ in parts():
            pass
        return Map(kind, values)
    # Over the image, flags are decided with p-values corrected for its size.
    found = source.samples.assemble(parts(), progress=False)
    return Map(kind, finish_patterns(found)["label"].to_numpy().astype(np.float32))


def _variables(name: str, block: Image) -> dict[str, Any]:
    if name == "pattern":
        found = dict(patterns_variables(patterns_of_part(luminance_part(block))))
        return {**found, "value": ((), found["label"][1])}
    return {"value": ((), _value(name, block))}


def _value(name: str, block: Image) -> npt.NDArray[Any]:
    if name.startswith(_ERROR):
        return _error_ratio(name.removeprefix(_ERROR), block)
    if name == "n_needed":
        return _needed(block)
    part = luminance_part(block)
    if name == "tail_index":
        return tail_of_part(part).xi
    if name == "finite_variance":
        tail = tail_of_part(part)
        verdict = np.where(tail.variance_suspect, 0.0, np.where(tail.variance_trusted, 2.0, 1.0))
        return np.where(tail.reason == Reason.OK, verdict, np.nan)
    best = select_part(part, [FAMILIES[family] for family in SELECTED]).best
    return np.where(best < 0, np.nan, best)


def _needed(block: Image) -> npt.NDArray[Any]:
    """Return the place of the N needed among those tested; one more where it is larger."""
    if block.shape[-1] < N_MEANS:
        return np.full(block.shape[:2], np.nan)
    sizes = sizes_of_means(block.shape[-1])
    bad = is_bad(block).any(axis=-2)
    with np.errstate(invalid="ignore", over="ignore"):
        light = np.where(bad, np.nan, luminance(block))[..., np.newaxis, :]
    needed = means_of_block(light, sizes).n_needed[..., 0]
    place = np.searchsorted(sizes, needed).astype(np.float64)
    return np.where(needed == MORE_THAN_TESTED, len(sizes), np.where(needed > 0, place, np.nan))


def with_sizes(kind: MapKind, source: StoreSource) -> MapKind:
    """Name the codes of the map of N needed, which depend on how many samples there are."""
    if kind.name != "n_needed" or source.samples.spp < N_MEANS:
        return kind
    sizes = sizes_of_means(source.samples.spp)
    names = {i: f"N = {n}" for i, n in enumerate(sizes)} | {len(sizes): f"N > {sizes[-1]}"}
    return replace(kind, names=names, ordered=True)


def _error_ratio(name: str, block: Image) -> npt.NDArray[Any]:
    """Return log10 of an estimator's squared error over the mean's, against all other samples."""
    estimator: Any = registry.lookup(name)
    height, width, _, spp = block.shape
    count = min(spp // _BATCH, _MOST_BATCHES)
    if count < 2:
        return np.full((height, width), np.nan)
    block = np.where(is_bad(block).any(axis=-2, keepdims=True), np.float32(np.nan), block)
    total, good = np.nansum(block, axis=-1, dtype=np.float64), np.isfinite(block).sum(axis=-1)
    errors = np.zeros((2, height, width))
    mean: Any = registry.lookup("mean")
    for i in range(count):
        batch = np.ascontiguousarray(block[..., i * _BATCH : (i + 1) * _BATCH])
        own = np.isfinite(batch).sum(axis=-1)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            truth = (total - np.nansum(batch, axis=-1, dtype=np.float64)) / (good - own)
            for k, method in enumerate((estimator, mean)):
                difference = np.asarray(method(batch), np.float64) - truth
                errors[k] += np.nansum(difference**2, axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.log10(errors[0] / errors[1])
    return np.where(np.isfinite(ratio), ratio, np.nan)
