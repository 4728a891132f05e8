"""Workspace: what all pages of one explorer share, its sources, images, maps and threads.

Clicks are worked on in one thread, passes over the image in another (`chdstat.explorer.passes`): a
pass stands still while a click is being worked on, and where nobody waits for it. Reading ahead and
exports have a third thread, slow estimates a fourth. Images and maps of a store are kept in the
user's cache folder, never beside the store.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Floats, luminance
from chdstat._core.files import Cache, is_exr, user_cache
from chdstat._core.positive import PositivePart
from chdstat.comparison.finished_images import ImageErrors, measuring_errors
from chdstat.errors import InputError
from chdstat.estimators.training import TrainedModel, load_model
from chdstat.explorer.address import BRUSHED, PixelIndex, View, channel_name
from chdstat.explorer.brushing import brushed
from chdstat.explorer.image_sources import (
    AnySource,
    ImageSource,
    Overall,
    Sampled,
    SceneSource,
    StoreSource,
    stream,
)
from chdstat.explorer.overlays import (
    CONTRASTS,
    DIFFERENCES,
    IMAGES,
    Map,
    map_kind,
    map_of,
    map_of_view,
    read_maps,
    walk,
)
from chdstat.explorer.passes import Pass, Passes
from chdstat.inference.contrasts import contrasting
from chdstat.inference.references import Reference
from chdstat.patterns import Thresholds
from chdstat.patterns.classification import Classification
from chdstat.patterns.definitions import firefly_limit
from chdstat.samples import Samples, cache_key
from chdstat.samples import open as open_store
from chdstat.summary.runner import measured

_MOST_FILES = 64
_FIRST_SPP = 64
_MOST_BRUSHED = 8
"""Maps of brushes that are kept."""
_SHOWN_EVERY = 0.5
"""The image is shown again after 0.4 s plus this share of the time since drawing began."""

T = TypeVar("T")
_Listener = Callable[[str], None]


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
    sources: Sequence[str | Path | Samples | SceneSource],
    models: Sequence[TrainedModel[Any] | str | Path] = (),
    *,
    maps: str | Path | None = None,
) -> Workspace:
    """Open what `chdstat.explore` is given; of a scene, what it made of it.

    Raises
    ------
    InputError
        If the sources do not fit each other.
    StoreError, SceneError, RenderError
        If something cannot be read or rendered.
    """
    trained = [
        (Path(one).stem, load_model(one)) if isinstance(one, str | Path) else (one.name, one)
        for one in models
    ]
    found = [one if isinstance(one, SceneSource) else _opened(one) for one in sources]
    for one in found[1:]:
        if (one.size, one.channels) != (found[0].size, found[0].channels):
            expected, got = (
                f"{s.size[1]} x {s.size[0]} pixels and channels {', '.join(s.channels)}"
                for s in (found[0], one)
            )
            message = (
                f"{one.name} must have the size and channels of {found[0].name}: expected "
                f"{expected}, got {got}"
            )
            raise InputError(message)
    given = {} if maps is None else read_maps(maps, found[0].size)
    return Workspace(found, trained, given)


def _opened(source: str | Path | Samples) -> StoreSource | ImageSource:
    if not isinstance(source, Samples) and is_exr(source):
        return ImageSource(Path(source))
    return _store(source)


def _store(source: str | Path | Samples) -> StoreSource:
    samples = source if isinstance(source, Samples) else open_store(source)
    channels = samples.shape[2]
    if channels not in {1, 3}:
        message = f"the explorer shows 1 or 3 channels, got {channels}"
        raise InputError(message)
    return StoreSource(samples)


class Workspace:
    """State of one explorer.

    Parameters
    ----------
    sources
        What is on the page: stores, a scene, images.
    models
        Names of trained estimators, and these.
    given
        Maps that were computed before, by name.

    Attributes
    ----------
    names
        Of the sources, each another one.
    overalls
        Their images so far.
    maps
        Maps, finished or not, by what `key` says and by their name.
    errors
        Errors of the other images against one, by its index.
    outdated
        Indices of errors that are of fewer samples than there are now.
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
        sources: Sequence[AnySource],
        models: Sequence[tuple[str, TrainedModel[Any]]] = (),
        given: Mapping[str, Map] = MappingProxyType({}),
    ) -> None:
        self.sources = list(sources)
        self.names = _distinct(self.sources)
        self.models, self.given = models, given
        empty = Overall.empty(*sources[0].size, len(sources[0].channels))
        self.overalls = [empty for _ in sources]
        self.maps: dict[tuple[str, str], Map] = {}
        self.errors, self.outdated = dict[int, ImageErrors](), set[int]()
        self.suggested: list[tuple[str, PixelIndex]] = []
        self.clicks, self.exports, self.additions, self.images = self._pools = [
            ThreadPoolExecutor(1, thread_name_prefix=f"chdstat-{name}")
            for name in ("clicks", "exports", "additions", "images")
        ]
        self._listeners: set[_Listener] = set()
        self._urgent, self._drawn = 0, False
        self._lock = threading.Lock()
        self.passes = Passes(lambda: self.is_urgent, self.tell)

    def start(self) -> None:
        """Show the first images, then begin to improve them."""
        # The first samples take a second where all take minutes.
        self.overalls = [
            _first(source) if isinstance(source, StoreSource) else source.overall()
            for source in self.sources
        ]
        self.passes.ask(self, "start", self._begin())

    def stop(self) -> None:
        """End all threads, now or at the next tile."""
        self.passes.stop()
        for pool in self._pools:
            pool.shutdown(wait=False, cancel_futures=True)
        for source in self.sources:
            if isinstance(source, SceneSource):
                source.close()

    def listen(self, listener: _Listener) -> Callable[[], None]:
        """Call a listener with the name of what changes; return what to call to end that.

        The names are "image", "drawn", "working", "source", "suggested", "start", and those of
        maps and errors.
        """
        self._listeners.add(listener)
        return partial(self._listeners.discard, listener)

    def tell(self, what: str) -> None:
        """Call all listeners with the name of what has changed."""
        for listener in tuple(self._listeners):
            listener(what)

    @property
    def is_urgent(self) -> bool:
        """Whether a click waits for its results."""
        return self._urgent > 0

    def urgent(self, change: int) -> None:
        """Count the clicks that wait for their results."""
        with self._lock:
            self._urgent += change

    def key(self, view: View) -> str:
        """Return what a map is called here, those of one contrast alike."""
        shown, reference = view.of_images(len(self.sources))
        if view.brush is not None:
            return f"{BRUSHED} {shown} {view.channel} {view.brush}"
        return f"contrast {shown} {reference}" if view.map in CONTRASTS else f"{view.map} {shown}"

    def want(self, who: Hashable, view: View) -> None:
        """Let a page wait for the map of its view, and for no other one.

        Raises
        ------
        InputError
            If there is no such map, or it needs samples and there are none.
        """
        self.passes.leave(who)
        found = self.map(view)
        if view.overlay == "image" or (found is not None and found.done >= 1):
            return
        kind, key = map_of_view(view), self.key(view)
        shown, reference = view.of_images(len(self.sources))
        source = self.sources[shown]
        if view.overlay in (*DIFFERENCES, *CONTRASTS) and shown == reference:
            message = "this image is the reference: choose another one"
            raise InputError(message)
        if view.overlay in CONTRASTS:
            self.passes.ask(who, key, self._contrast(key, shown, reference))
        elif isinstance(source, StoreSource) and view.brush is not None:
            self.passes.drop(BRUSHED)
            self.passes.ask(who, key, self._brush(source, key, view))
        elif isinstance(source, StoreSource):
            self.passes.ask(who, key, self._walk(source, key, view.map))
        else:
            how = "render the scene with 'chdstat render SCENE -o STORE'"
            message = f"{kind.title!r} needs samples, which {source.name} does not have: {how}"
            raise InputError(message)

    def want_errors(self, who: Hashable, reference: int) -> None:
        """Let a page wait for the errors of the images against one of them."""
        name, known = f"errors {reference}", reference in self.errors
        told = (known and reference not in self.outdated) or name in self.passes.failures
        if len(self.sources) > 1 and self._drawn and not told:
            self.passes.ask((who, "errors"), name, self._measure(reference), patient=True)

    def map(self, view: View) -> Map | None:
        """Return what there is of the map of a view."""
        shown, reference = view.of_images(len(self.sources))
        name, overall = view.overlay, self.overalls[shown]
        if name in self.given:
            return self.given[name]
        if name in DIFFERENCES and shown != reference:
            pair = (self.overalls[reference].mean, overall.mean)
            return map_of(name, *(luminance(mean, channel_axis=-1) for mean in pair))
        if name in IMAGES and not isinstance(self.sources[shown], ImageSource):
            return IMAGES[name].filled(getattr(overall, name))
        return self.maps.get((self.key(view), name))

    def refresh(self) -> None:
        """Go on with the samples that were added to stores since, if there are any.

        Passes that somebody waits for end first: begun anew with each growth, they never would.
        """
        if not self.passes.idle:
            return
        grown = [
            source.refreshed() if isinstance(source, StoreSource) and not source.complete else None
            for source in self.sources
        ]
        if any(grown):
            self.sources = [new or old for new, old in zip(grown, self.sources, strict=True)]
            self.passes.forget()
            self.maps.clear()
            self.outdated.update(self.errors)
            self._drawn = False
            self.passes.ask(self, "start", self._draw())
            self.tell("source")

    # --- passes ---------------------------------------------------------------------------------

    def _begin(self) -> Pass:
        """Draw the images, then look for pixels that are worth a look."""
        yield from self._draw()
        sampled = next((one for one in self.sources if not isinstance(one, ImageSource)), None)
        for share, found in suggest(sampled) if sampled else ():
            self.suggested = found
            yield "looking for typical pixels", share
        self.tell("suggested")

    def _draw(self) -> Pass:
        for i, source in enumerate(self.sources):
            if isinstance(source, StoreSource):
                for share, so_far in kept(source.samples, "overall", Overall, stream(source)):
                    found = so_far
                    yield f"reading all of {source.name}", share
                self._image(i, found)
            elif isinstance(source, SceneSource):
                shown = start = time.monotonic()
                for share in source.passes():
                    now = time.monotonic()
                    # The later, the less it changes; a large image takes long to send and to show.
                    if now - shown > _SHOWN_EVERY * (now - start) + 0.4 or share >= 1:
                        self._image(i, source.overall())
                        shown = now
                    yield "drawing the image", share
        self._drawn = True
        self.tell("drawn")

    def _image(self, index: int, overall: Overall) -> None:
        """Show an image; what takes long is found here and not in the thread of the server."""
        _ = overall.exposure
        self.overalls[index] = overall
        self.tell("image")

    def _walk(self, source: StoreSource, key: str, name: str) -> Pass:
        kind, array = map_kind(name, source.samples.spp), npt.NDArray[np.float32]
        for share, values in kept(source.samples, name, array, walk(source, name)):
            if source in self.sources:  # else it has grown
                self.maps[key, name] = replace(kind, values=values, done=share)
            yield f"mapping {kind.title}", share

    def _measure(self, reference: int) -> Pass:
        """Measure the errors of all other images against one."""
        source, mean = self.sources[reference], self.overalls[reference].mean
        name = self.names[reference]
        truth = source.samples if isinstance(source, StoreSource) else Reference(mean, name=name)
        images: dict[str, Any] = {}
        for i, (of, one) in enumerate(zip(self.names, self.sources, strict=True)):
            if i != reference and not isinstance(one, SceneSource):
                image = self.overalls[i].mean
                images[of] = one.samples if isinstance(one, StoreSource) else image
        means = {
            name: overall.mean for name, overall in zip(self.names, self.overalls, strict=True)
        }
        found = yield from measuring_errors(images, truth, name=name, means=means)
        if source is self.sources[reference]:  # else it has grown
            self.errors[reference] = found
            self.outdated.discard(reference)

    def _brush(self, source: StoreSource, key: str, view: View) -> Pass:
        assert view.brush is not None
        kind, channel = map_of_view(view), channel_name(view.channel, source.channels)
        earlier = [known for known in self.maps if known[1] == BRUSHED]
        for known in earlier[:-_MOST_BRUSHED]:  # each is another range
            self.maps.pop(known)
        for share, found in brushed(source, view.brush, view.channel):
            note = found.told(view.brush, channel) if share >= 1 else ""
            if source in self.sources:
                now = replace(kind, values=found.share, done=share, note=note)
                self.maps[key, BRUSHED] = now
            yield "counting samples", share

    def _contrast(self, key: str, shown: int, reference: int) -> Pass:
        pair = reference, shown
        if isinstance(self.sources[reference], ImageSource):
            pair = shown, reference  # what is exact comes second
        a, b = (self.sources[i] for i in pair)
        if not isinstance(a, StoreSource) or isinstance(b, SceneSource):
            message = f"a contrast of {a.name} and {b.name} needs the samples of a store"
            raise InputError(message)
        other = b.samples if isinstance(b, StoreSource) else self.overalls[pair[1]].mean
        found = yield from contrasting(a.samples, other)
        note = f"A {self.names[pair[0]]}, B {self.names[pair[1]]}. {found.conclusion}"
        self.maps |= {(key, name): map_of(name, found, note=note) for name in CONTRASTS}


def _first(source: StoreSource) -> Overall:
    """Return the image of the first samples."""
    *_, (_, found) = stream(source, spp=_FIRST_SPP)
    return found


def _distinct(sources: Sequence[AnySource]) -> list[str]:
    """Return names of sources; those that are called alike have a number."""
    names = [source.name for source in sources]
    return [f"{name} ({i + 1})" if names.count(name) > 1 else name for i, name in enumerate(names)]


# --- pixels that are worth a first look -----------------------------------------------------------

_GRID = 12
"""Pixels along the longer side of the image that are looked at."""
_SPP = 512
_AT_ONCE = 12
_SUGGESTED = (("long tail", ("long_tail",)), ("bimodal", ("bimodal", "multimodal")),
              ("null-heavy", ("null_heavy",)))  # fmt: skip
"""Names, and the patterns that they stand for."""


def first_pixel(overall: Overall) -> PixelIndex:
    """Return the pixel with the brightest firefly, or the centre of an image without any.

    Examples
    --------
    >>> first_pixel(Overall.empty(5, 9, 3))
    (2, 4)
    """
    count = np.nan_to_num(overall.good_count).astype(np.int64)
    with np.errstate(divide="ignore", invalid="ignore"):
        share = overall.extreme / (overall.extreme + overall.others)
        is_firefly = share > firefly_limit(count, Thresholds())
    height, width = share.shape
    if not is_firefly.any():
        return height // 2, width // 2
    brightest = int(np.argmax(np.where(is_firefly, overall.extreme, -np.inf)))
    return brightest // width, brightest % width


def suggest(source: Sampled) -> Iterator[tuple[float, list[tuple[str, PixelIndex]]]]:
    """Look for a pixel with a long tail, one with several modes and one that is null-heavy.

    Yields the progress, and in the end the pixels. They are chosen from a grid by the surest
    pattern: the largest lower end of the interval of its statistic. Patterns that no pixel of the
    grid has are left out.

    Parameters
    ----------
    source
        Where samples come from; the first 512 of each pixel are read or drawn.
    """
    cell = max(1.0, max(source.size) / _GRID)
    numbers = (max(1, int(length / cell)) for length in source.size)
    ys, xs = (
        ((np.arange(k) + 0.5) * length / k).astype(int).tolist()
        for k, length in zip(numbers, source.size, strict=True)
    )
    pixels = list(product(ys, xs))
    sure: dict[str, list[Floats]] = {name: [] for name, _ in _SUGGESTED}
    for i in range(0, len(pixels), _AT_ONCE):
        yield i / len(pixels), []
        part = PositivePart.of_pixels(source.some(pixels[i : i + _AT_ONCE], _SPP), rows="luminance")
        found = measured(part, Classification())
        for name, patterns in _SUGGESTED:
            lower = [
                np.where(found.flags[p] & (part.n > 0), found.intervals[p][..., 0], -np.inf)
                for p in patterns
            ]
            sure[name].append(np.fmax.reduce(lower, initial=-np.inf))
    chosen: dict[str, PixelIndex] = {}
    for name, parts in sure.items():
        score = np.concatenate(parts)
        score[[pixels.index(p) for p in chosen.values()]] = -np.inf
        if score.max() > -np.inf:
            chosen[name] = pixels[int(score.argmax())]
    yield 1.0, list(chosen.items())
