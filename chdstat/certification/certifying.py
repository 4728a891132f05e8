"""Certifying pixels of a scene, their datasets, and drawing samples of certified pixels again.

Pixels are chosen from all over an image, of every pattern, quiet and noisy ones. The image is cut
into blocks, 8 x 8 by default, and each block gives one pixel. It is of the kind that was chosen
least often so far. A kind is a pattern of `chdstat.classify` in one fourth of the image's pixels by
relative noise, so that rare patterns and extreme noise are as frequent as common ones. The weight
of a pixel undoes that, for figures of the whole image.

`certified` loads a dataset of certified pixels, the library's own or that in a file. `SCHEMA` names
what each variable is besides the certified numbers, which `chdstat.certification.reduction.Numbers`
declares. A file is a compressed ``.npz`` with an array for each variable, and the attributes as
JSON.
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

import chdstat
from chdstat._core.arrays import (
    Array,
    Counts,
    Floats,
    Image,
    flag_attributes,
    flag_names,
    luminance,
    spans,
    whole,
)
from chdstat._core.files import checked_target, replacing, shown
from chdstat._core.progress import track
from chdstat._core.statistic import RADIANCE
from chdstat.certification.reduction import (
    AVERAGED,
    BANDWIDTHS,
    LEAST,
    MOST_MODES,
    QUANTILES,
    SIZES,
    TAIL_SHARES,
    TOPS,
    Numbers,
    reduce,
)
from chdstat.errors import InputError, SceneError, StoreError
from chdstat.patterns import classify
from chdstat.rendering import render, render_pixels
from chdstat.samples import Samples
from chdstat.scenes import BUILTIN, load_scene

if TYPE_CHECKING:
    import xarray as xr

    from chdstat.rendering.backend import Backend
    from chdstat.scenes.scene import Scene, SceneLike

_VERSION = 1
"""Version of the schema."""
_SUFFIX = ".npz"
_FILE = Path(__file__).parent / "certified.npz"
_SE_BITS = 8
"""Bits of the mantissa of a standard error that are kept: more do not mean anything."""

COORDINATES: dict[str, tuple[tuple[Any, ...], str, str]] = {
    "q": (QUANTILES, "probability of a quantile", "1"),
    "top": (TOPS, "share of the samples that are the largest", "1"),
    "size": (SIZES, "samples of an error bar", "1"),
    "averaged": (AVERAGED, "samples of an average", "1"),
    "bound": (("low", "high"), "end of an interval", ""),
    "share": (TAIL_SHARES, "share of the positive samples in the tail", "1"),
    "bandwidth": (BANDWIDTHS, "standard deviation of the kernel in decades", "1"),
    "mode": (tuple(range(1, MOST_MODES + 1)), "rank of a mode by excess mass", "1"),
}
"""Coordinates of the dims after pixel and channel: values, label, unit."""

SCHEMA: dict[str, tuple[tuple[str, ...], str, str]] = {
    "scene": (("pixel",), "name of the scene", ""),
    "y": (("pixel",), "row of the pixel", "1"),
    "x": (("pixel",), "column of the pixel", "1"),
    "pattern": (("pixel",), "pattern of the pixel when it was chosen", ""),
    "noise": (("pixel",), "relative standard deviation of luminance when it was chosen", "1"),
    "weight": (("pixel",), "pixels of the image that it stands for", "1"),
    "source": (("pixel",), "file of the scene, or 'chdstat'", ""),
    "scene_hash": (("pixel",), "SHA-256 of the scene", ""),
    "width": (("pixel",), "width of the image in pixels", "1"),
    "height": (("pixel",), "height of the image in pixels", "1"),
    "seed": (("pixel",), "seed of the samples", "1"),
    "backend": (("pixel",), "backend that drew the samples", ""),
    "mitsuba_version": (("pixel",), "version of Mitsuba that drew the samples", ""),
    "first_mean": (("pixel", "channel"), "mean of the first 4096 samples", RADIANCE),
    "checksum": (("pixel",), "CRC-32 of the first 4096 samples as float32 (channel, sample)", "1"),
}
"""What is known of each pixel before its numbers: dims, label, unit."""
_PLACES = ("scene", "y", "x", "pattern", "noise", "weight")
"""Variables that are coordinates of the pixel."""


def certified(path: str | Path | None = None) -> xr.Dataset:
    """Load pixels of real scenes with certified answers.

    The library's own are 512 pixels of the eight built-in scenes, 64 of each. A million samples
    of each pixel (2^20) give the numbers and their standard errors: mean, variance, quantiles, how
    often error bars hold, tail index, modes and more. Try your own statistic on the same pixels:
    `chdstat.certification.draw` draws any number of samples of them again.

    Parameters
    ----------
    path
        A file of other pixels, written by ``chdstat bench --certified SCENE --folder FOLDER`` or by
        `chdstat.certification.save`; by default, the library's own.

    Returns
    -------
    xarray.Dataset
        Variables over (pixel, channel, ...), with scene, y, x, pattern, noise and weight as
        coordinates of the pixel. The channels are R, G, B and luminance. NaN where a reason says
        why.

    Raises
    ------
    StoreError
        If there is no such file, or it holds something else.

    See Also
    --------
    chdstat.certification.certify : Certify pixels of another scene.
    chdstat.certification.bench : What this library's own answers score.

    Examples
    --------
    >>> import chdstat as chd
    >>> truth = chd.certified()
    >>> dict(truth.sizes)["pixel"], sorted(set(truth.scene.to_numpy().tolist()))[:3]
    (512, ['bathroom', 'caustic', 'cornell-box'])
    >>> bars = truth.coverage.sel(channel="luminance", size=128)
    >>> print(f"95 % error bars of 128 samples hold the mean in {float(bars.mean()):.0%}")
    95 % error bars of 128 samples hold the mean in 85%
    """
    place = _FILE if path is None else Path(path)
    try:
        with np.load(place, allow_pickle=False) as held:
            arrays = {name: held[name] for name in held.files}
        attrs = json.loads(str(arrays.pop("attrs")))
        if attrs["schema_version"] != _VERSION:
            message = (
                f"{shown(place)} has certified pixels of schema {attrs['schema_version']}, and this"
                f" version reads {_VERSION}; certify them again, or install the version that did"
            )
            raise StoreError(message)
        return _labelled(arrays, attrs)
    except FileNotFoundError as error:
        message = f"there is no file of certified pixels at {shown(place)}"
        raise StoreError(message) from error
    except (OSError, KeyError, ValueError, EOFError) as error:
        message = (
            f"{shown(place)} holds no certified pixels; expected a file that chdstat bench "
            "--certified wrote"
        )
        raise StoreError(message) from error


def _dataset_of(
    numbers: Numbers, known: Mapping[str, Array], attrs: Mapping[str, Any]
) -> xr.Dataset:
    """Return a dataset of the numbers of pixels and what is `known` of them, see `SCHEMA`."""
    arrays = {name: getattr(numbers, own) for name, (own, _) in Numbers.declared().items()}
    return _labelled({**known, **arrays}, {"schema_version": _VERSION, **attrs})


def save(dataset: xr.Dataset, path: str | Path) -> Path:
    """Write certified pixels to an ``.npz`` file, from which `certified` reads them.

    Numbers are in single precision; standard errors keep three digits.

    Raises
    ------
    InputError
        If the file has another suffix.
    """
    target = checked_target(path, _SUFFIX)
    arrays: dict[str, Any] = {"attrs": np.array(json.dumps(dataset.attrs))}
    for name in (*SCHEMA, *Numbers.declared()):
        values = dataset[name].to_numpy()
        if values.dtype.kind == "f":
            values = values.astype(np.float32)
            values = _rounded(values) if name.endswith("_se") else values
        elif values.dtype.kind == "O":
            values = values.astype(np.str_)
        arrays[name] = values
    with replacing(target) as partial, partial.open("wb") as file:
        np.savez_compressed(file, **arrays)
    return target


def _rounded(values: Array) -> Array:
    """Return single-precision numbers with fewer bits, which are smaller when compressed."""
    drop = 23 - _SE_BITS
    bits = values.view(np.uint32).astype(np.uint64) + (1 << (drop - 1))
    cut = (bits >> drop << drop).astype(np.uint32).view(np.float32)
    return np.where(np.isfinite(values), cut, values)


def _labelled(arrays: Mapping[str, Array], attrs: Mapping[str, Any]) -> xr.Dataset:
    import xarray as xr

    declared = {
        name: (("pixel", *about.dims), about.label, about.unit)
        for name, (_, about) in Numbers.declared().items()
    }
    variables = {}
    for name, (dims, label, unit) in (SCHEMA | declared).items():
        values = arrays[name]
        about: dict[str, Any] = {"long_name": label} | ({"units": unit} if unit else {})
        if name.endswith("_reason"):
            about |= flag_attributes()
        if values.dtype.kind == "f":
            values = values.astype(np.float64)
        variables[name] = dims, values, about
    channels = variables["mean"][1].shape[1]
    names = ("R", "G", "B", "luminance") if channels == 4 else ("luminance",)
    coords: dict[str, Any] = {"channel": list(names)}
    for name, (values_of, label, unit) in COORDINATES.items():
        coords[name] = name, np.array(values_of), {"long_name": label, "units": unit}
    dataset = xr.Dataset(variables, coords=coords, attrs=dict(attrs))
    return dataset.set_coords(_PLACES)


# --- datasets of certified pixels -----------------------------------------------------------------


_CERTIFIED_SPP = 2**20
"""Samples of each pixel by default."""
SEED, FRESH_SEED = 1, 2
"""Seeds of the samples that certify, and of those that `draw` draws by default."""
_SIZE = (64, 64)
_CHOICE_SPP = 512
_FIRST = 4096
"""Samples whose mean and checksum are kept, so that others can check that they draw the same."""
_TOGETHER = 2**25
"""Values drawn at once."""
BLOCKS = 8
"""Blocks along each side of the image; each gives one pixel."""
_FOURTHS = 4
_STRIDE = 37
"""Blocks are visited in this step, which is coprime to any power of two: neighbours are far apart
in the order, so that no region of the image gets first choice of the rare kinds."""


def certify(
    scene: SceneLike,
    *,
    spp: int = _CERTIFIED_SPP,
    size: tuple[int, int] = _SIZE,
    blocks: int = BLOCKS,
    seed: int = SEED,
    backend: Backend = "auto",
    progress: bool = True,
) -> xr.Dataset:
    """Certify pixels of a scene: draw about a million samples of each, and reduce them to numbers.

    One pixel is chosen from each of `blocks` x `blocks` blocks of the image, so that all patterns
    and all degrees of noise are there, from a render of 512 spp with seed 0. The samples that
    certify share no random numbers with it. A million samples of 64 pixels take 1 to 5 minutes with
    the llvm backend on two cores.

    Parameters
    ----------
    scene
        As for `chdstat.render`.
    spp
        Samples of each pixel, at least 8192. With fewer than 2^20, errors are larger and more
        numbers are not determined.
    size
        (width, height) of the image in pixels.
    blocks
        Blocks along each side of the image.
    seed, backend
        As for `chdstat.rendering.render_pixels`. llvm and cuda are fastest, but their samples agree
        to the bit only on processors of one kind; scalar ones agree wherever Mitsuba's wheel is the
        same.
    progress
        As for `chdstat.render`.

    Returns
    -------
    xarray.Dataset
        As `chdstat.certified` returns.

    Raises
    ------
    InputError, SceneError, RenderError
        If the scene cannot be rendered as asked, or there are too few samples or pixels.

    Examples
    --------
    >>> truth = certify("cornell-box", spp=8192, size=(8, 8), blocks=2, backend="scalar")
    >>> dict(truth.sizes)["pixel"], str(truth.scene.to_numpy()[0])
    (4, 'cornell-box')
    """
    spp = whole("spp", spp, least=LEAST)
    loaded = load_scene(scene)
    view: Any = {"size": size, "backend": backend, "progress": progress}
    looked_at = render(loaded, spp=_CHOICE_SPP, seed=0, **view)
    choice = chosen(looked_at, blocks)
    parts = []
    step = max(1, _TOGETHER // (3 * spp))
    with track(f"certifying {loaded.name}", len(choice.pixels), show=progress) as advance:
        for piece in spans(len(choice.pixels), step):
            x = render_pixels(
                loaded, choice.pixels[piece], spp=spp, size=size, seed=seed, backend=backend
            )
            parts.append((reduce(x), first_samples(x)))
            advance(len(x))
    count = len(choice.pixels)
    known = {
        "y": choice.pixels[:, 0],
        "x": choice.pixels[:, 1],
        "pattern": choice.pattern,
        "noise": choice.noise,
        "weight": choice.weight,
        **provenance(looked_at, seed, count),
        **{name: np.concatenate([part[1][name] for part in parts]) for name in parts[0][1]},
    }
    return _dataset_of(joined([part[0] for part in parts]), known, about())


def of_scenes(
    scenes: Sequence[str],
    *,
    spp: int | None = None,
    size: tuple[int, int] | None = None,
    folder: Path | None = None,
    progress: bool = True,
) -> xr.Dataset:
    """Return certified pixels of several scenes; without scenes, those of the library.

    Parameters
    ----------
    scenes
        Names of built-in scenes, XML files, which are certified, and files of certified pixels.
    spp, size
        As for `certify`. With either, built-in scenes are certified, too.
    folder
        Where a file with the pixels of each scene is written after it was certified. If it is
        there, it is read.
    progress
        As for `chdstat.render`.

    Raises
    ------
    InputError
        If a file in the folder has other pixels than are asked for.
    """
    import xarray as xr

    if not scenes and spp is None and size is None:
        return certified()
    options: dict[str, Any] = {"spp": spp or _CERTIFIED_SPP, "size": size or _SIZE}
    parts = []
    for name in scenes or BUILTIN:
        if name.endswith(_SUFFIX):
            parts.append(certified(name))
        elif name in BUILTIN and spp is None and size is None:
            known = certified()
            parts.append(known.isel(pixel=np.flatnonzero(known["scene"].to_numpy() == name)))
        else:
            parts.append(_kept(load_scene(name), folder, options, progress))
    return xr.concat(parts, "pixel", data_vars="all", combine_attrs="override")


def _kept(scene: Scene, folder: Path | None, options: dict[str, Any], progress: bool) -> xr.Dataset:
    """Return certified pixels of a scene, from the folder if they are there."""
    if folder is None:
        return certify(scene, **options, progress=progress)
    file = folder / f"{scene.name}{_SUFFIX}"
    if not file.exists():
        folder.mkdir(parents=True, exist_ok=True)
        return certified(save(certify(scene, **options, progress=progress), file))
    found = certified(file)
    have = found["n"].max(), found["width"][0], found["height"][0], found["scene_hash"][0]
    asked = options["spp"], *options["size"], scene.hash
    if tuple(value.item() for value in have) != asked:
        message = (
            f"{file} has pixels of another scene, size or number of samples; remove it, or give "
            "another folder"
        )
        raise InputError(message)
    return found


def about() -> dict[str, Any]:
    """Return the attributes of a dataset that is made now."""
    return {
        "title": "Pixels of path-traced scenes with certified answers",
        "chdstat_version": chdstat.__version__,
        "fresh_seed": FRESH_SEED,
    }


def provenance(image: Samples, seed: int, count: int) -> dict[str, Any]:
    """Return where samples of `count` pixels come from, given a render of the same image."""
    height, width = image.shape[:2]
    origin = {
        "scene": image.attrs["scene"],
        "source": image.attrs["scene_source"],
        "scene_hash": image.attrs["scene_hash"],
        "width": width,
        "height": height,
        "seed": seed,
        "backend": image.attrs["backend"],
        "mitsuba_version": image.attrs["mitsuba_version"],
    }
    return {name: np.full(count, value) for name, value in origin.items()}


def first_samples(x: Image) -> dict[str, Any]:
    """Return mean and checksum of the first 4096 samples of pixels, (pixel, channel, sample)."""
    first = np.ascontiguousarray(x[..., :_FIRST], dtype="<f4")
    means = first.mean(axis=-1, dtype=np.float64)
    if first.shape[1] > 1:
        of_luminance = luminance(first).mean(axis=-1, dtype=np.float64)
        means = np.concatenate([means, of_luminance[:, np.newaxis]], axis=1)
    checksums = [zlib.crc32(pixel.tobytes()) for pixel in first]
    return {"first_mean": means, "checksum": np.array(checksums, np.uint32)}


def joined(parts: list[Numbers]) -> Numbers:
    """Return the numbers of several groups of pixels together."""
    names = [f.name for f in fields(Numbers)]
    return Numbers(**{n: np.concatenate([getattr(part, n) for part in parts]) for n in names})


def draw(
    truth: xr.Dataset,
    n: int,
    *,
    seed: int = FRESH_SEED,
    backend: Backend = "scalar",
    progress: bool = True,
) -> Image:
    """Draw samples of certified pixels, to try a method on.

    With the default seed, they are independent of the samples that certified the pixels. The
    scalar backend draws the same samples on every machine with the same wheel of Mitsuba; 2048 of
    512 pixels take about 15 seconds. Fewer samples are a prefix of more.

    Parameters
    ----------
    truth
        Pixels of `chdstat.certified`, or a selection of them.
    n
        Samples of each pixel.
    seed, backend
        As for `chdstat.rendering.render_pixels`. ``truth.seed`` and ``truth.backend`` name those
        that draw the certifying samples again.
    progress
        As for `chdstat.render`.

    Returns
    -------
    ndarray
        Linear radiance, shape (pixel, channel, sample), float32; the channels are R, G and B.

    Raises
    ------
    SceneError
        If a scene is no longer what it was.
    InputError, RenderError
        If a scene cannot be rendered.

    Examples
    --------
    >>> import chdstat as chd
    >>> truth = chd.certified().isel(pixel=slice(0, 2))
    >>> draw(truth, 16).shape
    (2, 3, 16)
    """
    count = truth.sizes["pixel"]
    places = np.stack([truth["y"].to_numpy(), truth["x"].to_numpy()], axis=-1)
    origin = zip(
        *(
            truth[name].to_numpy().tolist()
            for name in ("scene", "source", "scene_hash", "width", "height")
        ),
        strict=True,
    )
    groups: dict[tuple[Any, ...], list[int]] = {}
    for i, key in enumerate(origin):
        groups.setdefault(key, []).append(i)
    drawn = np.empty((count, 3, n), np.float32)
    with track("drawing certified pixels", count, show=progress) as advance:
        for (name, source, digest, width, height), rows in groups.items():
            scene = load_scene(name if source == "chdstat" else source)
            if scene.hash != digest:
                message = (
                    f"scene {name!r} is not the one whose pixels were certified: its hash is "
                    f"{scene.hash[:8]}, expected {digest[:8]}; certify it again"
                )
                raise SceneError(message)
            view: Any = {"size": (width, height), "seed": seed, "backend": backend}
            drawn[rows] = render_pixels(scene, places[rows], spp=n, **view)
            advance(len(rows))
    return drawn


# --- which pixels -------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Choice:
    """Pixels of an image; all arrays over the pixels, in the order of their blocks.

    Attributes
    ----------
    pixels
        (y, x) of each pixel, shape (pixel, 2).
    pattern
        Name of each pixel's pattern at the number of samples that were looked at.
    noise
        Standard deviation of luminance over its mean, of the same samples; 0 where all are null.
    weight
        Pixels of the image that each stands for: those of its kind over the chosen ones of it.
    """

    pixels: Counts
    pattern: npt.NDArray[np.str_]
    noise: Floats
    weight: Floats


def chosen(samples: Samples, blocks: int = BLOCKS) -> _Choice:
    """Choose one pixel from each of `blocks` x `blocks` blocks of an image.

    The choice depends on nothing but the samples.

    Raises
    ------
    InputError
        If the image has fewer rows or columns than blocks.

    Examples
    --------
    >>> import chdstat as chd
    >>> samples = chd.simulate("gamma", shape=(16, 16), spp=64)
    >>> chosen(samples, blocks=4).pixels[:3].tolist()
    [[0, 0], [0, 6], [0, 8]]
    """
    height, width = samples.shape[:2]
    if min(height, width) < blocks:
        message = (
            f"an image needs at least {blocks} x {blocks} pixels to choose one from each block, "
            f"got {width} x {height}; render it larger"
        )
        raise InputError(message)
    noise = _noise(samples)
    labels = classify(samples)["label"]
    kinds = _kinds(labels.to_numpy(), noise)
    places = _places(kinds, blocks)
    at = tuple(places.T)
    names = flag_names(labels.attrs)
    pattern = np.array([names[label] for label in labels.to_numpy()[at].tolist()])
    image = np.bincount(kinds.ravel())
    weight = image[kinds[at]] / np.bincount(kinds[at], minlength=len(image))[kinds[at]]
    return _Choice(places, pattern, noise[at], weight)


def _noise(samples: Samples) -> Floats:
    """Return the relative standard deviation of luminance, shape (y, x)."""
    values = luminance(samples.read()).astype(np.float64)
    mean = values.mean(axis=-1)
    spread = values.std(axis=-1)
    noise: Floats = np.divide(spread, np.abs(mean), out=np.zeros_like(mean), where=mean != 0)
    return noise


def _kinds(labels: Array, noise: Floats) -> Counts:
    """Return a number for each pixel's pattern and its fourth of the noise, shape (y, x)."""
    ends = np.quantile(noise, np.arange(1, _FOURTHS) / _FOURTHS)
    return np.asarray(labels * _FOURTHS + np.searchsorted(ends, noise), np.int64)


def _places(kinds: Counts, blocks: int) -> Counts:
    """Return (y, x) of one pixel of each block, of the kind chosen least often so far."""
    rows, columns = (np.linspace(0, n, blocks + 1).astype(int) for n in kinds.shape)
    taken = np.zeros(kinds.max() + 1, np.int64)
    places = np.empty((blocks**2, 2), np.int64)
    for turn in range(blocks**2):
        block = turn * _STRIDE % blocks**2
        i, j = divmod(block, blocks)
        inside = kinds[rows[i] : rows[i + 1], columns[j] : columns[j + 1]]
        candidates = np.argwhere(taken[inside] == taken[inside].min())
        y, x = candidates[turn * _STRIDE % len(candidates)]
        taken[inside[y, x]] += 1
        places[block] = rows[i] + y, columns[j] + x
    return places
