"""Bayesian collaborative denoising: similar patches are shrunk towards their mean.

`neighbourhood` averages pixels with similar samples. `boughida2017` estimates instead how much of
the difference between similar patches is noise, from the covariances of their samples, and removes
only that.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Floats, Reals, as_pixels, spans, whole
from chdstat._core.image_scales import exposure_unit
from chdstat.estimators import similarity
from chdstat.estimators.registry import check_positive, register

_LEAST = 1e-8
"""Added to the eigenvalues of the matrix that is inverted (authors' code)."""
_PATCHES = 2**14
"""Similar patches that are denoised at once."""


@register(
    "boughida2017",
    "Boughida & Boubekeur 2017, doi:10.1111/cgf.13231",
    label="Boughida and Boubekeur 2017",
    place=7,
    minimum_samples=2,
    uses_neighbours=True,
    joint_channels=True,
)
def boughida2017(
    x: Reals,
    *,
    threshold: float = 1.0,
    radius: int = 6,
    patch: int = 1,
    scales: int = 3,
    unit: float | None = None,
) -> Reals:
    """Bayesian collaborative denoising: remove the noise from the variance of similar patches.

    Patches are similar as in `delbracio2014`. For each patch, let m be the mean of the patches
    similar to it, C their covariance, and N the mean covariance of their noise. Each of these
    patches p becomes ``p - N (C' + N)^-1 (p - m)``. The first step takes C' = C - N without its
    negative eigenvalues; the second takes the mean and the covariance of the patches from the first
    step. Where too few patches are similar for a covariance, the patch becomes their mean. A pixel
    is the average of all patches that contain it. Coarser scales, each at half the resolution, are
    denoised in the same way and replace the low frequencies of the finer scale.

    Formulas and settings follow the authors' code. Two parts of it are left out: it skips patches
    that were already denoised, to save time, and it has a removal of spikes, which is off by
    default.

    Parameters
    ----------
    x
        Samples, shape (y, x, channel, sample), at least 2. Samples with a NaN or infinite channel
        are left out.
    threshold
        Distance up to which patches are similar, larger than 0.
    radius
        Radius of the search window, in pixels: 6 for 13 x 13.
    patch
        Radius of the patches: 1 for 3 x 3, 0 for single pixels.
    scales
        Number of scales, 1 or more; small images have fewer.
    unit
        Radiance that is exposed as 1; None makes the log-average of the image 0.18.

    Returns
    -------
    ndarray
        Estimates, shape (y, x, channel), in the unit and dtype of `x`, not negative if no sample
        is. Pixels with fewer than 2 samples that are good in all channels, and images smaller than
        a patch, get the mean of each channel's good samples.

    Raises
    ------
    InputError
        If `x` is not an image, has fewer than 2 samples, or an option is out of range.

    References
    ----------
    M. Boughida and T. Boubekeur, "Bayesian collaborative denoising for Monte Carlo rendering",
    Computer Graphics Forum 36(4), 2017, doi:10.1111/cgf.13231.

    Examples
    --------
    >>> image = np.random.default_rng(0).exponential(size=(8, 8, 3, 32))
    >>> alone, denoised = image.mean(axis=-1), boughida2017(image)
    >>> bool(denoised.std() < alone.std() / 2)
    True
    """
    whole("radius", radius, least=0)
    whole("patch", patch, least=0)
    whole("scales", scales, least=1)
    check_positive(threshold=threshold)
    image = similarity.ScaledSamples.of(as_pixels(x, minimum=2, image=True))
    exposed = exposure_unit(image.mean().mean(axis=-1) * image.unit, unit)
    sizes = [_Pixels.of(image, exposed)]
    while len(sizes) < scales and min(sizes[-1].count.shape) // 2 > 2 * patch:
        sizes.append(sizes[-1].halved())
    found = sizes[-1].denoised(threshold, radius, patch)
    for pixels in sizes[-2::-1]:
        fine = pixels.denoised(threshold, radius, patch)
        fine += _doubled(np.nan_to_num(found - _halved(fine)), fine.shape)
        found = fine
    if image.samples.min() >= 0:
        found = np.maximum(found, 0)
    return image.radiance(found)


@dataclass(frozen=True)
class _Pixels:
    """Statistics of the pixels of an image at one scale.

    Attributes
    ----------
    mean
        Shape (y, x, channel), NaN where fewer than 2 samples are good.
    noise
        Covariance of these means, shape (y, x, channel, channel).
    histogram
        Shape (y, x, channel x bin).
    count
        Number of good samples, shape (y, x).
    """

    mean: Floats
    noise: Floats
    histogram: Floats
    count: Floats

    @classmethod
    def of(cls, image: similarity.ScaledSamples, exposed: float) -> _Pixels:
        """Measure the samples of an image."""

        def work(rows: Floats, good: npt.NDArray[np.bool_], n: npt.NDArray[np.int64]) -> Any:
            n = np.where(n > 1, n, np.nan)
            mean = rows.sum(axis=-1) / n
            apart = (rows - mean[..., np.newaxis]) * good
            scale = n * (n - 1)
            return mean, apart @ apart.swapaxes(-1, -2) / scale[..., np.newaxis]

        with np.errstate(invalid="ignore", over="ignore"):
            mean, noise = image.walk(work)
        return cls(mean, noise, similarity.histograms(image, exposed), image.count.astype(float))

    def halved(self) -> _Pixels:
        """Return the image at half the resolution, each pixel with the samples of four."""
        share = _halved(np.isfinite(self.mean[..., :1]).astype(np.float64))
        with np.errstate(invalid="ignore"):
            mean = _halved(np.nan_to_num(self.mean)) / np.where(share > 0, share, np.nan)
            noise = _halved(np.nan_to_num(self.noise)) / (4 * share**2)[..., np.newaxis]
        counts = 4 * _halved(self.count[..., np.newaxis])[..., 0]
        return _Pixels(mean, noise, 4 * _halved(self.histogram), counts)

    def denoised(self, threshold: float, radius: int, patch: int) -> Floats:
        """Return the denoised means; NaN for pixels that are in no patch of known pixels."""
        height, width, channels = self.mean.shape
        side = 2 * patch + 1
        rows, columns = height - 2 * patch, width - 2 * patch
        total = np.zeros((height, width, channels + 1))
        if min(rows, columns) < 1:
            return np.full_like(self.mean, np.nan)
        similar = self._similar(threshold, radius, patch)
        values, noise = (
            _around(_patches(np.nan_to_num(image), patch), radius)
            for image in (self.mean, self.noise.reshape(height, width, -1))
        )
        # Each patch adds up, with the number of times that it was denoised, and goes to its pixels.
        added = np.zeros((rows + 2 * radius, columns + 2 * radius, values.shape[-1] + 1))
        window = (2 * radius + 1) ** 2
        for y in range(rows):
            for xs in spans(columns, max(1, _PATCHES // window)):
                members = similar[y, xs].astype(np.float64)
                its_values, its_noise = (_window(image, y, xs, radius) for image in (values, noise))
                patches, weight = _collaborated(its_values, its_noise, members, channels)
                weighted = np.concatenate([patches, np.ones_like(weight)[..., np.newaxis]], axis=-1)
                weighted *= weight[..., np.newaxis]
                for k in range(window):
                    dy, dx = divmod(k, 2 * radius + 1)
                    added[y + dy, xs.start + dx : xs.stop + dx] += weighted[:, k]
        inner = added[radius : radius + rows, radius : radius + columns]
        for k in range(side**2):
            dy, dx = divmod(k, side)
            at = total[dy : dy + rows, dx : dx + columns]
            at[..., :-1] += inner[..., k * channels : (k + 1) * channels]
            at[..., -1] += inner[..., -1]
        with np.errstate(invalid="ignore"):
            return np.asarray(total[..., :-1] / total[..., -1:])

    def _similar(self, threshold: float, radius: int, patch: int) -> npt.NDArray[np.bool_]:
        """Return which patches of the window are similar to its central patch, (y, x, place)."""
        height, width = self.count.shape
        rows, columns, side = height - 2 * patch, width - 2 * patch, 2 * radius + 1
        found = np.zeros((rows, columns, side, side), np.bool_)
        found[:, :, radius, radius] = True
        fields = self.histogram, self.count[..., np.newaxis]
        for here, there in similarity.pairs(height, width, radius):
            dy, dx = (b.start - a.start for a, b in zip(here, there, strict=True))
            distance, used = similarity.chi_square(
                *(field[here] for field in fields), *(field[there] for field in fields)
            )
            (h, w), cut = distance.shape, slice(patch, -patch or None)
            if min(h, w) <= 2 * patch:
                continue
            apart, bins = (
                similarity.window_sum(image, patch)[cut, cut] for image in (distance, used)
            )
            alike = apart <= threshold * bins
            for sign, corner in ((1, here), (-1, there)):
                top, left = corner[0].start, corner[1].start
                at = slice(top, top + alike.shape[0]), slice(left, left + alike.shape[1])
                found[*at, radius + sign * dy, radius + sign * dx] = alike
        patches = _patches(np.isfinite(self.mean[..., :1]), patch)
        whole_ones = np.asarray(patches.all(axis=-1, keepdims=True))
        around = np.lib.stride_tricks.sliding_window_view(
            _around(whole_ones, radius)[..., 0], (side, side)
        )
        both: npt.NDArray[np.bool_] = found & around & whole_ones[..., np.newaxis]
        return both.reshape(rows, columns, -1)


def _collaborated(
    values: Floats, noise: Floats, members: Floats, channels: int
) -> tuple[Floats, Floats]:
    """Denoise the similar patches of some windows.

    Values have shape (window, patch, number), noise (window, patch, number x channel), members (1
    or 0) (window, patch). Returns the patches and how often each counts.
    """
    n = members.sum(axis=-1)
    size = values.shape[-1]
    weight = np.zeros_like(members)
    patches = np.zeros_like(values)
    middle = members.shape[1] // 2
    share = members / np.maximum(n, 1)[..., np.newaxis]
    mean = (share[:, np.newaxis] @ values)[:, 0]
    few = (n > 0) & (n < size + 1)
    patches[few, middle], weight[few, middle] = mean[few], 1
    many = n > size
    if many.any():
        x, m, count = values[many], members[many], n[many]
        block = (share[many][:, np.newaxis] @ noise[many])[:, 0]
        block = block.reshape(len(x), size // channels, channels, channels)
        of_noise = np.zeros((len(x), size, size))
        for k in range(size // channels):
            at = slice(k * channels, (k + 1) * channels)
            of_noise[:, at, at] = block[:, k]
        signal = _covariance(x - mean[many][:, np.newaxis], m, count) - of_noise
        level, axes = np.linalg.eigh(signal)
        signal = (axes * np.maximum(level, 0)[:, np.newaxis]) @ axes.swapaxes(-1, -2)
        first = _shrunk(x, mean[many], signal, of_noise)
        centre = (share[many][:, np.newaxis] @ first)[:, 0]
        signal = _covariance(first - centre[:, np.newaxis], m, count)
        patches[many] = _shrunk(x, centre, signal, of_noise)
        weight[many] = m
    return patches, weight


def _covariance(apart: Floats, members: Floats, n: Floats) -> Floats:
    """Return the covariance of the members, shape (window, number, number)."""
    weighted = apart * members[..., np.newaxis]
    return np.asarray(weighted.swapaxes(-1, -2) @ apart / (n - 1)[:, np.newaxis, np.newaxis])


def _shrunk(values: Floats, centre: Floats, signal: Floats, noise: Floats) -> Floats:
    """Shrink patches towards their centre by the share of noise in their variance."""
    # Added, not used as a lower bound: it only matters where signal and noise are both near 0.
    whole_of = signal + noise + _LEAST * np.eye(signal.shape[-1])
    share = np.linalg.solve(whole_of, noise)  # its transpose, for both are symmetric
    return np.asarray(values - (values - centre[:, np.newaxis]) @ share)


def _patches(image: npt.NDArray[Any], radius: int) -> npt.NDArray[Any]:
    """Return the patch around each pixel that has a whole one, shape (y, x, pixel x value)."""
    side = 2 * radius + 1
    views = np.lib.stride_tricks.sliding_window_view(image, (side, side), axis=(0, 1))
    rows, columns = views.shape[:2]
    return np.moveaxis(views, 2, -1).reshape(rows, columns, -1)


def _around(image: npt.NDArray[Any], radius: int) -> npt.NDArray[Any]:
    """Surround an image with zeros."""
    return np.pad(image, ((radius, radius), (radius, radius), (0, 0)))


def _window(image: Floats, y: int, xs: slice, radius: int) -> Floats:
    """Return the windows around some pixels of a row, shape (pixel, place, value)."""
    side = 2 * radius + 1
    strip = image[y : y + side, xs.start : xs.stop + 2 * radius]
    views = np.lib.stride_tricks.sliding_window_view(strip, (side, side), axis=(0, 1))[0]
    return np.asarray(np.moveaxis(views, 1, -1).reshape(len(views), side**2, -1))


def _halved(image: Floats) -> Floats:
    """Average squares of 2 x 2 pixels; a last row or column without its pair is left out."""
    height, width = (size // 2 for size in image.shape[:2])
    squares = image[: 2 * height, : 2 * width].reshape(height, 2, width, 2, *image.shape[2:])
    return np.asarray(squares.mean(axis=(1, 3)))


def _doubled(image: Floats, shape: tuple[int, ...]) -> Floats:
    """Interpolate linearly between pixels of twice the size."""
    for axis in (0, 1):
        n, place = image.shape[axis], np.arange(shape[axis])
        near = np.minimum(place // 2, n - 1)
        next_to = np.clip(place // 2 + np.where(place % 2, 1, -1), 0, n - 1)
        image = 0.75 * image.take(near, axis=axis) + 0.25 * image.take(next_to, axis=axis)
    return image
