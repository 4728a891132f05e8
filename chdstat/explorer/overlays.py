"""Maps: one number or label per pixel, over the image.

`MAPS` is the table, `DIFFERENCES` and `CONTRASTS` are those of two images. Some maps come with the
image; for the others, `walk` goes through the store tile by tile and shows what it has so far.
Names and units of what an analysis wrote to a file come from its attributes (`read_maps`).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.colors import to_hex

from chdstat._core.arrays import Array, Image, spans
from chdstat._core.positive import PositivePart
from chdstat._core.statistic import MapKind, Statistic, shown_statistics
from chdstat.errors import InputError
from chdstat.explorer.address import BRUSHED, NULLS, View
from chdstat.explorer.image_sources import MOST_POOLED, StoreSource
from chdstat.inference.contrasts import Contrast
from chdstat.io.writing import open_maps
from chdstat.samples.assembly import assemble
from chdstat.summary.runner import measured
from chdstat.viz.maps import LABEL_COLORS, names_of
from chdstat.viz.styling import MAGNITUDES, SIGNED, called, color_limits, color_map

_FILE = "file:"
_DECADES = 8.0
"""Most decades of a colour bar."""
_TILE, _CELL = 16, 8
"""Pixels of a tile and of a cell, of which one pixel is computed first."""
_COARSE_SHARE = 0.05
_DARK = 80
"""Colours at the dark end of a ramp that are not used over the dimmed image."""
_LONGEST = 60
"""Characters of a description beside a colour bar."""
_LABELS = (
    *("#f0b429", "#62c4f5", "#3fd0a4", "#e39ac8", "#f4ea5c", "#ff8f5e", "#2f6fb7", "#8a5a9e"),
    *("#8f9296", "#9c3b3b", "#5b7f2b", "#c8c9ca"),
)
_NONE = np.empty((0, 0), np.float32)


@cache
def ramp(name: str = MAGNITUDES[0]) -> tuple[str, ...]:
    """Return 256 colours of one of Matplotlib's maps."""
    return tuple(to_hex(color) for color in color_map(name)(range(256)))


@dataclass(frozen=True)
class Map(MapKind):
    """A map over the image.

    Attributes
    ----------
    values
        Shape (y, x), float32; NaN where there is nothing to say. Empty in tables.
    done
        Share of the image that is computed.
    note
        What is said of it below the colour bar.
    cmap
        Name of the colour map of numbers; "" for the first one of its kind.
    falling
        Whether the smallest number has the last colour, as small p-values have.
    """

    values: Image = field(default_factory=lambda: _NONE)
    done: float = 1.0
    note: str = ""
    cmap: str = ""
    falling: bool = False

    @property
    def colors_by_name(self) -> str:
        """Name of the colour map of numbers, as Matplotlib knows it."""
        name = self.cmap or (SIGNED if self.diverging else MAGNITUDES)[0]
        return f"{name}_r" if self.falling else name

    @property
    def colors(self) -> list[str]:
        """Colours of the numbers, or of the codes in ascending order; a ramp if these have one."""
        count = len(self.names)
        if not count:
            # Over the dimmed image, pixels that hold a single sample are to be seen, too.
            return list(ramp(self.colors_by_name)[_DARK if self.name == BRUSHED else 0 :])
        if self.ordered:
            return [ramp()[255 * i // max(1, count - 1)] for i in range(count)]
        others = (_LABELS[i % len(_LABELS)] for i in range(count))
        return [LABEL_COLORS.get(*pair) for pair in zip(self.names.values(), others, strict=True)]

    @property
    def limits(self) -> tuple[float, float]:
        """Ends of the colour bar."""
        if self.names:
            return min(self.names) - 0.5, max(self.names) + 0.5
        if self.ends is not None and (self.ends[0] > 0 or not self.log):
            return self.ends
        low, high = color_limits(self.values, diverging=self.diverging, log=self.log)
        if self.log:  # a lamp has no variance but that of rounding
            low = max(low, high / 10**_DECADES)
        if self.name == BRUSHED:  # shares; there may be none yet
            high = min(high, 1.0)
            low = low if low < high else high / 2
        return low, high

    def scaled(self, numbers: npt.ArrayLike) -> Array:
        """Return what colours follow of numbers: their logarithm, or themselves."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(np.log10(numbers) if self.log else numbers)

    def filled(self, found: npt.ArrayLike) -> Map:
        """Return the map of these numbers; what is not finite, or has no logarithm, is NaN."""
        values = np.asarray(found)
        shown = np.where(np.isfinite(self.scaled(values)), values, np.nan)
        return replace(self, values=shown.astype(np.float32))


def _table(*maps: Map) -> dict[str, Map]:
    return {one.name: one for one in maps}


def _against_reference(found: Contrast) -> Array:
    """Return the difference over the reference in per cent; an image that is exact is that."""
    maps, sign = found.maps, -1.0 if found.spp[1] is None else 1.0
    base = maps["mean_a" if sign > 0 else "mean_b"].to_numpy()[..., 0]
    return np.asarray(100 * sign * maps["difference"].to_numpy()[..., 0] / np.abs(base))


def _of_statistics(spp: int) -> dict[str, tuple[Map, Statistic[Any]]]:
    """Return the maps of all statistics for so many samples, each with its statistic, by name."""
    known = (kind.of_pixel(spp) for kind in shown_statistics())
    found = {}
    for statistic in filter(None, known):
        for kind in statistic.maps():
            names = {code: called(name) for code, name in kind.names.items()}
            found[kind.name] = Map(**{**vars(kind), "names": names}), statistic
    return found


IMAGES = _table(
    Map("null_share", "Null share", "share of the good samples", ends=(0, 1)),
    Map("variance", "Variance of luminance", log=True),  # renders of others have units of their own
    Map("variation", "Standard deviation over mean", "luminance", log=True, ends=(1e-2, 1e2)),
    # One bright sample among nulls has an error as large as the mean.
    Map("relative_error", "Standard error over mean", "luminance", log=True, ends=(1e-3, 1)),
    Map("bad_count", "Bad samples", "samples"),
)
"""Maps that come with the image, a scene's too; attributes of an `Overall`."""
COST = Map("sample_seconds", "Cost of a sample", "µs", log=True)
"""Map of what was measured while samples were rendered."""
MAPS = {
    **IMAGES,
    **{name: shown for name, (shown, _) in _of_statistics(MOST_POOLED).items()},
    COST.name: COST,
}
"""Those, and maps for which samples are read: statistics of the luminance, for `walk`."""
OF_FILM = {n for n, (_, statistic) in _of_statistics(MOST_POOLED).items() if statistic.film}
"""Maps that need to know where samples fell in their pixel."""
_BRUSH = Map(BRUSHED, "Samples in the range", "share of the good samples", log=True)
DIFFERENCES = _table(
    Map("diff:signed", "Difference", "shown minus reference, luminance", lambda a, b: b - a,
        diverging=True),
    Map("diff:absolute", "Absolute difference", "luminance", lambda a, b: abs(b - a)),
    Map("diff:squared", "Squared difference", "luminance", lambda a, b: (b - a) ** 2, log=True),
    Map("diff:relative", "Relative difference", "shown minus reference, over their mean, luminance",
        lambda a, b: (b - a) / ((a + b) / 2), ends=(-1, 1), diverging=True),
)  # fmt: skip
"""Maps of two images: of the luminance of the reference and of what is shown."""
CONTRASTS = _table(
    Map("contrast:difference", "Difference over reference", "%, luminance", _against_reference,
        ends=(-100, 100), diverging=True),
    Map("contrast:p", "Significance of the difference", "p, least over channels",
        lambda found: found.maps["p_value"].min("channel"), log=True, ends=(1e-4, 1), falling=True),
    Map("contrast:efficiency", "Efficiency over the reference", "times",
        lambda found: found.maps["efficiency"], log=True, ends=(1 / 8, 8), diverging=True),
)  # fmt: skip
"""Maps of what `chdstat.contrast` says of two renders."""


def map_of_view(view: View, spp: int = 0) -> Map:
    """Return the map that a view shows, or that of its brush, without values; as `map_kind`."""
    if view.brush is None:
        return map_kind(view.map, spp)
    return replace(_BRUSH, title="Null samples") if view.brush == NULLS else _BRUSH


def map_of(name: str, *found: Any, note: str = "") -> Map:
    """Return a map of a table, of what this says.

    Examples
    --------
    >>> one, other = np.array([[1.0]]), np.array([[3.0]])
    >>> [f"{map_of(name, one, other).values[0, 0]:.2f}" for name in DIFFERENCES]
    ['2.00', '2.00', '4.00', '1.00']
    """
    kind = replace(map_kind(name), note=note)
    assert kind.of is not None
    with np.errstate(divide="ignore", invalid="ignore"):
        return kind.filled(kind.of(*found))


def map_kind(name: str, spp: int = 0) -> Map:
    """Return the map of that name without values.

    With `spp`, a map of a statistic is as of so many samples.

    Raises
    ------
    InputError
        If there is no such map.
    """
    of_spp = {name: shown for name, (shown, _) in _of_statistics(spp).items()} if spp else {}
    known = {**MAPS, **DIFFERENCES, **CONTRASTS, **of_spp}
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


def _microseconds(source: StoreSource) -> Image:
    """Return what a sample of each pixel takes."""
    if (costs := source.samples.costs) is None:
        message = (
            f"{COST.title!r} needs to know what samples take: render the scene with 'chdstat "
            "render --cost --backend scalar'"
        )
        raise InputError(message)
    return np.asarray(1e6 * costs.seconds, np.float32)


def walk(source: StoreSource, name: str) -> Iterator[tuple[float, Image]]:
    """Compute a map tile by tile; yield the share that is done, and the values so far.

    Parameters
    ----------
    source
        The store.
    name
        One of `MAPS`.
    """
    if name == COST.name:
        yield 1.0, _microseconds(source)
        return
    values = np.full(source.size, np.nan, np.float32)
    if name not in (known := _of_statistics(source.samples.spp)):  # too few samples for it
        yield 1.0, values
        return
    if name in OF_FILM and source.samples.film is None:
        message = (
            f"{known[name][0].title!r} needs to know where samples fell: render the scene with "
            "'chdstat render --film'"
        )
        raise InputError(message)
    shown, statistic = known[name]
    places = list(product(*(spans(length, _TILE) for length in source.size)))
    # Coarsely first, a pixel for each cell, which takes little more than reading.
    for step, before, share in ((_CELL, 0, _COARSE_SHARE), (1, _COARSE_SHARE, 1 - _COARSE_SHARE)):
        parts = []
        for i, (ys, xs) in enumerate(places):
            yield before + share * i / len(places), values
            block = np.ascontiguousarray(source.read(ys, xs)[::step, ::step])
            fell = source.samples.places(ys, xs) if statistic.film else None
            fell = None if fell is None else fell[::step, ::step]
            part = PositivePart.of_pixels(block, rows="luminance", places=fell)
            found = measured(part, statistic)
            cells = shown.filled(shown.of(found)).values if shown.of else values[ys, xs]
            height, width = values[ys, xs].shape
            values[ys, xs] = cells.repeat(step, 0).repeat(step, 1)[:height, :width]
            parts.append((ys, xs, statistic.variables(found) if shown.decided else {}))
    if shown.decided:
        # Over the image, labels are decided with p-values corrected for its size.
        whole = assemble(source.samples, iter(parts))
        values = statistic.finish(whole)[shown.decided].to_numpy().astype(np.float32)
    yield 1.0, values
