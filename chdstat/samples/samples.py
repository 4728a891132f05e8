"""Samples: every radiance sample of an image, in memory or on disk, with the same methods.

Index them with a pixel, cut them with `Samples.isel`, read parts with `Samples.read`, walk them
with `Samples.blocks`, or map a function over their tiles with `Samples.map`. Other modules take
them whole.
"""

from __future__ import annotations

import contextlib
import copy
import importlib
import itertools
import json
import math
import operator
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, SupportsIndex, TypeAlias, Unpack, overload

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import (
    Image,
    LeftOut,
    Mapped,
    Reals,
    as_samples,
    check_real,
    is_bad,
    spans,
    warn_caller,
    whole,
)
from chdstat._core.display import Card, channel_names, duration, png
from chdstat._core.doors import draw, pixel_of, regions_of
from chdstat._core.files import place_of, shown
from chdstat._core.image_scales import tonemap
from chdstat._core.moments import Moments
from chdstat._core.work import check_memory
from chdstat.errors import InputError
from chdstat.samples import tiles
from chdstat.samples.assembly import labelled, over_tiles
from chdstat.samples.costs import COSTS, SampleCosts, check_seconds
from chdstat.samples.dependence import (
    check_independent,
    check_sequences,
    check_single,
    sequence_of,
    warn_of_repeats,
)
from chdstat.samples.film_steps import OF_FILM, checked_places, unevenness
from chdstat.samples.ledger import PixelCounts
from chdstat.samples.tiles import (
    ALL,
    DIRECT_DEPTH,
    FILM,
    Chunk,
    LightPart,
    SampleSource,
    Work,
    is_depth,
)

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.figure import Figure


_BIASED = "where that number depended on the samples, means and their errors are biased"
_ALWAYS_READ = 2**26
"""Bytes that are read without checking the memory."""
_MOST_CHANNELS = 4
"""More channels than this are probably samples, unless the caller says otherwise."""
_DECADES, _LARGEST = 70, 38
"""Decades that single precision covers, and the logarithm of its largest number."""
_THUMBNAIL, _VALUES = 256, 2**25
"""Longer edge of a thumbnail in pixels, and most samples that are read for it."""

_Index = slice | SupportsIndex
_Places = tuple[range, range, range]


class Samples:
    """All radiance samples of an image, dims (y, x, channel, sample), float32, linear radiance.

    Make one with `chdstat.render`, `chdstat.open` or `Samples.from_array`.

    Examples
    --------
    >>> samples = Samples.from_array(np.ones((4, 6, 3, 32)), scene="flat")
    >>> samples
    <Samples 'flat' 6 x 4 pixels, 3 channels, 32 spp, in memory>
    >>> samples[0, 0].shape, np.asarray(samples).shape
    ((3, 32), (4, 6, 3, 32))
    """

    def __init__(
        self,
        held: Image | SampleSource,
        *,
        attrs: Mapping[str, Any],
        features: Mapping[str, Image] | None = None,
        parts: Mapping[LightPart, Samples] | None = None,
        part: _Places | None = None,
        path: Path | None = None,
        counts: PixelCounts | None = None,
    ) -> None:
        height, width, _, spp = held.shape
        self._held, self._attrs, self._counts = held, dict(attrs), counts
        self._features, self._parts, self._path = features, dict(parts or {}), path
        # Rows, columns and samples within the whole, such as a store, that these are.
        self.part = part or (range(height), range(width), range(spp))

    @classmethod
    def from_array(
        cls,
        array: npt.ArrayLike,
        *,
        features: Mapping[str, Image] | None = None,
        direct: npt.ArrayLike | None = None,
        film: npt.ArrayLike | None = None,
        axes: str | None = None,
        counts: npt.ArrayLike | None = None,
        seconds: npt.ArrayLike | None = None,
        **attrs: Any,
    ) -> Samples:
        """Hold samples that are already in memory.

        They are kept in single precision; float32 arrays are not copied. Masked samples become NaN.
        A `chdstat.errors.InputWarning` says if samples repeat each other over the image.

        Parameters
        ----------
        array
            Linear radiance, shape (y, x, channel, sample), or (y, x, sample) for one channel. The
            dims of an `xarray.DataArray` may be in any order: their names decide.
        features
            First-hit features by name, each (y, x) or (y, x, component).
        direct
            Emission and direct light of each sample, with the shape of the samples.
        film
            Where in its pixel each sample fell, shape (y, x, 2, sample) whatever the axes of
            `array`: from 0 to 1 across and down. A `chdstat.errors.InputWarning` says if samples do
            not fall everywhere alike, as they do with a box filter of one pixel.
        axes
            Order of the axes of `array` and `direct`, as letters y, x, c (channel) and s (sample),
            such as "yxsc". None means "yxcs" or "yxs", if that is plausible.
        counts
            Number of samples of each pixel, shape (y, x), if they differ; `array` is ignored beyond
            them. If these numbers depended on the samples themselves, as in most adaptive sampling,
            means are biased.
        seconds
            Time that a sample of each pixel took to render, shape (y, x), or each sample, (y, x,
            sample); NaN where it is unknown. See `Samples.costs`.
        **attrs
            Provenance: ``scene="name"``, ``seed=7``, ``unit`` of radiance, or ``sequence=16`` if 16
            samples at a time depend on each other.

        Raises
        ------
        InputError
            If the shape is not one of these, or an axis is empty. If neither `axes` nor named dims
            are given, and there would be more than 4 channels or fewer samples than channels: the
            axes are then probably in another order. If an array holds unsigned integers, as encoded
            images do, or a sample that is 0 or infinite only in single precision.

        Examples
        --------
        >>> radiance = np.ones((4, 6, 32, 3))  # samples before channels
        >>> Samples.from_array(radiance, axes="yxsc")
        <Samples 'samples' 6 x 4 pixels, 3 channels, 32 spp, in memory>
        """
        parts = [_as_image(array, "samples", axes)]
        shape = parts[0].shape
        if direct is not None:
            parts.append(_as_image(direct, "direct", axes))
            if parts[1].shape != shape:
                message = (
                    f"direct must have the shape of the samples, {shape}, got {parts[1].shape}"
                )
                raise InputError(message)
        places: Any = None
        if film is not None:
            places = checked_places(film, (*shape[:2], 2, shape[3]), "film")
            if uneven := unevenness(places):
                warn_caller(f"film: {uneven}")
        found = None if counts is None else check_counts(counts, shape)
        if found is not None:
            absent = np.arange(shape[3]) >= found[..., np.newaxis, np.newaxis]
            parts = [np.where(absent, np.float32(np.nan), part) for part in parts]
            if places is not None:
                places = np.where(absent, np.float16(np.nan), places)
        check_features(features or {}, shape)
        arrays = dict(features or {})
        if seconds is not None:
            arrays[COSTS] = check_seconds(seconds, shape).to_array()
        attrs = checked_attrs(attrs)
        warn_of_repeats(lambda y, x, s: parts[0][y, x, :, s], shape, "samples")
        held = [cls(p, attrs=attrs, features=arrays, counts=found) for p in parts]
        if places is not None:
            held[0]._parts[FILM] = cls(places, attrs={**attrs, **OF_FILM}, counts=found)
        if direct is not None:
            held[0]._parts[DIRECT_DEPTH] = held[1]
        return held[0]

    @property
    def attrs(self) -> dict[str, Any]:
        """Provenance: scene, scene hash, integrator, seed, backend, Mitsuba version and so on."""
        return dict(self._attrs)

    @property
    def name(self) -> str:
        """Name of the scene; 'samples' if it has none."""
        return str(self._attrs.get("scene", "samples"))

    @property
    def path(self) -> Path | None:
        """Path of the store; None for samples in memory, or for a part of a store."""
        return self._path and shown(self._path)

    @property
    def source(self) -> SampleSource | None:
        """Source that the samples are read from; None in memory."""
        return None if isinstance(self._held, np.ndarray) else self._held

    @property
    def shape(self) -> tuple[int, int, int, int]:
        """(y, x, channel, sample)."""
        rows, columns, samples = map(len, self.part)
        return rows, columns, self._held.shape[2], samples

    @property
    def spp(self) -> int:
        """Samples per pixel; if they differ, those of the pixel with the most."""
        return len(self.part[2])

    @property
    def fewest(self) -> int:
        """Number of samples that every pixel has."""
        return int(self.counts.min())

    @property
    def counts(self) -> PixelCounts:
        """Samples of each pixel, shape (y, x); those beyond them read as NaN."""
        if self._counts is None:
            return np.full(self.shape[:2], self.spp, np.int32)
        return _counted(self._counts, self.part[2])

    @property
    def unequal(self) -> bool:
        """Whether some pixels have more samples than others."""
        return self._counts is not None and self.fewest < self.spp

    @property
    def spp_range(self) -> str:
        """Samples per pixel in words: "64", or "32 to 161" if they differ."""
        return f"{self.fewest} to {self.spp}" if self.unequal else str(self.spp)

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the channels."""
        return channel_names(self.shape[2])

    @cached_property
    def features(self) -> dict[str, Image]:
        """First-hit features by name: albedo, normal, position (y, x, component), depth (y, x)."""
        return {name: image for name, image in self._arrays.items() if name != COSTS}

    @cached_property
    def _arrays(self) -> dict[str, Image]:
        """First-hit features, and the costs of samples, as far as they are known."""
        if self._features is not None or isinstance(self._held, np.ndarray):
            return dict(self._features or {})
        ys, xs, _ = map(_as_slice, self.part)
        return {name: image[ys, xs] for name, image in self._held.read_features().items()}

    @property
    def costs(self) -> SampleCosts | None:
        """How long a sample of each pixel takes to render; None if none was timed.

        ``costs.seconds`` is a map (y, x), and ``costs.error`` its standard error; see
        `chdstat.samples.costs.SampleCosts`.
        """
        return SampleCosts.of_array(self._arrays[COSTS]) if COSTS in self._arrays else None

    @property
    def direct(self) -> Samples | None:
        """Emission and direct light of the same samples, their paths cut; None if unknown."""
        return self._parts.get(DIRECT_DEPTH)

    @property
    def depths(self) -> dict[int, Samples]:
        """The same samples with paths cut after this many segments, ascending, as far as known.

        `chdstat.patterns.attribute` returns how much light comes from which depth.
        """
        return {n: part for n, part in self._parts.items() if is_depth(n)}

    @property
    def film(self) -> Samples | None:
        """Where in its pixel each sample fell, (y, x, 2, sample); None if unknown.

        The two numbers go from 0 to 1, across and down, in pixels: each is the middle of one of 16
        steps, as many as cells of the finest `chdstat.patterns.film_split`. A store keeps them in
        one byte a sample, memory in four. Samples that were appended to a store have none.

        Examples
        --------
        >>> places = np.random.default_rng(0).random((4, 6, 2, 32))
        >>> samples = Samples.from_array(np.ones((4, 6, 3, 32)), film=places)
        >>> samples.film.shape, samples.film.read()[0, 0, :, 0].tolist()
        ((4, 6, 2, 32), [0.65625, 0.15625])
        """
        return self._parts.get(FILM)

    def places(self, ys: slice = ALL, xs: slice = ALL) -> Image | None:
        """Return where samples fell, as `film` has it; NaN for those of which that is unknown."""
        if self.film is None:
            return None
        known = self.film.read(ys, xs)
        if known.shape[3] == self.spp:
            return known
        found = np.full((*known.shape[:3], self.spp), np.nan, np.float32)
        found[..., : known.shape[3]] = known
        return found

    @property
    def parts(self) -> dict[LightPart, Samples]:
        """Parts of the same samples: those of `depths` and of `lights`, and `film`."""
        return dict(self._parts)

    @property
    def lights(self) -> dict[str, Samples]:
        """The same samples with some lights only, by the names asked for, as far as known."""
        return {which: part for which, part in self._parts.items() if isinstance(which, str)}

    def shares_numbers_with(self, other: Samples) -> bool:
        """Return whether sample i of a pixel was drawn with the same random numbers in both.

        That is so for renders with equal seed and size by one kind of backend, whatever their
        scenes. Comparisons then use pairs. Samples without a known seed count as independent.

        Examples
        --------
        >>> one, same, other = (Samples.from_array(np.ones((4, 4, 8)), seed=s) for s in (0, 0, 7))
        >>> one.shares_numbers_with(same), one.shares_numbers_with(other)
        (True, False)
        """
        (*places, first), (*others, second) = self.part, other.part
        one, two = self._attrs, other._attrs
        named: dict[str, Any] = {"seed": None, "streams": None, "sampler": "independent"}
        named |= {"sequence": 1, "averaged": 1}
        return (
            one.get("seed") is not None
            and places == others
            and (first.start, first.step) == (second.start, second.step)
            # Compiled backends draw in wavefronts, with random numbers of their own.
            and (one.get("backend") == "scalar") == (two.get("backend") == "scalar")
            # The scalar backend draws adaptive samples pixel by pixel.
            and (one.get("backend") != "scalar" or ("adaptive" in one) == ("adaptive" in two))
            and all(one.get(name, value) == two.get(name, value) for name, value in named.items())
        )

    def pixel(self, y: int, x: int) -> Any:
        """Return a `chdstat.patterns.Pixel`: its nulls, statistics, fits and patterns.

        Examples
        --------
        >>> samples = Samples.from_array(np.random.default_rng(0).gamma(2.0, size=(4, 6, 3, 256)))
        >>> samples.pixel(2, 3).families["R"], samples.pixel(2, 3).null_share
        ('gamma', 0.0)
        """
        return pixel_of(self, y, x)

    def regions(self, places: Mapping[str, tuple[int, int]] | None = None) -> Any:
        """Return `chdstat.patterns.Regions`: pixels of several parts, for a figure and a table.

        Parameters
        ----------
        places
            (y, x) of a pixel, by the name of its region. None chooses a region for each pattern of
            the image, as `chdstat.patterns.choose_regions` does.

        Examples
        --------
        >>> samples = Samples.from_array(np.random.default_rng(0).gamma(2.0, size=(8, 8, 3, 256)))
        >>> study = samples.regions({"wall": (2, 3), "floor": (6, 1)})
        >>> figure, table = study.plot(width="column"), study.to_latex()
        """
        return regions_of(self, places)

    def plot(self, y: int, x: int, **options: Any) -> Figure:
        """Draw linear and log10 histograms of one pixel with their curves.

        Parameters
        ----------
        y, x
            Row and column.
        **options
            As for `Pixel.plot`: `channels`, `scales`, `width` and `fig`.

        Examples
        --------
        >>> samples = Samples.from_array(np.random.default_rng(0).gamma(2.0, size=(4, 6, 3, 256)))
        >>> figure = samples.plot(2, 3, channels="luminance", scales="log", width="column")
        >>> float(figure.get_figwidth())
        3.4
        """
        return draw(self.pixel(y, x), **options)

    def __repr__(self) -> str:
        height, width, channels, _ = self.shape
        length = sequence_of(self._attrs)
        number = f"{self.spp_range} spp"
        if length > 1:
            sampler = self._attrs.get("sampler", "")
            number += f" in {sampler} sequences of {length}".replace("  ", " ")
        elif self._attrs.get("averaged", 1) > 1:
            number += f" (averages of {self._attrs['averaged']})"
        where = "in memory"
        if self.source is not None:
            where = f"{'at' if self.path else 'part of'} {shown(self.source.path)}"
        return (
            f"<Samples {self.name!r} {width} x {height} pixels, "
            f"{channels} channel{'s' if channels > 1 else ''}, {number}, {where}>"
        )

    def _repr_html_(self) -> str:
        """Show a thumbnail and the origin of the samples."""
        height, width, channels, spp = self.shape
        facts = provenance(self._attrs, self.shape)
        if self.unequal:
            facts["Samples"] = different_counts(self._attrs, self.spp_range)
        if self.features:
            facts["First hit"] = ", ".join(self.features)
        facts["Stored"] = "in memory" if self.path is None else str(self.path)
        if channels not in (1, 3):
            return Card("Samples", facts).html()
        step = -(-max(height, width) // _THUMBNAIL)
        few = max(1, min(spp, _VALUES // math.prod(self.shape[:3])))
        thumbnail = self.isel(y=slice(None, None, step), x=slice(None, None, step))
        radiance = thumbnail.read(ss=slice(few)).astype(np.float64)
        image = png(tonemap(Moments.of(radiance, ~is_bad(radiance)).mean))
        return Card("Samples", facts, images={f"mean of the first {few} samples": image}).html()

    @overload
    def __getitem__(self, pixel: tuple[slice, slice]) -> Samples: ...
    @overload
    def __getitem__(self, pixel: tuple[SupportsIndex, _Index]) -> Image: ...
    @overload
    def __getitem__(self, pixel: tuple[slice, SupportsIndex]) -> Image: ...
    def __getitem__(self, pixel: tuple[_Index, _Index]) -> Image | Samples:
        """Return the samples of one pixel, shape (channel, sample); with slices, as `isel`."""
        pair = isinstance(pixel, tuple) and len(pixel) == 2
        if not pair or not all(isinstance(place, SupportsIndex | slice) for place in pixel):
            message = f"expected a pixel (y, x) or slices of rows and columns, got {pixel!r}"
            raise InputError(message)
        found = self.isel(y=pixel[0], x=pixel[1])
        if self._counts is None or any(isinstance(place, slice) for place in pixel):
            return found
        return np.asarray(found)[..., : int(_counted(self._counts[pixel], self.part[2]))]

    @overload
    def isel(self, *, y: slice = ..., x: slice = ..., sample: slice = ...) -> Samples: ...
    @overload
    def isel(self, *, y: SupportsIndex, x: _Index = ..., sample: _Index = ...) -> Image: ...
    @overload
    def isel(self, *, x: SupportsIndex, y: _Index = ..., sample: _Index = ...) -> Image: ...
    @overload
    def isel(self, *, sample: SupportsIndex, y: _Index = ..., x: _Index = ...) -> Image: ...
    def isel(self, *, y: _Index = ALL, x: _Index = ALL, sample: _Index = ALL) -> Image | Samples:
        """Select rows, columns or samples of each pixel.

        Slices return `Samples` without reading or copying; features and parts are cut alike. An
        integer drops its axis, as in xarray, and reads the rest into an array.

        Raises
        ------
        InputError
            If an index lies outside, keeps nothing, or goes backwards.

        Examples
        --------
        >>> samples = Samples.from_array(np.ones((4, 6, 3, 32)))
        >>> samples.isel(y=slice(1, 3), sample=slice(None, None, 2))
        <Samples 'samples' 6 x 2 pixels, 3 channels, 16 spp, in memory>
        >>> samples.isel(y=3).shape, samples.isel(sample=0).shape
        ((6, 3, 32), (4, 6, 3))
        """
        rows, columns, samples = self.part
        ys, xs, ss = _cut("y", rows, y), _cut("x", columns, x), _cut("sample", samples, sample)
        if not all(isinstance(index, slice) for index in (y, x, sample)):
            first = [ALL if isinstance(index, slice) else 0 for index in (y, x, sample)]
            return np.asarray(self.read(ys, xs, ss)[first[0], first[1], :, first[2]])
        features, parts, attrs = self._features, {}, self._attrs
        if features is not None:
            features = {name: image[ys, xs] for name, image in features.items()}
        for which, part in self._parts.items():
            if ss.start < part.spp:  # it may be rendered for fewer samples
                parts[which] = part.isel(y=ys, x=xs, sample=ss)
        if (kept := len(samples[ss])) != self.spp:
            seconds = attrs.get("render_seconds")
            spent = {"render_seconds": seconds * kept / self.spp} if seconds else {}
            attrs = {**attrs, "spp": kept, **spent}
        return Samples(
            self._held[ys, xs, :, ss] if isinstance(self._held, np.ndarray) else self._held,
            attrs=attrs,
            features=features,
            parts=parts,
            part=(rows[ys], columns[xs], samples[ss]),
            counts=None if self._counts is None else self._counts[ys, xs],
        )

    def read(self, ys: slice = ALL, xs: slice = ALL, ss: slice = ALL) -> Image:
        """Return a part of the samples, shape (y, x, channel, sample).

        Raises
        ------
        InputError
            If it does not fit into the memory of this machine.
        StoreError
            If the store on disk is damaged.
        """
        if isinstance(self._held, np.ndarray):
            return np.asarray(self._held[ys, xs, :, ss], np.float32)  # places are half as long
        parts = [whole[part] for whole, part in zip(self.part, (ys, xs, ss), strict=True)]
        size = 4 * self.shape[2] * math.prod(map(len, parts))
        if size > _ALWAYS_READ:
            advice = "read them in parts, such as read(ys, xs), or walk through blocks()"
            check_memory(size, "these samples", advice)
        return self._held.read(*map(_as_slice, parts))

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> npt.NDArray[Any]:
        """Return all samples as an array (y, x, channel, sample), for ``np.asarray(samples)``."""
        return np.array(self.read(), dtype=dtype, copy=copy)

    @property
    def nbytes(self) -> int:
        """Size of the samples in memory, in bytes."""
        return 4 * math.prod(self.shape)

    def load(self) -> Samples:
        """Return the same samples in memory, which pays before several analyses."""
        if isinstance(self._held, np.ndarray):
            return self
        loaded = copy.copy(self)
        loaded._held, loaded._features, loaded._path = self.read(), self._arrays, None
        loaded._parts = {which: part.load() for which, part in self._parts.items()}
        return loaded

    def save(self, path: str | Path, *, append: bool = False, progress: bool = True) -> Samples:
        """Write the samples to a store, and return the samples of the store.

        An interrupted call continues when it is repeated.

        Parameters
        ----------
        path
            The store to write, a path or a URL.
        append, progress
            Whether to add the samples to those of an existing store, and to show progress.

        Raises
        ------
        InputError
            If appended samples have another size, or the same random numbers.
        StoreError
            If something else is at the path, or it cannot be written.

        Examples
        --------
        >>> import tempfile
        >>> samples = Samples.from_array(np.ones((4, 6, 3, 32)), scene="flat")
        >>> samples.save(Path(tempfile.mkdtemp()) / "flat.zarr").spp
        32
        """
        from chdstat.samples.store import save

        return save(self, place_of(path), append=append, progress=progress)

    def first(self, spp: int) -> Samples:
        """Return the first samples of each pixel, in memory.

        Raises
        ------
        InputError
            If there are not so many, or less than one is asked for.
        """
        if not 1 <= spp <= self.spp:
            message = f"spp must be from 1 to {self.spp}, what these samples hold; got {spp}"
            raise InputError(message)
        return self.isel(sample=slice(spp)).load()

    def sequence_means(self) -> Samples:
        """Return the averages of sequences of dependent samples, in memory; they are independent.

        Samplers that spread the samples of a pixel draw them in sequences (see `chdstat.render`).
        An average with a bad sample is bad. An incomplete last sequence is left out.

        Raises
        ------
        InputError
            If samples are independent, begin within a sequence, or hold no whole sequence.

        Examples
        --------
        >>> drawn = Samples.from_array(np.ones((4, 6, 3, 32)), sampler="stratified", sequence=16)
        >>> drawn.sequence_means()
        <Samples 'samples' 6 x 4 pixels, 3 channels, 2 spp (averages of 16), in memory>
        """
        length = sequence_of(self._attrs)
        height, width, channels, spp = self.shape
        count = spp // length
        if length == 1 or not count:
            message = (
                f"expected samples in sequences, got {spp} of a sequence of {length}"
                if length > 1
                else "expected samples in sequences, as samplers that spread them draw, got "
                "independent ones, which need no averages"
            )
            raise InputError(message)
        check_sequences(self.attrs, self.part[2])
        advice = "take some rows of the image, with isel"
        check_memory(4 * height * width * channels * count, "averages of these sequences", advice)
        means = np.empty((height, width, channels, count), np.float32)
        for ys, xs in tiles.tiles(self.shape):
            block = self.read(ys, xs, slice(0, count * length))
            sequences = block.reshape(*block.shape[:3], count, length)
            with np.errstate(invalid="ignore"):  # of infinite samples
                means[ys, xs] = sequences.mean(axis=-1, dtype=np.float64)
        attrs = {name: value for name, value in self._attrs.items() if name != "sequence"}
        attrs |= {"averaged": length, "spp": count}
        return Samples(means, attrs=attrs, features=self._arrays)

    def blocks(self) -> Iterator[tuple[slice, slice, slice, Image]]:
        """Walk the samples in constant memory: tile by tile, and batch by batch within a tile.

        Yields
        ------
        ys, xs, ss : slice
            Place of the block.
        block : ndarray
            Its samples, shape (y, x, channel, sample).
        """
        height, width, _, spp = self.shape
        edges = spans(height, tiles.TILE), spans(width, tiles.TILE), spans(spp, tiles.BATCH)
        for ys, xs, ss in itertools.product(*edges):
            yield ys, xs, ss, self.read(ys, xs, ss)

    def map(
        self,
        function: Callable[..., Mapped],
        *,
        logarithms: bool = False,
        dependent: bool = False,
        film: bool = False,
        description: str = "analysing",
        **work: Unpack[Work],
    ) -> xr.Dataset:
        """Apply a function to tiles with all their samples and assemble the image.

        Tiles are computed in parallel: in one thread per core, or by a client's workers.

        Parameters
        ----------
        function
            Takes the samples (y, x, channel, sample) of some pixels. Returns, by variable name, the
            dims that follow (y, x) and an array of shape (y, x, ...). The result of a pixel must
            not depend on which others are given with it.
        logarithms
            Whether the function leaves out negative samples, too, as it does bad ones. A
            `chdstat.errors.LeftOutWarning` reports more than 1 %.
        dependent
            Whether the function takes samples that depend on each other, see `sequence_means`.
        film
            Whether the function also takes where these samples fell, as `places` returns it.
        description, **work
            What is done; ``progress`` to show how much of it; ``client`` for a Dask client, whose
            workers then compute the tiles.
        """
        check_single(self.attrs)
        if not dependent:
            check_independent(self.attrs)

        def of_tile(part: Samples, left_out: LeftOut) -> Mapped:
            block = part.read()
            left_out.see(block, channel_axis=-2, absent=part.absent())
            more = [places] if film and (places := part.places()) is not None else []
            return tiles.by_pixels(function, block, *more)

        places, shown = tiles.tiles(self.shape), {"description": description}
        return over_tiles(self, of_tile, places, logarithms=logarithms, **shown, **work)

    def absent(self, ys: slice = ALL, xs: slice = ALL, ss: slice = ALL) -> int:
        """Return how many samples are missing in a part because pixels have fewer than others."""
        if self._counts is None:
            return 0
        asked = self.part[2][ss]
        return int((len(asked) - _counted(self._counts[ys, xs], asked)).sum())

    def to_dataset(self) -> xr.Dataset:
        """Return samples, features and counts as a labelled dataset; lazily if on disk.

        Where samples fell is ``film`` (y, x, axis, sample), if it is known of all of them.
        """
        dims = ("y", "x", "component")
        variables: dict[str, Any] = {n: (dims[: i.ndim], i) for n, i in self.features.items()}
        if self.unequal:
            variables["counts"] = (dims[:2], self.counts, {"long_name": "samples", "units": "1"})
        if self.costs is not None:
            variables |= self.costs.variables()
        if self.film is not None and self.film.spp == self.spp:
            told = {"long_name": "place in the pixel, across and down", "units": "pixels"}
            variables["film"] = (("y", "x", "axis", "sample"), self.film._lazily(), told)
        about = {"long_name": "linear radiance", "units": self._attrs.get("unit", "W sr-1 m-2")}
        variables["radiance"] = (("y", "x", "channel", "sample"), self._lazily(), about)
        return labelled(self, variables)

    def _lazily(self) -> Any:
        """Return the samples; of a source as a dask array that reads its chunks when needed."""
        if isinstance(self._held, np.ndarray):
            return self._held
        da: Any = importlib.import_module("dask.array")

        def block(block_info: Any) -> Image:
            ys, xs, _, ss = (slice(*ends) for ends in block_info[None]["array-location"])
            return self.read(ys, xs, ss)

        named = {"name": f"radiance-{uuid.uuid4()}", "meta": np.empty((0, 0, 0, 0), np.float32)}
        chunks = da.core.normalize_chunks((tiles.TILE, tiles.TILE, -1, tiles.BATCH), self.shape)
        return da.map_blocks(block, chunks=chunks, **named)


ImageLike: TypeAlias = Samples | str | Path
"""An image: its samples, or the path of the store that holds them."""


class SampleStream(Protocol):
    """Samples that are drawn and not kept, as `chdstat.rendering.render_batches` makes them."""

    batch: int
    """Samples per pixel that are drawn together."""
    spp: int
    """Total samples per pixel."""

    @property
    def name(self) -> str:
        """Name of the scene."""

    @property
    def shape(self) -> tuple[int, int, int, int]:
        """(y, x, channel, sample)."""

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the channels."""

    @property
    def attrs(self) -> dict[str, Any]:
        """Provenance, as `Samples.attrs`."""

    @property
    def features(self) -> dict[str, Image]:
        """First-hit features by name."""

    def passes(self) -> Iterator[Iterator[tuple[Chunk, Image]]]:
        """Yield passes over the image, each as chunks and their samples."""

    def on_demand(self) -> contextlib.AbstractContextManager[tuple[Samples, int]]:
        """Return samples that are drawn when they are read, and how many may read at once."""


def different_counts(attrs: Mapping[str, Any], numbers: str) -> str:
    """Return how the numbers of samples per pixel differ, and what follows from that."""
    why = "none of its own decided how many" if "adaptive" in attrs else _BIASED
    return f"{numbers} in a pixel; {why}"


def provenance(attrs: Mapping[str, Any], shape: Sequence[int]) -> dict[str, str]:
    """Return the known settings that render the same samples again, by name.

    Parameters
    ----------
    attrs
        Attributes of the samples.
    shape
        Shape of the samples, (y, x, channel, sample).

    Examples
    --------
    >>> provenance({"scene": "flat", "seed": 3, "sampler": "independent"}, (4, 6, 3, 32))
    {'Scene': 'flat (samples given)',
     'Image': '6 × 4 pixels, 3 channels, 32 samples per pixel',
     'Random numbers': 'independent sampler, seed 3'}
    """
    height, width, channels, spp = shape
    integrator = dict(attrs.get("integrator") or {})
    kind = integrator.pop("type", "")
    settings = ", ".join(f"{name} {value}" for name, value in integrator.items())
    seconds = float(attrs.get("render_seconds") or 0)
    numbers, length = list[str](), sequence_of(attrs)
    if {"sampler", "seed"} <= attrs.keys():  # a seed alone tells nothing
        numbers.append(f"{attrs['sampler']} sampler, seed {attrs['seed']}")
    if length > 1:
        numbers.append(f"in sequences of {length} samples that depend on each other")
    source = Path(str(attrs.get("scene_source", "samples given"))).name  # no folders of a machine
    rows = {
        "Scene": f"{attrs.get('scene', 'samples')} ({source})",
        "Scene hash": str(attrs.get("scene_hash", ""))[:16],
        "Plugins": ", ".join(f"{n} ({digest})" for n, digest in attrs.get("plugins", {}).items()),
        "Integrator": f"{kind} ({settings})" if settings else kind,
        "Image": f"{width} × {height} pixels, {channels} channel{'s' * (channels > 1)}, "
        f"{spp} sample{'s' * (spp > 1)} per pixel{' at most' * ('adaptive' in attrs)}",
        "Random numbers": ", ".join(numbers),
        "Light": {"spectral": "spectral, samples in linear sRGB", "mono": "of one channel"}.get(
            attrs.get("color", ""), ""
        ),
        "Filter": str(attrs.get("filter", "")),
        "Renderer": f"Mitsuba {attrs['mitsuba_version']}, {attrs['backend']}"
        if "mitsuba_version" in attrs
        else str(attrs.get("renderer", "")),
        "Averages": f"each value is the average of {attrs['averaged']} samples"
        if attrs.get("averaged", 1) > 1
        else "",
        "Rendering time": duration(seconds) if seconds else "",
        "Note": "; ".join(attrs.get("notes") or []),
    }
    return {name: value for name, value in rows.items() if value}


# --- what is given as samples -------------------------------------------------------------------


def _as_image(array: npt.ArrayLike, name: str, axes: str | None) -> Image:
    """Return samples (y, x, channel, sample) in single precision.

    Raises
    ------
    InputError
        If the axes are probably others, or single precision would make samples null or infinite.
    """
    data = as_samples(array, minimum=0, name=name)
    if not hasattr(array, "dims"):
        letters = axes_of(data, name, axes)
        axis_order = [letters.index(letter) for letter in "yxcs" if letter in letters]
        data = np.ascontiguousarray(data.transpose(axis_order))
    elif axes is not None:
        message = f"the dims of {name} have names, which decide: leave axes={axes!r} out"
        raise InputError(message)
    elif data.ndim not in (3, 4) or ("channel" in array.dims) != (data.ndim == 4):
        message = f"{name} must have the dims y, x, sample and perhaps channel, got {array.dims}"
        raise InputError(message)
    elif 0 in data.shape:
        message = f"{name} must have shape (y, x, channel, sample), got {data.shape}"
        raise InputError(message)
    return single(data if data.ndim == 4 else data[:, :, np.newaxis, :], name)


def axes_of(array: Any, name: str, axes: str | None) -> str:
    """Return the letters of the axes of an array without named dims, such as "yxcs".

    Raises
    ------
    InputError
        If it holds no real numbers, is empty, or `axes` are not, or probably not, its axes.
    """
    check_real(array.dtype, name)
    shape = tuple(map(int, array.shape))
    if len(shape) not in (3, 4) or 0 in shape:
        message = (
            f"{name} must have shape (y, x, channel, sample) or (y, x, sample), with at least one "
            f"element along each axis, got {shape}"
        )
        raise InputError(message)
    letters = "yxcs" if len(shape) == 4 else "yxs"
    if axes is None:
        _check_plausible(name, shape)
        return letters
    if not isinstance(axes, str) or sorted(axes) != sorted(letters):
        named = "y, x, s (sample) and c (channel)" if len(shape) == 4 else "y, x and s (sample)"
        message = (
            f"axes must name each axis of the samples once, by the letters {named}, such as "
            f"{letters[:2] + letters[:1:-1]!r}; got {axes!r} for {name} of shape {shape}"
        )
        raise InputError(message)
    return axes


def _check_plausible(name: str, shape: tuple[int, ...]) -> None:
    """Refuse samples whose axes are probably in another order than (y, x, channel, sample)."""
    *_, channels, spp = shape
    if len(shape) == 3 and spp > _MOST_CHANNELS:
        return
    if len(shape) == 3:
        message = (
            f"{name} of shape {shape} would be {spp} samples of one channel in each pixel; it "
            "looks like an image, of means of samples. If it holds samples, give axes='yxs'"
        )
        raise InputError(message)
    if channels <= _MOST_CHANNELS and spp >= channels:
        return
    short = next((i for i in (3, 0, 1) if shape[i] <= _MOST_CHANNELS), None)
    likely = {
        3: "axes='yxsc' if (y, x, sample, channel), axes='syxc' if (sample, y, x, channel)",
        0: "axes='cyxs' if (channel, y, x, sample)",
        1: "axes='scyx' if (sample, channel, y, x)",
        None: "axes='yxsc' if (y, x, sample, channel)",
    }[short]
    message = (
        f"{name} of shape {shape} would have {channels} channels of {spp} samples; say what the "
        f"axes are: {likely}, or axes='yxcs' if this is right"
    )
    raise InputError(message)


def single(data: Reals, name: str) -> Image:
    """Return samples in single precision, unless that makes some null or infinite."""
    if data.dtype in (np.float32, np.float16):
        return data.astype(np.float32, copy=False)
    with np.errstate(over="ignore", under="ignore"):
        kept = data.astype(np.float32)
    changed = ((kept == 0) != (data == 0)) | (np.isinf(kept) != np.isinf(data))
    if changed.any():
        message = (
            f"{name} holds {data[changed][0]:.6g}, but samples are kept in single precision, from "
            f"1.5e-45 to 3.4e38: {_in_range(np.abs(data))}"
        )
        raise InputError(message)
    return kept


def _in_range(size: Reals) -> str:
    """Return how to bring absolute values into the range of single precision."""
    low, high = np.log10([f(size[(size > 0) & np.isfinite(size)]) for f in (np.min, np.max)])
    if high - low < _DECADES:
        return f"scale the radiance, such as by 1e{-round((low + high) / 2)}"
    if high < _LARGEST:
        return "give 0 for what is too small to matter"
    return f"scale the radiance by 1e{-round(high)}, and give 0 for what is then too small"


def check_features(features: Mapping[str, npt.ArrayLike], shape: tuple[int, ...]) -> None:
    """Refuse first-hit features of another image than that of these samples."""
    for name, image in features.items():
        if name in (given := {"counts": "number", COSTS: "time"}):
            option = "counts" if name == "counts" else "seconds"
            message = (
                f"a feature must not be called {name}: give the {given[name]} of the samples of "
                f"each pixel as {option}="
            )
            raise InputError(message)
        if np.ndim(image) not in (2, 3) or np.shape(image)[:2] != shape[:2]:
            message = (
                f"feature {name} must have shape {shape[:2]} or (*{shape[:2]}, component), "
                f"as the samples, got {np.shape(image)}"
            )
            raise InputError(message)


def check_counts(counts: npt.ArrayLike, shape: tuple[int, ...]) -> PixelCounts:
    """Return how many of its samples each pixel has, shape (y, x).

    Raises
    ------
    InputError
        If they are not whole numbers from 0 to the number of samples, or are of another image.
    """
    found = np.asarray(counts)
    if found.dtype.kind not in "iu" or found.shape != shape[:2]:
        message = (
            f"counts must be whole numbers, the samples of each pixel, of shape {shape[:2]}; got "
            f"{found.dtype} of shape {found.shape}"
        )
        raise InputError(message)
    if found.min() < 0 or found.max() > shape[3]:
        message = (
            f"counts must be from 0 to {shape[3]}, the samples that there are, got {found.min()} "
            f"to {found.max()}"
        )
        raise InputError(message)
    return np.asarray(found, np.int32)


_KINDS: Mapping[str, Any] = {
    "averaged": int,
    "sequence": int,
    "integrator": dict,
    "notes": list,
    "plugins": dict,
    "render_seconds": int | float,
}
"""Types of the provenance that is not only shown."""


def checked_attrs(attrs: Mapping[str, Any]) -> dict[str, Any]:
    """Return provenance as stores keep it: text, numbers, and lists and dicts of these, no None.

    Raises
    ------
    InputError
        If provenance of a known name has another type.

    Examples
    --------
    >>> checked_attrs({"seed": np.int64(7), "integrator": "path", "sequence": None})
    {'seed': 7, 'integrator': {'type': 'path'}}
    """
    found = {}
    for name, value in attrs.items():
        if value is None:
            continue
        plain = json.loads(json.dumps(value, default=_plain), parse_constant=str)
        kind = _KINDS.get(name, object)
        if isinstance(plain, str) and kind in (dict, list):
            plain = {"type": plain} if kind is dict else [plain]
        if kind is int:
            plain = whole(name, plain, least=1)
        if not isinstance(plain, kind):
            message = f"{name} must be of type {getattr(kind, '__name__', kind)}, got {value!r}"
            raise InputError(message)
        found[name] = plain
    return found


def _plain(value: Any) -> Any:
    return value.tolist() if isinstance(value, np.generic | np.ndarray) else str(value)


def _counted(counts: PixelCounts, samples: range) -> PixelCounts:
    """Return how many of some samples each pixel has, if it has the first `counts`.

    Examples
    --------
    >>> _counted(np.array([[0, 5, 9]], np.int32), range(2, 8, 2))
    array([[0, 2, 3]], dtype=int32)
    """
    last = np.minimum(counts, samples.stop) - samples.start
    return np.asarray(np.maximum(-(-last // samples.step), 0), np.int32)


def _cut(dim: str, places: range, index: _Index) -> slice:
    """Return an index along a dim as a forward slice; an integer becomes a slice of one."""
    length = len(places)
    if isinstance(index, slice):
        kept = range(length)[index]
    else:
        place = operator.index(index)
        kept = range(place % length, place % length + 1) if -length <= place < length else range(0)
    if not kept or kept.step < 0:
        forward = " and go forward" * isinstance(index, slice)
        message = f"{dim} must lie within {-length} to {length - 1}{forward}, got {index!r}"
        raise InputError(message)
    return _as_slice(kept)


def _as_slice(places: range) -> slice:
    return slice(places.start, places.stop, places.step)
