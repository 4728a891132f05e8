"""Render the built-in scenes at a size to look at; write docs/scenes/NAME.webp and recipe.json.

    python tools/make_scene_pictures.py FOLDER [NAME ...]

FOLDER keeps the samples, some 150 MB for each scene; what is there is not rendered again. All
eight take some minutes on one core. Each scene gets a picture, the mean of its samples after Open
Image Denoise; a map of its noise; and in recipe.json the settings, the scene's hash and the
numbers that the page of the scenes prints. tests/docs/test_scene_pictures.py holds them together.
"""

from __future__ import annotations

import hashlib
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import colormaps
from PIL import Image

import chdstat as chd
from chdstat import viz
from chdstat.scenes import BUILTIN, load_scene

OUT = Path(__file__).parents[1] / "docs" / "scenes"
SETTINGS = {"size": (480, 480), "spp": 64, "seed": 1}
DECADES = -0.5, 1.5
"""Logarithms of the noise at both ends of the map's colours."""
COLOURS = "magma"
QUALITY = {"": 88, "-noise": 70}
"""Of a picture, and of a map of noise, whose grain takes most of the bytes."""
LARGEST = 60_000
"""Bytes of a file."""
BRIGHTEST = 0.01
"""Share of the samples whose part of the light is told."""


def pictures(samples: chd.Samples) -> tuple[dict[str, np.ndarray], dict[str, float]]:
    """Return the picture of samples and the map of their noise, 8 bits each, and their numbers."""
    x = samples.read().astype(np.float32)
    mean = x.mean(axis=-1, dtype=np.float64)
    features = {name: samples.features[name] for name in ("albedo", "normal")}
    clean = chd.io.denoise(mean.astype(np.float32), **features)
    null = (x == 0).all(axis=2)
    light = x.mean(axis=2)  # of all channels
    level = light.mean(axis=-1, dtype=np.float64)
    with np.errstate(invalid="ignore", divide="ignore"):
        noise = light.std(axis=-1, ddof=1, dtype=np.float64) / level
    low, high = DECADES
    shade = np.clip((np.log10(np.maximum(noise, 10.0**low)) - low) / (high - low), 0, 1)
    coloured = colormaps[COLOURS](np.where(np.isfinite(shade), shade, 0.0))[..., :3]
    flat = light.ravel()
    most = np.partition(flat, -int(BRIGHTEST * flat.size))[-int(BRIGHTEST * flat.size) :]
    quartiles = np.nanquantile(noise, (0.1, 0.5, 0.9))
    numbers = {
        "null_share": float(null.mean()),
        "mostly_null": float((null.mean(axis=-1) > 0.5).mean()),
        "brightest_share": float(most.sum(dtype=np.float64) / flat.sum(dtype=np.float64)),
        "noise_low": float(quartiles[0]),
        "noise_median": float(quartiles[1]),
        "noise_high": float(quartiles[2]),
    }
    shown = {"": viz.tonemap(clean), "-noise": coloured}
    return {end: np.round(255 * image).astype(np.uint8) for end, image in shown.items()}, numbers


def make(name: str, folder: Path) -> dict[str, Any]:
    """Render a scene, write both images, and return its part of the recipe."""
    samples = chd.render(name, out=folder / f"{name}.zarr", **SETTINGS)
    images, numbers = pictures(samples)
    digests = {}
    for end, image in images.items():
        file = OUT / f"{name}{end}.webp"
        for quality in range(QUALITY[end], 0, -10):
            Image.fromarray(image).save(file, quality=quality, method=6)
            if file.stat().st_size <= LARGEST:
                break
        digests[file.name] = hashlib.sha256(file.read_bytes()).hexdigest()
    return {
        "scene_hash": load_scene(name).hash,
        "chdstat": chd.__version__,
        "mitsuba": samples.attrs["mitsuba_version"],
        "backend": samples.attrs["backend"],
        **SETTINGS,
        "numbers": numbers,
        "files": digests,
    }


def main() -> None:
    """Make what the command line names, else all scenes."""
    folder, names = Path(sys.argv[1]), sys.argv[2:] or list(BUILTIN)
    file = OUT / "recipe.json"
    recipe = json.loads(file.read_text("utf-8")) if file.exists() else {"scenes": {}}
    recipe["command"] = "python tools/make_scene_pictures.py FOLDER"
    recipe["decades"], recipe["colours"], recipe["brightest"] = DECADES, COLOURS, BRIGHTEST
    for name in names:
        recipe["scenes"][name] = make(name, folder)
        text = json.dumps(recipe, indent=1, sort_keys=True)
        file.write_text(f"{text}\n", encoding="utf-8")
        sys.stdout.write(f"{name}\n")


if __name__ == "__main__":
    main()
