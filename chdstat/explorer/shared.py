"""State that all pages of one explorer share: sources, the image, maps and threads.

Clicks are worked on in one thread, passes over the image in another; a pass stands still while a
click is being worked on. Reading ahead and exports have a third thread, slow estimates a fourth.
Images and maps of a store are kept in the user's cache folder, never beside the store.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from chdstat._core.work import Cache, user_cache
from chdstat.errors import ChdstatError, InputError
from chdstat.estimators.training import TrainedModel
from chdstat.explorer.estimators import Learner, learners
from chdstat.explorer.maps import (
    DIFFERENCES,
    IMAGES,
    Map,
    difference_of,
    map_kind,
    of_overall,
    read_maps,
    walk,
)
from chdstat.explorer.place import suggest
from chdstat.explorer.sources import Overall, SceneSource, Source, StoreSource, stream
from chdstat.explorer.view import Pixel
from chdstat.samples import Samples, cache_key
from chdstat.samples import open as open_store

__all__ = ["Shared", "Stopped", "kept", "opened"]

_MOST_FILES = 64
_FIRST_SPP = 64
_EVERY = 0.4
"""Seconds between two reports of a pass."""

_SHOWN_EVERY = 0.5
"""Of the time since drawing began, between two times that the image is shown."""

T = TypeVar("T")
Listener = Callable[[str], None]


def kept(samples: Samples, name: str, kind: type[T], compute: Callable[[], T]) -> T:
    """Return a result of a store from the user's cache, or compute and keep it.

    Parameters
    ----------
    samples
        What the result is computed from.
    name, kind
        Its name and type.
    compute
        Returns it, where it is not there.
    """
    cache = Cache(user_cache() / "explorer", cache_key(samples), most=_MOST_FILES)
    return cache.record("arrays", kind, compute, inputs=name)


def opened(
    source: str | Path | Samples | SceneSource,
    other: str | Path | Samples | None = None,
    reference: str | Path | Samples | None = None,
    models: Sequence[TrainedModel[Any] | str | Path] = (),
    *,
    maps: str | Path | None = None,
) -> Shared:
    """Open what `chdstat.explore` is given; of a scene, what it made of it.

    Raises
    ------
    InputError
        If the stores do not fit each other.
    StoreError, SceneError, RenderError
        If something cannot be read or rendered.
    """
    trained = learners(models)
    first: Source = source if isinstance(source, SceneSource) else _store(source)
    second, truth = (None if s is None else _store(s) for s in (other, reference))
    for store in (second, truth):
        if store is not None and (store.size, store.channels) != (first.size, first.channels):
            expected, got = (
                f"{s.size[1]} x {s.size[0]} pixels and channels {', '.join(s.channels)}"
                for s in (first, store)
            )
            message = (
                f"{store.name} must have the size and channels of {first.name}: expected "
                f"{expected}, got {got}"
            )
            raise InputError(message)
    given = {} if maps is None else read_maps(maps, first.size)
    return Shared(first, second, truth, trained, given)


def _store(source: str | Path | Samples) -> StoreSource:
    samples = source if isinstance(source, Samples) else open_store(source)
    channels = samples.shape[2]
    if channels not in {1, 3}:
        message = f"the explorer shows 1 or 3 channels, got {channels}"
        raise InputError(message)
    return StoreSource(samples)


class Stopped(Exception):  # noqa: N818 - not an error
    """The explorer is closing, or nobody waits for the result any more."""


class Shared:
    """State of one explorer.

    Parameters
    ----------
    source
        The store or scene on the page.
    other
        A second store that it is compared with.
    reference
        A store of the same scene with more samples, which errors are measured against.
    learners
        Trained estimators of the selection.
    given
        Maps that were computed before, by name.

    Attributes
    ----------
    overall, other_overall
        Images of `source` and `other` so far.
    maps
        Maps by name, finished or not.
    suggested
        Names and places of pixels that are worth a first look.
    working
        What a pass is doing, as text; empty for nothing.
    failed
        Why the last pass ended early; empty if it did not.
    clicks, exports, additions, images
        Threads for clicks, for exports and reading ahead, for slow estimates, and for what images
        look like on the screen.
    """

    def __init__(
        self,
        source: Source,
        other: StoreSource | None = None,
        reference: StoreSource | None = None,
        learners: Sequence[Learner] = (),
        given: Mapping[str, Map] = MappingProxyType({}),
    ) -> None:
        self.source, self.other, self.reference = source, other, reference
        self.learners, self.given = tuple(learners), given
        self.overall = Overall.empty(*source.size, len(source.channels))
        self.other_overall = self.overall
        self.maps: dict[str, Map] = {}
        self.suggested: list[tuple[str, Pixel]] = []
        self.working = self.failed = ""
        self.clicks, self.exports, self.additions, self.images, self._passes = (
            ThreadPoolExecutor(1, thread_name_prefix=f"chdstat-{name}")
            for name in ("clicks", "exports", "additions", "images", "passes")
        )
        self._listeners: set[Listener] = set()
        self._wanted: dict[str, Future[None]] = {}
        self._stopping = threading.Event()
        self._urgent = 0
        self._lock = threading.Lock()
        self._told = 0.0

    def start(self) -> None:
        """Show the first image, then begin to improve it."""
        if isinstance(self.source, SceneSource):
            self.overall = self.source.overall()
        if isinstance(self.source, StoreSource):
            # The first samples take a second where all take minutes.
            self.overall = stream(self.source, spp=_FIRST_SPP)
            if self.other is not None:
                self.other_overall = stream(self.other, spp=_FIRST_SPP)
        self._passes.submit(self._guarded, self._begin)

    def stop(self) -> None:
        """End all threads, now or at the next tile."""
        self._stopping.set()
        for pool in (self.clicks, self.exports, self.additions, self.images, self._passes):
            pool.shutdown(wait=False, cancel_futures=True)
        if isinstance(self.source, SceneSource):
            self.source.close()

    def listen(self, listener: Listener) -> Callable[[], None]:
        """Call a listener with the name of what changes; return what to call to end that.

        The names are "image", "working", "source", "suggested" and those of maps.
        """
        self._listeners.add(listener)
        return partial(self._listeners.discard, listener)

    def tell(self, what: str) -> None:
        """Call all listeners with the name of what has changed."""
        for listener in tuple(self._listeners):
            listener(what)

    def urgent(self, change: int) -> None:
        """Count the clicks that wait for their results."""
        with self._lock:
            self._urgent += change

    def want(self, name: str) -> None:
        """Start to compute a map, unless it is there or being computed.

        Raises
        ------
        InputError
            If there is no such map, or it needs a store and there is none.
        """
        if name in self.given or (self.other is not None and name in DIFFERENCES):
            return
        kind = map_kind(name)
        if not isinstance(self.source, StoreSource):
            if name not in IMAGES:
                how = "render the scene with 'chdstat render SCENE -o STORE'"
                message = f"{kind.title!r} needs a store: {how}"
                raise InputError(message)
            return
        running = self._wanted.get(name)
        there = name in self.maps and self.maps[name].done >= 1
        if not there and (running is None or running.done()):
            self._wanted[name] = self._passes.submit(self._guarded, lambda: self._walk(name))

    def map(self, name: str) -> Map | None:
        """Return what there is of a map."""
        of_two = difference_of(self.overall, self.other_overall, name) if self.other else None
        found = self.given.get(name) or of_two or of_overall(self.overall, name)
        return found or self.maps.get(name)

    def refresh(self) -> None:
        """Go on with the samples that were added to the store since, if there are any."""
        grown = self.source.refreshed() if isinstance(self.source, StoreSource) else None
        if grown is not None:
            self.source = grown
            self.maps.clear()
            self._wanted.clear()
            self._passes.submit(self._guarded, self._draw)
            self.tell("source")

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
            self._say("")

    def _begin(self) -> None:
        """Draw the image, then look for pixels that are worth a look."""
        self._draw()
        self.suggested = suggest(self.source, self._reported("looking for typical pixels"))
        self.tell("suggested")

    def _draw(self) -> None:
        source = self.source
        if isinstance(source, SceneSource):
            shown = start = time.monotonic()
            step = self._reported("drawing the image")
            for share in source.passes():
                step(share)
                now = time.monotonic()
                # The later, the less it changes; a large image takes long to send and to show.
                if now - shown > _SHOWN_EVERY * (now - start) + _EVERY or share >= 1:
                    self._image(source.overall())
                    shown = now
            return
        overall = self._streamed(source)
        if self.other is not None:
            self.other_overall = self._streamed(self.other)
        self._image(overall)

    def _image(self, overall: Overall) -> None:
        """Show an image; what takes long is found here and not in the thread of the server."""
        _ = overall.exposure
        self.overall = overall
        self.tell("image")

    def _streamed(self, source: StoreSource) -> Overall:
        step = self._reported(f"reading all of {source.name}")
        return kept(source.samples, "overall", Overall, lambda: stream(source, step))

    def _walk(self, name: str) -> None:
        source = self.source
        if not isinstance(source, StoreSource):
            return
        kind = map_kind(name, source.samples.spp)

        def step(share: float, values: npt.NDArray[np.float32]) -> None:
            if self._is_due():
                self.maps[name] = replace(kind, values=values.copy(), done=share)
                self._say(f"mapping {kind.title}, {100 * share:.0f} %")
                self.tell(name)

        found = of_overall(self.overall, name)
        if found is None:
            array = npt.NDArray[np.float32]
            values = kept(source.samples, name, array, lambda: walk(source, name, step).values)
            found = replace(kind, values=values)
        self.maps[name] = found
        self.tell(name)

    def _reported(self, text: str) -> Callable[[float], None]:
        """Return what is called with the share done, and tells the page now and then."""

        def step(share: float) -> None:
            if self._is_due():
                self._say(f"{text}, {100 * share:.0f} %")

        return step

    def _is_due(self) -> bool:
        """Stand still while clicks are worked on; return whether to report the progress."""
        while self._urgent > 0 and not self._stopping.is_set():
            time.sleep(0.005)
        if self._stopping.is_set():
            raise Stopped
        now = time.monotonic()
        due = now - self._told >= _EVERY
        self._told = now if due else self._told
        return due

    def _say(self, text: str) -> None:
        self.working = text
        self.tell("working")
