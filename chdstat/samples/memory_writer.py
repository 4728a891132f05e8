"""Samples that are drawn and stay in memory."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from chdstat._core.arrays import Image
from chdstat._core.work import check_memory
from chdstat.samples.costs import COSTS, SampleCosts, with_times
from chdstat.samples.film_steps import FILM_STEPS, in_steps
from chdstat.samples.layout import GUIDE
from chdstat.samples.ledger import Ledger, counts_of
from chdstat.samples.samples import Samples
from chdstat.samples.tiles import Chunk, LightPart


class MemoryWriter:
    """Keeps samples in memory, as `chdstat.samples.store.Store` does on disk.

    Parameters
    ----------
    shape
        Room, (y, x, channel, sample).
    attrs
        Provenance; with "adaptive", pixels may have different numbers of samples.
    """

    def __init__(self, shape: tuple[int, int, int, int], attrs: Mapping[str, Any]) -> None:
        self.attrs, self._features = dict(attrs), dict[str, Image]()
        self.density: Image | None = None
        self._costs: SampleCosts | None = None
        self._kind: Any = np.float16 if FILM_STEPS in attrs else np.float32
        self._array = np.full(shape, np.nan, self._kind)
        counts = np.full(shape[:2], shape[3], np.int32) if "adaptive" in attrs else None
        self.ledger = Ledger(shape, counts)

    def to_draw(self, chunk: Chunk) -> Chunk:
        """Return a chunk with its missing samples marked, if counts differ on purpose."""
        return self.ledger.to_draw(chunk, lambda c: self._array[c.ys, c.xs, :, c.ss])

    def write(self, chunk: Chunk, block: Image) -> None:
        """Keep the samples of a chunk."""
        held = self._array[chunk.ys, chunk.xs, :, chunk.ss]
        kept: Any = in_steps(block) if FILM_STEPS in self.attrs else block
        where = True if chunk.missing is None else chunk.missing[:, :, np.newaxis]
        np.copyto(held, kept, where=where)
        self.ledger.note(chunk)

    def read(self, ys: slice, xs: slice, ss: slice) -> Image:
        """Return a part of the samples, NaN where there are none yet."""
        return self._array[ys, xs, :, ss]

    def fit(self, held: int, spp: int) -> None:
        """Keep the first `held` samples of every pixel, and return `spp` in all."""
        self.attrs["spp"] = spp
        self.ledger = Ledger((*self._array.shape[:3], spp), None)
        self.ledger.note_first(held)

    def renew(self, features: Mapping[str, Image], **attrs: Any) -> None:
        """Replace features, and change attributes."""
        self._features = dict(features)
        self.update(**attrs)

    def decide(self, density: Image, spp: float, noise: Mapping[str, Any]) -> None:
        """Let pixels have different numbers of samples from now on, `spp` on average."""
        first, self.density = self._array, density
        self.attrs |= {"spp": spp, "noise": dict(noise)}
        counts = counts_of(density, spp, self.attrs["adaptive"]["first"])
        shape = (*self.ledger.shape[:3], int(counts.max()))
        what = f"up to {shape[3]} samples for each of {shape[1]} x {shape[0]} pixels"
        check_memory(4 * math.prod(shape), what, "give a store to write to, or use fewer samples")
        self._array = np.full(shape, np.nan, self._kind)
        self._array[..., : first.shape[3]] = first
        self.ledger = self.ledger.grown(shape, counts)

    @property
    def lacks_features(self) -> bool:
        """Whether first-hit features are still missing."""
        return not self._features

    def restore(self, features: Mapping[str, Image], why_none: str = "") -> None:
        """Keep first-hit features, or why there are none."""
        self._features = {n: image for n, image in features.items() if n not in GUIDE}
        if why_none:
            self.attrs["why_no_features"] = why_none

    def update(self, **attrs: Any) -> None:
        """Change attributes."""
        self.attrs |= attrs

    def timed(self, chunk: Chunk, costs: SampleCosts) -> None:
        """Take note of what the samples of a chunk took."""
        self._costs = with_times(self._costs, self._array.shape, chunk, costs)

    def spent(self, seconds: float) -> None:
        """Record the rendering time."""
        self.attrs["render_seconds"] = round(seconds, 3)

    def finish(self, parts: Mapping[LightPart, Samples] | None = None) -> Samples:
        """Return the samples, with the parts of their light."""
        spp, counts = self.ledger.complete_spp, self.ledger.counts
        attrs = self.attrs if counts is not None else {**self.attrs, "spp": spp}
        features = dict(self._features)
        if self._costs is not None:
            features[COSTS] = self._costs.to_array()
        about: Any = {"attrs": attrs, "features": features, "parts": parts}
        return Samples(self._array[..., :spp], counts=counts, **about)
