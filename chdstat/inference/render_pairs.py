"""Pairs of renders: the terms by which they are compared, and what is counted beside them.

Term k of a pixel is the mean of the samples k, k + K, k + 2 K ... of B, minus that of A. So sample
i of both lies in one term, which pairs renders that share random numbers, however many samples
each has.

Renders of unequal numbers of samples are also compared by units, which are averages of as many
samples in both: if both renders are of one distribution, any of all units may as well be A's.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import LUMINANCE, Floats, LeftOut, all_good, is_bad, spans
from chdstat._core.display import number
from chdstat._core.reasons import first_of
from chdstat._core.resampling import q_values
from chdstat.errors import InputError, Reason
from chdstat.inference.permutation import Shuffles, p_of_means
from chdstat.inference.sign_flips import CellUnits, FlipMoments, guarded, p_of_signs
from chdstat.io.exr import ExrImage, read_exr
from chdstat.samples import Samples, samples_of
from chdstat.samples.tiles import sequence_of

__all__ = ["Compared", "Pair"]

_TERMS = 256
"""Terms of a pixel at most: of more samples, batches are averaged."""
_UNITS, _TIMES = 1024, 16
"""Units of the longer render at most: so many, or so many times as many as the other has; more
change the standard error of the difference by less than 3 %."""
_DOUBTED = 0.1
"""Pixels with p-values up to this are compared by units, too."""
_AT_ONCE = 2**22
_ROUNDING = 1e-3
"""Relative precision of half floats."""
_CELLS, _LEAST_CELL = 32, 4
"""Cells along the longer edge of the image, and pixels along theirs, the latter at least."""


@dataclass(frozen=True)
class Compared:
    """What was measured of a pair of renders.

    Attributes
    ----------
    bands
        Their names: luminance first, where there are R, G and B.
    mean_a, mean_b
        Means of all good samples, shape (y, x, band).
    p_value, standard_error
        Of the difference of the means, shape (y, x, band).
    variance_a, variance_b
        Of a sample's luminance, shape (y, x); NaN where it is unknown.
    correlation
        Of terms of A and B, shape (y, x).
    reason
        Why a pixel has no p-value, shape (y, x).
    cell
        Edge of a cell in pixels.
    differences, levels
        Sums of terms, and of the means of A and B that go with them, over the pixels of each cell,
        shape (band, y, x, term).
    units
        The same of units, if the renders differ in their numbers of samples.
    """

    bands: tuple[str, ...]
    mean_a: Floats
    mean_b: Floats
    p_value: Floats
    standard_error: Floats
    variance_a: Floats
    variance_b: Floats
    correlation: Floats
    reason: npt.NDArray[np.int8]
    cell: int
    differences: npt.NDArray[np.float32]
    levels: npt.NDArray[np.float32]
    units: CellUnits | None


@dataclass(frozen=True)
class Pair:
    """Two renders, or one and an exact image, and how many samples of each are compared."""

    a: Samples
    b: Samples | Floats
    names: tuple[str, str]
    spp: tuple[int, int]
    seconds: tuple[float, float]
    paired: bool

    @classmethod
    def of(cls, one: Any, two: Any, seconds: float | None) -> Pair:
        """Return a pair with as many samples as each renders in some seconds, or has."""
        a, b = _independent(one), _other(two)
        _check_sizes(a, b)
        names = _name(one, a), _name(two, b)
        times = _seconds_of(a), _seconds_of(b)
        if not isinstance(b, Samples):
            count = a.spp if seconds is None else _count_in(seconds, times[0], a.spp, "A")
            return cls(a, b, names, (count, count), _each(times, a, b), paired=False)
        paired = a.shares_numbers_with(b)
        if seconds is not None:
            counts = [
                _count_in(seconds, time, x.spp, name)
                for time, x, name in zip(times, (a, b), "AB", strict=True)
            ]
        else:
            counts = [min(a.spp, b.spp)] * 2 if paired else [a.spp, b.spp]
        return cls(a, b, names, (counts[0], counts[1]), _each(times, a, b), paired)

    @property
    def terms(self) -> int:
        """Number of terms of a pixel."""
        least = min(self.spp)
        return least // -(-least // _TERMS)

    @property
    def units(self) -> tuple[int, int]:
        """Numbers of units of A and B that are compared; 0 where their numbers of samples agree."""
        exact = not isinstance(self.b, Samples)
        if exact or self.spp[0] == self.spp[1] or _averaged(self.a) != _averaged(self.b):
            return 0, 0
        most = max(_UNITS, _TIMES * self.terms)
        one, other = (min(spp // self.unit_size, most) for spp in self.spp)
        return one, other

    @property
    def unit_size(self) -> int:
        """Number of samples of a unit."""
        return min(self.spp) // self.terms

    def unit_numbers(self, i: int) -> npt.NDArray[np.int64]:
        """Return to which unit of A (0) or B (1) each of its first samples belongs.

        Sample k of both is in term k and so in the first units, as far as these go.
        """
        block, within = np.divmod(
            np.arange(self.units[i] * self.unit_size), self.terms * self.unit_size
        )
        width = np.minimum(self.terms, self.units[i] - block * self.terms)
        return np.asarray(block * self.terms + within % width)

    def compare(self) -> Compared:
        """Read the samples once, and return what was measured."""
        height, width, channels, _ = self.a.shape
        bands = (*(("luminance",) if channels == 3 else ()), *self.a.channels)
        cell = min(max(_LEAST_CELL, -(-max(height, width) // _CELLS)), max(1, min(height, width)))
        in_memory = self.terms + sum(self.units)
        rows = max(1, _AT_ONCE // (width * len(bands) * in_memory * cell)) * cell
        left_out = LeftOut()
        tiles = [self._tile(ys, cell, left_out) for ys in spans(height, rows)]
        left_out.warn()
        whole: dict[str, Any] = {
            name: np.concatenate([tile[name] for tile in tiles], axis=axis)
            for name, axis in ((n, 1 if n in _OF_CELLS else 0) for n in tiles[0] if n != "moments")
        }
        mean = (whole["mean_a"] + whole["mean_b"]) / 2
        p = whole.pop("p_value")
        exact = whole.pop("exact")
        for band in range(len(bands)):
            moments = _joined([tile["moments"][band] for tile in tiles], mean[..., band])
            p[..., band] = guarded(p[..., band], moments, exact[..., band])
        units = None
        if all(self.units):
            of_units = whole.pop("units"), whole.pop("unit_levels")
            units = CellUnits(*of_units, short=min(self.units), size=self.unit_size)
        return Compared(bands=bands, cell=cell, p_value=p, units=units, **whole)

    def shapes(self, seed: int) -> dict[str, Any]:
        """Return maps of p- and q-values of equal variances and equal distributions of luminance.

        NaN where a sample is missing, or B is exact.
        """
        return {
            f"{name}_{kind}_value": (
                ("y", "x"),
                p if kind == "p" else q_values(p),
                {"long_name": f"{kind}-value of equal {name}s of luminance", "units": "1"},
            )
            for name, p in self._p_of_shapes(seed).items()
            for kind in ("p", "q")
        }

    def _p_of_shapes(self, seed: int) -> dict[str, Floats]:
        size = self.a.shape[:2]
        found = {name: np.full(size, np.nan) for name in ("variance", "distribution")}
        if isinstance(self.b, Samples) and _averaged(self.a) != _averaged(self.b):
            message = (
                f"distributions of averages of {_averaged(self.a)} and {_averaged(self.b)} samples "
                "differ whatever is averaged: contrast the means alone, or as many samples in both"
            )
            raise InputError(message)
        if not isinstance(self.b, Samples):
            return found
        shuffles = Shuffles.draw(self.spp, seed, paired=self.paired)
        rows = max(1, _AT_ONCE // (size[1] * sum(self.spp)))
        for ys in spans(size[0], rows):
            read = (self.a.read(ys, ss=slice(self.spp[0])), self.b.read(ys, ss=slice(self.spp[1])))
            one, other = (_luminance(x).reshape(-1, x.shape[-1]) for x in read)
            known = np.isfinite(one).all(axis=1) & np.isfinite(other).all(axis=1)
            for name, test in (
                ("variance", shuffles.p_of_variances),
                ("distribution", shuffles.p_of_distributions),
            ):
                p = np.full(len(one), np.nan)
                p[known] = test(one[known], other[known])
                found[name][ys] = p.reshape(found[name][ys].shape)
        return found

    def _tile(self, ys: slice, cell: int, left_out: LeftOut) -> dict[str, Any]:
        """Return what was measured in some rows."""
        read = _Sums.of(self, ys, left_out)
        one, other = read.means()
        terms = self.terms
        missing = ((read.number[0] == 0) | (read.number[1] == 0))[:, :, np.newaxis]
        if missing.any():
            one, other = np.where(missing, 0, one), np.where(missing, 0, other)
        one, other = _with_luminance(one), _with_luminance(other)
        d = other - one
        known = terms - missing.sum(axis=-1)
        mean_a, mean_b = (_with_luminance(m[..., np.newaxis])[..., 0] for m in read.totals())
        exact = (np.ptp(one, axis=-1) == 0) & (np.ptp(other, axis=-1) == 0)
        # Of lamps, which are constant, files and sums keep so many digits only.
        d[exact & (np.abs(d[..., 0]) <= _ROUNDING * np.abs(one[..., 0]))] = 0
        bands = range(d.shape[2])
        level = (mean_a + mean_b) / 2
        p = np.stack(
            [p_of_signs(d[:, :, i].reshape(-1, terms)).reshape(d.shape[:2]) for i in bands], axis=-1
        )
        of_units = self._of_units(read, p, cell) if all(self.units) else {}
        p[(known < 2)[..., 0]] = np.nan
        with np.errstate(invalid="ignore", divide="ignore"):
            error = d.std(axis=-1, dtype=float) / np.sqrt(np.maximum(known - 1, 0))
        nothing = (one == 0).all(axis=(2, 3)) & (other == 0).all(axis=(2, 3))
        reason = first_of(
            {
                Reason.ALL_BAD: known[..., 0] == 0,
                Reason.TOO_FEW: known[..., 0] < 2,
                Reason.ALL_NULL: nothing,
                Reason.CONSTANT: np.isnan(p).all(axis=-1),
            }
        )
        variance_a, variance_b = read.variances()
        return {
            "mean_a": mean_a,
            "mean_b": mean_b,
            "p_value": p,
            "exact": exact,
            "standard_error": error,
            "variance_a": variance_a,
            "variance_b": variance_b,
            "correlation": _correlation(one[:, :, 0], other[:, :, 0]),
            "reason": reason,
            "differences": _cells(d, cell),
            "levels": _cells(one + other, cell) / 2,
            "moments": [FlipMoments.of(d[:, :, i], level[..., i]) for i in bands],
            **of_units,
        }

    def _of_units(self, read: _Sums, p: Floats, cell: int) -> dict[str, Any]:
        """Return sums of units over cells; p-values (y, x, band) that they doubt are replaced."""
        short = min(self.units)
        order = (0, 1) if self.units[0] == short else (1, 0)
        total, number = (
            np.concatenate([x[i] for i in order], axis=-1)
            for x in (read.unit_total, read.unit_number)
        )
        x, good = _with_luminance(total / np.maximum(number, 1)[:, :, np.newaxis]), number > 0
        for band in range(x.shape[2]):
            doubted = p[..., band] <= _DOUBTED
            rows, known = x[:, :, band][doubted], good[doubted]
            found = p_of_means(rows[:, :short], rows[:, short:], known[:, :short], known[:, short:])
            p[doubted, band] = np.fmax(p[doubted, band], found)
        number_of_good = np.maximum(good.sum(axis=-1), 1)[:, :, np.newaxis, np.newaxis]
        level = (x.sum(axis=-1, keepdims=True, dtype=float) / number_of_good).astype(x.dtype)
        x = np.where(good[:, :, np.newaxis], x - level, 0)
        return {"units": _cells(x, cell), "unit_levels": _cells(level, cell)}


_OF_CELLS = ("differences", "levels", "units", "unit_levels")


@dataclass(frozen=True)
class _Sums:
    """Sums of samples of both renders over the terms of some rows.

    `total` has shape (y, x, channel, term), `number` (y, x, term), `first` and `second`, sums of
    luminance and of its squares, (y, x), each for A and B. Of an exact image, `number` is 1.
    `unit_total` and `unit_number` are those of units.
    """

    total: list[Any]
    number: list[Any]
    first: list[Any]
    second: list[Any]
    averaged: list[int]
    exact: bool
    unit_total: list[Any]
    unit_number: list[Any]

    @classmethod
    def of(cls, pair: Pair, ys: slice, left_out: LeftOut) -> _Sums:
        """Read the samples of some rows."""
        renders = [x for x in (pair.a, pair.b) if isinstance(x, Samples)]
        height = len(range(pair.a.shape[0])[ys])
        shape = height, *pair.a.shape[1:3], pair.terms
        places = shape[:2]
        # Means of equal samples must not differ by rounding.
        total = [np.zeros(shape) for _ in renders]
        counted = [np.zeros((*places, pair.terms), np.int32) for _ in renders]
        first, second = ([np.zeros(places) for _ in renders] for _ in range(2))
        unit_total = [np.zeros((*shape[:3], n), np.float32) for n in pair.units if n]
        unit_number = [np.zeros((*places, n), np.int32) for n in pair.units if n]
        no_units = np.zeros(0, np.int64)
        numbers = [pair.unit_numbers(i) for i in range(len(unit_total))]
        for ss in spans(max(pair.spp), pair.terms):
            parts: dict[int, tuple[npt.NDArray[Any], Any]] = {}
            for i, samples in enumerate(renders):
                part = slice(ss.start, min(ss.stop, pair.spp[i]))
                if part.start < part.stop:
                    x = samples.read(ys, ss=part)
                    left_out.see(x, channel_axis=-2, absent=samples.absent(ys, ss=part))
                    parts[i] = x, None if all_good(x) else np.asarray(~is_bad(x).any(axis=2))
            if pair.paired and any(good is not None for _, good in parts.values()):
                both = np.logical_and.reduce(
                    [g for _, g in parts.values() if g is not None], axis=0
                )
                parts = {i: (x, both) for i, (x, _) in parts.items()}
            for i, (x, good) in parts.items():
                if good is not None:
                    x = np.where(good[:, :, np.newaxis], x, 0)
                size = x.shape[-1]
                total[i][..., :size] += x
                np.add(
                    counted[i][..., :size],
                    True if good is None else good,
                    out=counted[i][..., :size],
                )
                for own, to in _runs(numbers[i][ss] if numbers else no_units):
                    unit_total[i][..., to] += x[..., own]
                    unit_number[i][..., to] += True if good is None else good[..., own]
                bright = _luminance(x)
                first[i] += bright.sum(axis=-1, dtype=float)
                second[i] += np.einsum("yxs,yxs->yx", bright, bright, dtype=float)
        if not isinstance(pair.b, Samples):
            total.append(np.broadcast_to(pair.b[ys][..., np.newaxis], shape))
            known = np.asarray(np.isfinite(pair.b[ys]).all(axis=-1), dtype=np.int32)
            counted.append(known[..., np.newaxis])
        averaged = [_averaged(samples) for samples in renders]
        exact = not isinstance(pair.b, Samples)
        return cls(total, counted, first, second, averaged, exact, unit_total, unit_number)

    def means(self) -> tuple[npt.NDArray[Any], npt.NDArray[Any]]:
        """Return means of the samples of each term, of A and B, shape (y, x, channel, term)."""
        one, other = (
            (t / np.maximum(n, 1)[:, :, np.newaxis]).astype(np.float32)
            for t, n in zip(self.total, self.number, strict=True)
        )
        return one, other

    def totals(self) -> tuple[Floats, Floats]:
        """Return means of all samples, of A and B, shape (y, x, channel)."""
        with np.errstate(invalid="ignore", divide="ignore"):
            one, other = (
                t.sum(axis=-1, dtype=float) / n.sum(axis=-1)[..., np.newaxis]
                for t, n in zip(self.total, self.number, strict=True)
            )
        return (one, self.total[1][..., 0].astype(float)) if self.exact else (one, other)

    def variances(self) -> tuple[Floats, Floats]:
        """Return variances of single samples' luminance, of A and B, shape (y, x)."""
        found = []
        for one, two, n, each in zip(
            self.first, self.second, self.number, self.averaged, strict=False
        ):
            count = n.sum(axis=-1)
            with np.errstate(invalid="ignore", divide="ignore"):
                spread = (two - one**2 / count) / (count - 1) * each
            # What is left of equal samples is rounding.
            rounding = spread <= 1e-12 * two / np.maximum(count, 1)
            found.append(np.where(count > 1, np.where(rounding, 0, spread), np.nan))
        return (found[0], np.full_like(found[0], np.nan)) if self.exact else (found[0], found[1])


def _runs(numbers: npt.NDArray[np.int64]) -> Iterator[tuple[slice, slice]]:
    """Return where consecutive numbers stand, and which they are."""
    ends = np.flatnonzero(np.diff(numbers, append=-2) != 1) + 1
    for start, stop in zip([0, *ends], ends, strict=False):
        yield slice(start, stop), slice(numbers[start], numbers[stop - 1] + 1)


def _luminance(x: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return luminance of channels (y, x, channel, sample), their mean if they are not R, G, B."""
    weights = LUMINANCE if x.shape[2] == 3 else np.full(x.shape[2], 1 / x.shape[2], np.float32)
    return np.asarray(np.einsum("yxcs,c->yxs", x, weights.astype(x.dtype), optimize=True))


def _with_luminance(x: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return bands (y, x, band, ...): luminance before R, G and B; other channels as they are."""
    if x.shape[2] != 3:
        return x
    return np.concatenate([_luminance(x)[:, :, np.newaxis], x], axis=2)


def _cells(x: npt.NDArray[Any], cell: int) -> npt.NDArray[np.float32]:
    """Return sums of (y, x, band, term) over cells, shape (band, y, x, term)."""
    rows = np.add.reduceat(x, np.arange(0, x.shape[0], cell), axis=0)
    both = np.add.reduceat(rows, np.arange(0, x.shape[1], cell), axis=1)
    return np.moveaxis(both, 2, 0).astype(np.float32, copy=False)


def _correlation(a: npt.NDArray[Any], b: npt.NDArray[Any]) -> Floats:
    """Return correlations of terms (y, x, term), NaN where one is constant."""
    one, other = (x - x.mean(axis=-1, keepdims=True) for x in (a, b))
    product, first, second = (
        np.einsum("yxk,yxk->yx", u, v, dtype=float)
        for u, v in ((one, other), (one, one), (other, other))
    )
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(product / np.sqrt(first * second))


def _joined(parts: list[FlipMoments], mean: Floats) -> FlipMoments:
    """Return moments of consecutive rows as one."""
    arrays = {
        name: np.concatenate([getattr(part, name) for part in parts])
        for name in ("scale", "total", "square", "central2", "central3", "central6", "rarer")
    }
    return FlipMoments(n=parts[0].n, mean=np.nan_to_num(mean), **arrays)


def _other(b: Any) -> Samples | Floats:
    """Return samples, or an exact image (y, x, channel)."""
    if isinstance(b, str | Path) and Path(b).suffix.lower() == ".exr":
        b = read_exr(b)
    if isinstance(b, ExrImage):
        b = b.image
    if isinstance(b, Samples | str | Path) or np.ndim(b) != 3 or "sample" in getattr(b, "dims", ()):
        return _independent(b)
    return np.asarray(b, dtype=np.float64)


def _independent(source: Any) -> Samples:
    """Return samples or averages; of samples that depend on each other, averages that do not."""
    found = samples_of(source, averages=True, dependent=True)
    return found.sequence_means() if sequence_of(found.attrs) > 1 else found


def _each(times: tuple[float, float], a: Samples, b: Any) -> tuple[float, float]:
    """Return how long a single sample took, from the times of averages of some."""
    return times[0] / _averaged(a), times[1] / _averaged(b)


def _averaged(samples: Any) -> int:
    """Return how many samples each value is the average of."""
    return int(samples.attrs.get("averaged", 1)) if isinstance(samples, Samples) else 1


def _name(source: Any, samples: Any) -> str:
    of = f", averages of {_averaged(samples)}" if _averaged(samples) > 1 else ""
    if isinstance(source, str | Path):
        return f"{source}{of}"
    if isinstance(samples, Samples):
        return f"{samples.path or samples.name}{of}"
    return "image"


def _check_sizes(a: Samples, b: Samples | Floats) -> None:
    one, other = a.shape[:3], b.shape[:3]
    if one[:2] != other[:2]:
        message = (
            f"A has {one[1]} x {one[0]} pixels and B {other[1]} x {other[0]}: render both at one "
            "size, or cut them with isel(y=, x=)"
        )
        raise InputError(message)
    if one[2] != other[2]:
        message = f"expected as many channels in both, got {one[2]} in A and {other[2]} in B"
        raise InputError(message)


def _seconds_of(samples: Samples | Floats) -> float:
    """Return how long all pixels of a sample took to render."""
    total = samples.attrs.get("render_seconds") if isinstance(samples, Samples) else None
    return float(total) / samples.shape[3] if total else np.nan


def _count_in(seconds: float, each: float, most: int, name: str) -> int:
    if not (seconds > 0 and np.isfinite(seconds)):
        message = f"seconds must be above 0, got {seconds}"
        raise InputError(message)
    if not np.isfinite(each):
        message = (
            f"{name} does not say how long its rendering took, attrs['render_seconds']: give it to "
            "Samples.from_array, or compare without seconds"
        )
        raise InputError(message)
    count = int(seconds / each + 1e-9)
    if not 1 <= count <= most:
        message = (
            f"in {number(seconds)} s, {name} renders {count} samples per pixel, and it has {most}: "
            + ("render more of them" if count else "give more seconds")
        )
        raise InputError(message)
    return count
