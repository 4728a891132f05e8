"""Images whose radiance is known, and estimators that were trained on them once for all tests."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

import chdstat as chd
from chdstat.estimators import Progressive


@dataclass(frozen=True)
class Known:
    """An image and the radiance that its samples are draws of, shape (y, x, channel)."""

    samples: chd.Samples
    radiance: npt.NDArray[np.float64]

    @property
    def x(self) -> npt.NDArray[np.float32]:
        """Samples, shape (y, x, channel, sample)."""
        return self.samples.read()

    def error(self, estimate: npt.NDArray[Any], *, relative: bool = False) -> float:
        """Return the MSE or the relMSE, that of the sample mean being 1."""
        floor = 0.01 * self.radiance.mean(axis=(0, 1)) ** 2
        weight = 1 / (self.radiance**2 + floor) if relative else np.ones_like(self.radiance)
        of_mean = self.x.mean(axis=-1, dtype=np.float64)
        lost, baseline = (
            float((weight * (p - self.radiance) ** 2).mean()) for p in (estimate, of_mean)
        )
        return lost / baseline

    def bias(self, estimate: npt.NDArray[Any]) -> float:
        """Return how much brighter than the truth the image is on average, as a share."""
        return float((estimate - self.radiance).mean() / self.radiance.mean())


def _make(size: int, spp: int, *, seed: int, smooth: bool = False) -> Known:
    """Simulate pixels of many brightnesses whose light comes seldom, and then in gamma amounts.

    The albedo is known; where `smooth`, the light varies slowly over the image, or else from
    pixel to pixel.
    """
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:size, :size][..., np.newaxis, np.newaxis] / 32
    if smooth:
        light, seldom = np.exp(np.sin(5 * y) + np.cos(4 * x)), 0.2 + 0.15 * np.sin(3 * x)
    else:
        light = rng.lognormal(size=(size, size, 1, 1))
        seldom = rng.uniform(0.05, 0.9, size=(size, size, 1, 1))
    albedo = np.where((y + x) % 0.5 < 0.25, 0.8, 0.3) * np.array([1, 0.8, 0.5])[:, np.newaxis]
    lit = rng.random((size, size, 1, spp)) < seldom
    draws = lit * rng.gamma(0.5, 2.0, size=(size, size, 1, spp))
    return Known(
        chd.Samples.from_array(light * albedo * draws, features={"albedo": albedo[..., 0]}),
        (light * albedo * seldom)[..., 0],
    )


@pytest.fixture(scope="session")
def image() -> Callable[..., Known]:
    """Return what makes images: ``image(size, spp, seed=, smooth=False)``."""
    return _make


@pytest.fixture(scope="session")
def trained() -> Progressive:
    """Return an estimator that had a reference."""
    samples = _make(32, 128, seed=0).samples
    return Progressive().train(samples, sizes=(8, 32), iterations=150, progress=False)


@pytest.fixture(scope="session")
def featured() -> Progressive:
    """Return one that looks at first-hit features."""
    samples = _make(24, 32, seed=1, smooth=True).samples
    model = Progressive(with_features=True)
    return model.train(samples, sizes=(8,), iterations=20, progress=False)
