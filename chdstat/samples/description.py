"""Description of samples in words: for reports, the command line and notebooks."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from chdstat._core.arrays import is_bad
from chdstat._core.display import Card, duration, png
from chdstat._core.image_scales import tonemap
from chdstat._core.moments import Moments
from chdstat.samples.samples import Samples
from chdstat.samples.tiles import sequence_of

__all__ = ["BIASED", "card", "line", "provenance"]

BIASED = "where that number depended on the samples, means and their errors are biased"
"""What follows from pixels with different numbers of samples."""
_EDGE, _VALUES = 256, 2**25
"""Longer edge of a thumbnail in pixels, and samples that are read for it at most."""


def provenance(attrs: Mapping[str, Any], shape: Sequence[int]) -> dict[str, str]:
    """Return the settings that render the same samples again, by name; those that are known.

    Parameters
    ----------
    attrs
        Of the samples.
    shape
        Theirs, (y, x, channel, sample).

    Examples
    --------
    >>> provenance({"scene": "flat", "seed": 3, "sampler": "independent"}, (4, 6, 3, 32))
    {'Scene': 'flat (samples given)',
     'Image': '6 × 4 pixels, 3 channels, 32 samples per pixel',
     'Random numbers': 'independent sampler, seed 3'}
    """
    height, width, channels, spp = shape
    integrator = dict(attrs.get("integrator") or {})
    kind = integrator.pop("type", "")
    settings = ", ".join(f"{name} {value}" for name, value in integrator.items())
    seconds = float(attrs.get("render_seconds") or 0)
    source = Path(attrs.get("scene_source", "samples given")).name  # no folders of a machine
    rows = {
        "Scene": f"{attrs.get('scene', 'samples')} ({source})",
        "Scene hash": str(attrs.get("scene_hash", ""))[:16],
        "Plugins": ", ".join(f"{n} ({digest})" for n, digest in attrs.get("plugins", {}).items()),
        "Integrator": f"{kind} ({settings})" if settings else kind,
        "Image": f"{width} × {height} pixels, {channels} channel{'s' * (channels > 1)}, "
        f"{spp} samples per pixel",
        "Random numbers": _random_numbers(attrs),
        "Light": {"spectral": "spectral, samples in linear sRGB", "mono": "of one channel"}.get(
            attrs.get("color", ""), ""
        ),
        "Filter": str(attrs.get("filter", "")),
        "Renderer": f"Mitsuba {attrs['mitsuba_version']}, {attrs['backend']}"
        if "mitsuba_version" in attrs
        else str(attrs.get("renderer", "")),
        "Averages": f"each value is the average of {attrs['averaged']} samples"
        if attrs.get("averaged", 1) > 1
        else "",
        "Rendering time": duration(seconds) if seconds else "",
        "Note": "; ".join(attrs.get("notes") or []),
    }
    return {name: value for name, value in rows.items() if value}


def _random_numbers(attrs: Mapping[str, Any]) -> str:
    """Return sampler and seed in words, and how many samples depend on each other; "" if unknown.

    A seed alone tells nothing.
    """
    parts, length = list[str](), sequence_of(attrs)
    if {"sampler", "seed"} <= attrs.keys():
        parts.append(f"{attrs['sampler']} sampler, seed {attrs['seed']}")
    if length > 1:
        parts.append(f"in sequences of {length} samples that depend on each other")
    return ", ".join(parts)


def line(samples: Samples) -> str:
    """Return what Python shows of samples."""
    height, width, channels, spp = samples.shape
    counts, length, source = samples.counts, sequence_of(samples.attrs), samples.source
    number = f"{spp} spp" if counts is None else f"{counts.min()} to {spp} spp"
    if length > 1:
        sampler = samples.attrs.get("sampler", "")
        number += f" in {sampler} sequences of {length}".replace("  ", " ")
    elif samples.attrs.get("averaged", 1) > 1:
        number += f" (averages of {samples.attrs['averaged']})"
    where = "in memory"
    if source is not None:
        where = f"{'at' if samples.path else 'part of'} {source.path}"
    return (
        f"<Samples {samples.name!r} {width} x {height} pixels, "
        f"{channels} channel{'s' if channels > 1 else ''}, {number}, {where}>"
    )


def card(samples: Samples) -> Card:
    """Return what a notebook shows of samples: a thumbnail, and where they come from."""
    height, width, channels, spp = samples.shape
    facts = provenance(samples.attrs, samples.shape)
    if samples.counts is not None:
        fewest, most = samples.counts.min(), samples.counts.max()
        facts["Samples"] = f"{fewest} to {most} in a pixel; {BIASED}"
    if samples.features:
        facts["First hit"] = ", ".join(samples.features)
    facts["Stored"] = "in memory" if samples.path is None else str(samples.path)
    if channels not in (1, 3):
        return Card("Samples", facts)
    step = -(-max(height, width) // _EDGE)
    few = max(1, min(spp, _VALUES // math.prod(samples.shape[:3])))
    thumbnail = samples.isel(y=slice(None, None, step), x=slice(None, None, step))
    radiance = thumbnail.read(ss=slice(few)).astype(np.float64)
    mean = Moments.of(radiance, ~is_bad(radiance)).mean
    return Card("Samples", facts, images={f"mean of the first {few} samples": png(tonemap(mean))})
