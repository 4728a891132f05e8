"""Film split: how much of a pixel's variance is between places within it, how much of its paths.

The variance of a sample is the mean of its variance at a fixed place in the pixel, which the paths
make, and the variance of the radiance over the pixel (the law of total variance; Elek et al. 2019,
equation 4 and after). The pixel is cut into k x k cells. What differs between the means of cells
is what a stratified sampler, or a filter that knew the image, could take; what differs within a
cell counts as of the paths.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np
import numpy.typing as npt
from scipy import special

from chdstat._core.arrays import Counts, Floats, chunks, first_of
from chdstat._core.display import percent, reasons, step_of, with_interval
from chdstat._core.positive import CONSTANT_SPREAD, PositivePart
from chdstat._core.statistic import MapKind, Quantity, Result, Statistic, result, variable
from chdstat.errors import InputError, Reason
from chdstat.samples import ImageLike, Samples, samples_of
from chdstat.summary.runner import run

if TYPE_CHECKING:
    import xarray as xr

_IN_A_CELL = 12
"""Samples that a cell should hold on average."""
_CELLS = 2, 4, 8, 16
"""Cells along the edge of a pixel; no step of the places that are kept lies in two of them."""
_GROUPS = 8
"""Groups of samples, each of which is left out once for standard errors."""
_T = float(special.stdtrit(_GROUPS - 1, 0.975))
"""Half of an interval at 95 %, in standard errors."""
_LEVEL = 0.05
"""False discovery rate over an image, and level of one pixel."""
_MOST_SEEN = 8
"""Most cells along each edge of a pixel of which a picture shows the means."""
_UNIT = "(W sr-1 m-2)2"


@result
class FilmSplit(Result):
    """The variance of the samples of pixels, and its two parts; NaN where `reason` says why.

    Attributes
    ----------
    variance
        Variance of a sample.
    paths, places
        Mean variance within the cells of the pixel, and variance between their means. Noise may
        make the latter negative.
    places_error
        Standard error of `places`.
    places_limit
        Variance between places that ever smaller cells would have, as at edges: twice `places` less
        that of cells twice as large, since an edge through cells hides 1/k of its variance in them.
        It is noisier, and for sums over pixels.
    share, share_interval
        Share of `places` in the sum of both, and its 95 % interval, shape (..., 2). Where samples
        miss rare bright paths, which belong to `paths`, only the upper end holds; where they miss a
        small bright part of the pixel, only the lower end.
    p_value
        Of radiance that does not depend on the place.
    cells
        Cells k along each edge.
    """

    variance: Floats = variable("variance of a sample", unit=_UNIT)
    paths: Floats = variable("variance of a sample at a fixed place in the pixel", unit=_UNIT)
    places: Floats = variable("variance between places in the pixel", unit=_UNIT)
    places_error: Floats = variable("standard error of the variance between places", unit=_UNIT)
    places_limit: Floats = variable("variance between places, of ever smaller cells", unit=_UNIT)
    share: Floats = variable("share of the variance that is between places in the pixel")
    share_interval: Floats = variable("95 % interval of the share between places", "bound")
    p_value: Floats = variable(
        "p-value of radiance that does not depend on the place in the pixel", pooled=True,
        rejected="whether radiance depends on the place in the pixel",
    )  # fmt: skip
    reason: npt.NDArray[np.int8] = variable("why the variance is not split")
    cells: int

    def in_words(self, row: int, *, holds: bool = True) -> str:
        """Return what a row's variance comes from; `holds` says whether its error bar is trusted.

        Examples
        --------
        >>> rng = np.random.default_rng(0)
        >>> places = rng.random((1, 2, 1024))
        >>> x = 4.0 * (places[:, 0] > 0.5) + rng.gamma(2.0, size=(1, 1024))
        >>> split_by_place(x, places, 8).in_words(0).partition("]")[2][:41]
        ' is the picture changing within the pixel'
        """
        if self.reason[row] != Reason.OK:
            return f"cannot be told: {reasons(self.reason[row])}"
        low, high = map(float, self.share_interval[row])
        most = percent(high, step=step_of(low, high))
        between = f"between its {self.cells} × {self.cells} parts"
        if self.p_value[row] > _LEVEL:
            return f"no change of the picture within the pixel is seen: {between}, at most {most}"
        share = with_interval(max(float(self.share[row]), 0.0), low, high, percent)
        if holds:
            return (
                f"{share} is the picture changing within the pixel, {between}, which strata take "
                "away; the rest is of paths, or of finer changes"
            )
        return (
            f"{share} of what the samples show is the picture changing within the pixel, {between};"
            " bright paths that they may miss would leave less"
        )


def _in_words(found: FilmSplit, row: int) -> str:
    low, high = map(float, found.share_interval[row])
    return with_interval(float(found.share[row]), low, high, percent)


@dataclass(frozen=True)
class VarianceByPlace(Statistic[FilmSplit]):
    """How much of the variance is between places in the pixel, for so many cells along its edges.

    `alpha` is the false discovery rate over an image.
    """

    result: ClassVar = FilmSplit
    description: ClassVar = "splitting the variance"
    rows: ClassVar = "luminance"
    logarithms: ClassVar = False
    film: ClassVar = True
    quantities: ClassVar = (Quantity("of the variance, within the pixel", _in_words),)

    cells: int = 4
    alpha: float = _LEVEL

    @classmethod
    def of_pixel(cls, spp: int) -> Self | None:
        """Return the statistic for as many cells as so many samples tell apart."""
        return cls(_cells_for(spp)) if spp >= 2 * min(_CELLS) ** 2 else None

    def maps(self) -> tuple[MapKind, ...]:
        """Return the share of the variance that is between places, where that is significant."""

        def significant(found: FilmSplit) -> Floats:
            return np.where(found.p_value <= self.alpha, found.share, np.nan)

        unit = "share of the variance of luminance"
        title, decided = "Variation within the pixel", "share_told"
        return (MapKind("film", title, unit, significant, ends=(0, 1), decided=decided),)

    def attrs(self) -> dict[str, Any]:
        """Return the number of cells along each edge."""
        return {"cells": self.cells}

    def measure(self, part: PositivePart) -> FilmSplit:
        """Split the variance of each row."""
        assert part.places is not None, "run and its callers give places to statistics of film"
        return split_by_place(part.x, np.stack(part.places, axis=-2), self.cells)

    def finish(self, dataset: xr.Dataset) -> xr.Dataset:
        """Also say where the share is significant over the image."""
        found = super().finish(dataset)
        told = found["share"].where(found["rejected"] == 1)
        return found.assign(share_told=told.assign_attrs(long_name=_TOLD, units="1"))


_TOLD = "share of the variance that is between places in the pixel, where it is significant"


def film_split(
    samples: ImageLike, *, cells: int | None = None, progress: bool = True
) -> xr.Dataset:
    """Split the variance of each pixel's luminance by the places where its samples fell.

    By the law of total variance, the variance of a sample is E[Var[L | u]] + Var[E[L | u]] for the
    place u in the pixel: the variance of paths, and the variation of radiance within the pixel
    (Elek et al. 2019, after equation 4). The pixel is cut into k x k cells. What varies within a
    cell counts as of paths: ``places`` is without bias what k x k strata take, and on average less
    than all variation within the pixel, by 1/k² of a ramp's, and by up to 1/k of an edge's.

    Parameters
    ----------
    samples
        Samples rendered with ``film=True``, or recorded or given with film; independent ones, with
        a box filter of one pixel.
    cells
        Cells k along each edge of the pixel: 2, 4, 8 or 16; None for as many as hold 12 samples
        each, in a pixel with the median number.
    progress
        Show progress: a bar in a terminal or notebook, elsewhere a line every ten seconds.

    Returns
    -------
    xarray.Dataset
        ``variance`` of a sample, ``paths``, ``places`` and ``places_error``, all (y, x) in squared
        radiance; NaN where ``reason`` says why. The parts add up to the variance within their
        noise; two ``places_error`` hold what k x k strata take in 89 to 99 % of pixels, from 64 to
        1024 spp, also with long tails; but in two thirds, if a hundredth of the pixel is so bright
        that it decides. ``places_limit`` extrapolates ``places`` to ever smaller
        cells, for sums over pixels. ``share`` is that of ``places``, with a 95 %
        ``share_interval`` (bound) by leaving groups of samples out; where samples miss rare bright
        paths, only its upper end holds, and where they miss a small bright part of the pixel, only
        the lower one.
        ``p_value`` is of radiance that does not depend on the place, neither in its mean nor in its
        noise: where noise alone does, up to a fifth of the pixels are below .05, with intervals
        from 0. ``share_told`` is the share
        where that is rejected over the image, at a false discovery rate of 5 %.
        ``attrs["cells"]`` is k.

    Raises
    ------
    InputError
        If the samples were rendered without, are fewer than two for each cell, or depend on each
        other, as those of samplers that spread them: pairs of such samples tell other variances.

    References
    ----------
    Elek, Thomas and Forbes, "Learning Patterns in Sample Distributions for Monte Carlo Variance
    Reduction", 2019. Variance of stratified sampling: Cochran, "Sampling Techniques", 1977. Errors:
    the jackknife (Efron and Stein, "The jackknife estimate of variance", 1981,
    doi:10.1214/aos/1176345462) of eight groups of samples.

    Examples
    --------
    >>> import chdstat as chd
    >>> scene = {"scene": "cornell-box", "spp": 64, "size": (8, 8), "backend": "scalar"}
    >>> found = film_split(chd.render(**scene, film=True))
    >>> found.attrs["cells"], found["share"].shape, float(found["share"][4, 4]) < 1
    (2, (8, 8), True)
    """
    image = samples_of(samples)
    spp = image.spp if image.film is None else image.film.spp
    k = _cells_for(_typical_spp(image)) if cells is None else cells
    if k not in _CELLS:
        message = f"cells must be one of {', '.join(map(str, _CELLS))}, got {cells!r}"
        raise InputError(message)
    if spp < 2 * k * k:
        message = f"expected at least {2 * k * k} samples for {k} x {k} cells, got {spp}"
        raise InputError(message)
    statistic: Statistic[Any] = VarianceByPlace(k)
    found: xr.Dataset = run(statistic, image, progress=progress)
    return found


def film_statistic(samples: Samples) -> VarianceByPlace | None:
    """Return the statistic for samples; None if they do not say where they fell, or are too few."""
    return None if samples.film is None else VarianceByPlace.of_pixel(_typical_spp(samples))


def _typical_spp(samples: Samples) -> int:
    """Return how many samples most pixels have of which it may be known where they fell."""
    counts = samples.counts
    return int(np.median(counts if samples.film is None else counts.clip(max=samples.film.spp)))


def means_by_place(
    x: npt.NDArray[np.floating], places: npt.NDArray[np.floating]
) -> tuple[Floats, Counts]:
    """Return mean radiance by the cell of a pixel in which samples fell, and how many did.

    Parameters
    ----------
    x
        Samples of a pixel, shape (row, sample); NaN or infinite for bad ones.
    places
        Where they fell, from 0 to 1 across and down, shape (2, sample).

    Returns
    -------
    means : ndarray
        Shape (row, k, k), from the top left; NaN where no sample fell.
    counts : ndarray
        Shape (k, k). There are as many cells as the samples tell apart, at most 8 x 8.

    Examples
    --------
    >>> places = np.random.default_rng(0).random((2, 64))
    >>> means, counts = means_by_place(1.0 * (places[:1] > 0.5), places)
    >>> means[0].tolist(), int(counts.sum())
    ([[0.0, 1.0], [0.0, 1.0]], 64)
    """
    good = np.isfinite(x).all(axis=0) & np.isfinite(places).all(axis=0)
    k = min(_cells_for(int(good.sum())), _MOST_SEEN)
    across, down = np.clip((places[:, good] * k).astype(np.intp), 0, k - 1)
    cell = down * k + across
    counts = np.bincount(cell, minlength=k * k)
    sums = np.stack([np.bincount(cell, row, k * k) for row in x[:, good].astype(np.float64)])
    with np.errstate(invalid="ignore", divide="ignore"):
        return (sums / counts).reshape(-1, k, k), counts.reshape(k, k)


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
    flat, at = np.reshape(x, (-1, spp)), np.reshape(places, (-1, 2, spp))
    parts = [_cell_sums(flat[part], at[part], k) for part in chunks(len(flat), spp)]
    sums, of_rows = (np.concatenate(found, axis=1) for found in zip(*parts, strict=True))
    count, mean, squares, fourth = of_rows
    whole = sums.sum(axis=2)
    within, between = _of_cells(whole)
    left_out = _of_cells(whole[:, :, np.newaxis] - sums)
    with np.errstate(invalid="ignore", divide="ignore"):
        share, shares = (b / (w + b) for w, b in ((within, between), left_out))
        margin = _T * _jackknifed(shares)
        interval = np.clip(np.stack([share - margin, share + margin], axis=-1), 0, 1)
        p_value = _of_permutations(whole[0], whole[1], squares, fourth)
        variance = squares / (count - 1)
        constant = variance <= (CONSTANT_SPREAD * mean) ** 2
    error = _jackknifed(left_out[1])
    limit = 2 * between - _of_cells(_coarse(whole, k))[1]
    numbers = (variance, within, between, error, limit, share, interval, p_value)
    reason = first_of(
        {
            Reason.ALL_BAD: count == 0,
            Reason.ALL_NULL: (mean == 0) & (variance == 0),
            Reason.CONSTANT: constant,
            Reason.TOO_FEW: ~np.isfinite(sum(v.reshape(len(v), -1).sum(axis=1) for v in numbers)),
        }
    )
    for values in numbers:
        values[reason != Reason.OK] = np.nan
    found = [v.reshape((*shape, *v.shape[1:])) for v in (*numbers, reason)]
    fields: list[Any] = [*found, k]
    return FilmSplit(*fields)


def _cell_sums(
    x: npt.NDArray[np.floating], places: npt.NDArray[np.floating], k: int
) -> tuple[Floats, Floats]:
    """Return sums of the samples of rows, less the mean of their row.

    That is, by group and cell, their number, their sum and that of their squares, shape (3, row,
    group, cell); and for each row their number, their mean, and the sums of their squares and
    fourth powers, shape (4, row).
    """
    rows, spp = x.shape
    good = np.isfinite(x + places.sum(axis=1))
    flat = np.where(good, x, 0).astype(np.float64)
    count = good.sum(axis=-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = flat.sum(axis=-1) / count
        flat = np.where(good, flat - mean[:, np.newaxis], 0)
    cell = np.clip((np.nan_to_num(places) * k).astype(np.intp), 0, k - 1)
    group = np.arange(spp) % _GROUPS  # in turns, since pixels may have the first samples only
    index = (np.arange(rows)[:, np.newaxis] * _GROUPS + group) * k * k + cell[:, 1] * k + cell[:, 0]
    squared = flat**2
    sums = [
        np.bincount(index.ravel(), weights.ravel(), rows * _GROUPS * k * k)
        for weights in (good.astype(np.float64), flat, squared)
    ]
    of_rows = [count, mean, squared.sum(axis=-1), np.vecdot(squared, squared)]
    return np.reshape(sums, (3, rows, _GROUPS, k * k)), np.stack(of_rows).astype(np.float64)


def _coarse(sums: Floats, k: int) -> Floats:
    """Return the sums of cells twice as large, of those of k x k cells, (3, row, cell)."""
    fine = sums.reshape(*sums.shape[:2], k // 2, 2, k // 2, 2)
    return np.asarray(fine.sum(axis=(3, 5)).reshape(*sums.shape[:2], -1))


def _jackknifed(found: Floats) -> Floats:
    """Return the standard error of a number from those without one group each, (..., group)."""
    spread = ((found - found.mean(axis=-1, keepdims=True)) ** 2).sum(axis=-1)
    return np.asarray(np.sqrt(spread * (_GROUPS - 1) / _GROUPS))


def _of_permutations(n: Floats, sums: Floats, squares: Floats, fourth: Floats) -> Floats:
    """Return p-values of the share of the squares that cells explain, (row,).

    `n` and `sums` of samples without their mean are of cells, (row, cell); `squares` and `fourth`
    are the sums of their squares and fourth powers. If radiance does not depend on the place, all
    orders of the samples are as likely. A beta distribution has the mean and the variance that the
    share has over all of them, which are exact: Pitman, "Significance tests which may be applied to
    samples from any populations, III", 1938, doi:10.1093/biomet/29.3-4.322. The F-test knows of no
    long tails.
    """
    k, total = (n > 0).sum(axis=-1), n.sum(axis=-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        h, explained = (np.where(n > 0, v / n, 0).sum(axis=-1) for v in (1, sums**2))
        four = fourth / squares**2
        pairs = total * (total - 1)
        triples, quadruples = pairs * (total - 2), pairs * (total - 2) * (total - 3)
        # How often each product of four samples is in the square of what is explained, by which of
        # them are the same sample, and its mean over all orders.
        twos, threes = k - h, total - 3 * k + 2 * h
        square = (
            h * four / total
            + (k**2 - h + 2 * twos) * (1 - four) / pairs
            - 4 * twos * four / pairs
            + (2 * k * (total - k) - 4 * twos + 4 * threes) * (2 * four - 1) / triples
            + ((total - k) ** 2 - 2 * twos - 4 * threes) * (3 - 6 * four) / quadruples
        )
        mean = (k - 1) / (total - 1)
        a = mean * (mean * (1 - mean) / (square - mean**2) - 1)
        b = a * (1 - mean) / mean
        return np.asarray(special.betaincc(a, b, np.clip(explained / squares, 0, 1)))


def _of_cells(sums: Floats) -> tuple[Floats, Floats]:
    """Return the variance within cells and between them, from counts, sums and sums of squares.

    `sums` is (3, ..., cell). Which cells hold enough samples does not depend on the light, so that
    these stand for all. Some of them differ less from each other than all do: for c of k, by
    (1 - 1 / c) / (1 - 1 / k).
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
        of_all = np.where(known.all(axis=-1), 1, (1 - 1 / n.shape[-1]) / (1 - 1 / count))
        return within, (squares - square) * of_all
