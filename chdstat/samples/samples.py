"""Samples: every radiance sample of an image, in memory or on disk, with the same methods.

Index it with a pixel, read parts of it, walk it in constant memory with `Samples.blocks`, or map a
function over its tiles with `Samples.map`; statistics elsewhere take it whole.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, SupportsIndex

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import LeftOut, spans
from chdstat._core.executor import check_memory, in_order, track
from chdstat.errors import InputError
from chdstat.samples.axes import as_image

if TYPE_CHECKING:
    import xarray as xr

    from chdstat.samples.store import Store

__all__ = ["Mapped", "Samples"]

_MAP_BYTES = 16 * 2**20
"""Size of the block that `Samples.map` hands out at most, unless 16 x 16 pixels are larger."""
_MEMORY_TILE, _MEMORY_BATCH = 64, 64
_ALWAYS_HELD = 2**26
"""Bytes that are read without a look at how much memory there is."""

Mapped = Mapping[str, tuple[tuple[str, ...], npt.NDArray[Any]]]


class Samples:
    """All radiance samples of an image, dims (y, x, channel, sample), float32, linear radiance.

    Make one with `chdstat.render`, `chdstat.open` or `Samples.from_array`.

    Examples
    --------
    >>> import numpy as np
    >>> samples = Samples.from_array(np.ones((4, 6, 3, 32)), scene="flat")
    >>> samples
    <Samples 'flat' 6 x 4 pixels, 3 channels, 32 spp, in memory>
    >>> samples[0, 0].shape
    (3, 32)
    """

    def __init__(
        self,
        *,
        array: npt.NDArray[np.float32] | None = None,
        store: Store | None = None,
        attrs: Mapping[str, Any],
        features: Mapping[str, npt.NDArray[np.float32]] | None = None,
        direct: Samples | None = None,
        spp: int | None = None,
    ) -> None:
        if (array is None) == (store is None):
            message = "Samples holds either an array or a store; use Samples.from_array or open"
            raise InputError(message)
        self._array = array
        self._store = store
        self._attrs = dict(attrs)
        self._features = features
        self._direct = direct
        self._spp = spp

    @classmethod
    def from_array(
        cls,
        array: npt.ArrayLike,
        *,
        features: Mapping[str, npt.NDArray[np.float32]] | None = None,
        direct: npt.ArrayLike | None = None,
        axes: str | None = None,
        **attrs: Any,
    ) -> Samples:
        """Hold samples that are already in memory.

        They are kept in single precision, float32 arrays without a copy. Masked samples become NaN.

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
        **attrs
            Provenance, such as ``scene="name"``.

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
        data = as_image(array, "samples", axes)
        for name, image in (features or {}).items():
            if np.ndim(image) not in (2, 3) or np.shape(image)[:2] != data.shape[:2]:
                message = (
                    f"feature {name} must have shape {data.shape[:2]} or (*{data.shape[:2]}, "
                    f"component), as the samples, got {np.shape(image)}"
                )
                raise InputError(message)
        part = None
        if direct is not None:
            part = cls(array=as_image(direct, "direct", axes), attrs=attrs)
            if part.shape != data.shape:
                message = (
                    f"direct must have the shape of the samples, {data.shape}, got {part.shape}"
                )
                raise InputError(message)
        return cls(array=data, attrs=attrs, features=features, direct=part)

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
        """Where the store lies; None in memory."""
        return self._store.path if self._store else None

    @property
    def shape(self) -> tuple[int, int, int, int]:
        """(y, x, channel, sample)."""
        height, width, channels, spp = (self._store or self._array).shape  # type: ignore[union-attr]
        return height, width, channels, spp if self._spp is None else self._spp

    @property
    def spp(self) -> int:
        """Samples per pixel."""
        return self.shape[3]

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the channels."""
        count = self.shape[2]
        return ("R", "G", "B") if count == 3 else tuple(f"channel{i}" for i in range(count))

    @cached_property
    def features(self) -> dict[str, npt.NDArray[np.float32]]:
        """First-hit features by name: albedo, normal, position (y, x, component), depth (y, x)."""
        if self._features is not None:
            return dict(self._features)
        return self._store.read_features() if self._store else {}

    @property
    def direct(self) -> Samples | None:
        """Emission and direct light of the same samples, as far as known; None where it is not.

        These are the same paths, cut after their first reflection: sample by sample no more than
        the whole. Where their rendering was stopped they are fewer than the samples.
        """
        return self._direct

    def shares_numbers_with(self, other: Samples) -> bool:
        """Return whether sample i of a pixel was drawn with the random numbers of the other's.

        So it is of renders of equal seed and size by one kind of backend, whatever their scenes or
        integrators: their noise is correlated, and what compares them compares pairs of samples.
        Samples that do not say their seed are taken for independent.

        Examples
        --------
        >>> one, same, other = (Samples.from_array(np.ones((4, 4, 8)), seed=s) for s in (0, 0, 7))
        >>> one.shares_numbers_with(same), one.shares_numbers_with(other)
        (True, False)
        """
        if self._attrs.get("seed") is None or self.shape[:2] != other.shape[:2]:
            return False
        # What compiles draws in wavefronts, with numbers of their own.
        kinds = {s.attrs.get("backend") == "scalar" for s in (self, other)}
        named = ("seed", "streams")
        return len(kinds) == 1 and all(self._attrs.get(n) == other.attrs.get(n) for n in named)

    def __repr__(self) -> str:
        height, width, channels, spp = self.shape
        where = f"at {self.path}" if self.path else "in memory"
        return (
            f"<Samples {self.name!r} {width} x {height} pixels, "
            f"{channels} channel{'s' if channels > 1 else ''}, {spp} spp, {where}>"
        )

    def __getitem__(self, pixel: tuple[int, int]) -> npt.NDArray[np.float32]:
        """Return the samples of one pixel, shape (channel, sample)."""
        pair = isinstance(pixel, tuple) and len(pixel) == 2
        if not pair or not all(isinstance(place, SupportsIndex) for place in pixel):
            message = f"expected one pixel (y, x), got {pixel!r}; read() returns parts of an image"
            raise InputError(message)
        y, x = map(int, pixel)
        height, width = self.shape[:2]
        if not (-height <= y < height and -width <= x < width):
            message = f"pixel (y={y}, x={x}) is outside the image of {width} x {height} pixels"
            raise InputError(message)
        y, x = y % height, x % width
        pixels: npt.NDArray[np.float32] = self.read(slice(y, y + 1), slice(x, x + 1))[0, 0]
        return pixels

    def read(
        self, ys: slice = slice(None), xs: slice = slice(None), ss: slice = slice(None)
    ) -> npt.NDArray[np.float32]:
        """Return a part of the samples, shape (y, x, channel, sample).

        Raises
        ------
        InputError
            If it is more than the memory of this machine holds.
        StoreError
            If the store on disk is damaged.
        """
        height, width, channels, spp = self.shape
        ys, xs, ss = (slice(*s.indices(n)) for s, n in ((ys, height), (xs, width), (ss, spp)))
        if self._store is not None:
            lengths = (len(range(s.start, s.stop, s.step)) for s in (ys, xs, ss))
            size = 4 * channels * math.prod(lengths)
            if size > _ALWAYS_HELD:
                advice = "read them in parts, such as read(ys, xs), or walk through blocks()"
                check_memory(size, "these samples", advice)
            return self._store.read(ys, xs, ss)
        return self._array[ys, xs, :, ss]  # type: ignore[index]

    @property
    def nbytes(self) -> int:
        """Size of the samples in memory, in bytes."""
        return 4 * math.prod(self.shape)

    def load(self) -> Samples:
        """Return the same samples held in memory: worth it before several analyses."""
        if self._array is not None:
            return self
        direct = None if self.direct is None else self.direct.load()
        return Samples(array=self.read(), attrs=self.attrs, features=self.features, direct=direct)

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
        direct = self.direct
        return Samples(
            array=self.read(ss=slice(0, spp)),
            attrs={**self.attrs, "spp": spp},
            features=self.features,
            direct=None if direct is None else direct.first(min(spp, direct.spp)),
        )

    def blocks(self) -> Iterator[tuple[slice, slice, slice, npt.NDArray[np.float32]]]:
        """Walk the samples in constant memory: tile by tile, and batch by batch within a tile.

        Yields
        ------
        ys, xs, ss : slice
            Where the block lies.
        block : ndarray
            Its samples, shape (y, x, channel, sample).
        """
        height, width, _, spp = self.shape
        for ys in spans(height, _MEMORY_TILE):
            for xs in spans(width, _MEMORY_TILE):
                for ss in spans(spp, _MEMORY_BATCH):
                    yield ys, xs, ss, self.read(ys, xs, ss)

    def map(
        self,
        function: Callable[[npt.NDArray[np.float32]], Mapped],
        *,
        logarithms: bool = False,
        description: str = "analysing",
        progress: bool | None = None,
    ) -> xr.Dataset:
        """Apply a function to tiles with all their samples and assemble the image.

        Tiles are worked on at once, in one thread for each core.

        Parameters
        ----------
        function
            Takes samples (y, x, channel, sample) of a tile; returns, by variable name, the names
            of the dims that follow (y, x) and an array of shape (y, x, ...). It must not depend
            on the order of the tiles.
        logarithms
            Whether it leaves negative samples out; where more than 1 % are left out, as bad ones
            are in any case, a `chdstat.errors.LeftOutWarning` says so.
        description
            What the progress bar says.
        progress
            Show a progress bar; None shows it on a terminal.

        Returns
        -------
        xarray.Dataset
            The variables over the whole image, with y, x and channel coordinates.
        """
        height, width, channels, spp = self.shape
        edge = _MEMORY_TILE
        while edge > 16 and edge * edge * channels * spp * 4 > _MAP_BYTES:
            edge //= 2
        tiles = itertools.product(spans(height, edge), spans(width, edge))
        left_out = LeftOut(logarithms=logarithms)

        def of_tile(tile: tuple[slice, slice]) -> tuple[slice, slice, Mapped]:
            block = self.read(*tile)
            left_out.see(block, channel_axis=-2)
            return (*tile, function(block))

        parts = in_order(of_tile, tiles)
        dataset = self.assemble(parts, description=description, progress=progress)
        left_out.warn()
        return dataset

    def assemble(
        self,
        parts: Iterable[tuple[slice, slice, Mapped]],
        *,
        description: str = "analysing",
        progress: bool | None = None,
    ) -> xr.Dataset:
        """Assemble what was computed tile by tile; `map` does it for functions of whole tiles.

        Parameters
        ----------
        parts
            Rows, columns and variables of each tile, the latter as the function of `map` returns
            them; consumed one by one.
        description, progress
            As for `map`.
        """
        height, width = self.shape[:2]
        results: dict[str, tuple[tuple[str, ...], npt.NDArray[Any]]] = {}
        with track(description, height * width, unit="px", show=progress) as advance:
            for ys, xs, variables in parts:
                for name, (dims, part) in variables.items():
                    if name not in results:
                        whole = np.empty((height, width, *part.shape[2:]), part.dtype)
                        results[name] = (("y", "x", *dims), whole)
                    results[name][1][ys, xs] = part
                advance((ys.stop - ys.start) * (xs.stop - xs.start))
        return self._dataset(results)

    def to_dataset(self) -> xr.Dataset:
        """Return samples and features as a labelled dataset, lazily (dask) where on disk."""
        import xarray as xr

        dims = ("y", "x", "channel", "sample")
        if self._store is None:
            radiance = xr.DataArray(self._array, dims=dims)
        else:
            radiance = xr.DataArray(self._store.lazy(), dims=dims)
        radiance = radiance.isel(sample=slice(0, self.spp))
        radiance.attrs = {"long_name": "linear radiance", "units": "W sr-1 m-2"}
        features = {
            name: (("y", "x", "component")[: image.ndim], image)
            for name, image in self.features.items()
        }
        return self._dataset({**features, "radiance": radiance})

    def _dataset(self, variables: Mapping[str, Any]) -> xr.Dataset:
        import xarray as xr

        height, width = self.shape[:2]
        dataset = xr.Dataset(dict(variables), attrs=self.attrs)
        dataset = dataset.assign_coords(y=np.arange(height), x=np.arange(width))
        if "channel" in dataset.dims:
            # Strings of variable length: zarr v3 has no stable type for those of fixed length.
            dataset = dataset.assign_coords(channel=np.array(self.channels, dtype=object))
        return dataset
