"""Maps: one number or label per pixel in place of the image, and images as a browser shows them.

`MAPS` is the table. Some come with the image (`of_overall`); for the others, `walk` goes through
the store tile by tile and shows what it has so far.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt

from chdstat import viz
from chdstat._core.arrays import is_bad, luminance
from chdstat.errors import InputError, Reason
from chdstat.explorer.estimators import batches_of, fixed
from chdstat.explorer.sources import Overall, StoreSource, tiles
from chdstat.fit.families import FAMILIES, SELECTED
from chdstat.fit.selection import select_part
from chdstat.fit.tail import tail_of_part
from chdstat.inference import MORE_THAN_TESTED, N_MEANS, sizes_of_means
from chdstat.inference.normality_of_means import means_of_block
from chdstat.patterns import classification
from chdstat.samples.samples import Mapped

__all__ = ["IMAGES", "MAPS", "Map", "MapKind", "map_kind", "of_overall", "ramp", "rgba", "walk"]

_ERROR = "error:"
_BATCH = 32
"""Samples of an estimate, in maps of errors."""
_MOST_BATCHES = 16
_DECADES = 8.0
"""Of a colour bar, at most."""
_OVER_MEAN = "log10, luminance"

_LABELS = (
    *("#f0b429", "#62c4f5", "#3fd0a4", "#e39ac8", "#f4ea5c", "#ff8f5e", "#2f6fb7", "#8a5a9e"),
    *("#8f9296", "#9c3b3b", "#5b7f2b", "#c8c9ca"),
)
_FILMIC = (0.15, 0.50, 0.10, 0.20, 0.02, 0.30)
_WHITE = 11.2

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
            {0: "suspect", 1: "samples cannot tell", 2: "yes"},
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
        Called with the share that is done and the values so far; whatever it raises ends the walk.
    """
    values = np.full(source.size, np.nan, np.float32)
    places = tiles(source.size, 16)

    def parts() -> Iterator[tuple[slice, slice, Mapped]]:
        for i, (ys, xs) in enumerate(places):
            step(i / len(places), values)
            block = source.read(ys, xs)
            variables: Mapped = {"label": ((), np.empty(0))}
            if name == "pattern":
                part = classification.luminance_part(block)
                found = classification.patterns_of_part(part)
                variables = classification.patterns_variables(found)
                values[ys, xs] = variables["label"][1]
            else:
                values[ys, xs] = _value(name, block)
            yield ys, xs, variables

    if name == "pattern":
        # Over the image, flags are decided with p-values corrected for its size.
        whole = source.samples.assemble(parts(), progress=False)
        values = classification.finish_patterns(whole)["label"].to_numpy().astype(np.float32)
    else:
        for _ in parts():
            pass
    return Map(map_kind(name, source.samples.spp), values)


def _value(name: str, block: Image) -> npt.NDArray[Any]:
    if name.startswith(_ERROR):
        return _error_ratio(name.removeprefix(_ERROR), block)
    if name == "n_needed":
        spp = block.shape[-1]
        if spp < N_MEANS:
            return np.full(block.shape[:2], np.nan)
        bad, sizes = is_bad(block).any(axis=-2), sizes_of_means(spp)
        with np.errstate(invalid="ignore", over="ignore"):
            light = np.where(bad, np.nan, luminance(block))[..., np.newaxis, :]
        needed = means_of_block(light, sizes).n_needed[..., 0]
        # The place of the N needed among those tested; one more where it is larger.
        place = np.where(needed > 0, np.searchsorted(sizes, needed), np.nan)
        return np.where(needed == MORE_THAN_TESTED, len(sizes), place)
    part = classification.luminance_part(block)
    if name == "tail_index":
        return tail_of_part(part).xi
    if name == "finite_variance":
        tail = tail_of_part(part)
        verdict = np.where(tail.variance_suspect, 0.0, np.where(tail.variance_trusted, 2.0, 1.0))
        return np.where(tail.reason == Reason.OK, verdict, np.nan)
    best = select_part(part, [FAMILIES[family] for family in SELECTED]).best
    return np.where(best < 0, np.nan, best)


def _error_ratio(name: str, block: Image) -> npt.NDArray[Any]:
    """Return log10 of an estimator's squared error over the mean's, against all other samples."""
    batches = batches_of(block, _BATCH, most=_MOST_BATCHES)
    if batches is None or len(batches.x) < 2:
        return np.full(block.shape[:2], np.nan)
    estimates = np.asarray(fixed()[name](np.ascontiguousarray(batches.x)), np.float64)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        errors = [
            np.nansum((e - batches.truth) ** 2, axis=-1).sum(axis=0)
            for e in (estimates, batches.mean)
        ]
        ratio = np.log10(errors[0] / errors[1])
    return np.where(np.isfinite(ratio), ratio, np.nan)


# --- on the screen ------------------------------------------------------------------------------


@cache
def ramp() -> tuple[str, ...]:
    """Return 256 colours of magnitudes, dark to bright, distinct for the colour-blind: viridis."""
    from matplotlib import colormaps
    from matplotlib.colors import to_hex

    return tuple(to_hex(color) for color in colormaps["viridis"](range(256)))


def rgba(mean: Image, exposure: float, tone: str) -> npt.NDArray[np.uint32]:
    """Return an image as a browser wants it: packed RGBA, shape (y, x).

    Parameters
    ----------
    mean
        Linear radiance, shape (y, x, channel); what is not finite becomes magenta.
    exposure
        Stops.
    tone
        'srgb' clips, 'reinhard' maps v to v / (1 + v), 'filmic' is Hable's curve.

    References
    ----------
    Reinhard, Stark, Shirley and Ferwerda, "Photographic tone reproduction for digital images",
    2002, doi:10.1145/566654.566575, equation 3. Hable, "Uncharted 2: HDR lighting", Game Developers
    Conference 2010.

    Examples
    --------
    >>> hex(rgba(np.ones((1, 1, 3), np.float32), 0, "srgb")[0, 0])
    '0xffffffff'
    """
    with np.errstate(invalid="ignore", over="ignore"):
        value = mean * np.float32(2.0**exposure)
        if tone == "reinhard":
            value = np.where(np.isfinite(value), value / (1 + value), value)
        elif tone == "filmic":
            value = np.where(
                np.isfinite(value), _hable(2 * value) / _hable(np.float32(_WHITE)), value
            )
    shown = viz.tonemap(value, exposure=0)
    packed = np.full((*shown.shape[:2], 4), 255, np.uint8)
    packed[..., :3] = np.round(255 * shown)
    return packed.view(np.uint32)[..., 0]


def _hable(v: npt.NDArray[np.float32] | np.float32) -> npt.NDArray[np.float32]:
    a, b, c, d, e, f = _FILMIC
    v = np.minimum(v, np.float32(1e15))  # v squared stays within float32
    return np.asarray((v * (a * v + c * b) + d * e) / (v * (a * v + b) + d * f) - e / f, np.float32)
