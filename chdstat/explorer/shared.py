"""State that all pages of one explorer share: sources, the image, maps, threads and the cache.

Clicks are worked on in one thread, passes over the image in another; a pass stands still while a
click is being worked on. Reading ahead and exports have a third thread, slow estimates a fourth.
Images and maps of a store are kept in the user's cache folder, never beside the store.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from chdstat._core.files import Cache, user_cache
from chdstat.errors import ChdstatError, InputError
from chdstat.estimators.models import AnyModel
from chdstat.explorer.estimators import Learner, learners, quick_names
from chdstat.explorer.images import Overall, SceneSource, preview, stream
from chdstat.explorer.maps import Map, map_kind, of_overall, walk, with_sizes
from chdstat.explorer.sources import StoreSource
from chdstat.samples import Samples, cache_key, is_store
from chdstat.samples import open as open_store
from chdstat.scenes import Scene, load_scene

__all__ = ["Explored", "Shared", "Stopped", "kept", "opened"]

_MOST_FILES = 64

Arrays = dict[str, npt.NDArray[Any]]


def kept(samples: Samples, name: str, compute: Callable[[], Arrays]) -> Arrays:
    """Return arrays of a store from the user's cache, or compute and keep them.

    Parameters
    ----------
    samples
        What the arrays are computed from.
    name
        What they are.
    compute
        Returns them, where they are not there.
    """
    cache = Cache(user_cache() / "explorer", cache_key(samples), most=_MOST_FILES)
    return cache.record("arrays", Arrays, compute, inputs=name)


Explored = str | Path | dict[str, Any] | Scene | Samples
"""A store or its path, samples in memory, or a scene."""


def opened(
    source: Explored,
    other: str | Path | Samples | None,
    reference: str | Path | Samples | None,
    models: Sequence[AnyModel | str | Path] = (),
    **options: Any,
) -> Shared:
    """Open what is explored, what it is compared with, and trained estimators.

    Raises
    ------
    InputError
        If the stores do not fit each other.
    StoreError, SceneError, RenderError
        If something cannot be read or rendered.
    """
    trained = learners(models)
    first = _source(source, **options)
    second, truth = (None if s is None else _store(s) for s in (other, reference))
    for store in (second, truth):
        if store is not None and (store.size, store.channels) != (first.size, first.channels):
            message = (
                f"{store.name} must have the size and channels of {first.name}: expected "
                f"{_sized(first)}, got {_sized(store)}"
            )
            raise InputError(message)
    return Shared(first, second, truth, trained)


def _sized(source: StoreSource | SceneSource) -> str:
    height, width = source.size
    return f"{width} x {height} pixels and channels {', '.join(source.channels)}"


def _source(source: Explored, **options: Any) -> StoreSource | SceneSource:
    if isinstance(source, Samples) or is_store(source):
        return _store(source)
    return SceneSource(load_scene(source), **options)


def _store(source: Any) -> StoreSource:
    samples = source if isinstance(source, Samples) else open_store(source)
    channels = samples.shape[2]
    if channels not in {1, 3}:
        message = f"the explorer shows 1 or 3 channels, got {channels}"
        raise InputError(message)
    return StoreSource(samples)


_EVERY = 0.4
"""Seconds between two reports of a pass."""

Listener = Callable[[str], None]


class Stopped(Exception):  # noqa: N818 - not an error
    """The explorer is closing, or nobody waits for the result any more."""


class Shared:
    """State of one explorer.

    Parameters
    ----------
    source
        What is explored.
    other
        A second store that it is compared with.
    reference
        A store of the same scene with more samples, which errors are measured against.
    learners
        Trained estimators of what is selected.

    Attributes
    ----------
    overall, other_overall
        Images so far; None before there is any.
    maps
        Maps by name, finished or not.
    working
        What a pass is doing, as text; empty for nothing.
    failed
        Why the last pass ended early; empty if it did not.
    """

    def __init__(
        self,
        source: StoreSource | SceneSource,
        other: StoreSource | None = None,
        reference: StoreSource | None = None,
        learners: Sequence[Learner] = (),
    ) -> None:
        self.source, self.other, self.reference = source, other, reference
        self.learners = tuple(learners)
        self.overall: Overall | None = None
        self.other_overall: Overall | None = None
        self.maps: dict[str, Map] = {}
        self.working = ""
        self.failed = ""
        self.clicks = ThreadPoolExecutor(1, thread_name_prefix="chdstat-clicks")
        self.exports = ThreadPoolExecutor(1, thread_name_prefix="chdstat-exports")
        self.additions = ThreadPoolExecutor(1, thread_name_prefix="chdstat-additions")
        self._passes = ThreadPoolExecutor(1, thread_name_prefix="chdstat-passes")
        self._listeners: list[Listener] = []
        self._asked: dict[str, Future[None]] = {}
        self._stopping = threading.Event()
        self._urgent = 0
        self._lock = threading.Lock()
        self._told = 0.0

    @property
    def unit(self) -> float | None:
        """Radiance that trained estimators count from, None before there is an image."""
        overall = self.overall
        known = overall is not None and np.isfinite(overall.mean).any()
        return overall.unit if overall is not None and known else None

    @property
    def first_of_reference(self) -> int:
        """First sample of the reference that has random numbers of its own.

        In a reference of the seed of the source, the noise of those before is that of the source:
        errors against them would be too small.
        """
        source, reference = self.source, self.reference
        if reference is None or not isinstance(source, StoreSource):
            return 0
        shared = source.samples.shares_numbers_with(reference.samples)
        return source.samples.spp if shared else 0

    def start(self) -> None:
        """Show the first image, then begin to improve it."""
        quick_names()
        if isinstance(self.source, StoreSource):
            self.overall = preview(self.source)
            if self.other is not None:
                self.other_overall = preview(self.other)
        self._passes.submit(self._guarded, self._draw)

    def stop(self) -> None:
        """End all threads, now or at the next tile."""
        self._stopping.set()
        for pool in (self.clicks, self.exports, self.additions, self._passes):
            pool.shutdown(wait=False, cancel_futures=True)

    def listen(self, listener: Listener) -> Callable[[], None]:
        """Call a listener with "image", "working" or the name of a map when it changes.

        Returns what to call to end that.
        """
        with self._lock:
            self._listeners.append(listener)

        def end() -> None:
            with self._lock:
                if listener in self._listeners:
                    self._listeners.remove(listener)

        return end

    def urgent(self, change: int) -> None:
        """Count the clicks that wait for their results."""
        with self._lock:
            self._urgent += change

    def want(self, name: str) -> None:
        """See to it that a map gets computed.

        Raises
        ------
        InputError
            If there is no such map.
        """
        map_kind(name)
        with self._lock:
            running = self._asked.get(name)
            if name in self.maps and self.maps[name].done >= 1:
                return
            if running is not None and not running.done():
                return
            self._asked[name] = self._passes.submit(self._guarded, lambda: self._walk(name))

    def replace_source(self, source: StoreSource) -> None:
        """Go on with more samples of the same store."""
        self.source = source
        self.maps.clear()
        self._asked.clear()
        self._passes.submit(self._guarded, self._draw)

    # --- passes ---------------------------------------------------------------------------------

    def _guarded(self, work: Callable[[], None]) -> None:
        try:
            self.failed = ""
            work()
        except Stopped:
            return
        except ChdstatError as error:
            self.failed = str(error)
        except (OSError, ValueError, RuntimeError, MemoryError) as error:
            self.failed = f"a pass over the image failed: {type(error).__name__}: {error}"
        finally:
            self.working = ""
            self.tell("working")

    def _draw(self) -> None:
        source = self.source
        if isinstance(source, SceneSource):
            for share in source.passes():
                if self._due() or share >= 1:
                    self.overall = source.overall()
                    self._say(f"drawing the image, {100 * share:.0f} %")
                    self.tell("image")
                self._wait()
            return
        self.overall = self._streamed(source)
        if self.other is not None:
            self.other_overall = self._streamed(self.other)
        self.tell("image")

    def _streamed(self, source: StoreSource) -> Overall:
        def step(share: float) -> None:
            self._wait()
            if self._due():
                self._say(f"reading all of {source.name}, {100 * share:.0f} %")

        def compute() -> dict[str, Any]:
            whole = stream(source, step)
            return {field.name: np.asarray(getattr(whole, field.name)) for field in fields(whole)}

        arrays = dict(kept(source.samples, "overall", compute))
        values: dict[str, Any] = {**arrays, "spp": int(arrays["spp"])}
        return Overall(**values)

    def _walk(self, name: str) -> None:
        source = self.source
        if not isinstance(source, StoreSource):
            return
        if self.overall is not None and (found := of_overall(self.overall, name)) is not None:
            self.maps[name] = found
            self.tell(name)
            return
        kind = with_sizes(map_kind(name), source)

        def step(share: float, values: Any) -> None:
            self._wait()
            if self._due():
                self.maps[name] = Map(kind, values.copy(), share)
                self._say(f"mapping {kind.title}, {100 * share:.0f} %")
                self.tell(name)

        arrays = kept(source.samples, name, lambda: {"v": walk(source, name, step).values})
        self.maps[name] = Map(kind, arrays["v"])
        self.tell(name)

    def _wait(self) -> None:
        """Stand still while clicks are answered."""
        while self._urgent > 0 and not self._stopping.is_set():
            time.sleep(0.005)
        if self._stopping.is_set():
            raise Stopped

    def _due(self) -> bool:
        now = time.monotonic()
        if now - self._told < _EVERY:
            return False
        self._told = now
        return True

    def _say(self, text: str) -> None:
        self.working = text
        self.tell("working")

    def tell(self, what: str) -> None:
        """Tell all pages what has changed."""
        with self._lock:
            listeners = list(self._listeners)
        for listener in listeners:
            listener(what)
