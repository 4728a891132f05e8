"""State that all pages of one explorer share: sources, the image, maps and threads.

Clicks are worked on in one thread, passes over the image in another (`chdstat.explorer.passes`); a
pass stands still while a click is being worked on. Reading ahead and exports have a third thread,
slow estimates a fourth. Images and maps of a store are kept in the user's cache folder, never
beside the store.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Generator, Hashable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from chdstat._core.work import Cache, user_cache
from chdstat.errors import InputError
from chdstat.estimators.training import TrainedModel
from chdstat.explorer.estimators import Learner, learners
from chdstat.explorer.maps import (
    Map,
    difference_of,
    map_kind,
    of_overall,
    read_maps,
    walk,
)
from chdstat.explorer.passes import Pass, Passes
from chdstat.explorer.place import suggest
from chdstat.explorer.sources import Overall, SceneSource, Source, StoreSource, stream
from chdstat.explorer.view import Pixel
from chdstat.samples import Samples, cache_key
from chdstat.samples import open as open_store

__all__ = ["Shared", "kept", "opened"]

_MOST_FILES = 64
_FIRST_SPP = 64
_SHOWN_EVERY = 0.5
"""Of the time since drawing began, between two times that the image is shown, and 0.4 s more."""

T = TypeVar("T")
Listener = Callable[[str], None]


def kept(
    samples: Samples, name: str, kind: type[T], work: Iterator[tuple[float, T]]
) -> Iterator[tuple[float, T]]:
    """Yield a result of a store from the user's cache, or what work yields, and keep its last.

    Parameters
    ----------
    samples
        What the result is computed from.
    name, kind
        Its name and type.
    work
        Yields the share that is done and the result so far.
    """
    cache = Cache(user_cache() / "explorer", cache_key(samples), most=_MOST_FILES)
    found = cache.recall("arrays", kind, inputs=name)
    if found is not None:
        yield 1.0, found
        return
    for share, so_far in work:
        found = so_far
        yield share, so_far
    if found is not None:
        cache.record("arrays", kind, lambda: found, inputs=name, again=True)


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
    passes
        What is being computed over the image.
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
        self.clicks, self.exports, self.additions, self.images = (
            ThreadPoolExecutor(1, thread_name_prefix=f"chdstat-{name}")
            for name in ("clicks", "exports", "additions", "images")
        )
        self._listeners: set[Listener] = set()
        self._urgent = 0
        self._lock = threading.Lock()
        self.passes = Passes(lambda: self._urgent > 0, self.tell)

    def start(self) -> None:
        """Show the first image, then begin to improve it."""
        if isinstance(self.source, SceneSource):
            self.overall = self.source.overall()
        if isinstance(self.source, StoreSource):
            # The first samples take a second where all take minutes.
            self.overall = _first(self.source)
            if self.other is not None:
                self.other_overall = _first(self.other)
        self.passes.ask(self, "start", self._begin())

    def stop(self) -> None:
        """End all threads, now or at the next tile."""
        self.passes.stop()
        for pool in (self.clicks, self.exports, self.additions, self.images):
            pool.shutdown(wait=False, cancel_futures=True)
        if isinstance(self.source, SceneSource):
            self.source.close()

    def listen(self, listener: Listener) -> Callable[[], None]:
        """Call a listener with the name of what changes; return what to call to end that.

        The names are "image", "working", "source", "suggested", "start" and those of maps.
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

    def want(self, who: Hashable, name: str) -> None:
        """Let a page wait for a map, and for no other one; "image" waits for none.

        Raises
        ------
        InputError
            If there is no such map, or it needs a store and there is none.
        """
        self.passes.leave(who)
        if self.map(name) is not None and name not in self.maps:
            return
        if name == "image" or (name in self.maps and self.maps[name].done >= 1):
            return
        kind = map_kind(name)
        if not isinstance(self.source, StoreSource):
            how = "render the scene with 'chdstat render SCENE -o STORE'"
            message = f"{kind.title!r} needs a store: {how}"
            raise InputError(message)
        self.passes.ask(who, name, self._walk(self.source, name))

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
            self.passes.forget()
            self.maps.clear()
            self.passes.ask(self, "start", self._draw())
            self.tell("source")

    # --- passes ---------------------------------------------------------------------------------

    def _begin(self) -> Pass:
        """Draw the image, then look for pixels that are worth a look."""
        yield from self._draw()
        for share, found in suggest(self.source):
            self.suggested = found
            yield "looking for typical pixels", share
        self.tell("suggested")

    def _draw(self) -> Pass:
        source = self.source
        if isinstance(source, SceneSource):
            shown = start = time.monotonic()
            for share in source.passes():
                now = time.monotonic()
                # The later, the less it changes; a large image takes long to send and to show.
                if now - shown > _SHOWN_EVERY * (now - start) + 0.4 or share >= 1:
                    self._image(source.overall())
                    shown = now
                yield "drawing the image", share
            return
        if self.other is not None:
            self.other_overall = yield from _read(self.other)
        self._image((yield from _read(source)))

    def _image(self, overall: Overall) -> None:
        """Show an image; what takes long is found here and not in the thread of the server."""
        _ = overall.exposure
        self.overall = overall
        self.tell("image")

    def _walk(self, source: StoreSource, name: str) -> Pass:
        kind, array = map_kind(name, source.samples.spp), npt.NDArray[np.float32]
        for share, values in kept(source.samples, name, array, walk(source, name)):
            if source is self.source:  # else it has grown
                self.maps[name] = replace(kind, values=values, done=share)
            yield f"mapping {kind.title}", share


def _first(source: StoreSource) -> Overall:
    """Return the image of the first samples."""
    *_, (_, found) = stream(source, spp=_FIRST_SPP)
    return found


def _read(source: StoreSource) -> Generator[tuple[str, float], None, Overall]:
    """Return the image of all samples."""
    for share, so_far in kept(source.samples, "overall", Overall, stream(source)):
        found = so_far
        yield f"reading all of {source.name}", share
    return found
