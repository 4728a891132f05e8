"""Pairs of renders: the terms by which they are contrasted, and the sums over their samples.

Term k of a pixel is the mean of the samples k, k + K, k + 2 K ... of B, minus that of A. Sample i
of both renders thus lies in the same term. That pairs renders that share random numbers, for any
numbers of samples.

Renders with unequal numbers of samples are also contrasted by units. A unit is an average of the
same number of samples in both renders. If both renders have one distribution, any of the units may
be A's.

A `Reference` without batches does not show how rare its light is: a pixel whose samples are all
null may have missed light that comes in one of 1000 samples. `_unseen_variance` bounds how much the
samples of a pixel may vary beyond what they show, so that such a pixel is no evidence, whatever the
unit of radiance.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy import ndimage

from chdstat._core.arrays import (
    LUMINANCE,
    Array,
    Counts,
    Floats,
    Image,
    LeftOut,
    Mask,
    all_good,
    block_sums,
    first_of,
    is_bad,
    spans,
    warn_caller,
)
from chdstat._core.display import number
from chdstat._core.resampling import q_values
from chdstat.errors import InputError, Reason
from chdstat.inference.permutations import Shuffles, p_of_means, p_of_signs
from chdstat.inference.references import SINGLE, Reference
from chdstat.inference.windows import FEWEST_FLIPS, Cells, FlipMoments, guarded
from chdstat.samples import Samples, samples_of
from chdstat.samples.dependence import sequence_of
from chdstat.samples.ledger import PixelCounts

_NEAR = 11
"""Edge of the neighbourhood that shows how bright the samples of a pixel may be, in pixels."""
_ALIKE = 1 / 8
"""If neighbours lack so much of what a pixel lacks, they have not seen that light, either."""
_RAREST = 1 / 300
"""Light that neighbours have not seen, either, may come in so few samples."""


def _shrunk(d: Image, slack: Array, known: Array) -> Image:
    """Return differences without what rounding explains, which is no difference of a pixel."""
    shift: Array = np.clip(d.sum(axis=-1, dtype=float) / np.maximum(known, 1), -slack, slack)
    return d - shift.astype(d.dtype)[..., np.newaxis]


def _with_luminance(x: Array) -> Array:
    """Return bands (y, x, band, ...): luminance before R, G and B; other channels as they are."""
    if x.shape[2] != 3:
        return x
    light = np.einsum("yxc...,c->yx...", x, LUMINANCE.astype(x.dtype), optimize=True)
    return np.concatenate([light[:, :, np.newaxis], x], axis=2)


def _unseen_variance(
    mean: Floats, variance: Floats, shift: Floats, lowest: Floats, highest: Floats
) -> tuple[Floats, Mask]:
    """Return how much samples may vary of which hardly any shows light that their pixel has.

    Samples of size e that make its mean larger by `shift` come in a share shift / e of them, and
    add a variance of shift e. With that variance, n samples that are all alike are sqrt(n shift /
    e) standard errors from their mean, and miss the light with a probability of at least (1 - shift
    / e)^n.

    The samples of its neighbours show how a pixel may vary if they are about as bright as the
    reference is there, and do not lack such light, too. Otherwise the light is hidden: e may be the
    largest sample of the image, and for pixels whose samples are all equal at least 300 times the
    shift, so that 217 nulls are no evidence. Where the reference is darker, samples may be missing
    that are as dark as the darkest, or as 0.

    Parameters
    ----------
    mean, variance, lowest, highest
        Of the samples of each pixel, shape (y, x).
    shift
        Mean of the reference minus that of the samples.

    Returns
    -------
    variance
        Variance of a sample, shape (y, x).
    hidden
        Where light is hidden.
    """
    near, light = ndimage.maximum_filter(highest, _NEAR) - mean, _around(mean)
    unlike = (_around(shift) > _ALIKE * shift) | (light < (mean + shift) / 2) | (shift > near)
    hidden = (shift > 0) & unlike
    # Samples of neighbours around the mean of the pixel.
    spread = _around(variance + mean**2) - mean * (2 * light - mean)
    equal = variance <= (SINGLE * mean) ** 2
    far = np.maximum(highest.max(initial=0) - mean, np.where(equal, shift / _RAREST, 0))
    event = np.where(hidden, far, np.where(shift > 0, near, mean - lowest.min(initial=0)))
    found = np.abs(shift) * np.maximum(event, 0)
    return np.where((shift > 0) & ~hidden, np.minimum(found, np.maximum(spread, 0)), found), hidden


def _around(x: Floats) -> Floats:
    """Return means of neighbourhoods, not by running sums: their rounding errors drown what is dim.

    Examples
    --------
    >>> float(_around(np.eye(11))[5, 5] * 11)
    1.0
    """
    weights = np.full(_NEAR, 1 / _NEAR)
    return np.asarray(ndimage.correlate1d(ndimage.correlate1d(x, weights, 0), weights, 1))


_TERMS = 256
"""Most terms of a pixel, and half as many beside batches of a reference; of more samples, batches
are averaged."""
_UNITS, _TIMES = 1024, 16
"""Most units of the longer render: this number, or this many times the units of the other. More
change the standard error of the difference by less than 3 %."""
_FEWEST_UNITS = 4
"""With fewer, no division of units is rare enough."""
_SMALL, _SMALL_OF_BATCHES = 0.1, 0.01
"""Pixels with p-values up to this are also compared by units: of renders, or batches."""
_AT_ONCE = 2**22
_ROUNDING = 1e-3
"""Relative precision of half floats."""
_CELLS, _LEAST_CELL = 32, 4
"""Cells along the longer edge of the image, and least edge of a cell in pixels."""
_OF_CELLS = ("differences", "levels", "units", "unit_level")
_OF_REFERENCE = ("number", "lowest", "highest")


@dataclass(frozen=True)
class Pair:
    """Two renders, or a render and a reference, and how to contrast them.

    Attributes
    ----------
    a, b
        The renders.
    names
        Names of the renders.
    spp
        Samples of each that are compared; those of A twice if B is a reference.
    seconds
        Rendering time of one sample in every pixel, for each; NaN if it is unknown. If both know
        what samples of single pixels take, it is the sum of that, else the time on the clock.
    costs
        Time of a sample of each pixel, (y, x), for each; None if one of them does not know it.
    paired
        Whether the renders share random numbers.
    scenes
        Names of their scenes, "" where they are unknown.
    """

    a: Samples
    b: Samples | Reference
    names: tuple[str, str]
    spp: tuple[int, int]
    seconds: tuple[float, float]
    paired: bool
    scenes: tuple[str, str] = ("", "")
    costs: tuple[Floats, Floats] | None = None

    @classmethod
    def of(cls, one: Any, two: Any, seconds: float | None) -> Pair:
        """Return a pair, with all samples, or those that each renders in the given seconds.

        An image whose noise is unknown is B, whichever is given first.
        """
        if callable(two):
            message = "the function that draws samples must be A, got it as B: swap them"
            raise InputError(message)
        first, second = Reference.of(one), Reference.of(two)
        variance = second.variance if first and second and first.shape == second.shape else None
        if first and (first.spp is None or (first.variance is None and variance is None)):
            one, two, first, second = two, one, second, first
            if first and (first.spp is None or first.variance is None):
                message = (
                    f"{first.name} and {one if second is None else second.name} are images, and "
                    "the noise of neither is known: give a variance and a number of samples of one"
                )
                raise InputError(message)
        a = first.to_samples(variance) if first else independent(one)
        b = second or independent(two)
        names = (
            _name(first.name if first else one, a),
            b.name if isinstance(b, Reference) else _name(two, b),
        )
        _check_same_size(a.shape, b.shape, names)
        seed = a.attrs.get("seed")
        if isinstance(b, Reference) and seed is not None and seed == b.attrs.get("seed"):
            warn_caller(
                f"A was rendered with the seed of the reference, {seed}: the same random numbers "
                "hide differences; render A with another seed"
            )
        renders = [x for x in (a, b) if isinstance(x, Samples)]
        times = [float(x.attrs.get("render_seconds") or np.nan) / x.spp for x in renders]
        if seconds is not None:
            counts = [
                _count_in(seconds, time, x.spp, name)
                for time, x, name in zip(times, renders, "AB", strict=False)
            ]
        else:
            counts = [x.spp for x in renders]
        paired = isinstance(b, Samples) and a.shares_numbers_with(b)
        if paired and seconds is None:
            counts = [min(counts)] * 2
        each = seconds_of(renders)
        maps = [x.costs.seconds for x in renders if x.costs is not None]
        costs = (maps[0], maps[1]) if len(maps) == 2 else None
        return cls(
            a,
            b,
            names,
            (counts[0], counts[-1]),
            (each[0], each[1] if len(each) > 1 else np.nan),
            paired,
            _scenes(a, b),
            costs,
        )

    @property
    def spp_range(self) -> tuple[str, str]:
        """Samples of A and B in words; "unknown" for an image that does not say it."""
        found = []
        for of, most in zip((self.a, self.b), self.spp, strict=True):
            if isinstance(of, Reference):
                found.append("unknown" if of.spp is None else str(of.spp))
            else:
                fewest = min(of.fewest, most)
                found.append(str(most) if fewest == most else f"{fewest} to {most}")
        return found[0], found[1]

    @property
    def counts(self) -> tuple[int, int | None]:
        """Samples of A and B; None for an image that does not say it."""
        return self.spp[0], self.b.spp if isinstance(self.b, Reference) else self.spp[1]

    @property
    def of_image(self) -> bool:
        """Whether B is a reference, which has no samples."""
        return isinstance(self.b, Reference)

    @property
    def terms(self) -> int:
        """Number of terms of a pixel."""
        least = min(self.spp)
        most = _TERMS // 2 if self.of_image and self.unit_size else _TERMS
        return least // -(-least // most)

    @property
    def unit_size(self) -> int:
        """Number of samples of a unit; those of a batch of a reference, 0 if A cannot fill it."""
        if not isinstance(self.b, Reference):
            return min(self.spp) // self.terms
        if self.b.batches is None or self.b.spp is None:
            return 0
        size, rest = divmod(self.b.spp, _averaged(self.a) * self.b.batches.shape[-1])
        return 0 if rest else size

    @property
    def units(self) -> tuple[int, int]:
        """Units of A and B that are compared; 0 if both have the same number of samples.

        Those of a reference are its batches.
        """
        most = max(_UNITS, _TIMES * self.terms)
        if isinstance(self.b, Reference):
            count = min(self.spp[0] // self.unit_size, most) if self.unit_size else 0
            if self.b.batches is None or count < _FEWEST_UNITS:
                return 0, 0
            return count, self.b.batches.shape[-1]
        if self.spp[0] == self.spp[1] or _averaged(self.a) != _averaged(self.b):
            return 0, 0
        one, other = (min(spp // self.unit_size, most) for spp in self.spp)
        return one, other

    def unit_numbers(self, i: int) -> Counts:
        """Return the unit of each of the first samples of A (0) or B (1).

        Sample k of both is in term k, and thus in the same one of the first units, as far as they
        go.
        """
        if self.of_image:
            return np.arange(self.units[i] * self.unit_size) % max(self.units[i], 1)
        block, within = np.divmod(
            np.arange(self.units[i] * self.unit_size), self.terms * self.unit_size
        )
        width = np.minimum(self.terms, self.units[i] - block * self.terms)
        return np.asarray(block * self.terms + within % width)

    def compare(self) -> Generator[tuple[str, float], None, tuple[dict[str, Any], Cells, int]]:
        """Read the samples once; yield what is being done, and the share that is done.

        Return maps, sums over cells, and the edge of a cell.

        Maps of shape (y, x, band), luminance first if there are R, G and B, are ``mean_a``,
        ``mean_b``, and ``p_value`` and ``standard_error`` of the difference. Maps of shape (y, x)
        are ``variance_a`` and ``variance_b`` of a sample's luminance, NaN where unknown (of two
        renders, ``spread_a`` and ``spread_b`` are those of each band), the
        ``correlation`` of the terms, ``bad_a`` and ``bad_b``, the shares of bad samples, where
        terms are ``constant`` in both, and the ``reason`` why there is no p-value. Against a
        reference, ``hidden`` is light that A does not show, and ``extra`` what the variance of the
        terms lacks for luminance.
        """
        height, width, channels, _ = self.a.shape
        bands = channels + (channels == 3)
        cell = min(max(_LEAST_CELL, -(-max(height, width) // _CELLS)), max(1, min(height, width)))
        in_memory = self.terms + sum(self.units)
        rows = max(1, _AT_ONCE // (width * bands * in_memory * cell)) * cell
        left_out, tiles = LeftOut(), []
        for ys in spans(height, rows):
            tiles.append(self._tile(ys, cell, left_out))
            yield "contrasting pixels", ys.stop / height
        left_out.warn()
        parts = [tile.pop("moments") for tile in tiles]
        maps = {
            name: np.concatenate([tile[name] for tile in tiles], axis=int(name in _OF_CELLS))
            for name in tiles[0]
        }
        lamps, p = maps.pop("lamps"), maps["p_value"]
        extras, outliers = [], []
        for band in range(bands):
            moments = FlipMoments.joined([part[band] for part in parts])
            p[..., band] = guarded(p[..., band], moments, lamps[..., band])
            if isinstance(self.b, Reference):
                extra, hidden = self._extra_variance(band, moments, maps)
                extras.append(extra)
                excess = maps["highest"][..., band] - maps["mean_a"][..., band]
                outliers.append(self.b.outlier(excess, self.spp[0] * _averaged(self.a)))
                if band == 0:
                    maps |= {"hidden": hidden, "extra": extra}
                p[..., band] = np.maximum(p[..., band], moments.p_value_with(extra, outliers[-1]))
        sums = {name: maps.pop(name) for name in _OF_CELLS if name in maps}
        if isinstance(self.b, Reference):
            for name in _OF_REFERENCE:
                del maps[name]
            known = np.isfinite(maps["mean_a"] + maps["mean_b"])
            sums |= {
                "extra": np.maximum(_cells(np.stack(extras, axis=-1)[..., None], cell), 0)[..., 0],
                "slack": _cells(np.where(known, self.b.rounding, 0)[..., None], cell)[..., 0],
                "outlier": np.array(outliers),
            }
        return maps, Cells(**sums, short=min(self.units), unit_size=self.unit_size), cell

    def _extra_variance(
        self, band: int, moments: FlipMoments, maps: dict[str, Array]
    ) -> tuple[Floats, Floats]:
        """Return what the variance of the terms lacks, and light that no sample shows, each (y, x).

        The terms lack the noise of the reference, which is the same in all of them, and what its
        samples, or else light that A may not have seen, vary more than those of A.
        """
        assert isinstance(self.b, Reference)
        averaged = _averaged(self.a)
        number = np.maximum(maps["number"], 1) * averaged
        each = number / self.terms
        own = moments.central2 * moments.scale**2 / moments.n * each
        shift = moments.total * moments.scale / moments.n
        unseen, hidden = _unseen_variance(
            np.nan_to_num(maps["mean_a"][..., band]),
            own / averaged,
            shift,
            maps["lowest"][..., band],
            maps["highest"][..., band],
        )
        of_sample, spp = own, np.asarray(self.b.spp or np.inf)
        more = np.where(moments.few_outliers, unseen * averaged, 0)
        if self.b.variance is not None:
            # Of luminance, the largest that those of the channels allow.
            variance = _with_luminance(np.sqrt(self.b.variance))[..., band] ** 2
            known, spp = np.isfinite(variance), np.asarray(self.b.spp or number)
            of_sample, more = np.where(known, variance, own), np.where(known, variance - own, more)
            hidden = hidden & ~known
        extra = np.asarray((more + number / spp * of_sample) / each)
        return extra, np.where(hidden & moments.few_outliers, shift, 0)

    def _present(self, i: int, ys: slice) -> Array | int:
        """Return the number of samples of A (0) or B (1) in the pixels of some rows, bad or not."""
        of = (self.a, self.b)[i]
        if isinstance(of, Reference):
            return 1
        return self.spp[i] if of.counts is None else np.clip(of.counts[ys], 1, self.spp[i])

    def shapes(self, seed: int) -> dict[str, Any]:
        """Return maps of p- and q-values of equal variances and equal distributions of luminance.

        They are NaN where a sample is missing or B is exact.
        """
        size = self.a.shape[:2]
        found = {name: np.full(size, np.nan) for name in ("variance", "distribution")}
        if isinstance(self.b, Samples):
            if _averaged(self.a) != _averaged(self.b):
                message = (
                    f"distributions of averages of {_averaged(self.a)} and {_averaged(self.b)} "
                    "samples differ whatever is averaged: contrast the means alone, or as many "
                    "samples in both"
                )
                raise InputError(message)
            shuffles = Shuffles.draw(self.spp, seed, paired=self.paired)
            tests = shuffles.p_of_variances, shuffles.p_of_distributions
            for ys in spans(size[0], max(1, _AT_ONCE // (size[1] * sum(self.spp)))):
                one, other = (
                    light_of(x.read(ys, ss=slice(spp))).reshape(-1, spp)
                    for x, spp in zip((self.a, self.b), self.spp, strict=True)
                )
                known = np.isfinite(one).all(axis=1) & np.isfinite(other).all(axis=1)
                for name, test in zip(found, tests, strict=True):
                    p = np.full(len(one), np.nan)
                    p[known] = test(one[known], other[known])
                    found[name][ys] = p.reshape(-1, size[1])
        return {
            f"{name}_{kind}_value": (
                ("y", "x"),
                values,
                {"long_name": f"{kind}-value of equal {name}s of luminance", "units": "1"},
            )
            for name, p in found.items()
            for kind, values in (("p", p), ("q", q_values(p)))
        }

    @np.errstate(all="ignore")
    def _tile(self, ys: slice, cell: int, left_out: LeftOut) -> dict[str, Any]:
        """Return the maps and sums of some rows."""
        sums = self._read(ys, left_out)
        missing = ((sums[0].number == 0) | (sums[1].number == 0))[:, :, np.newaxis]
        one, other = (
            np.where(missing, 0, x) if missing.any() else x
            for x in (_with_luminance(render.of_terms()) for render in sums)
        )
        d = other - one
        known = self.terms - missing.sum(axis=-1)
        means = [sums[0].mean(), sums[1].mean() if isinstance(self.b, Samples) else self.b.mean[ys]]
        mean_a, mean_b = map(_with_luminance, means)
        tested, constant, of_reference = d, np.ones(d.shape[:-1], bool), {}
        if isinstance(self.b, Reference):
            tested = _shrunk(d, self.b.rounding[ys], known) * ~missing
            of_reference = {name: getattr(sums[0], name) for name in _OF_REFERENCE[1:]}
            of_reference["number"] = sums[0].number.sum(axis=-1)
        else:
            constant = (np.ptp(one, axis=-1) == 0) & (np.ptp(other, axis=-1) == 0)
            # For constant renders, such as lamps, only so many digits of files and sums count.
            d[constant & (np.abs(d[..., 0]) <= _ROUNDING * np.abs(one[..., 0]))] = 0
        bands = list(np.moveaxis(tested, 2, 0))
        level = np.nan_to_num((mean_a + mean_b) / 2)
        p = [p_of_signs(x.reshape(-1, self.terms)).reshape(x.shape[:2]) for x in bands]
        p_value = np.stack(p, axis=-1)
        of_units = self._of_units(sums, p_value, cell) if all(self.units) else {}
        p_value[(known < 2)[..., 0]] = np.nan
        error = d.std(axis=-1, dtype=float) / np.sqrt(np.maximum(known - 1, 0))
        reasons = {
            Reason.ALL_BAD: known[..., 0] == 0,
            Reason.TOO_FEW: known[..., 0] < 2,
            Reason.ALL_NULL: (one == 0).all(axis=(2, 3)) & (other == 0).all(axis=(2, 3)),
            Reason.CONSTANT: np.isnan(p_value).all(axis=-1),
        }
        number_a, number_b = (
            render.number.sum(axis=-1) * _averaged(of)
            for render, of in zip(sums, (self.a, self.b), strict=True)
        )
        share = number_a / (number_a + number_b)
        return {
            "mean_a": mean_a,
            "mean_b": mean_b,
            "radiance": share * mean_a[..., 0] + (1 - share) * mean_b[..., 0],
            "p_value": p_value,
            "constant": constant.all(axis=-1),
            "lamps": constant & (not self.of_image),
            "standard_error": error,
            **self._variances(sums),
            **({} if self.of_image else self._spreads(one, other)),
            "correlation": _correlation(one[:, :, 0], other[:, :, 0]),
            "bad_a": 1 - sums[0].good / self._present(0, ys),
            "bad_b": 1 - sums[1].good / self._present(1, ys),
            "reason": first_of(reasons),
            "differences": _cells(d, cell),
            "levels": _cells(one + other, cell) / 2,
            "moments": [FlipMoments.of(x, level[..., i]) for i, x in enumerate(bands)],
            **of_units,
            **of_reference,
        }

    def _variances(self, sums: Sequence[_Sums]) -> dict[str, Floats]:
        """Return variances of a sample of each render; NaN for that of an image."""
        a = sums[0].variance(_averaged(self.a))
        unknown = np.full_like(a, np.nan)
        b = unknown if self.of_image else sums[1].variance(_averaged(self.b))
        return {"variance_a": a, "variance_b": b}

    def _spreads(self, *terms: Array) -> dict[str, Floats]:
        """Return variances of samples in each band, as terms (y, x, band, term) tell them."""
        return {
            f"spread_{name}": x.var(axis=-1, dtype=float) * (spp / self.terms)
            for name, x, spp in zip("ab", terms, self.spp, strict=True)
        }

    def _read(self, ys: slice, left_out: LeftOut) -> list[_Sums]:
        """Read the samples of some rows, and add them up."""
        renders = [x for x in (self.a, self.b) if isinstance(x, Samples)]
        shape = (len(range(self.a.shape[0])[ys]), *self.a.shape[1:3], self.terms)
        sums = [_Sums(shape, self.units[i], extremes=self.of_image) for i in range(len(renders))]
        numbers = [self.unit_numbers(i) for i in range(len(renders))]
        for ss in spans(max(self.spp), self.terms):
            parts: dict[int, tuple[Image, Mask | None]] = {}
            for i, samples in enumerate(renders):
                part = slice(ss.start, min(ss.stop, self.spp[i]))
                if part.start < part.stop:
                    x = samples.read(ys, ss=part)
                    left_out.see(x, channel_axis=-2, absent=samples.absent(ys, ss=part))
                    parts[i] = x, None if all_good(x) else np.asarray(~is_bad(x).any(axis=2))
            for i, (x, good) in parts.items():
                sums[i].good += x.shape[-1] if good is None else good.sum(axis=-1)
            masks = [good for _, good in parts.values() if good is not None]
            if self.paired and masks:
                both = np.logical_and.reduce(masks, axis=0)
                parts = {i: (x, both) for i, (x, _) in parts.items()}
            for i, (x, good) in parts.items():
                sums[i].add(x, good, numbers[i][ss])
        if not isinstance(self.b, Samples):
            batches = self.b.batches if all(self.units) else None
            sums.append(_Sums.exact(self.b.mean[ys], None if batches is None else batches[ys]))
        return sums

    def _of_units(self, sums: list[_Sums], p: Floats, cell: int) -> dict[str, Any]:
        """Return sums of units over cells; raise p-values (y, x, band) that they do not confirm."""
        short = min(self.units)
        ordered = sums if self.units[0] == short else sums[::-1]
        total = np.concatenate([render.unit_total for render in ordered], axis=-1)
        number = np.concatenate([render.unit_number for render in ordered], axis=-1)
        good, number = number > 0, np.maximum(number, 1)
        bands = [light_of(total)] if total.shape[2] == 3 else []
        alone = self.of_image and self.terms < FEWEST_FLIPS
        units, levels = [], []
        for band, of_band in enumerate([*bands, *np.moveaxis(total, 2, 0)]):
            x = of_band / number.astype(of_band.dtype)
            small = p[..., band] <= (_SMALL_OF_BATCHES if self.of_image else _SMALL)
            rows, known = x[small], good[small]
            found = p_of_means(rows[:, :short], rows[:, short:], known[:, :short], known[:, short:])
            p[small, band] = found if alone else np.fmax(p[small, band], found)
            level = x.sum(axis=-1, dtype=float) / np.maximum(good.sum(axis=-1), 1)
            level = level.astype(x.dtype)[..., np.newaxis]
            x -= level
            x *= good
            units.append(_cells(x[:, :, np.newaxis], cell))
            levels.append(_cells(level[:, :, np.newaxis], cell))
        return {"units": np.concatenate(units), "unit_level": np.concatenate(levels)}


class _Sums:
    """Sums over the samples of a render in some rows, by term and by unit, and for luminance.

    Parameters
    ----------
    shape
        (y, x, channel, term).
    units
        Number of units.

    Attributes
    ----------
    total, number
        Sums of the good samples of each term, with that shape, and their number, shape (y, x,
        term).
    unit_total, unit_number
        The same for units.
    first, second
        Sums of luminance and of its squares, shape (y, x).
    good
        Number of good samples, shape (y, x), also of those that leave with their pair.
    lowest, highest
        Smallest and largest sample and 0, shape (y, x, band), with `extremes`.
    """

    def __init__(self, shape: tuple[int, ...], units: int, *, extremes: bool = False) -> None:
        height, width, channels, terms = shape
        # In double precision: means of equal samples must not differ by rounding.
        self.total: Array = np.zeros(shape)
        self.number: Array = np.zeros((height, width, terms), np.int32)
        self.unit_total = np.zeros((height, width, channels, units), np.float32)
        self.unit_number = np.zeros((height, width, units), np.int32)
        self.first, self.second = np.zeros((2, height, width))
        self.good: Array = np.zeros((height, width), np.int64)
        self._extremes = extremes
        self.lowest, self.highest = np.zeros((2, height, width, channels + (channels == 3)))

    @classmethod
    def exact(cls, image: Floats, batches: Floats | None) -> _Sums:
        """Return an image (y, x, channel) as sums of one sample, and its batches as units."""
        found = cls((*image.shape, 0), 0)
        if batches is not None:
            good = np.asarray(np.isfinite(batches).all(axis=2))
            found.unit_total = np.where(good[:, :, np.newaxis], batches, 0).astype(np.float32)
            found.unit_number = np.asarray(good, np.int32)
        found.total = image[..., np.newaxis]
        known = np.asarray(np.isfinite(image).all(axis=-1, keepdims=True))
        found.number = known.astype(np.int32)
        found.good = found.number[..., 0]
        return found

    def add(self, x: Array, good: Mask | None, units: Counts) -> None:
        """Add samples (y, x, channel, sample), one per term, which belong to these units.

        `good` marks the samples that count, shape (y, x, sample); None counts all.
        """
        if good is None:
            good = np.ones((1, 1, x.shape[-1]), bool)
        else:
            x = np.where(good[:, :, np.newaxis], x, 0)
        self.total[..., : x.shape[-1]] += x
        self.number[..., : x.shape[-1]] += good
        for own, to in _runs(units):
            self.unit_total[..., to] += x[..., own]
            self.unit_number[..., to] += good[..., own]
        bright = light_of(x)
        if self._extremes:
            bands = [bright, x] if x.shape[2] == 3 else [x]
            low = [values.min(axis=-1) for values in bands]
            high = [values.max(axis=-1) for values in bands]
            self.lowest = np.minimum(self.lowest, np.dstack(low))
            self.highest = np.maximum(self.highest, np.dstack(high))
        self.first += bright.sum(axis=-1, dtype=float)
        self.second += np.einsum("yxs,yxs->yx", bright, bright, dtype=float)

    def of_terms(self) -> Image:
        """Return means over the samples of each term, shape (y, x, channel, term)."""
        found = self.total / np.maximum(self.number, 1)[:, :, np.newaxis]
        return found.astype(np.float32)

    def mean(self) -> Floats:
        """Return the mean of all samples, shape (y, x, channel)."""
        return np.asarray(
            self.total.sum(axis=-1) / self.number.sum(axis=-1)[..., np.newaxis], float
        )

    def variance(self, averaged: int) -> Floats:
        """Return the variance of a sample's luminance, from averages of samples, shape (y, x)."""
        count = self.number.sum(axis=-1)
        spread = (self.second - self.first**2 / count) / (count - 1) * averaged
        # The rest for equal samples is rounding.
        rounding = spread <= 1e-12 * self.second / np.maximum(count, 1)
        return np.where(count > 1, np.where(rounding, 0, spread), np.nan)


def _runs(numbers: Counts) -> Iterator[tuple[slice, slice]]:
    """Return where consecutive numbers stand, and their range."""
    ends = np.flatnonzero(np.diff(numbers, append=-2) != 1) + 1
    for start, stop in zip([0, *ends], ends, strict=False):
        yield slice(start, stop), slice(numbers[start], numbers[stop - 1] + 1)


def light_of(x: Array) -> Array:
    """Return luminance of (y, x, channel, sample), or the mean of channels other than R, G, B."""
    weights = LUMINANCE if x.shape[2] == 3 else np.full(x.shape[2], 1 / x.shape[2], np.float32)
    return np.asarray(np.einsum("yxcs,c->yxs", x, weights.astype(x.dtype), optimize=True))


def _cells(x: Array, cell: int) -> Image:
    """Return sums of (y, x, band, term) over cells, shape (band, y, x, term)."""
    return block_sums(np.moveaxis(x, 2, 0), cell).astype(np.float32, copy=False)


def _correlation(a: Array, b: Array) -> Floats:
    """Return correlations of terms (y, x, term), NaN where one is constant."""
    one, other = (x - x.mean(axis=-1, keepdims=True) for x in (a, b))
    product, first, second = (
        np.einsum("yxk,yxk->yx", u, v, dtype=float)
        for u, v in ((one, other), (one, one), (other, other))
    )
    return np.asarray(product / np.sqrt(first * second))


def independent(source: Any) -> Samples:
    """Return samples, or averages that are independent if the samples are not."""
    found = samples_of(source, averages=True, dependent=True)
    return found.sequence_means() if sequence_of(found.attrs) > 1 else found


def _check_same_size(a: Sequence[int], b: Sequence[int], names: tuple[str, str]) -> None:
    """Refuse renders of different sizes or channels, given their shapes (y, x, channel, ...)."""
    if tuple(a[:2]) != tuple(b[:2]):
        named = [
            f"{letter}{f', {name},' * (name != letter)}"
            for letter, name in zip("AB", names, strict=True)
        ]
        message = (
            f"{named[0]} has {a[1]} x {a[0]} pixels and {named[1]} {b[1]} x {b[0]}: "
            "render both at one size"
        )
        raise InputError(message)
    if a[2] != b[2]:
        message = f"expected as many channels in both, got {a[2]} in A and {b[2]} in B"
        raise InputError(message)


def _scenes(a: Samples, b: Samples | Reference) -> tuple[str, str]:
    """Return the names of both scenes, "" where they are unknown, and warn if they differ."""
    about = [x.attrs if isinstance(x, Samples) else {} for x in (a, b)]
    one, other = (str(attrs.get("scene") or "") for attrs in about)
    hashes = [attrs.get("scene_hash") for attrs in about]
    if one and other and one != other and (None in hashes or hashes[0] != hashes[1]):
        warn_caller(
            f"A and B are renders of two scenes, {one} and {other}: their means differ if their "
            "views do"
        )
    return one, other


def _averaged(samples: Samples | Reference) -> int:
    """Return how many samples each value is the average of."""
    return int(samples.attrs.get("averaged", 1)) if isinstance(samples, Samples) else 1


def seconds_of(renders: Sequence[Samples]) -> list[float]:
    """Return the rendering time of one sample in every pixel of each render; NaN if unknown.

    It is the sum of what samples of single pixels take if all renders know it, else the time on the
    clock of each.
    """
    costs = [x.costs for x in renders]
    if costs and all(of is not None for of in costs):
        return [
            _in_every_pixel(of.seconds, x.counts)
            for of, x in zip(costs, renders, strict=True)
            if of is not None
        ]
    return [float(x.attrs.get("render_seconds") or np.nan) / x.spp / _averaged(x) for x in renders]


def _in_every_pixel(seconds: Floats, counts: PixelCounts) -> float:
    """Return the time of one sample in every pixel, or of as many as are drawn in an average one.

    Pixels of unknown times count like the others.
    """
    known = np.isfinite(seconds)
    share = counts[known] / counts[known].sum() if known.any() else np.nan
    return float((seconds[known] * share).sum() * seconds.size) if known.any() else np.nan


def _name(source: Any, samples: Samples) -> str:
    of = f", averages of {_averaged(samples)}" if _averaged(samples) > 1 else ""
    return f"{source if isinstance(source, str | Path) else samples.path or samples.name}{of}"


def _count_in(seconds: float, each: float, most: int, name: str) -> int:
    """Return how many samples a render makes in the given seconds."""
    if not (seconds > 0 and np.isfinite(seconds)):
        message = f"seconds must be above 0, got {seconds}"
        raise InputError(message)
    if not np.isfinite(each):
        message = (
            f"{name} does not say how long its rendering took, attrs['render_seconds']: give it to "
            "Samples.from_array, or leave out seconds="
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
