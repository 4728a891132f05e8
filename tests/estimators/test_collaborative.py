"""Bayesian collaborative denoising, against a loop over patches that follows the publication."""

import itertools

import numpy as np
import pytest

from chdstat import estimators
from chdstat.estimators import similarity


def by_loop(x, threshold, radius, patch):
    """Denoise one scale of (y, x, 1, sample), one patch of known pixels after the other."""
    image = similarity.ScaledSamples.of(x)
    assert image.unit == 1
    mean, n = x[:, :, 0].mean(axis=-1), x.shape[-1]
    noise, bins = x[:, :, 0].var(axis=-1, ddof=1) / n, similarity.histograms(image, 1.0)
    height, width = mean.shape
    total, times = np.zeros_like(mean), np.zeros_like(mean)

    def square(y, x):
        return slice(y - patch, y + patch + 1), slice(x - patch, x + patch + 1)

    centres = itertools.product(range(patch, height - patch), range(patch, width - patch))
    centres = [at for at in centres if np.isfinite(mean[square(*at)]).all()]
    for y, x in centres:
        alike = []
        for v, u in centres:
            if max(abs(v - y), abs(u - x)) <= radius:
                h, g = bins[square(y, x)], bins[square(v, u)]
                used = h + g > 1
                terms = (n * h - n * g)[used] ** 2 / (n * n * (h + g)[used])
                if terms.sum() <= threshold * used.sum() or (v, u) == (y, x):
                    alike.append((v, u))
        p = np.array([mean[square(*at)].ravel() for at in alike])
        if len(alike) <= p.shape[1]:
            total[square(y, x)] += p.mean(axis=0).reshape(2 * patch + 1, -1)
            times[square(y, x)] += 1
            continue
        of_noise = np.diag(np.mean([noise[square(*at)].ravel() for at in alike], axis=0))
        level, axes = np.linalg.eigh(np.cov(p.T) - of_noise)
        inverse = np.linalg.pinv(axes @ np.diag(np.maximum(level, 0)) @ axes.T + of_noise)
        first = p - (p - p.mean(axis=0)) @ inverse @ of_noise
        inverse = np.linalg.pinv(np.cov(first.T) + of_noise)
        for at, one in zip(alike, p - (p - first.mean(axis=0)) @ inverse @ of_noise, strict=True):
            total[square(*at)] += one.reshape(2 * patch + 1, -1)
            times[square(*at)] += 1
    return np.where(times > 0, total / np.maximum(times, 1), mean)


@pytest.mark.filterwarnings("ignore::chdstat.errors.LeftOutWarning")
@pytest.mark.parametrize("patch", [0, 1])
def test_it_is_the_publication_patch_by_patch(patch):
    rng = np.random.default_rng(3)
    level = 1 + np.sin(np.arange(8))[:, np.newaxis] / 2 + np.arange(9) / 20
    x = level[..., np.newaxis, np.newaxis] * rng.gamma(4, 0.05, size=(8, 9, 1, 24))
    x[1, 6] = np.nan  # the patches with this pixel are left out, the others of its neighbours not
    options = {"threshold": 1.4, "radius": 3, "patch": patch}
    found = estimators.boughida2017(x, **options, scales=1, unit=1.0)[..., 0]
    expected = by_loop(x, **options)
    assert np.allclose(found, expected, rtol=1e-5, equal_nan=True)
    assert np.nanmax(np.abs(found / x[:, :, 0].mean(axis=-1) - 1)) > 0.02


def test_noise_vanishes_and_edges_stay_at_every_scale():
    rng = np.random.default_rng(1)
    x = rng.exponential(size=(40, 41, 3, 32))  # an odd width has no pair for its last column
    x[:, 20:] *= 20
    mean = x.mean(axis=-1)
    for scales in (1, 2, 3):
        found = estimators.boughida2017(x, scales=scales)
        assert found[:, :20].std() < 0.3 * mean[:, :20].std()
        assert np.allclose([found[:, :20].mean(), found[:, 20:].mean()], [1, 20], rtol=0.03)
    coarse = np.lib.stride_tricks.sliding_window_view(found[:, :20, 0], (8, 8)).mean(axis=(2, 3))
    fine = estimators.boughida2017(x, scales=1)[:, :20, 0]
    fine = np.lib.stride_tricks.sliding_window_view(fine, (8, 8)).mean(axis=(2, 3))
    assert coarse.std() < fine.std()  # low frequencies are those of the coarser scales


def test_patches_without_noise_stay():
    x = np.repeat(np.random.default_rng(0).random((12, 13, 3, 1)), 8, axis=-1)
    assert np.allclose(estimators.boughida2017(x), x[..., 0])


def test_small_images_are_taken():
    x = np.random.default_rng(2).exponential(size=(2, 5, 3, 8))
    assert np.allclose(estimators.boughida2017(x), x.mean(axis=-1))
