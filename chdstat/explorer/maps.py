"""Maps: one number or label per pixel, over the image.

`MAPS` is the table, `DIFFERENCES` and `CONTRASTS` are those of two images. Some maps come with the
image; for the others, `walk` goes through the store tile by tile and shows what it has so far.
Names and units of what an analysis wrote to a file come from its attributes (`read_maps`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib import colormaps
from matplotlib.colors import to_hex

from chdstat import inference
from chdstat._core.arrays import Array, Image, Mapped, spans
from chdstat._core.positive import PositivePart
from chdstat.errors import InputError
from chdstat.explorer.place import HOLDS, error_bar
from chdstat.explorer.sources import StoreSource
from chdstat.fit.families import FAMILIES
from chdstat.fit.selection import FamilySelection
from chdstat.fit.tail import TailIndex
from chdstat.inference.averages import NormalityOfMeans
from chdstat.inference.contrasts import Contrast
from chdstat.io.writing import open_maps
from chdstat.patterns.classification import Classification, Label
from chdstat.samples.tiles import assemble
from chdstat.summary.runner import measured
from chdstat.viz.maps import LABEL_COLORS, names_of
from chdstat.viz.styling import called

_FILE = "file:"
_DECADES = 8.0
"""Most ticks of a colour bar."""
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
_NONE = np.empty((0, 0), np.float32)


@cache
def ramp(name: str = "viridis") -> tuple[str, ...]:
    """Return 256 colours of one of Matplotlib's maps, distinct for the colour-blind."""
    return tuple(to_hex(color) for color in colormaps[name](range(256)))


@dataclass(frozen=True)
class Map:
    """A map over the image.

    Attributes
    ----------
    name, title
        In the address, and for readers.
    unit
        Of the colour bar.
    of
        Returns the numbers (y, x), of what its table says; None where they need no computing.
    names
        Of codes, for a map of labels; empty for a map of numbers.
    ordered
        Whether codes have an order, which their colours then show.
    log
        Whether the numbers are shown as their log10.
    ends
        Ends of the colour bar; None for percentiles of what there is.
    diverging
        Whether 0 stands in the middle, between two colours.
    values
        Shape (y, x), float32; NaN where there is nothing to say. Empty in tables.
    done
        Share of the image that is computed.
    note
        What is said of it below the colour bar.
    """

    name: str
    title: str
    unit: str = ""
    of: Callable[..., npt.ArrayLike] | None = None
    names: Mapping[int, str] = field(default_factory=dict)
    ordered: bool = False
    log: bool = False
    ends: tuple[float, float] | None = None
    diverging: bool = False
    values: Image = field(default_factory=lambda: _NONE)
    done: float = 1.0
    note: str = ""

    @property
    def colors(self) -> list[str]:
        """Colours of the numbers, or of the codes in ascending order; a ramp if these have one."""
        count = len(self.names)
        if not count:
            return list(ramp("BrBG_r" if self.diverging else "viridis"))
        if self.ordered:
            return [ramp()[255 * i // max(1, count - 1)] for i in range(count)]
        others = (_LABELS[i % len(_LABELS)] for i in range(count))
        return [LABEL_COLORS.get(*pair) for pair in zip(self.names.values(), others, strict=True)]

    @property
    def limits(self) -> tuple[float, float]:
        """Ends of the colour bar."""
        if self.names:
            return min(self.names) - 0.5, max(self.names) + 0.5
        if self.ends is not None:
            return self.ends
        finite = self.values[np.isfinite(self.values)]
        if not finite.size:
            return -float(self.diverging), 1.0
        if self.diverging:
            most = float(np.percentile(np.abs(finite), 99)) or 1.0
            return -most, most
        low, high = (float(v) for v in np.percentile(finite, (1, 99)))
        if self.log:  # a lamp has no variance but that of rounding
            low = max(low, high - _DECADES)
        return (low, high) if high > low else (low - 0.5, high + 0.5)

    def filled(self, found: npt.ArrayLike) -> Map:
        """Return the map of these numbers; what is not finite is NaN."""
        values = np.asarray(found)
        with np.errstate(divide="ignore", invalid="ignore"):
            values = np.log10(values) if self.log else values
        return replace(
            self, values=np.where(np.isfinite(values), values, np.nan).astype(np.float32)
        )


def _table(*maps: Map) -> dict[str, Map]:
    return {one.name: one for one in maps}


def _against_reference(found: Contrast) -> Array:
    """Return the difference over the reference in per cent; an image that is exact is that."""
    maps, sign = found.maps, -1.0 if found.spp[1] is None else 1.0
    base = maps["mean_a" if sign > 0 else "mean_b"].to_numpy()[..., 0]
    return np.asarray(100 * sign * maps["difference"].to_numpy()[..., 0] / np.abs(base))


def _best_family(part: PositivePart) -> Array:
    best = measured(part, FamilySelection()).best
    return np.where(best < 0, np.nan, best)


def _n_needed(part: PositivePart) -> Array:
    """Return the place of the N needed among those tested; one more where it is larger."""
    tests = NormalityOfMeans.of(part.x.shape[-1])
    if tests is None:
        return np.full(part.n.shape, np.nan)
    needed = measured(part, tests).n_needed
    place = np.where(needed > 0, np.searchsorted(tests.sizes, needed), np.nan)
    return np.where(needed == inference.MORE_THAN_TESTED, len(tests.sizes), place)


_FAMILIES = dict(enumerate(map(called, FAMILIES)))
_PATTERNS = {int(label): called(label.name.lower()) for label in Label}
IMAGES = _table(
    Map("null_share", "Null share", "share of the good samples", ends=(0, 1)),
    Map("variance", "Variance of luminance", "log10, (W sr⁻¹ m⁻²)²", log=True),
    Map("variation", "Standard deviation over mean", _OVER_MEAN, log=True, ends=(-2, 2)),
    # One bright sample among nulls has an error as large as the mean.
    Map("relative_error", "Standard error over mean", _OVER_MEAN, log=True, ends=(-3, 0)),
    Map("bad_count", "Bad samples", "samples"),
)
"""Maps that come with the image, a scene's too, as `chdstat.explorer.sources.Overall` has them."""
MAPS = IMAGES | _table(
    Map("tail_index", "Tail index", "generalised Pareto ξ, luminance",
        lambda part: measured(part, TailIndex()).xi, ends=(-0.5, 1)),
    Map("error_bar", "Does the error bar hold?", "by the luminance of each pixel alone",
        lambda part: error_bar(measured(part, TailIndex())), HOLDS, ordered=True),
    Map("best_family", "Best family", "by BIC, luminance", _best_family, _FAMILIES),
    Map("pattern", "Pattern", "primary label", names=_PATTERNS),
    Map("n_needed", "N needed for Gaussian averages", "samples, luminance", _n_needed),
)  # fmt: skip
"""Those, and maps for which samples are read: of the luminance of pixels, for `walk`."""
DIFFERENCES = _table(
    Map("diff:signed", "Difference", "shown minus reference, luminance", lambda a, b: b - a,
        diverging=True),
    Map("diff:absolute", "Absolute difference", "luminance", lambda a, b: abs(b - a)),
    Map("diff:squared", "Squared difference", "log10, luminance", lambda a, b: (b - a) ** 2,
        log=True),
    Map("diff:relative", "Relative difference", "shown minus reference, over their mean, luminance",
        lambda a, b: (b - a) / ((a + b) / 2), ends=(-1, 1), diverging=True),
)  # fmt: skip
"""Maps of two images: of the luminance of the reference and of what is shown."""
CONTRASTS = _table(
    Map("contrast:difference", "Difference over reference", "%, luminance", _against_reference,
        ends=(-100, 100), diverging=True),
    Map("contrast:p", "Significance of the difference", "−log10 p, least over channels",
        lambda found: -np.log10(found.maps["p_value"].min("channel")), ends=(0, 4)),
    Map("contrast:efficiency", "Efficiency over the reference", "log2",
        lambda found: np.log2(found.maps["efficiency"]), ends=(-3, 3), diverging=True),
)  # fmt: skip
"""Maps of what `chdstat.contrast` says of two renders."""


def map_of(name: str, *found: Any, note: str = "") -> Map:
    """Return a map of a table, of what this says.

    Examples
    --------
    >>> one, other = np.array([[1.0]]), np.array([[3.0]])
    >>> [f"{map_of(name, one, other).values[0, 0]:.2f}" for name in DIFFERENCES]
    ['2.00', '2.00', '0.60', '1.00']
    """
    kind = replace(map_kind(name), note=note)
    assert kind.of is not None
    with np.errstate(divide="ignore", invalid="ignore"):
        return kind.filled(kind.of(*found))


def map_kind(name: str, spp: int = 0) -> Map:
    """Return the map of that name without values.

    The codes of N needed have names if there are enough samples per pixel to test averages.

    Raises
    ------
    InputError
        If there is no such map.
    """
    if name == "n_needed" and (tests := NormalityOfMeans.of(spp)) is not None:
        sizes = tests.sizes
        names = {i: f"N = {n}" for i, n in enumerate(sizes)} | {len(sizes): f"N > {sizes[-1]}"}
        return replace(MAPS[name], names=names, ordered=True)
    known = {**MAPS, **DIFFERENCES, **CONTRASTS}
    if name in known:
        return known[name]
    message = f"no map is called {name!r}; there are {', '.join(MAPS)}"
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
    for variable, values in sorted(found.data_vars.items()):
        if values.dims == ("y", "x") and values.dtype.kind in "bif":
            name, unit = str(variable).lower(), str(values.attrs.get("long_name", ""))
            names = names_of(values) if "flag_meanings" in values.attrs else {}
            names = {0: "no", 1: "yes"} if values.dtype.kind == "b" else names
            maps[f"{_FILE}{name}"] = Map(
                f"{_FILE}{name}",
                name.replace("_", " ").capitalize(),
                unit if len(unit) <= _LONGEST else "",
                names=names,
                values=values.to_numpy().astype(np.float32),
            )
    return maps


def walk(source: StoreSource, name: str) -> Iterator[tuple[float, Image]]:
    """Compute a map tile by tile; yield the share that is done, and the values so far.

    Parameters
    ----------
    source
        The store.
    name
        One of `MAPS`.
    """
    values = np.full(source.size, np.nan, np.float32)
    places = list(product(*(spans(length, _TILE) for length in source.size)))

    # Coarsely first, a pixel for each cell, which takes little more than reading.
    for step, before, share in ((_CELL, 0, _COARSE_SHARE), (1, _COARSE_SHARE, 1 - _COARSE_SHARE)):
        parts = []
        for i, (ys, xs) in enumerate(places):
            yield before + share * i / len(places), values
            block = np.ascontiguousarray(source.read(ys, xs)[::step, ::step])
            cells, variables = _of_tile(name, block)
            height, width = values[ys, xs].shape
            values[ys, xs] = cells.repeat(step, 0).repeat(step, 1)[:height, :width]
            parts.append((ys, xs, variables))
    if name == "pattern":
        # Over the image, flags are decided with p-values corrected for its size.
        whole = assemble(source.samples, iter(parts), progress=False)
        values = Classification().finish(whole)["label"].to_numpy().astype(np.float32)
    yield 1.0, values


def _of_tile(name: str, block: Image) -> tuple[Array, Mapped]:
    """Return the values of a tile (y, x, channel, sample), and what labels are decided by."""
    if name == "pattern":
        patterns = Classification()
        found = measured(PositivePart.of_pixels(block, rows="luminance"), patterns)
        variables = patterns.variables(found)
        return np.asarray(variables["label"][1]), variables
    return map_of(name, PositivePart.of_pixels(block, rows="luminance")).values, {}
