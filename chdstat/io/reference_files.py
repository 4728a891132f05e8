"""Files of references: what a test needs of many samples, in one EXR file that fits into git.

`write_reference` writes a `chdstat.inference.Reference`, and `Reference.read` reads it, as well as
images of other programs. The file shows its mean in any viewer. Means of batches are layers
``batch.00`` and so on, of deviations from the mean, times a power of two in the header. Of a
deviation, 7 significant bits are kept, as half floats: rounding moves a sum over any window by less
than a hundredth of its standard error, and what is not kept compresses to nothing.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from chdstat import __version__
from chdstat._core.arrays import Array, Floats, Image, whole
from chdstat._core.display import channel_names
from chdstat._core.doors import read_reference
from chdstat._core.files import checked_target, local
from chdstat.errors import ChdstatError, InputError, StoreError
from chdstat.inference.references import BATCHES, Reference, mean_of_batches
from chdstat.io.exr import ExrImage, write_exr
from chdstat.io.other_references import of_image, read_image
from chdstat.io.reading import read

_LAYOUT = "chdstatReference"
"""Attribute that marks a file of a reference; its text is the version of the layout."""
_VERSION = "1"
_SIGNIFICANT = 7
"""Bits that are kept of a deviation: its rounding error has 1/300 of its variation."""
_LARGEST_EXPONENT = 15
"""Deviations are multiplied so that the largest lies just below 2^15, as half floats can."""
_LIMIT = 120
"""Largest exponent of that factor, which is a float."""
_LOST = 2.0**-_SIGNIFICANT
"""Error of half floats, over the largest deviation of a pixel, from which floats are written."""
_TEXTS = (
    *("scene", "scene_hash", "sampler", "filter", "unit", "units"),
    *("renderer", "mitsuba_version", "chdstat_version"),
)
_PROVENANCE = ("seed", "integrator", *_TEXTS)
"""What is kept of where samples come from: what is the same if they are rendered again."""


def write_reference(reference: Reference, path: str | Path) -> Path:
    """Write a reference to an EXR file, from which `Reference.read` makes it again.

    The mean is the image. Each batch is a layer of deviations from the mean, 7 significant bits of
    each. Without batches, there is a layer ``variance`` if it is known. The layer ``bad`` holds the
    share of bad samples, if there are any. The header says spp, scene, seed and versions. The same
    reference gives the same bytes.

    Parameters
    ----------
    reference
        The reference, such as one of `Reference.of_samples`.
    path
        The file, .exr; an existing one is replaced when the new one is complete.

    Returns
    -------
    pathlib.Path
        The file.

    Raises
    ------
    InputError
        If the suffix is another one, or a mean is too large for single precision.
    StoreError
        If the file cannot be written.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> x = np.random.default_rng(1).gamma(2.0, size=(8, 8, 3, 480))
    >>> with TemporaryDirectory() as folder:
    ...     file = write_reference(Reference.of_samples(x), f"{folder}/box.exr")
    ...     found = Reference.read(file)
    >>> found.spp, found.batches.shape, bool(np.allclose(found.mean, x.mean(axis=-1)))
    (480, (8, 8, 3, 48), True)
    """
    target = checked_target(path, ".exr")
    text = {
        _LAYOUT: _VERSION,
        "software": f"chdstat {__version__}",
        "spp": reference.spp,
        "precision": reference.precision,
        **({"limits": reference.limits} if reference.limits else {}),
        **{name: reference.attrs[name] for name in _PROVENANCE if name in reference.attrs},
    }
    layers: dict[str, Array] = {}
    if reference.batches is not None:
        scale, stored = _packed(reference.batches)
        text |= {"batches": len(stored), "batchScale": scale}
        layers |= {_layer(k): one for k, one in enumerate(stored)}
    elif reference.variance is not None:
        layers["variance"] = reference.variance
    if reference.bad is not None and np.any(reference.bad):
        layers["bad"] = reference.bad
    channels = reference.mean.shape[-1]
    return write_exr(
        target,
        reference.mean,
        channels=None if channels == 1 else channel_names(channels),
        extra=layers,
        attributes={
            name: value if isinstance(value, str) else json.dumps(value, sort_keys=True)
            for name, value in text.items()
        },
    )


def _layer(number: int) -> str:
    return f"batch.{number:02}"


def _packed(batches: Array) -> tuple[float, list[Array]]:
    """Return a power of two, and deviations of each batch from their mean, times that power.

    Half floats hold a batch if no pixel loses more than bits that are not kept; else floats do.
    """
    mean = mean_of_batches(batches)
    with np.errstate(invalid="ignore"):
        largest = np.fmax(np.fmax.reduce(batches, -1) - mean, mean - np.fmin.reduce(batches, -1))
    largest[~np.isfinite(largest)] = 0
    exponent = min(_LARGEST_EXPONENT - int(np.frexp(largest.max())[1]), _LIMIT)
    slack = _LOST * np.ldexp(largest, exponent)
    found = []
    for batch in np.ascontiguousarray(np.moveaxis(batches, -1, 0)):
        scaled = _rounded(np.ldexp(batch - mean, exponent))
        halves = scaled.astype(np.float16)
        with np.errstate(invalid="ignore"):
            held = not (np.abs(halves - scaled) > slack).any()
        found.append(halves if held else scaled.astype(np.float32))
    return 2.0**exponent, found


@np.errstate(all="ignore")
def _unpacked(mean: Image, stored: Sequence[Array], scale: float) -> Array:
    """Return batches around a mean, which rounding has not moved."""
    found = np.stack(stored, axis=-1) / np.float32(scale)
    found[~np.isfinite(found)] = np.nan
    found += (mean - mean_of_batches(found))[..., np.newaxis].astype(np.float32)
    return found


def _rounded(x: Floats) -> Floats:
    """Return the nearest numbers of `_SIGNIFICANT` bits.

    Examples
    --------
    >>> _rounded(np.array([1.0, 1 + 1 / 64, 1 + 1 / 200, -1000.0]))
    array([    1.      ,     1.015625,     1.      , -1000.      ])
    """
    mantissa, exponent = np.frexp(x)
    digits = np.ldexp(1.0, _SIGNIFICANT)
    return np.asarray(np.ldexp(np.rint(mantissa * digits) / digits, exponent))


# --- reading --------------------------------------------------------------------------------------


def _read(
    path: str | Path,
    *,
    variance: str | Path | None = None,
    spp: int | None = None,
    precision: float | None = None,
) -> Reference:
    """Return the reference in a file, as `Reference.read`."""
    place = local(path)
    image = None if place.is_dir() else read_image(place)
    if image is None or _LAYOUT in image.attributes:
        given = {"variance": variance, "spp": spp}
        if told := [name for name, value in given.items() if value is not None]:
            message = f"{path} says how well it is known: leave out {' and '.join(told)}"
            raise InputError(message)
        found = _of_passes(place) if image is None else _of_own(place, image)
    else:
        found = of_image(place, image, variance)
    return replace(
        found,
        name=str(path),
        spp=found.spp if spp is None else spp,
        precision=found.precision if precision is None else precision,
    )


def _of_passes(folder: Path) -> Reference:
    """Return a reference of images, each of as many samples, in a folder.

    Raises
    ------
    InputError
        If they are too few for batches.
    """
    passes = read(folder, format="exr")
    return Reference.of_samples(passes, batches=min(passes.spp, BATCHES), name=str(folder))


def _of_own(path: Path, found: ExrImage) -> Reference:
    """Return what `write_reference` wrote.

    Raises
    ------
    StoreError
        If something is missing in the file, or it is of a later version.
    """
    if (version := found.attributes[_LAYOUT]) != _VERSION:
        message = f"{path} is a reference of layout {version}, and this chdstat reads {_VERSION}"
        raise StoreError(message)
    text = {name: _parsed(name, value) for name, value in found.attributes.items()}
    none = np.zeros(found.image.shape[:2], np.float32)
    try:
        return Reference(
            found.image,
            found.extra.get("variance"),
            text.get("spp"),
            text.get("precision", 0),
            batches=_batches(found, text),
            bad=found.extra.get("bad", none if "batches" in text else None),
            attrs={name: text[name] for name in _PROVENANCE if name in text},
            limits=tuple(map(str, text.get("limits", ()))),
        )
    except (ChdstatError, KeyError, TypeError, ValueError) as error:
        why = f"it lacks {error}" if isinstance(error, KeyError) else error
        message = f"{path} is a damaged reference, write it again: {why}"
        raise StoreError(message) from error


def _batches(found: ExrImage, text: Mapping[str, Any]) -> Array | None:
    """Return the batches of a file; None if it has none."""
    if "batches" not in text:
        return None
    number = whole("batches", text["batches"], least=1)
    scale = float(text["batchScale"])
    if not 0 < scale < np.inf:
        message = f"batchScale must be above 0, got {scale}"
        raise InputError(message)
    return _unpacked(found.image, [found.extra[_layer(k)] for k in range(number)], scale)


def _parsed(name: str, value: str) -> Any:
    """Return an attribute of a file; text that is no number stays text."""
    if name in _TEXTS:
        return value
    with contextlib.suppress(ValueError):
        return json.loads(value)
    return value


for _path in (str, Path):
    read_reference.register(_path, _read)
