"""Film split: how much of a pixel's variance is between places within it, how much of its paths.

The variance of a sample is the mean of its variance at a fixed place in the pixel, which the paths
make, and the variance of the radiance over the pixel (the law of total variance; Elek et al. 2019,
equation 4 and after). The pixel is cut into k x k cells. What differs between the means of cells
is what a stratified sampler, or a filter that knew the image, could take; what differs within a
cell counts as of the paths.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Floats, first_of, is_bad, label_variables, luminance
from chdstat.errors import InputError, Reason
from chdstat.samples import ImageLike, Mapped, Samples, samples_of
from chdstat.samples.assembly import over_tiles
from chdstat.samples.tiles import tiles

if TYPE_CHECKING:
    import xarray as xr

_IN_A_CELL = 12
"""Samples that a cell should hold on average."""
_CELLS = 2, 4, 8, 16
"""Cells along the edge of a pixel; no step of the places that are kept lies in two of them."""
_GROUPS = 8
"""Groups of samples, each of which is left out once for the standard error."""
_SAID = {
    "variance": "variance of a sample",
    "paths": "variance of a sample at a fixed place in the pixel",
    "places": "variance between places in the pixel",
    "places_error": "standard error of the variance between places",
    "reason": "why the variance is not split",
}


class FilmSplit(NamedTuple):
    """The variance of the samples of pixels, and its two parts.

    Attributes
    ----------
    paths, places
        Mean variance within the cells of the pixel, and variance between their means. Noise may
        make the latter negative.
    places_error
        Standard error of `places`.
    """

    paths: Floats
    places: Floats
    places_error: Floats


def film_split(
    samples: ImageLike, *, cells: int | None = None, progress: bool = True
) -> xr.Dataset:
    """Split the variance of each pixel's luminance by the places where its samples fell.

    Parameters
    ----------
    samples
        Samples rendered with ``film=True``.
    cells
        Cells k along each edge of the pixel: 2, 4, 8 or 16; None for as many as hold 12 samples
        each.
    progress
        Show progress: a bar in a terminal or notebook, elsewhere a line every ten seconds.

    Returns
    -------
    xarray.Dataset
        ``variance`` of a sample, ``paths``, ``places`` and ``places_error``, all (y, x) in squared
        radiance; NaN where ``reason`` says why. The parts add up to the variance within their
        noise. ``attrs["cells"]`` is k.

    Raises
    ------
    InputError
        If the samples were rendered without, or are fewer than two for each cell.

    References
    ----------
    Elek, Thomas and Forbes, "Learning Patterns in Sample Distributions for Monte Carlo Variance
    Reduction", 2019. Variance of stratified sampling: Cochran, "Sampling Techniques", 1977.

    Examples
    --------
    >>> import chdstat as chd
    >>> scene = {"scene": "cornell-box", "spp": 64, "size": (8, 8), "backend": "scalar"}
    >>> found = film_split(chd.render(**scene, film=True))
    >>> found.attrs["cells"], sorted(found.data_vars)
    (2, ['paths', 'places', 'places_error', 'reason', 'variance'])
    """
    image = samples_of(samples)
    if image.film is None:
        message = "these samples do not say where they fell; render them with film=True (--film)"
        raise InputError(message)
    k = _cells_for(image.film.spp) if cells is None else cells
    if k not in _CELLS:
        message = f"cells must be one of {', '.join(map(str, _CELLS))}, got {cells!r}"
        raise InputError(message)
    if image.film.spp < 2 * k * k:
        message = f"expected at least {2 * k * k} samples for {k} x {k} cells, got {image.film.spp}"
        raise InputError(message)

    def of_tile(tile: Samples, _: object) -> Mapped:
        assert tile.film is not None, "parts are cut like their samples"
        block, places = tile.read(ss=slice(tile.film.spp)), tile.film.read()
        bad = is_bad(block).any(axis=2) | np.isnan(places).any(axis=2)
        x = np.where(bad, np.nan, luminance(block.astype(np.float64)))
        count = (~bad).sum(axis=-1)
        with np.errstate(invalid="ignore", divide="ignore"):
            total = np.nansum(x, axis=-1)
            deviations = np.where(bad, 0, x - (total / count)[..., np.newaxis])
            variance = (deviations**2).sum(axis=-1) / (count - 1)
        found = split_by_place(x, places, k)
        reason = first_of(
            {
                Reason.ALL_BAD: count == 0,
                Reason.ALL_NULL: (total == 0) & (variance == 0),
                Reason.TOO_FEW: ~np.isfinite(found.places_error),
            }
        )
        usable = reason == Reason.OK
        named = {"variance": variance, **found._asdict()}
        maps: Mapped = {
            name: ((), np.where(usable, value, np.nan).astype(np.float32))
            for name, value in named.items()
        }
        return {**maps, "reason": ((), reason)}

    split = over_tiles(
        image,
        of_tile,
        tiles(image.shape),
        description="splitting the variance",
        progress=progress,
    )
    return label_variables(split, _SAID).assign_attrs(cells=k)


def _cells_for(spp: int) -> int:
    """Return the cells along each edge of a pixel that so many samples tell apart.

    Examples
    --------
    >>> [_cells_for(spp) for spp in (8, 64, 256, 1024, 100_000)]
    [2, 2, 4, 8, 16]
    """
    return max((k for k in _CELLS if k * k * _IN_A_CELL <= spp), default=_CELLS[0])


def split_by_place(
    x: npt.NDArray[np.floating], places: npt.NDArray[np.floating], k: int
) -> FilmSplit:
    """Split the variance of samples by the cells of the pixel in which they fell.

    All cells have the same probability, 1/k², since samples fall everywhere in a pixel alike. The
    mean square of the cells' means is above its true value by their noise, which is subtracted.
    Cells with fewer than two samples are left out.

    Parameters
    ----------
    x
        Samples, shape (..., sample); NaN for bad ones.
    places
        Places in the pixel from 0 to 1, shape (..., 2, sample).
    k
        Cells along each edge.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> places = rng.random((2, 4096))
    >>> found = split_by_place(places[0] + rng.normal(size=4096), places, 8)
    >>> round(float(found.paths), 1), round(float(found.places * 12), 1)  # a ramp: 1/12
    (1.0, 1.0)
    """
    *shape, spp = x.shape
    rows = math.prod(shape)
    flat = np.reshape(x, (rows, spp)).astype(np.float64)
    good = np.isfinite(flat)
    with np.errstate(invalid="ignore", divide="ignore"):
        centre = np.where(good, flat, 0).sum(axis=-1) / good.sum(axis=-1)
    flat = np.where(good, flat - centre[:, np.newaxis], 0)
    at = np.nan_to_num(np.reshape(places, (rows, 2, spp)))
    cell = np.clip((at * k).astype(np.intp), 0, k - 1)
    group = np.arange(spp) * _GROUPS // spp
    index = (np.arange(rows)[:, np.newaxis] * _GROUPS + group) * k * k + cell[:, 1] * k + cell[:, 0]
    sums = np.stack(
        [
            np.bincount(index.ravel(), weights.ravel(), rows * _GROUPS * k * k)
            for weights in (good.astype(np.float64), flat, flat**2)
        ]
    ).reshape(3, rows, _GROUPS, k * k)
    whole_sums = sums.sum(axis=2)
    within, between = _of_cells(whole_sums)
    without = _of_cells(whole_sums[:, :, np.newaxis] - sums)[1]
    spread = ((without - without.mean(axis=-1, keepdims=True)) ** 2).sum(axis=-1)
    error = np.sqrt(spread * (_GROUPS - 1) / _GROUPS)
    return FilmSplit(*(found.reshape(shape) for found in (within, between, error)))


def _of_cells(sums: Floats) -> tuple[Floats, Floats]:
    """Return the variance within cells and between them, from counts, sums and sums of squares.

    `sums` is (3, ..., cell).
    """
    n = sums[0]
    known = n >= 2
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.where(known, sums[1] / n, 0)
        variance = np.where(known, (sums[2] - n * mean**2) / (n - 1), 0)
        noise = np.where(known, variance / n, 0)
    count = known.sum(axis=-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        within = variance.sum(axis=-1) / count
        squares = (mean**2 - noise).sum(axis=-1) / count
        square = (mean.sum(axis=-1) ** 2 - noise.sum(axis=-1)) / count**2
    return within, squares - square
