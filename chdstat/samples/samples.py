"""Samples: every radiance sample of an image, in memory or on disk, with the same methods.

Index it with a pixel, cut it with `Samples.isel`, read parts, walk it with `Samples.blocks`, or map
a function over its tiles with `Samples.map`; statistics elsewhere take it whole.
"""

from __future__ import annotations

import copy
import itertools
import math
from collections.abc import Callable, Iterator, Mapping
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, SupportsIndex, Unpack, overload

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Image, spans
from chdstat._core.files import place_of
from chdstat.errors import InputError
from chdstat.samples import tiles
from chdstat.samples.axes import as_images, as_slice, check_features, counted, cut, same_numbers
from chdstat.samples.repeats import warn_of_repeats
from chdstat.samples.tiles import DIRECT_DEPTH, Mapped, Part, Source, Work

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.figure import Figure

    from chdstat.patterns.pixel import Pixel

__all__ = ["Samples"]

_ALL = slice(None)


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
        held: Image | Source,
        *,
        attrs: Mapping[str, Any],
        features: Mapping[str, Image] | None = None,
        parts: Mapping[Part, Samples] | None = None,
        part: tuple[range, range, range] | None = None,
        path: Path | None = None,
        counts: npt.NDArray[np.int32] | None = None,
    ) -> None:
        height, width, _, spp = held.shape
        self._held, self._attrs, self._counts = held, dict(attrs), counts
        self._features, self._parts, self._path = features, dict(parts or {}), path
        # Rows, columns and samples of the whole that these are: of a store, those that are read.
        self.part = part or (range(height), range(width), range(spp))

    @classmethod
    def from_array(
        cls,
        array: npt.ArrayLike,
        *,
        features: Mapping[str, Image] | None = None,
        direct: npt.ArrayLike | None = None,
        axes: str | None = None,
        counts: npt.ArrayLike | None = None,
        **attrs: Any,
    ) -> Samples:
        """Hold samples that are already in memory.

        They are kept in single precision, float32 arrays without a copy. Masked samples become NaN.
        A `chdstat.errors.InputWarning` tells of samples that repeat each other over the image.

        Parameters
        ----------
        array
            Linear radiance, shape (y, x, channel, sample) or (y, x, sample), which gains one
            channel. The dims of an `xarray.DataArray` may be in any order: their names decide.
        features
            First-hit features by name, each (y, x) or (y, x, component).
        direct
            Emission and direct light of each sample, of the same shape as the samples.
        axes
            Order of the axes of `array` and `direct`: the letters y, x, c (channel) and s (sample),
            such as "yxsc"; None for "yxcs" or "yxs", where that is plausible.
        counts
            How many samples each pixel has, shape (y, x), where they differ; what `array` holds
            beyond them is ignored. Where they depended on the samples themselves, as in adaptive
            sampling, means are biased.
        **attrs
            Provenance: ``scene="name"``, ``seed=7``, ``unit`` of radiance; ``sequence=16`` where so
            many samples depend on each other.

        Raises
        ------
        InputError
            If the shape is not one of these, or an axis is empty. Without `axes` and names: if
            there would be more than 4 channels, or fewer samples than channels, of which the axes
            are probably in another order. If an array holds unsigned integers, as encoded images
            do, or a sample that is 0 or infinite in single precision only.

        Examples
        --------
        >>> radiance = np.ones((4, 6, 32, 3))  # samples before channels
        >>> Samples.from_array(radiance, axes="yxsc")
        <Samples 'samples' 6 x 4 pixels, 3 channels, 32 spp, in memory>
        """
        parts, found = as_images(array, direct, counts, axes)
        check_features(features or {}, parts[0].shape)
        warn_of_repeats(lambda y, x, s: parts[0][y, x, :, s], parts[0].shape, "samples")
        held = [cls(p, attrs=attrs, features=features or {}, counts=found) for p in parts]
        held[0]._parts = dict.fromkeys([DIRECT_DEPTH] if direct is not None else [], held[-1])
        return held[0]

    @property
    def attrs(self) -> dict[str, Any]:
        """Provenance: scene, scene hash, integrator, seed, backend, Mitsuba version and so on."""
        return dict(self._attrs)

    @property
    def name(self) -> str:
        """Name of the scene, or 'samples' where none was given."""
        return str(self._attrs.get("scene", "samples"))

    @property
    def path(self) -> Path | None:
        """Where the store lies; None in memory, or for a part of a store."""
        return self._path

    @property
    def source(self) -> Source | None:
        """What the samples are read from; None in memory."""
        return None if isinstance(self._held, np.ndarray) else self._held

    @property
    def shape(self) -> tuple[int, int, int, int]:
        """(y, x, channel, sample)."""
        rows, columns, samples = map(len, self.part)
        return rows, columns, self._held.shape[2], samples

    @property
    def spp(self) -> int:
        """Samples per pixel."""
        return len(self.part[2])

    @property
    def counts(self) -> npt.NDArray[np.int32] | None:
        """Samples of each pixel, shape (y, x), where they differ (others read as NaN); or None."""
        found = None if self._counts is None else counted(self._counts, self.part[2])
        return None if found is None or (found == self.spp).all() else found

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the channels."""
        count = self.shape[2]
        return ("R", "G", "B") if count == 3 else tuple(f"channel{i}" for i in range(count))

    @cached_property
    def features(self) -> dict[str, Image]:
        """First-hit features by name: albedo, normal, position (y, x, component), depth (y, x)."""
        if self._features is not None or isinstance(self._held, np.ndarray):
            return dict(self._features or {})
        ys, xs, _ = map(as_slice, self.part)
        return {name: image[ys, xs] for name, image in self._held.read_features().items()}

    @property
    def direct(self) -> Samples | None:
        """Emission and direct light of the same samples, their paths cut; None if not known."""
        return self._parts.get(DIRECT_DEPTH)

    @property
    def depths(self) -> dict[int, Samples]:
        """The same samples of paths cut after so many segments, ascending, as far as known.

        `chdstat.patterns.attribute` says what light comes from which depth.
        """
        return {which: part for which, part in self._parts.items() if isinstance(which, int)}

    @property
    def parts(self) -> dict[Part, Samples]:
        """The same samples with a part of their light: those of `depths` and of `lights`."""
        return dict(self._parts)

    @property
    def lights(self) -> dict[str, Samples]:
        """The same samples by some lights alone, by the names asked for, as far as known."""
        return {which: part for which, part in self._parts.items() if isinstance(which, str)}

    def shares_numbers_with(self, other: Samples) -> bool:
        """Return whether sample i of a pixel was drawn with the random numbers of the other's.

        So it is of renders of equal seed and size by one kind of backend, whatever their scenes:
        what compares them compares pairs. Samples that do not say their seed are independent.

        Examples
        --------
        >>> one, same, other = (Samples.from_array(np.ones((4, 4, 8)), seed=s) for s in (0, 0, 7))
        >>> one.shares_numbers_with(same), one.shares_numbers_with(other)
        (True, False)
        """
        return same_numbers(self._attrs, self.part, other._attrs, other.part)

    def pixel(self, y: int, x: int) -> Pixel:
        """Return one pixel as an object that knows its nulls, statistics, fits and patterns.

        Examples
        --------
        >>> samples = Samples.from_array(np.random.default_rng(0).gamma(2.0, size=(4, 6, 3, 256)))
        >>> samples.pixel(2, 3).families["R"], samples.pixel(2, 3).null_share
        ('gamma', 0.0)
        """
        from chdstat.patterns.pixel import Pixel

        return Pixel.of(self, y, x)

    def plot(self, y: int, x: int, *, fig: Figure | None = None) -> Figure:
        """Draw linear and log10 histograms of one pixel with their best fits, as `Pixel.plot`."""
        return self.pixel(y, x).plot(fig=fig)

    def _repr_html_(self) -> str:
        from chdstat.samples.description import card

        return card(self).html()

    def __repr__(self) -> str:
        from chdstat.samples.description import line

        return line(self)

    @overload
    def __getitem__(self, pixel: tuple[SupportsIndex, SupportsIndex]) -> Image: ...
    @overload
    def __getitem__(self, pixel: tuple[slice, slice | SupportsIndex]) -> Samples: ...
    @overload
    def __getitem__(self, pixel: tuple[slice | SupportsIndex, slice]) -> Samples: ...
    def __getitem__(
        self, pixel: tuple[slice | SupportsIndex, slice | SupportsIndex]
    ) -> Image | Samples:
        """Return the samples that one pixel has, shape (channel, sample); of slices, as `isel`."""
        tiles.check_place(pixel)
        part = self.isel(y=pixel[0], x=pixel[1])
        if any(isinstance(i, slice) for i in pixel):
            return part
        number = part.spp if part.counts is None else int(part.counts[0, 0])
        return part.read()[0, 0, :, :number]

    def isel(
        self,
        *,
        y: slice | SupportsIndex = _ALL,
        x: slice | SupportsIndex = _ALL,
        sample: slice | SupportsIndex = _ALL,
    ) -> Samples:
        """Return some rows, columns or samples of each pixel; nothing is read or copied for it.

        Features and parts are cut alike. An integer keeps its axis, of length 1.

        Raises
        ------
        InputError
            If an index lies outside, keeps nothing, or goes backwards.

        Examples
        --------
        >>> samples = Samples.from_array(np.ones((4, 6, 3, 32)))
        >>> samples.isel(y=slice(1, 3), sample=slice(None, None, 2))
        <Samples 'samples' 6 x 2 pixels, 3 channels, 16 spp, in memory>
        """
        rows, columns, samples = self.part
        ys, xs, ss = cut("y", rows, y), cut("x", columns, x), cut("sample", samples, sample)
        features, parts = self._features, {}
        if features is not None:
            features = {name: image[ys, xs] for name, image in features.items()}
        for which, part in self._parts.items():
            if ss.start < part.spp:  # it may be rendered for fewer samples
                parts[which] = part.isel(y=ys, x=xs, sample=ss)
        return Samples(
            self._held[ys, xs, :, ss] if isinstance(self._held, np.ndarray) else self._held,
            attrs=tiles.attrs_of(self._attrs, self.spp, len(samples[ss])),
            features=features,
            parts=parts,
            part=(rows[ys], columns[xs], samples[ss]),
            counts=None if self._counts is None else self._counts[ys, xs],
        )

    def read(self, ys: slice = _ALL, xs: slice = _ALL, ss: slice = _ALL) -> Image:
        """Return a part of the samples, shape (y, x, channel, sample).

        Raises
        ------
        InputError
            If it is more than the memory of this machine holds.
        StoreError
            If the store on disk is damaged.
        """
        if isinstance(self._held, np.ndarray):
            return self._held[ys, xs, :, ss]
        rows, columns, samples = (r[s] for r, s in zip(self.part, (ys, xs, ss), strict=True))
        return tiles.read_part(self._held, rows, columns, samples)

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> npt.NDArray[Any]:
        """Return all samples as an array (y, x, channel, sample), for ``np.asarray(samples)``."""
        return np.array(self.read(), dtype=dtype, copy=copy)

    @property
    def nbytes(self) -> int:
        """Size of the samples in memory, in bytes."""
        return 4 * math.prod(self.shape)

    def load(self) -> Samples:
        """Return the same samples held in memory: worth it before several analyses."""
        if isinstance(self._held, np.ndarray):
            return self
        loaded = copy.copy(self)
        loaded._held, loaded._features, loaded._path = self.read(), self.features, None
        loaded._parts = {which: part.load() for which, part in self._parts.items()}
        return loaded

    def save(
        self, path: str | Path, *, append: bool = False, progress: bool | None = None
    ) -> Samples:
        """Write the samples to a store, and return those of the store.

        One that was interrupted goes on when it is repeated.

        Parameters
        ----------
        path
            The store to write, a path or a URL.
        append, progress
            Whether to add them to those of an existing store; and to show a progress bar.

        Raises
        ------
        InputError
            If samples of another size are appended, or of the same random numbers.
        StoreError
            If something else is at the path, or it cannot be written.

        Examples
        --------
        >>> import tempfile
        >>> samples = Samples.from_array(np.ones((4, 6, 3, 32)), scene="flat")
        >>> samples.save(Path(tempfile.mkdtemp()) / "flat.zarr").spp
        32
        """
        from chdstat.samples.saving import save

        return save(self, place_of(path), append=append, progress=progress)

    def first(self, spp: int) -> Samples:
        """Return the first samples of each pixel, in memory.

        Raises
        ------
        InputError
            If there are not so many, or less than one is wanted.
        """
        if not 1 <= spp <= self.spp:
            message = f"spp must be from 1 to {self.spp}, what these samples hold; got {spp}"
            raise InputError(message)
        return self.isel(sample=slice(spp)).load()

    def sequence_means(self) -> Samples:
        """Return the averages of sequences of dependent samples, which are independent, in memory.

        Samplers that spread the samples of a pixel draw them in sequences (`chdstat.render`). An
        average with a bad sample is bad; an incomplete last sequence is left out.

        Raises
        ------
        InputError
            If samples are independent, or these begin within a sequence, or hold none.

        Examples
        --------
        >>> drawn = Samples.from_array(np.ones((4, 6, 3, 32)), sampler="stratified", sequence=16)
        >>> drawn.sequence_means()
        <Samples 'samples' 6 x 4 pixels, 3 channels, 2 spp (averages of 16), in memory>
        """
        means, length = tiles.sequence_means(self), tiles.sequence_of(self._attrs)
        attrs = {name: value for name, value in self._attrs.items() if name != "sequence"}
        attrs |= {"averaged": length, "spp": means.shape[-1]}
        return Samples(means, attrs=attrs, features=self.features)

    def blocks(self) -> Iterator[tuple[slice, slice, slice, Image]]:
        """Walk the samples in constant memory: tile by tile, and batch by batch within a tile.

        Yields
        ------
        ys, xs, ss : slice
            Where the block lies.
        block : ndarray
            Its samples, shape (y, x, channel, sample).
        """
        height, width, _, spp = self.shape
        edges = spans(height, tiles.TILE), spans(width, tiles.TILE), spans(spp, tiles.BATCH)
        for ys, xs, ss in itertools.product(*edges):
            yield ys, xs, ss, self.read(ys, xs, ss)

    def map(
        self,
        function: Callable[[Image], Mapped],
        *,
        logarithms: bool = False,
        dependent: bool = False,
        description: str = "analysing",
        **work: Unpack[Work],
    ) -> xr.Dataset:
        """Apply a function to tiles with all their samples and assemble the image.

        Tiles are computed in parallel, in one thread for each core, or by a client's workers.

        Parameters
        ----------
        function
            Takes samples (y, x, channel, sample) of a tile; returns, by variable name, the names
            of the dims that follow (y, x) and an array of shape (y, x, ...). Its results must not
            depend on the order of the tiles.
        logarithms
            Whether it leaves negative samples out, as bad ones are in any case; a
            `chdstat.errors.LeftOutWarning` tells of more than 1 %.
        dependent
            Whether it takes samples that depend on each other, see `sequence_means`.
        description, **work
            Label of a progress bar; ``progress`` to show it, None for a terminal alone; ``client``
            for a Dask client, whose workers then compute the tiles.
        """
        kinds = {"logarithms": logarithms, "dependent": dependent}
        return tiles.mapped(self, function, **kinds, description=description, **work)

    def absent(self, ys: slice = _ALL, xs: slice = _ALL, ss: slice = _ALL) -> int:
        """Return how many samples the pixels of a part lack, where some have fewer than others."""
        if self._counts is None:
            return 0
        asked = self.part[2][ss]
        return int((len(asked) - counted(self._counts[ys, xs], asked)).sum())

    def to_dataset(self) -> xr.Dataset:
        """Return samples, features and counts as a labelled dataset, lazily where on disk."""
        return tiles.dataset_of(self)
