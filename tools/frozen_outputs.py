"""Compare what forty calls return with what they returned at another commit, to the bit.

    python tools/frozen_outputs.py write FILE     # at the commit to compare with
    python tools/frozen_outputs.py check FILE     # prints every field that differs

Images, arrays and options are made here from seeds. A call that raises is compared by its error.
Digests depend on the versions of NumPy and SciPy and on the machine, so FILE is made anew where it
is needed.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import shutil
import sys
import tempfile
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

import chdstat as chd

ESTIMATORS = (
    *("mean", "median_of_means", "huber", "catoni", "delbracio2014"),
    *("zirr2018", "gmon_adaptive", "jung2015", "rousselle2012", "sakai2024"),
)
FAMILIES = ("gamma", "lognormal", "weibull")


def image(seed: int, shape: tuple[int, int] = (24, 24), n: int = 64) -> np.ndarray:
    """Return samples (y, x, channel, sample) of an image with nulls, two modes and fireflies."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[: shape[0], : shape[1]]
    level = (0.05 + np.hypot(x, y) / 30)[..., None, None] * np.array([1.0, 0.7, 0.4])[:, None]
    samples = level * rng.gamma(1.5, 0.7, (*shape, 1, n))
    samples = samples * np.where(rng.random((*shape, 1, n)) < 0.3, 6.0, 1.0)
    samples = samples * (rng.random((*shape, 1, n)) > 0.2)
    samples += level * 200 * (rng.random((*shape, 1, n)) < 0.0005)
    return samples.astype(np.float32)


def pixels(seed: int, n: int = 512) -> np.ndarray:
    """Return samples (pixel, sample) of laws with one or two modes, heavy tails, or ties."""
    rng = np.random.default_rng(seed)
    laws = [
        rng.gamma(2, 1, n), rng.lognormal(0, 1, n), rng.weibull(0.7, n), rng.pareto(2, n),
        np.where(rng.random(n) < 0.5, rng.normal(1, 0.1, n), rng.normal(3, 0.2, n)),
        rng.integers(0, 4, n).astype(float), np.zeros(n), np.full(n, 2.0),
        rng.normal(0, 1, n), np.where(rng.random(n) < 0.97, 0.0, rng.gamma(2, 1, n)),
    ]  # fmt: skip
    return np.stack(laws)


def calls(folder: Path) -> Iterator[tuple[str, Callable[[], Any]]]:
    """Yield names and calls; later ones use what earlier ones made."""
    a, b = image(1), image(2)
    samples, other = (chd.Samples.from_array(value) for value in (a, b))
    x = pixels(3)
    box = chd.render("cornell-box", spp=32, size=(24, 24), seed=5, progress=False)
    yield "render", lambda: (box.read(), box.counts, box.features)
    yield (
        "render-path",
        lambda: chd.render(
            "bathroom", spp=8, size=(16, 16), seed=6, integrator="path", max_depth=5, progress=False
        ).read(),
    )
    yield (
        "render-store",
        lambda: chd.render(
            "cornell-box", spp=8, size=(16, 16), seed=7, out=folder / "box.zarr", progress=False
        ).read(),
    )
    yield "open", lambda: chd.open(folder / "box.zarr").read()
    yield (
        "adaptive",
        lambda: (
            chd.render(
                "cornell-box",
                spp=16,
                size=(16, 16),
                seed=7,
                adaptive=True,
                out=folder / "a.zarr",
                progress=False,
            ).counts
        ),
    )
    yield (
        "render_pixels",
        lambda: chd.rendering.render_pixels("cornell-box", [(3, 4), (5, 6)], spp=32, seed=8),
    )
    yield "from_array", lambda: (samples.read(), samples.counts, samples[3, 4])
    yield "summarize", lambda: chd.summarize(box)
    yield "histogram", lambda: chd.histogram(x, scale="log")
    yield "analyze", lambda: chd.analyze(samples, progress=False)
    yield "modality", lambda: chd.modality(x)
    yield "modes", lambda: chd.modality(x).modes
    yield "tail_index", lambda: chd.fit.tail_index(x)
    yield "select", lambda: chd.fit.select(x, FAMILIES)
    yield "select-held-out", lambda: chd.fit.select(x, FAMILIES, held_out=True)
    yield "mixture", lambda: chd.fit.mixture(x)
    yield "gamma", lambda: chd.fit.gamma(x)
    yield "lognormal", lambda: chd.fit.lognormal(x)
    yield "goodness", lambda: chd.fit.goodness(x, "gamma")
    yield "gaussianity", lambda: chd.gaussianity(x)
    yield "gaussianity_of_means", lambda: chd.inference.gaussianity_of_means(x)
    yield "classify", lambda: chd.classify(samples)
    yield "contrast", lambda: chd.contrast(samples, other)
    yield "contrast-distributions", lambda: chd.contrast(samples, other, distributions=True)
    yield "difference", lambda: chd.difference(x[0], x[1])
    yield (
        "estimate",
        lambda: fields(
            chd.estimate(samples, progress=False), "radiance", "low", "high", "relative_error"
        ),
    )
    yield (
        "estimate-box",
        lambda: fields(
            chd.estimate(box, progress=False), "radiance", "low", "high", "relative_error"
        ),
    )
    mlp = chd.estimators.MLP(chd.estimators.PRESETS["elek2019"])
    yield (
        "MLP",
        lambda: mlp.train(samples, seed=1, iterations=60, progress=False).predict(a[..., :32]),
    )
    for name in ESTIMATORS:
        yield f"estimators.{name}", lambda name=name: getattr(chd.estimators, name)(a)
    yield (
        "compare",
        lambda: chd.compare(
            samples, ["mean", "huber", "catoni", "median_of_means"], n=16, progress=False
        ).table(),
    )
    yield (
        "error_curve",
        lambda: chd.comparison.error_curve(
            samples, ["mean", "huber"], sizes=[4, 16], progress=False
        ).table(),
    )
    yield (
        "bench",
        lambda: chd.bench(
            {"a": samples, "b": other},
            ["mean", "huber"],
            spp=(8, 16),
            references=None,
            progress=False,
        ).table(),
    )
    yield (
        "bench-box",
        lambda: chd.bench(
            ["cornell-box"],
            ["mean", "huber"],
            spp=(8,),
            size=(12, 12),
            reference_spp=64,
            progress=False,
        ).table(),
    )
    yield "atlas", lambda: chd.atlas(samples, progress=False)
    yield (
        "simulate",
        lambda: chd.simulate(list(chd.patterns.CHDS)[:3], shape=(6, 6), spp=32, seed=2).read(),
    )
    yield "certified", lambda: chd.certified()
    yield "denoise", lambda: chd.io.denoise(a.mean(-1))
    yield "write-read", lambda: written(folder, a)
    yield "pixel", lambda: samples.pixel(3, 4)
    yield "names", lambda: " ".join(sorted(dir(chd)))


def fields(result: Any, *names: str) -> dict[str, Any]:
    """Return some attributes of a result."""
    return {name: getattr(result, name) for name in names}


def written(folder: Path, a: np.ndarray) -> Any:
    """Return what is read from frames that were written as EXR files."""
    names = []
    for index in range(4):
        path = folder / f"frame{index}.exr"
        chd.io.write_image(path, np.ascontiguousarray(a[..., index]))
        names.append(path)
    return chd.io.read(*names).read()


def digests(value: Any, path: str = "") -> Iterator[tuple[str, str]]:
    """Yield the fields of a result with a digest of each."""
    if isinstance(value, xr.Dataset):
        for name in sorted([*map(str, value.variables)]):
            yield from digests(np.asarray(value[name]), f"{path}.{name}")
    elif isinstance(value, xr.DataArray):
        yield from digests(np.asarray(value), path)
    elif isinstance(value, np.ndarray) and value.dtype != object:
        plain = np.ascontiguousarray(value)
        head = f"{plain.dtype.kind}{plain.shape}".encode()
        yield path, hashlib.sha256(head + plain.tobytes()).hexdigest()[:16]
    elif dataclasses.is_dataclass(value) and not isinstance(value, type):
        for field in dataclasses.fields(value):
            if not field.name.startswith("_"):
                yield from digests(getattr(value, field.name), f"{path}.{field.name}")
    elif isinstance(value, dict):
        for key in sorted({*value} - {"seconds"}, key=str):
            yield from digests(value[key], f"{path}.{key}")
    elif isinstance(value, list | tuple):
        for index, item in enumerate(value):
            yield from digests(item, f"{path}.{index}")
    elif hasattr(value, "to_csv"):
        yield path, hashlib.sha256(value.to_csv().encode()).hexdigest()[:16]
    elif isinstance(value, str | int | float | bool | np.generic) or value is None:
        text = repr(value)
        yield path, text if len(text) < 60 else hashlib.sha256(text.encode()).hexdigest()[:16]
    elif hasattr(value, "read") and hasattr(value, "counts"):
        yield from digests(value.read(), f"{path}.read")


def frozen() -> dict[str, str]:
    """Return the digest of each field of each call."""
    folder = Path(tempfile.mkdtemp())
    found: dict[str, str] = {}
    try:
        for name, call in calls(folder):
            try:
                found |= {f"{name}{path}": digest for path, digest in digests(call())}
            except Exception as error:  # noqa: BLE001
                found[name] = f"{type(error).__name__}: {error}"[:200]
    finally:
        shutil.rmtree(folder)
    return found


def main() -> int:
    """Write or check digests."""
    what, file = sys.argv[1], Path(sys.argv[2])
    warnings.simplefilter("ignore")
    now = frozen()
    if what == "write":
        file.write_text(json.dumps(now, indent=1))
        sys.stdout.write(f"{len(now)} fields of {len({k.split('.')[0] for k in now})} calls\n")
        return 0
    before = json.loads(file.read_text())
    different = [k for k in before if now.get(k, "gone") != before[k]]
    for key in different:
        sys.stdout.write(f"{key}: was {before[key]}, is {now.get(key, 'gone')}\n")
    equal = len(before) - len(different)
    sys.stdout.write(f"{equal} of {len(before)} fields are equal to the bit\n")
    return bool(different)


if __name__ == "__main__":
    sys.exit(main())
