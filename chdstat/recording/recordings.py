"""Recordings: samples of any renderer, pass by pass.

Passes are kept in groups, as what they are: samples of all pixels. Everything before the last group
is thus in the store at any moment, whatever ends the recording, and the same call goes on there.
"""

from __future__ import annotations

import contextlib
import functools
import importlib.metadata
import logging
import math
import pickle
import threading
import time
from collections.abc import Callable, Generator, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Image, say_once, warn_caller, whole
from chdstat._core.files import place_of
from chdstat._core.progress import track
from chdstat._core.work import check_memory, in_order
from chdstat.errors import ChdstatError, ClusterError, InputError, RenderError, StoreError, brief
from chdstat.recording.pass_checks import findings
from chdstat.recording.pass_sources import SEEDS, DrawnPass, PassSource, checked_pass, seed_of_pass
from chdstat.recording.scene_files import SceneFileSource
from chdstat.samples import Samples, is_store
from chdstat.samples.film_steps import OF_FILM
from chdstat.samples.layout import check_same, part_folder
from chdstat.samples.memory_writer import MemoryWriter
from chdstat.samples.samples import checked_attrs
from chdstat.samples.store import Store
from chdstat.samples.tiles import BATCH, FILM, LightPart
from chdstat.scenes.plugins import digest_of

if TYPE_CHECKING:
    from distributed import Client

_log = logging.getLogger("chdstat")
_MOST_BYTES = 2**30
"""Most bytes of passes that wait to be kept."""
_KEEP_EVERY, _MOST_SHARE = 10.0, 0.1
"""Seconds after which passes are kept, unless that would take a larger share of the time."""
_STREAMS = "passes"
"""Samples of these random numbers belong together: sample i is of the pass with number i."""

_OTHERS = (
    "passes of equal seeds differ: samples that are appended are as good as others, but another "
    "recording with the same seed gives others"
)

_PassFunction = Callable[[int], Any] | PassSource
_Keeper = MemoryWriter | Store


def record(
    draw: _PassFunction,
    *,
    spp: int = 256,
    seed: int = 0,
    out: str | Path | None = None,
    name: str | None = None,
    seconds: float | None = None,
    client: Client | None = None,
    progress: bool = True,
    **attrs: Any,
) -> Samples:
    """Record the samples of any renderer that draws an image of one sample per pixel.

    Such an image is a pass. Passes are kept in groups of at most 64, after 10 seconds at the
    latest: what was drawn before a recording was stopped, killed, or ended by an error of the
    renderer is kept in `out`. The same call goes on there, and more `spp` are appended. At the end,
    passes tell about their renderer: a `chdstat.errors.InputWarning` names what makes them no
    independent samples of linear radiance, and what to set; ``attrs["notes"]`` repeats it.

    The first pass is drawn twice, to learn whether the renderer repeats it to the bit. If it does,
    a recording that is continued draws it again and refuses to mix samples of another scene.

    Parameters
    ----------
    draw
        A function, or a `chdstat.recording.PassSource`, that takes a seed below 2^30 and returns
        one sample of every pixel: linear radiance, shape (y, x, channel), or (y, x) for one
        channel. A tuple ``(image, features)`` adds first-hit features by name: albedo, normal and
        position (y, x, 3), depth (y, x); their averages over the passes are kept. A
        `chdstat.recording.DrawnPass` may also have parts of the same light, and say where in its
        pixel each sample fell.
    spp
        Samples per pixel: the number of passes.
    seed
        A whole number below 2^30. It and the number of a pass give the seed of the pass; another
        one gives independent samples.
    out
        Where to store the samples, a path or a URL; None to keep them in memory.
    name
        Name of the scene; None for that of `draw`.
    seconds
        Stop after this time, with fewer samples. The first pass is always drawn.
    client
        A Dask client, whose workers draw the passes; each has a copy of `draw`.
    progress
        Show progress: a bar in a terminal or notebook, elsewhere a line every ten seconds.
    **attrs
        More provenance, such as ``integrator="path"``; samples of another one are not mixed with
        these.

    Returns
    -------
    Samples
        The samples that were kept, with features, parts and provenance.

    Raises
    ------
    InputError
        If `spp` or `seed` is out of range, or the first pass is no image.
    RenderError
        If a later pass is another image, or `draw` raises an exception.
    StoreError
        If `out` holds something else, or cannot be written to.

    Examples
    --------
    >>> import chdstat as chd
    >>> def draw(seed):
    ...     return np.random.default_rng(seed).gamma(0.5, size=(8, 8, 3))
    >>> chd.record(draw, spp=32)
    <Samples 'draw' 8 x 8 pixels, 3 channels, 32 spp, in memory>
    """
    spp, seed = whole("spp", spp, least=1), whole("seed", seed, least=0)
    for what, number in (("spp", spp), ("seed", seed)):
        if number >= SEEDS:
            message = f"{what} must be below {SEEDS}, the number of seeds of passes, got {number}"
            raise InputError(message)
    check_seconds(seconds)
    _check_callable(draw)
    place = None if out is None else place_of(out)
    with contextlib.ExitStack() as opened:
        recording = _Recording(draw, seed, place, opened, _provenance(draw, name, attrs))
        if spp < recording.held:
            message = "nothing to record: %s holds %d samples per pixel, %d were asked for"
            _log.warning(message, out, recording.held, spp)
        if recording.held < spp:
            recording.draw(spp, seconds, client, progress)
        return recording.finish()


def check_seconds(seconds: float | None) -> None:
    """Raise InputError unless a time, if there is one, is positive."""
    if seconds is not None and not seconds > 0:
        message = f"seconds must be positive, got {seconds!r}"
        raise InputError(message)


def _check_callable(draw: Any) -> None:
    if not callable(draw):
        message = f"draw must be a function of a seed, got {type(draw).__name__}"
        raise InputError(message)


def _provenance(draw: _PassFunction, name: str | None, attrs: Mapping[str, Any]) -> dict[str, Any]:
    """Return what samples depend on, apart from their seed and size."""
    function: Any = draw
    while isinstance(function, functools.partial):
        function = function.func
    named = function if hasattr(function, "__qualname__") else type(function)
    told: dict[str, Any] = {
        "scene": getattr(draw, "name", named.__name__.strip("<>")),
        "renderer": "Python",
        "units": "linear radiance",
    }
    if hasattr(draw, "attrs"):
        told |= draw.attrs
    else:
        told["drawn_by"] = f"{named.__module__}.{named.__qualname__}"
        with contextlib.suppress(Exception):  # code of any kind; passes are compared, too
            told["code"] = digest_of(function)
    told |= {} if name is None else {"scene": name}
    version = importlib.metadata.version("chdstat")
    own = {"streams": _STREAMS, "chdstat_version": version, "render_seconds": 0.0}
    return checked_attrs({**told, **attrs, **own})


class _Recording:
    """Passes on their way from their source to where they are kept.

    Attributes
    ----------
    held
        Passes that are kept.
    """

    def __init__(
        self,
        draw: _PassFunction,
        seed: int,
        place: Path | None,
        opened: contextlib.ExitStack,
        attrs: Mapping[str, Any],
    ) -> None:
        self._draw, self._seed, self._place, self._opened = draw, seed, place, opened
        self._attrs: dict[str, Any] = {"notes": [], **attrs, "seed": seed}
        self._keepers: dict[LightPart | None, _Keeper] = {}
        self._waiting: dict[LightPart | None, npt.NDArray[np.float32]] = {}
        self._sums: dict[str, npt.NDArray[np.float64]] = {}
        self.held = self._drawn = self._summed = 0
        self._is_new = place is None or not is_store(place)
        self._first: DrawnPass | None = None
        self._keep_next = 0.0
        if place is not None and not self._is_new:
            self._continue(place)

    @property
    def _main(self) -> _Keeper:
        return self._keepers[None]

    @property
    def _where(self) -> str:
        return "memory" if self._place is None else str(self._place)

    # --- drawing --------------------------------------------------------------------------------

    def draw(self, spp: int, seconds: float | None, client: Client | None, progress: bool) -> None:
        """Draw the passes that are missing, and keep what was drawn whatever happens."""
        start = time.monotonic()
        if self._attrs["notes"]:
            say_once(f"{self._attrs['scene']}: {'; '.join(self._attrs['notes'])}")

        def numbers() -> Iterator[int]:
            yield 0  # drawn once more than it is kept
            for number in range(self.held, spp):
                late = seconds is not None and time.monotonic() - start > seconds
                if late and number > self.held:
                    return
                yield number

        what, missing = f"recording {self._attrs['scene']}", spp - self.held
        with (
            contextlib.closing(self._passes(numbers(), client)) as passes,
            track(what, missing, unit="passes", show=progress) as advance,
        ):
            try:
                self._begin(next(passes))
                for drawn in passes:
                    self._add(drawn, spp)
                    advance(1)
                self._keep()
            except BaseException as error:
                self._end(error)
                raise
            finally:
                if self._keepers:
                    self._main.spent(time.monotonic() - start)

    def _passes(
        self, numbers: Iterator[int], client: Client | None
    ) -> Generator[DrawnPass, None, None]:
        """Yield passes in the order of their numbers."""
        seeds = (seed_of_pass(self._seed, number) for number in numbers)
        if client is None and isinstance(self._draw, SceneFileSource):
            # Its process draws the next pass while this one is kept.
            yield from map(checked_pass, in_order(self._draw, seeds, workers=1))
            return
        if client is None:
            yield from map(checked_pass, map(self._draw, seeds))
            return
        from distributed.protocol.pickle import dumps

        try:
            work = functools.partial(_drawn_remote, dumps(self._draw))
        except (TypeError, AttributeError, pickle.PicklingError) as error:
            message = (
                f"draw cannot be sent to the workers of a cluster: {brief(error)}; let it open "
                "what it needs, such as files and programs, when it is called"
            )
            raise InputError(message) from error
        yield from map(checked_pass, in_order(work, seeds, client=client))

    def _end(self, error: BaseException) -> None:
        """Keep what was drawn before an error, and say so."""
        if self._keepers and not isinstance(error, StoreError):
            self._keep()
        if self._keepers and self._is_new and not self.held:
            if isinstance(self._main, Store):
                self._main.discard()
            self._keepers = {}
        is_own = isinstance(error, ChdstatError) and not self._keepers
        if is_own or isinstance(error, StoreError | ClusterError):
            return
        if not isinstance(error, Exception):  # such as Ctrl-C
            return
        self._fail(error)

    def _fail(self, error: Exception) -> None:
        """Raise an error that says which pass could not be drawn, and what is kept."""
        number = self.held
        kept = (
            f"give out to keep the {number} passes before it"
            if self._place is None
            else f"the {number} passes before it are kept in {self._where}; repeat the call to "
            "go on"
        )
        said = brief(error)
        if not isinstance(error, ChdstatError):
            said = f"{type(error).__name__}: {said}"
        seed = seed_of_pass(self._seed, number)
        message = f"pass {number} of {self._attrs['scene']}, seed {seed}: {said}; {kept}"
        raise RenderError(message) from error

    # --- the first pass -------------------------------------------------------------------------

    def _begin(self, first: DrawnPass) -> None:
        """Take the first pass, which tells the shape of all; it will be drawn once more."""
        self._first, self._shape = first, first.image.shape
        if not self._keepers:
            return
        assert isinstance(self._main, Store), "a recording in memory is not continued"
        if self._main.shape[:3] != self._shape:
            of_store, of_pass = self._main.shape[:3], self._shape
            message = (
                f"{self._where} holds an image of (y, x, channel) = {of_store}, draw returns one "
                f"of {of_pass}. Nothing was changed; give another path"
            )
            raise StoreError(message)
        features = self._main.feature_names
        for what, theirs, ours in (
            ("parts", {*self._keepers} - {None}, {*first.parts}),
            ("features", {*features}, {*first.features} if features else set()),
        ):
            if theirs != ours:
                message = (
                    f"{self._where} holds the {what} {sorted(map(str, theirs))}, draw returns "
                    f"{sorted(map(str, ours))}. Nothing was changed; give another path"
                )
                raise StoreError(message)
        if not self.held:
            return
        stored = self._main.read(slice(None), slice(None), slice(1))[..., 0]
        if self._main.attrs.get("repeats") and not _same(stored, first.image):
            message = (
                f"{self._where} holds samples of another scene or renderer: its first pass is "
                "another one when it is drawn again. Nothing was changed; give another path"
            )
            raise StoreError(message)
        if not self._main.attrs.get("repeats"):
            self._tell_of_others()

    def _continue(self, place: Path) -> None:
        """Open a store and its parts, and refuse one of other samples."""
        held = Store.open(place)
        attrs = {"size": held.attrs.get("size"), **self._attrs, "spp": 0}
        check_same(held.path, held.attrs, checked_attrs(attrs))
        store = self._opened.enter_context(Store.open(place, writable=True))
        parts: dict[LightPart | None, _Keeper] = {
            which: self._opened.enter_context(Store.open(part.path, writable=True))
            for which, part in store.parts().items()
        }
        self._keepers = {None: store, **parts}
        complete = [keeper.ledger.complete_spp for keeper in self._keepers.values()]
        self.held = min(complete)
        if not store.lacks_features:
            self._summed = int(store.attrs.get("feature_passes", 0))
            self._sums = {
                n: self._summed * f.astype(float) for n, f in store.read_features().items()
            }

    def _make(self, second: DrawnPass, spp: int) -> None:
        """Make what keeps the passes, once the first one was drawn twice."""
        assert self._first is not None, "there is a first pass"
        repeats = _same(self._first.image, second.image)
        height, width, channels = self._shape
        attrs = self._attrs | {"size": [width, height], "spp": 1, "repeats": repeats}
        of_all: dict[LightPart | None, dict[str, Any]] = {None: attrs}
        of_all |= {which: _of_part(attrs, which) for which in second.parts}
        if self._place is None:
            needed = 4 * math.prod(self._shape) * spp * len(of_all)
            what = f"{spp} samples for each of {width} x {height} pixels"
            check_memory(needed, what, "give a store to write to, or use fewer samples")
            self._keepers = {
                which: MemoryWriter((height, width, 2 if which == FILM else channels, spp), about)
                for which, about in of_all.items()
            }
            return
        for which, about in of_all.items():
            path = self._place if which is None else self._place / part_folder(which)
            shape = height, width, 2 if which == FILM else channels, 1
            store = Store.create(path, shape=shape, attrs=about)
            self._keepers[which] = self._opened.enter_context(store)

    def _tell_of_others(self) -> None:
        """Say that nothing shows whether a store that is continued is of the same scene."""
        said = f"{self._where}: {_OTHERS}"
        if self._main.attrs.get("code") != self._attrs.get("code"):
            said += ". The code of draw has changed since; nothing shows if it draws the same scene"
        say_once(said)

    # --- keeping --------------------------------------------------------------------------------

    def _add(self, drawn: DrawnPass, spp: int) -> None:
        """Take a pass; keep it with others that wait when it is time."""
        self._check_like_first(drawn)
        if not self._keepers:
            self._make(drawn, spp)
        if not self._waiting:
            of_pass = 4 * math.prod(self._shape) * len(self._keepers)
            room = min(max(_MOST_BYTES // of_pass, 1), BATCH)
            self._waiting = {
                which: np.empty((room, *keeper.ledger.shape[:3]), np.float32)
                for which, keeper in self._keepers.items()
            }
        for which, waiting in self._waiting.items():
            waiting[self._drawn] = drawn.image if which is None else drawn.parts[which]
        if self.held + self._drawn >= self._summed:
            for name, feature in drawn.features.items():
                self._sums[name] = self._sums.get(name, 0.0) + feature.astype(float)
            self._summed += 1
        self._drawn += 1
        now, full = time.monotonic(), self._drawn == len(self._waiting[None])
        if full or (self.held + self._drawn) % BATCH == 0 or now >= self._keep_next:
            self._keep()
            took = time.monotonic() - now
            self._keep_next = time.monotonic() + max(_KEEP_EVERY, took / _MOST_SHARE)

    def _check_like_first(self, drawn: DrawnPass) -> None:
        """Refuse a pass of another shape than the first, or with other features or parts."""
        assert self._first is not None, "there is a first pass"
        for what, first, own in (
            ("an image (y, x, channel) of", self._shape, drawn.image.shape),
            ("features", sorted(self._first.features), sorted(drawn.features)),
            ("parts", sorted(map(str, self._first.parts)), sorted(map(str, drawn.parts))),
        ):
            if first != own:
                message = f"expected {what} {first}, as in the first pass, got {own}"
                raise InputError(message)

    def _keep(self) -> None:
        """Keep the passes that wait: features and parts first, so that none is missing."""
        if not self._drawn:
            return
        start, stop = self.held, self.held + self._drawn
        if self._sums:
            averages = {n: (s / self._summed).astype(np.float32) for n, s in self._sums.items()}
            self._main.renew(averages, feature_passes=self._summed)
        for which, keeper in reversed(self._keepers.items()):
            self._write(keeper, self._waiting[which], start, stop)
        self.held, self._drawn = stop, 0

    @staticmethod
    def _write(keeper: _Keeper, waiting: npt.NDArray[np.float32], start: int, stop: int) -> None:
        keeper.fit(start, stop)
        for chunk in keeper.ledger.chunks(ss=slice(start, stop)):
            ys, xs, begun = chunk.ys, chunk.xs, chunk.ss.start
            part = waiting[max(begun - start, 0) : chunk.ss.stop - start, ys, xs]
            block: Image = np.moveaxis(part, 0, -1)
            if begun < start:  # the chunk holds samples already
                block = np.concatenate([keeper.read(ys, xs, slice(begun, start)), block], axis=-1)
            keeper.write(chunk, block)

    def finish(self) -> Samples:
        """Return the samples that are kept, with what passes that were drawn show."""
        parts = {w: keeper.finish() for w, keeper in self._keepers.items() if w is not None}
        samples = self._main.finish(parts)
        if self._first is None:
            return samples
        found = findings(samples)
        for finding in found:
            warn_caller(f"{samples.name}: {finding}")
        others = [] if samples.attrs["repeats"] else [_OTHERS]
        changed = {"code": self._attrs["code"]} if "code" in self._attrs else {}
        self._main.update(notes=[*self._attrs["notes"], *others, *found], **changed)
        return self._main.finish(parts)


def _of_part(attrs: Mapping[str, Any], which: LightPart) -> dict[str, Any]:
    """Return the provenance of a part of the samples."""
    if which == FILM:
        return {**attrs, **OF_FILM}
    if isinstance(which, str):
        return {**attrs, "light": which}
    return {**attrs, "integrator": {**attrs.get("integrator", {}), "max_depth": which}}


def _same(one: Image, other: Image) -> bool:
    return np.array_equal(one, other, equal_nan=True)


# --- on workers of a cluster --------------------------------------------------------------------

_one_pass = threading.Lock()
"""Sources draw one pass at a time in a process."""


def _drawn_remote(pickled: bytes, seed: int) -> DrawnPass:
    with _one_pass:
        return checked_pass(_source_of(pickled)(seed))


@functools.lru_cache(maxsize=1)
def _source_of(pickled: bytes) -> _PassFunction:
    """Return a worker's own copy of a source, which starts its renderer once."""
    from distributed.protocol.pickle import loads

    source: _PassFunction = loads(pickled)
    return source
