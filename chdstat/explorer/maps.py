"""Maps: one number or label per pixel, over the image.

`MAPS` is the table. Some come with the image (`of_overall`); for the others, `walk` goes through
the store tile by tile and shows what it has so far.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Image, luminance, spans
from chdstat.errors import InputError, Reason
from chdstat.explorer.estimators import batches_of, fixed
from chdstat.explorer.sources import Overall, StoreSource
from chdstat.explorer.startup import ramp
from chdstat.fit.families import FAMILIES, SELECTED
from chdstat.fit.selection import select_part
from chdstat.fit.tail import TailIndex
from chdstat.inference import MORE_THAN_TESTED, N_MEANS, sizes_of_means
from chdstat.inference.averages import NormalityOfMeans
from chdstat.io.maps import open_maps
from chdstat.patterns import classification
from chdstat.patterns.pixel_statistics import PixelFits
from chdstat.samples.tiles import Mapped, assemble
from chdstat.viz.estimators import NAMES

if TYPE_CHECKING:
    import xarray as xr

__all__ = [
    "DIFFERENCES",
    "IMAGES",
    "MAPS",
    "Map",
    "MapKind",
    "difference_of",
    "map_kind",
    "of_overall",
    "read_maps",
    "walk",
]

_ERROR, _FILE = "error:", "file:"
_BATCH = 32
"""Samples of an estimate, in maps of errors."""
_MOST_BATCHES = 16
_DECADES = 8.0
"""Of a colour bar, at most."""
_TILE, _CELL = 16, 8
"""Pixels of a tile and of a cell, of which one pixel is computed first."""
_COARSE_SHARE = 0.05
_LONGEST = 60
"""Characters of a description beside a colour bar."""
_OVER_MEAN = "log10, luminance"

_LABELS = (
    *("#f0b429", "#62c4f5", "#3fd0a4", "#e39ac8", "#f4ea5c", "#ff8f5e", "#2f6fb7", "#8a5a9e"),
    *("#8f9296", "#9c3b3b", "#5b7f2b", "#c8c9ca"),
)
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
    diverging
        Whether 0 stands in the middle, between two colours.
    """

    name: str
    title: str
    unit: str = ""
    names: Mapping[int, str] = field(default_factory=dict)
    ordered: bool = False
    log: bool = False
    limits: tuple[float, float] | None = None
    diverging: bool = False

    @property
    def ramp(self) -> tuple[str, ...]:
        """Colours of the numbers."""
        return ramp("BrBG_r" if self.diverging else "viridis")


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
        """Colours of the codes, in ascending order; those of `ramp` if the codes have an order."""
        count = len(self.kind.names)
        if self.kind.ordered:
            return [ramp()[255 * i // max(1, count - 1)] for i in range(count)]
        return [_LABELS[i % len(_LABELS)] for i in range(count)]

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
            {0: "suspect", 1: "samples cannot tell", 2: "looks finite"},
            ordered=True,
        ),
        MapKind("best_family", "Best family", "by BIC, luminance", dict(enumerate(SELECTED))),
        MapKind(
            "pattern",
            "Pattern",
            "primary label",
            {int(label): label.name.lower().replace("_", " ") for label in classification.Label},
        ),
        MapKind("n_needed", "N needed for Gaussian averages", "samples, luminance"),
    )
}


def map_kind(name: str, spp: int = 0) -> MapKind:
    """Return what a map of that name shows; ``error:NAME`` is the error of an estimator.

    The codes of N needed have names if there are enough samples per pixel to test averages.

    Raises
    ------
    InputError
        If there is no such map.
    """
    if name == "n_needed" and spp >= N_MEANS:
        sizes = sizes_of_means(spp)
        names = {i: f"N = {n}" for i, n in enumerate(sizes)} | {len(sizes): f"N > {sizes[-1]}"}
        return replace(MAPS[name], names=names, ordered=True)
    if name in MAPS:
        return MAPS[name]
    estimator = name.removeprefix(_ERROR)
    if name.startswith(_ERROR) and estimator in fixed():
        if estimator == "mean":
            return MapKind(name, "Error of the mean", f"log10 of MSE, N = {_BATCH}")
        unit = f"log10 of MSE over that of the mean, N = {_BATCH}"
        title = f"Error of {NAMES.get(estimator, estimator)}"
        return MapKind(name, title, unit, limits=(-1, 1), diverging=True)
    message = f"no map is called {name!r}; there are {', '.join(MAPS)} and {_ERROR}ESTIMATOR"
    raise InputError(message)


def read_maps(path: str | Path, size: tuple[int, int]) -> dict[str, Map]:
    """Return the maps of an analysis that was written before, by name.

    Parameters
    ----------
    path
        What ``chdstat analyze -o`` wrote.
    size
        (height, width) of the image.

    Raises
    ------
    StoreError
        If there is no dataset.
    InputError
        If it is of an image of another size.
    """
    found = open_maps(path)
    shape = tuple(found.sizes[dim] for dim in ("y", "x"))
    if shape != size:
        expected, got = (f"{width} x {height}" for height, width in (size, shape))
        message = f"the maps in {path} must have {expected} pixels, got {got}"
        raise InputError(message)
    maps = {}
    for variable, values in found.data_vars.items():
        if values.dims == ("y", "x") and values.dtype.kind in "bif":
            name = f"{_FILE}{str(variable).lower()}"
            maps[name] = Map(_kind_of(name, values), values.to_numpy().astype(np.float32))
    return maps


def _kind_of(name: str, values: xr.DataArray) -> MapKind:
    attrs, title = values.attrs, name.removeprefix(_FILE).replace("_", " ").capitalize()
    words = str(attrs.get("flag_meanings", "")).split()
    codes = dict(zip(map(int, attrs.get("flag_values", ())), words, strict=False))
    names = {code: word.lower().replace("_", " ") for code, word in codes.items()}
    if values.dtype.kind == "b":
        names = {0: "no", 1: "yes"}
    unit = str(attrs.get("long_name", ""))
    return MapKind(name, title, unit if len(unit) <= _LONGEST else "", names)


DIFFERENCES: dict[str, MapKind] = {
    kind.name: kind
    for kind in (
        MapKind("diff:signed", "Difference", "second minus first, luminance", diverging=True),
        MapKind("diff:absolute", "Absolute difference", "luminance"),
        MapKind("diff:squared", "Squared difference", "log10, luminance", log=True),
        MapKind(
            "diff:relative",
            "Relative difference",
            "second minus first, over their mean, luminance",
            limits=(-1, 1),
            diverging=True,
        ),
    )
}
"""Maps of two stores."""


def difference_of(one: Overall, other: Overall, name: str) -> Map | None:
    """Return one of `DIFFERENCES` of two images, None for another map.

    Examples
    --------
    >>> image = Overall.empty(1, 1, 3)
    >>> one, other = (replace(image, mean=np.full((1, 1, 3), v, np.float32)) for v in (1, 3))
    >>> [f"{difference_of(one, other, name).values[0, 0]:.2f}" for name in DIFFERENCES]
    ['2.00', '2.00', '0.60', '1.00']
    """
    if name not in DIFFERENCES:
        return None
    first, second = (luminance(image.mean, channel_axis=-1) for image in (one, other))
    kind, values = DIFFERENCES[name], second - first
    with np.errstate(divide="ignore", invalid="ignore"):
        if name == "diff:relative":
            values = values / ((first + second) / 2)
        elif name == "diff:squared":
            values = np.log10(values**2)
        elif name == "diff:absolute":
            values = np.abs(values)
    values = np.where(np.isfinite(values), values, np.nan).astype(np.float32)
    if name == "diff:signed":
        most = float(np.nanpercentile(np.abs(values), 99)) if np.isfinite(values).any() else 0.0
        kind = replace(kind, limits=(-most or -1.0, most or 1.0))
    return Map(kind, values)


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
        Called with the share that is done and the values so far; whatever it raises ends the walk.
    """
    values = np.full(source.size, np.nan, np.float32)
    places = list(product(*(spans(length, _TILE) for length in source.size)))

    def found_in(block: Image) -> tuple[npt.NDArray[Any], Mapped]:
        if name != "pattern":
            return _value(name, block), {"label": ((), np.empty(0))}
        part = classification.luminance_part(block)
        variables = classification.patterns_variables(classification.patterns_of(PixelFits(part)))
        return np.asarray(variables["label"][1]), variables

    # Coarsely first, a pixel for each cell, which takes little more than reading.
    for i, (ys, xs) in enumerate(places):
        step(_COARSE_SHARE * i / len(places), values)
        cells, _ = found_in(np.ascontiguousarray(source.read(ys, xs)[::_CELL, ::_CELL]))
        height, width = values[ys, xs].shape
        values[ys, xs] = cells.repeat(_CELL, 0).repeat(_CELL, 1)[:height, :width]

    def parts() -> Iterator[tuple[slice, slice, Mapped]]:
        for i, (ys, xs) in enumerate(places):
            step(_COARSE_SHARE + (1 - _COARSE_SHARE) * i / len(places), values)
            values[ys, xs], variables = found_in(source.read(ys, xs))
            yield ys, xs, variables

    if name == "pattern":
        # Over the image, flags are decided with p-values corrected for its size.
        whole = assemble(source.samples, parts(), progress=False)
        values = classification.finish_patterns(whole)["label"].to_numpy().astype(np.float32)
    else:
        for _ in parts():
            pass
    return Map(map_kind(name, source.samples.spp), values)


def _value(name: str, block: Image) -> npt.NDArray[Any]:
    if name.startswith(_ERROR):
        return _error(name.removeprefix(_ERROR), block)
    if name == "n_needed":
        spp = block.shape[-1]
        if spp < N_MEANS:
            return np.full(block.shape[:2], np.nan)
        sizes = sizes_of_means(spp)
        part = classification.luminance_part(block)
        needed = part.measured(NormalityOfMeans(tuple(sizes.tolist()))).n_needed
        # The place of the N needed among those tested; one more where it is larger.
        place = np.where(needed > 0, np.searchsorted(sizes, needed), np.nan)
        return np.where(needed == MORE_THAN_TESTED, len(sizes), place)
    part = classification.luminance_part(block)
    if name == "tail_index":
        return part.measured(TailIndex()).xi
    if name == "finite_variance":
        tail = part.measured(TailIndex())
        verdict = np.where(tail.variance_suspect, 0.0, np.where(tail.variance_trusted, 2.0, 1.0))
        return np.where(tail.reason == Reason.OK, verdict, np.nan)
    best = select_part(part, [FAMILIES[family] for family in SELECTED]).best
    return np.where(best < 0, np.nan, best)


def _error(name: str, block: Image) -> npt.NDArray[Any]:
    """Return log10 of an estimator's squared error over the mean's, against all other samples.

    Of the mean itself, log10 of the mean squared error.
    """
    batches = batches_of(block, _BATCH, most=_MOST_BATCHES)
    if batches is None or len(batches.x) < 2:
        return np.full(block.shape[:2], np.nan)
    estimates = np.asarray(fixed()[name](np.ascontiguousarray(batches.x)), np.float64)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        own, of_mean = (
            np.nansum((e - batches.truth) ** 2, axis=-1).sum(axis=0)
            for e in (estimates, batches.mean)
        )
        number = np.isfinite(batches.truth).sum(axis=(0, -1))
        error = np.log10(own / (number if name == "mean" else of_mean))
    return np.where(np.isfinite(error), error, np.nan)
