"""Patterns of noise with exact answers: a mask that lets some rays through to a lamp behind it.

A sample of a pixel is ``base``, and with probability ``chance`` it is ``base + light``.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

Image = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Pattern:
    """Radiance of each pixel, shape (y, x), and the error to ask for."""

    base: Image
    light: Image
    chance: Image
    asked: float = 0.1

    @property
    def mean(self) -> Image:
        """The exact image."""
        return self.base + self.light * self.chance

    @property
    def variance(self) -> Image:
        """The exact variance of a sample."""
        return self.light**2 * self.chance * (1 - self.chance)

    @property
    def scale(self) -> Image:
        """What squared errors are relative to."""
        return self.mean**2 + 0.01 * self.mean.mean() ** 2

    def error(self, squared: Image) -> float:
        """Return the root of relMSE of squared errors."""
        return float(np.sqrt((squared / self.scale).mean()))

    def samples(self, rng: np.random.Generator, spp: int) -> npt.NDArray[np.float32]:
        """Draw samples without a renderer, shape (y, x, 1, sample)."""
        met = rng.random((*self.base.shape, spp)) < self.chance[..., np.newaxis]
        x = self.base[..., np.newaxis] + self.light[..., np.newaxis] * met
        return x[:, :, np.newaxis].astype(np.float32)

    @property
    def scene(self) -> dict[str, Any]:
        """The scene, of which a pixel is a texel."""
        height, width = self.base.shape
        place, camera = np.diag([width / height, 1.0, 1.0, 1.0]), np.eye(4)
        camera[[0, 1, 2], [0, 1, 2]] = -width / height, width / height, -1
        behind, camera[2, 3] = place.copy(), 5
        behind[2, 3] = -1
        black = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.0}}
        opacity = _texture(1 - self.chance[..., np.newaxis])
        return {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": 3},
            "sensor": {"type": "orthographic", "to_world": camera},
            "front": {
                "type": "rectangle",
                "to_world": place,
                "bsdf": {"type": "mask", "opacity": opacity, "nested": black},
                "emitter": {"type": "area", "radiance": _texture(_grey(self.base))},
            },
            "lamp": {
                "type": "rectangle",
                "to_world": behind,
                "bsdf": black,
                "emitter": {"type": "area", "radiance": _texture(_grey(self.light))},
            },
        }


def _grey(image: Image) -> Image:
    return np.repeat(image[..., np.newaxis], 3, axis=-1)


def _texture(image: Image) -> dict[str, Any]:
    data = np.ascontiguousarray(image[::-1], np.float32)  # the first row of a texture lies below
    return {"type": "bitmap", "data": data, "raw": True, "filter_type": "nearest"}


def noisy_where(mask: npt.NDArray[np.bool_], chance: float, asked: float = 0.1) -> Pattern:
    """Return an image of mean 1 whose noise lies where the mask is."""
    calm = np.where(mask, 0.0, 1.0)
    return Pattern(calm, np.where(mask, 1 / chance, 0.0), np.where(mask, chance, 1.0), asked)


def patterns(height: int, width: int) -> dict[str, Pattern]:
    """Return patterns by name."""
    (y, x), rng = np.indices((height, width)), np.random.default_rng(0)
    flat, shuffled = np.ones((height, width)), rng.permutation(height * width)
    shuffled = shuffled.reshape(height, width)
    dots, albedo = rng.random((height, width)) < 0.02, rng.uniform(0.05, 2, (height, width))
    chance = np.geomspace(0.9, 0.02, width) * flat
    return {
        "diagonals, every 16 pixels": noisy_where((x + y) % 16 == 0, 0.01),
        "one diagonal": noisy_where(x * height // width == y, 0.05),
        "anti-diagonal": noisy_where((width - 1 - x) * height // width == y, 0.05),
        "vertical line": noisy_where(x == width // 2, 0.05),
        "checker, 1 pixel": noisy_where((x + y) % 2 == 0, 0.05),
        "checker, 2 pixels": noisy_where((x // 2 + y // 2) % 2 == 0, 0.05),
        "single pixel": noisy_where(shuffled == 0, 0.2, 0.25 / np.sqrt(height * width)),
        "five pixels": noisy_where(shuffled < 5, 0.1, 0.6 / np.sqrt(height * width)),
        "dots, 8 over 0.2": Pattern(
            np.where(dots, 0, 0.2), np.where(dots, 80.0, 0), np.where(dots, 0.1, 1.0), 0.05
        ),
        "corner": noisy_where((x < width // 5) & (y < height // 5), 0.02),
        "gradient": Pattern(0 * flat, np.linspace(0.2, 2, height)[:, None] / chance, chance),
        "white texture": Pattern(0 * flat, albedo / 0.2, 0.2 * flat),
        "rare fireflies": Pattern(0.9 * flat, 100 * flat, 0.001 * flat),
        "many nulls": Pattern(0 * flat, 50 * flat, 0.02 * flat, 0.15),
    }
