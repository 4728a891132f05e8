"""Renders: all samples of a scene, chunk by chunk.

`render` keeps every sample, in a store or in memory; it can be stopped and resumed at any moment.
`render_pixels` draws the samples of a few pixels on demand.
"""

from __future__ import annotations

import contextlib
import logging
import pickle
import time
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Unpack

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Image, say_once, whole
from chdstat._core.files import free_disk, place_of
from chdstat._core.progress import track
from chdstat._core.work import check_memory, pool
from chdstat.errors import InputError, RenderError, StoreError, brief
from chdstat.recording import record
from chdstat.recording.recordings import check_seconds
from chdstat.recording.renderers import source_of
from chdstat.rendering.adaptive import Adaptive, ErrorMeasure, Look, decided, error_of, more
from chdstat.rendering.backend import activate
from chdstat.rendering.jobs import SETTINGS, Job, RenderSettings, checked_settings, with_settings
from chdstat.rendering.mitsuba_renderer import MitsubaRenderer
from chdstat.rendering.seeds import check_spp, max_spp
from chdstat.rendering.workers import features_remote, rendered
from chdstat.samples import Samples, is_store
from chdstat.samples.costs import SampleCosts, with_times
from chdstat.samples.layout import check_same, part_folder
from chdstat.samples.ledger import counts_of
from chdstat.samples.memory_writer import MemoryWriter
from chdstat.samples.store import Store
from chdstat.samples.tiles import (
    BATCH,
    DIRECT_DEPTH,
    FILM,
    Chunk,
    LightPart,
    Work,
    chunk_grid,
    is_depth,
)
from chdstat.scenes import Scene, SceneLike, load_scene
from chdstat.scenes.scene import MITSUBA, LiveScene
from chdstat.scenes.settings import LONGEST

if TYPE_CHECKING:
    from distributed import Client

_log = logging.getLogger("chdstat")
_MOST_COMPRESSION = 10
"""Stores shrink to between a third and nine tenths; a tenth leaves room for darker scenes."""


@with_settings
def render(
    scene: SceneLike,
    *,
    direct: bool = False,
    by_depth: int | None = None,
    by_light: Sequence[str] = (),
    film: bool = False,
    cost: bool = False,
    adaptive: bool | ErrorMeasure = False,
    error: float | None = None,
    percentile: float | None = None,
    seconds: float | None = None,
    out: str | Path | None = None,
    client: Client | None = None,
    progress: bool = True,
    **options: Unpack[RenderSettings],
) -> Samples:
    """Render a scene and keep every sample.

    The samples of a chunk (a tile of pixels times a batch of samples) depend only on scene,
    backend, seed, tile and batch. A render that was stopped can therefore resume, more `spp` are
    appended, and any worker may render any chunk. The result is always the same to the bit.

    Parameters
    ----------
    scene
        Scene, in any form that `chdstat.load_scene` takes.
    spp
        Samples per pixel, on average. If `out` holds fewer, the missing ones are appended.
    size
        (width, height) in pixels; None for the size of `out`, or else the scene's own.
    seed
        An integer from 0 to 2^31 - 1; another seed gives independent samples.
    max_depth
        Longest path in segments; None for the scene's own.
    sensor
        Number of the scene's sensor, counted from 0.
    integrator
        Integrator that replaces the scene's own, in one of these forms:

        - Mitsuba's name, or a dict with settings, such as ``{"type": "path", "rr_depth": 100}``.
        - "guided": the scene's own, which draws some of its directions towards light that earlier
          paths have found (see `chdstat.rendering.guiding`), with the llvm and cuda backends.
          "auto" does so if these paths show that it pays.
        - Your own, by the name under which a plugin registers it (see
          `chdstat.scenes.load_plugin`); `max_depth` applies to it.
    crop
        (x, y, width, height): render only this part of the image, with its own random numbers. To
        continue an `out` with a crop, give the same `size` and `crop` again.
    color
        How light is transported before it becomes linear sRGB: "rgb"; "spectral", each sample at
        four random wavelengths; or "mono", one channel that is copied to all three, with llvm and
        cuda only.
    sampler
        "independent", or one of Mitsuba's samplers that spread the samples of a pixel:
        "stratified", "multijitter", "orthogonal" or "ldsampler". Spread samples depend on each
        other; `Samples.sequence_means` gives averages that do not. The scene's own sampler is
        ignored.
    sequence
        Samples of a pixel that such a sampler spreads together; 16 by default. Each sequence has
        its own random numbers, and `spp` must be a multiple of `sequence`.
    direct
        Also render every sample with at most two segments, which is its emission and direct light:
        `Samples.direct`. The rest is indirect. That takes a tenth more time in rooms, and more
        where paths are short. An `out` with direct light continues with it.
    by_depth
        Also render every sample with at most 2, 3, ... and this many segments: `Samples.depths`.
        Their differences are the light of each sample by the length of its path;
        `chdstat.patterns.attribute` turns them into shares of the mean, the variance and the tail.
    by_light
        Also render every sample with some lights only: `Samples.lights`. Each entry is the name of
        a light (of its shape, in most scenes), or a pattern such as ``"lamp-*"`` for a group of
        lights. `chdstat.patterns.attribute` returns their shares, too.
    film
        Also keep where in its pixel each sample fell: `Samples.film`. `chdstat.patterns.film_split`
        tells from it how much of the variance is between places in the pixel. Samples stay the same
        to the bit. It takes a byte a sample in a store (a tenth to a quarter of it) and a third
        more memory, and about 3 % of the time; twice the time where the scalar backend draws
        samples one by one, which is adaptive renders and samplers that spread samples. An `out`
        with it continues with it; one without gets the places of its samples, too.
    cost
        Also time the samples of each pixel: `Samples.costs`. Only the scalar backend can tell, and
        its samples stay the same to the bit. `chdstat.contrast` then knows the efficiency of each
        pixel, and an adaptive render draws fewer samples where they take long; its numbers of
        samples then depend on the machine. An `out` with times continues with them.
    adaptive
        Draw samples where they are needed. Every pixel gets some first (a quarter of `spp`, or 32
        but at most half). The others are drawn where the first ones of other pixels tell that the
        image is noisy; see `chdstat.rendering.adaptive`. True minimises the relative error of the
        image ("relMSE"), "MSE" the absolute one. The samples of a pixel do not depend on their
        number, so that means have no bias. With llvm and cuda, they are the first samples of a
        render that is not adaptive. With scalar, they are drawn pixel by pixel, which takes longer.
        An adaptive `out` continues adaptively.
    error
        Relative error of the image to reach, such as 0.02 for 2 %: the root of its relMSE (see
        `chdstat.rendering.adaptive`). The render is then adaptive. Trial samples, which are not
        kept, tell where and how many samples it takes; `spp` is the most that are drawn on average,
        trials included. At the end, the error is estimated from all samples that are kept:
        ``samples.attrs["error"]`` holds its value, the ends of its 95 % interval, and whether it is
        ``reached``, with a tenth more allowed. If it is not, a warning says so.
    percentile
        Reach the error in single pixels: 95 means in 95 % of them. None takes the error of the
        image, which its noisiest pixels decide.
    seconds
        Stop after this time, once every pixel has samples; `spp` is then the most. The same render
        goes on in `out`.
    out
        Where to store the samples, a path or a URL; None to keep them in memory.
    backend
        "auto" takes the fastest backend that works on this machine.
    client
        A Dask client, whose workers render one chunk per task.
    progress
        Show progress: a bar in a terminal or notebook, elsewhere a line every ten seconds.

    Returns
    -------
    Samples
        All samples, with first-hit features and provenance.

    Raises
    ------
    InputError
        If `spp`, `size` or `seed` is out of range, or the sampler would round `sequence`. Also if
        light by depth or by lights, or an adaptive render, is asked for with a sampler that spreads
        samples, or with `seconds`.
    SceneError, RenderError
        If the scene cannot be read, or cannot be rendered as asked.
    StoreError
        If `out` holds something else, or cannot be written to.

    Examples
    --------
    >>> import chdstat as chd
    >>> samples = chd.render("cornell-box", spp=2, size=(8, 8), backend="scalar")
    >>> samples
    <Samples 'cornell-box' 8 x 8 pixels, 3 channels, 2 spp, in memory>
    """
    loaded, settings = load_scene(scene), checked_settings(options)
    if loaded.renderer != MITSUBA:
        decided = {"by_depth": by_depth, "error": error, "percentile": percentile}
        asked = {**settings, **decided, "adaptive": adaptive or None}
        parts: Any = {"direct": direct, "by_light": by_light}
        for name, given, what in (
            ("film", film, "where in a pixel its samples fall"),
            ("cost", cost, "what single samples take"),
        ):
            if given:
                message = f"{loaded.renderer} does not say {what}; leave out {name}"
                raise InputError(message)
        working: Any = {"seconds": seconds, "client": client, "progress": progress}
        return _recorded(loaded, asked, parts, out, **working)
    deepest = DIRECT_DEPTH if by_depth is None else whole("by_depth", by_depth, least=DIRECT_DEPTH)
    depths = set(range(DIRECT_DEPTH, deepest + 1)) if direct or by_depth else set()
    place = None if out is None else place_of(out)
    existing = Store.open(place) if place and is_store(out) else None
    if existing is not None:
        held = existing.parts()  # parts of other samples are refused here
        depths |= set(filter(is_depth, held))
        film = film or FILM in held
        by_light = [*dict.fromkeys([*by_light, *(p for p in held if isinstance(p, str))])]
        settings = _as_stored(settings, existing)
    how, decided_by = None, existing.adaptive if existing else None
    if adaptive is not False or (error, percentile, decided_by) != (None, None, None):
        how = Adaptive.of(adaptive, error, percentile, settings["spp"], decided_by)
    if (depths or by_light or how is not None) and settings["sampler"] != "independent":
        message = (
            "direct=, by_depth= and by_light= draw the same samples again, and adaptive= draws "
            "more of some pixels, which only independent ones allow; leave them out, or "
            f"sampler={settings['sampler']!r}"
        )
        raise InputError(message)
    _check_lights(loaded, by_light)
    job = Job.of(loaded, **settings)
    went_on = existing is not None and existing.has_costs and client is None
    if cost or (went_on and job.backend.name == "scalar"):
        _check_timing(job, client)
        job = replace(job, cost=True)
    if job.guided and existing is not None:
        from chdstat.rendering.guiding import kept_guide

        job = replace(job, guide=kept_guide(existing, job.guided))
    if client is not None:
        _check_portable(job)
    check_seconds(seconds)
    if seconds is not None and (depths or by_light or how):
        message = (
            "seconds= is for samples alone: direct=, by_depth= and by_light= draw them again, and "
            "an adaptive render decides from all that it draws; leave one of them out"
        )
        raise InputError(message)
    work: Work = {"client": client, "progress": progress}
    with activate(job.backend):
        return _captured(job, depths, by_light, film, how, place, work, seconds)


def _check_lights(scene: Scene, by_light: Sequence[str]) -> None:
    """Refuse to switch lights of a scene that belongs to the caller."""
    if by_light and isinstance(scene.source, LiveScene):
        message = (
            "by_light switches lights off, which would change the scene that Mitsuba has built; "
            "give the file or dict that it was made of"
        )
        raise InputError(message)


def _check_timing(job: Job, client: Client | None) -> None:
    """Refuse to time samples where that says nothing of single pixels."""
    if job.backend.name != "scalar":
        message = (
            "cost=True times the samples of each pixel, which only the scalar backend draws one by "
            f"one, got backend={job.backend.name!r}; give backend='scalar', or leave out cost=True"
        )
        raise InputError(message)
    if job.built_integrator is not None:
        message = (
            "cost=True needs to know in which order pixels are drawn, which an integrator that is "
            "there already does not tell; give one by name or as a dict, or leave out cost=True"
        )
        raise InputError(message)
    if client is not None:
        message = (
            "cost=True measures on this machine, and the workers of a cluster differ; leave out "
            "client or cost"
        )
        raise InputError(message)


_OF_ANY = ("spp", "size", "seed", "max_depth", "crop")
"""Settings of a render that other renderers have, too."""


def _recorded(
    scene: Scene,
    settings: Mapping[str, Any],
    parts: Mapping[str, Any],
    out: str | Path | None,
    **work: Any,
) -> Samples:
    """Record the samples of a scene of another renderer."""
    defaults = {name: parameter.default for name, parameter in SETTINGS.items()}
    others = [n for n in settings if n not in _OF_ANY and settings[n] != defaults.get(n)]
    if others:
        message = (
            f"{', '.join(others)}: for scenes that Mitsuba renders, but {scene.renderer} renders "
            f"{scene.name}; leave it out"
        )
        raise InputError(message)
    view = {name: settings[name] for name in ("size", "crop", "max_depth")}
    if out is not None and is_store(out) and view["size"] is view["crop"] is None:
        view["size"] = tuple(Store.open(place_of(out)).attrs["size"])
    with contextlib.closing(source_of(scene, **view, **parts)) as source:
        return record(source, spp=settings["spp"], seed=settings["seed"], out=out, **work)


def _captured(
    job: Job,
    depths: Collection[int],
    lights: Sequence[str],
    film: bool,
    how: Adaptive | None,
    out: Path | None,
    work: Work,
    seconds: float | None,
) -> Samples:
    """Render a job, and again for each part of its light."""
    spp = job.options["spp"]
    kept = spp * (1 + len(depths) + len(lights)) + (spp // 3 if film else 0)  # half floats, two
    renderer = checked_renderer(job, kept=kept, out=out)
    renderer.check_lights(lights)
    of_film = renderer.for_film() if film else None
    partial = _cut_paths(renderer, depths) | {n: replace(renderer.job, light=n) for n in lights}
    partial = {which: replace(of_part, cost=False) for which, of_part in partial.items()}
    with _writer(renderer, out, how) as writer:  # which refuses a store of another scene
        is_less = spp < writer.attrs["spp"] and (how is None or how.error is None)
        if is_less and not writer.ledger.pending():
            message = "nothing to render: %s holds %d samples per pixel, %d were asked for"
            _log.warning(message, out, writer.attrs["spp"], spp)
        with _features_restored(renderer, writer, work):
            _fill(renderer, writer, work, seconds)
        if how is not None:
            _AdaptiveRender(how, renderer, writer, work).finish()
        parts = dict[LightPart, Samples]()
        if of_film is not None:
            parts[FILM] = _part(of_film, FILM, writer, out, how, work)
        del renderer, of_film  # kernels are frozen where one scene is alive only
        for which, of_part in partial.items():
            parts[which] = _part(MitsubaRenderer(of_part), which, writer, out, how, work)
        return writer.finish(parts)


def _part(
    renderer: MitsubaRenderer,
    which: LightPart,
    whole: Writer,
    out: Path | None,
    how: Adaptive | None,
    work: Work,
) -> Samples:
    """Render a part of the samples that there are."""
    with _writer(renderer, out and out / part_folder(which), how) as part:
        if whole.density is not None:
            part.decide(whole.density, whole.attrs["spp"], whole.attrs["noise"])
        _fill(renderer, part, work, like=whole)
        return part.finish()


@dataclass
class _AdaptiveRender:
    """An adaptive render whose first samples are there.

    Attributes
    ----------
    how
        The plan of the render.
    renderer, writer, work
        What renders, what keeps the samples, and where and how to work.
    """

    how: Adaptive
    renderer: MitsubaRenderer
    writer: Writer
    work: Work
    _trial_costs: SampleCosts | None = None

    def __post_init__(self) -> None:
        self._most = self.renderer.job.options["spp"]

    def finish(self) -> None:
        """Render the other samples, and say how large the error is."""
        self._decide()
        _fill(self.renderer, self.writer, self.work)
        look = self._go_on()
        _fill(self.renderer, self.writer, self.work)
        self._tell(look)

    def _decide(self) -> None:
        """Make room for the samples of each pixel, as first samples or trial samples decide."""
        how, density = self.how, self.writer.density
        if density is not None:
            noise = self.writer.attrs["noise"]
            if how.percentile not in (None, decided_for := noise.get("percentile")):
                whole_image = "the whole image"
                of = whole_image if decided_for is None else f"{decided_for:g} % of the pixels"
                message = (
                    f"the numbers of samples were decided for the error of {of}, not of "
                    f"{how.percentile:g} % of the pixels: render into another store, or leave "
                    "out percentile="
                )
                raise InputError(message)
        else:
            held = self.writer.finish()
            if how.error is None:
                density, noise = decided(Look.of(held), how, held.features, held.costs)
            else:
                density, noise = self._tried(held.features)
        self._make_room(density, how.spp(noise, self._most), noise)

    def _make_room(self, density: Image, spp: float, noise: Mapping[str, Any]) -> None:
        """Let pixels have different numbers of samples, `spp` on average."""
        height, width = density.shape
        counts = counts_of(density, spp, self.writer.attrs["adaptive"]["first"])
        check_spp(self.renderer.job.backend.name, width, height, int(counts.max()))
        self.writer.decide(density, spp, noise)

    def _tried(self, features: Mapping[str, Image]) -> tuple[Image, dict[str, Any]]:
        """Return what trial samples decide, which are not kept.

        Their batches are numbered from the middle of those that have random numbers, so that none
        of them is rendered.
        """
        width, height = self.renderer.size
        number = max_spp(self.renderer.job.backend.name, width, height) // (2 * BATCH)
        look, drawn, wanted = None, 0, self.how.first_trial(self._most)
        self._trial_costs = None
        while True:
            while drawn < wanted:
                begin, size = number * BATCH, min(BATCH, wanted - drawn)
                chunks = chunk_grid(height, width, begin + size, ss=slice(begin, None))
                part = self._looked(list(chunks))
                look = part if look is None else look.merge(part)
                number, drawn = number + 1, drawn + size
            assert look is not None, "there are trial samples"
            density, noise = decided(look, self.how, features, self._trial_costs)
            noise["trials"] = drawn
            if not self.how.needs_larger_trial(noise, self._most):
                return density, noise
            wanted = 2 * drawn

    def _looked(self, chunks: list[Chunk]) -> Look:
        """Render chunks of one batch, look at them, and keep nothing."""
        (width, height), name = self.renderer.size, self.renderer.job.scene.name
        samples = sum(chunk.size for chunk in chunks)
        with track(f"trying {name}", samples, unit="S", show=self.work["progress"]) as advance:

            def blocks() -> Iterator[tuple[tuple[slice, ...], Image]]:
                for chunk, block in rendered(self.renderer, chunks, self.work["client"]):
                    assert block is not None, "without a store, samples are yielded"
                    yield (chunk.ys, chunk.xs), block
                    if chunk.costs is not None:
                        held, shape = self._trial_costs, (height, width)
                        self._trial_costs = with_times(held, shape, chunk, chunk.costs)
                    advance(chunk.size)

            return Look.of_blocks((height, width, 3), blocks())

    def _go_on(self) -> Look | None:
        """Make room for more samples, once, if those that were kept tell that the error needs them.

        Return what was looked at, if nothing comes to it.
        """
        how, writer, noise = self.how, self.writer, self.writer.attrs["noise"]
        if how.error is None or "trials" not in noise or noise.get("settled"):
            return None
        held, spp = writer.finish(), writer.attrs["spp"]
        look, noise = Look.of(held), noise | {"settled": True}
        factors, most = more(look, how, held.features), self._most - noise["trials"]
        if factors is None or most <= spp:
            writer.update(noise=noise)
            return look
        assert writer.density is not None, "numbers were decided"
        density = writer.density * factors
        needed = spp * density.mean() / writer.density.mean()
        noise = {k: v for k, v in noise.items() if k not in ("low", "high", "surely")}
        noise["value"] = float(how.error**2 * needed)
        density = writer.density * np.minimum(factors, most / spp)
        mean = density.mean() / writer.density.mean()
        # Rounded up: no pixel loses a sample.
        rounded = np.nextafter((density / mean).astype(np.float32), np.float32(np.inf))
        self._make_room(rounded, float(spp * mean), noise)
        return None

    def _tell(self, look: Look | None) -> None:
        """Estimate the error of all samples, and say so if it is not what was asked for."""
        how, writer, held = self.how, self.writer, self.writer.finish()
        found = error_of(look or Look.of(held), "relMSE", how.percentile, features=held.features)
        told = how.told(found)
        writer.update(error=told)
        if not told.get("reached", True):
            drawn = writer.attrs["spp"] + writer.attrs["noise"].get("trials", 0)
            _log.warning(how.not_reached(found, drawn, self._most))


def render_pixels(
    scene: SceneLike, pixels: npt.ArrayLike, **options: Unpack[RenderSettings]
) -> Image:
    """Draw samples of a few pixels without rendering the rest of the image.

    Parameters
    ----------
    scene
        As for `render`.
    pixels
        (y, x) of each pixel, shape (pixel, 2); a single pair is one pixel.
    **options
        As for `render`: `spp` (2048 by default), `size`, `seed`, `max_depth`, `sensor`,
        `integrator`, `crop`, `color`, and `backend` ("scalar" by default). The samples are
        independent, also of those that `render` draws.

    Returns
    -------
    ndarray
        Linear radiance, shape (pixel, channel, sample), float32.

    Raises
    ------
    InputError
        If a pixel lies outside the image, or an option is out of range.

    Examples
    --------
    >>> import chdstat as chd
    >>> chd.rendering.render_pixels("cornell-box", [(4, 4)], spp=16, size=(8, 8)).shape
    (1, 3, 16)
    """
    options = {"spp": 2048, "backend": "scalar", **options}
    job = Job.of(scene, **options)
    if job.sequences is not None:
        sampler = job.options["sampler"]
        message = f"samples of single pixels are independent; leave out {sampler=}"
        raise InputError(message)
    with activate(job.backend):
        renderer = MitsubaRenderer(job)
        return renderer.pixels(_checked_pixels(pixels, renderer.size), job.options["spp"])


def _checked_pixels(pixels: npt.ArrayLike, size: tuple[int, int]) -> npt.NDArray[np.intp]:
    array = np.atleast_2d(np.asarray(pixels))
    if array.ndim != 2 or array.shape[1] != 2 or array.dtype.kind not in "iu":
        message = f"pixels must be integers (y, x), shape (pixel, 2), got shape {array.shape}"
        raise InputError(message)
    width, height = size
    outside = (array < 0).any(axis=1) | (array[:, 0] >= height) | (array[:, 1] >= width)
    if outside.any():
        y, x = array[outside][0]
        message = f"pixel (y={y}, x={x}) is outside the image of {width} x {height} pixels"
        raise InputError(message)
    return array.astype(np.intp)


def _check_portable(job: Job) -> None:
    """Refuse a job that cannot be sent to other processes, before any work."""
    try:
        pickle.dumps(job)
    except (TypeError, AttributeError, pickle.PicklingError) as error:
        message = (
            f"scene {job.scene.name!r} cannot be sent to the workers of a cluster: {brief(error)}; "
            "describe it by files and plain values: a (4, 4) array for a transform, "
            "{'type': 'bitmap', 'data': array} for an image texture"
        )
        raise InputError(message) from error


def checked_renderer(job: Job, *, kept: int, out: Path | None) -> MitsubaRenderer:
    """Return the renderer of a job, after checking that it can draw, and that `kept` samples fit.

    Raises
    ------
    InputError, SceneError, RenderError
        If the scene cannot be rendered as asked, or there is no room for the kept samples.
    """
    renderer, spp = MitsubaRenderer(job), job.options["spp"]
    width, height = renderer.size
    check_spp(job.backend.name, width, height, spp, job.sequences)
    needed = 12 * width * height * kept
    what = f"{kept} samples for each of {width} x {height} pixels"
    if out is None:
        check_memory(needed, what, "use fewer samples or pixels, or give a store to write to")
    elif (free := free_disk(out)) is not None and needed > _MOST_COMPRESSION * free:
        message = (
            f"{what} take {needed / 1e9:.3g} GB, more than the disk can hold; use fewer samples "
            "or pixels, or free some space"
        )
        raise InputError(message)
    if renderer.notes:
        say_once(f"{job.scene.name}: {'; '.join(renderer.notes)}")
    return renderer


def _cut_paths(renderer: MitsubaRenderer, depths: Collection[int]) -> dict[LightPart, Job]:
    """Return the job with paths cut after each of some depths, where that cuts any.

    A sample of it is the whole sample without the light that its path meets later: both draw the
    same random numbers in the same order.
    """
    longest, job = renderer.depth, renderer.job
    if depths and longest is None:
        message = (
            f"integrator {renderer.integrator['type']!r} has no max_depth that can be set, so that "
            "light cannot be told apart by depth; give one that has, by name or as a dict, such as "
            "'path', or neither direct nor by_depth"
        )
        raise RenderError(message)
    most = LONGEST if longest is None or longest < 0 else longest
    return {
        depth: replace(job, options=job.options | {"max_depth": min(depth, most)})
        for depth in sorted(depths)
        if depth < most or depth == DIRECT_DEPTH
    }


@contextlib.contextmanager
def _features_restored(renderer: MitsubaRenderer, writer: Writer, work: Work) -> Iterator[None]:
    """Give a writer the first-hit features that it lacks, while its samples are rendered.

    Features take as long as a few dozen samples per pixel, so that one worker of a cluster draws
    them while the others render.
    """
    if not writer.lacks_features:
        yield
    elif work["client"] is None:
        writer.restore(*renderer.features())
        yield
    else:
        with pool(client=work["client"]) as cluster:
            drawn = cluster.submit(features_remote, renderer.job, renderer.identity)
            try:
                yield
                features = cluster.result(drawn)
            finally:
                drawn.cancel()
            writer.restore(*features)


def _fill(
    renderer: MitsubaRenderer,
    writer: Writer,
    work: Work,
    seconds: float | None = None,
    like: Writer | None = None,
) -> None:
    """Render what is missing, or what comes in some time, and write each chunk as it arrives.

    With `like`, only chunks are rendered that it holds.
    """
    chunks = writer.ledger.pending()
    if like is not None:
        chunks = [chunk for chunk in chunks if like.ledger.held[chunk.index]]
    if not chunks:
        return
    start, name = time.monotonic(), renderer.job.scene.name
    samples = writer.ledger.lacking if like is None else sum(c.size for c in chunks)
    # This process adds the missing samples of chunks to the existing ones.
    store = writer if isinstance(writer, Store) and writer.adaptive is None else None
    with track(f"rendering {name}", samples, unit="S", show=work["progress"]) as advance:
        try:
            drawn = rendered(renderer, map(writer.to_draw, chunks), work["client"], store)
            for chunk, block in drawn:
                if block is not None:
                    writer.write(chunk, block)
                elif store is not None:
                    store.note(chunk)
                if chunk.costs is not None:
                    writer.timed(chunk, chunk.costs)
                advance(chunk.size)
                late = seconds is not None and time.monotonic() - start > seconds
                if late and writer.ledger.complete_spp:
                    drawn.close()
        finally:
            writer.spent(time.monotonic() - start)


# --- what keeps samples -------------------------------------------------------------------------


Writer = MemoryWriter | Store
"""Keeps rendered samples."""


@contextlib.contextmanager
def _writer(renderer: MitsubaRenderer, out: Path | None, how: Adaptive | None) -> Iterator[Writer]:
    """Yield the keeper of samples: a store, which may exist already, or memory."""
    attrs = renderer.provenance | ({} if how is None else {"adaptive": how.attrs})
    width, height = renderer.size
    shape = height, width, renderer.channels, _first_spp(attrs)
    if out is None:
        yield MemoryWriter(shape, attrs)
        return
    is_new = not is_store(out)
    if is_new:
        store = Store.create(out, shape=shape, attrs=attrs)
    else:
        held = Store.open(out)
        check_same(held.path, held.attrs, attrs)
        store = Store.open(out, writable=True)
    with store:
        try:
            if store.adaptive is None:
                store.extend(attrs["spp"])
            yield store
        except Exception:
            if is_new:
                store.discard()
            raise


def _first_spp(attrs: Mapping[str, Any]) -> int:
    """Return the number of samples that all pixels get before any pixel gets more."""
    return int(attrs["adaptive"]["first"] if "adaptive" in attrs else attrs["spp"])


def _as_stored(options: RenderSettings, store: Store) -> RenderSettings:
    """Take options that were not given from the store that is continued."""
    if "scene_hash" not in store.attrs:
        message = (
            f"{store.path} holds samples that were saved or imported, to which no render can be "
            "added; nothing was changed. Give another path"
        )
        raise StoreError(message)
    stored: RenderSettings = {}
    if options["backend"] == "auto":
        stored["backend"] = store.attrs["backend"]
    if options["size"] is None and options["crop"] is None:
        width, height = store.attrs["size"]
        stored["size"] = width, height
    return options | stored
