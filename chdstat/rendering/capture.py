"""Capture: a scene to samples, chunk by chunk.

`render` keeps every sample, in a store or in memory, and can be stopped and resumed at any moment;
`render_pixels` draws those of a few pixels on demand.
"""

from __future__ import annotations

import contextlib
import logging
import pickle
import time
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Image, Seed, whole
from chdstat._core.files import place_of
from chdstat._core.work import track
from chdstat.errors import InputError, RenderError, StoreError, brief
from chdstat.rendering.backend import Backend, Color, activate
from chdstat.rendering.job import Crop, IntegratorLike, Job
from chdstat.rendering.renderer import Renderer
from chdstat.rendering.sequences import SamplerName
from chdstat.rendering.workers import features_restored, rendered
from chdstat.rendering.writers import MemoryWriter, Writer, opened_store, provenance, renderer_of
from chdstat.samples import Samples, is_store
from chdstat.samples.layout import part_folder
from chdstat.samples.store import Store
from chdstat.samples.tiles import DIRECT_DEPTH, LightPart
from chdstat.scenes import SceneLike, load_scene
from chdstat.scenes.scene import LiveScene
from chdstat.scenes.settings import LONGEST

if TYPE_CHECKING:
    from distributed import Client

__all__ = ["refuse_render", "render", "render_pixels"]

_log = logging.getLogger("chdstat")


def render(
    scene: SceneLike,
    *,
    spp: int = 256,
    size: tuple[int, int] | None = None,
    seed: Seed = 0,
    max_depth: int | None = None,
    sensor: int = 0,
    integrator: IntegratorLike | None = None,
    crop: Crop | None = None,
    color: Color = "rgb",
    sampler: SamplerName = "independent",
    sequence: int | None = None,
    direct: bool = False,
    by_depth: int | None = None,
    by_light: Sequence[str] = (),
    out: str | Path | None = None,
    backend: Backend = "auto",
    client: Client | None = None,
    progress: bool | None = None,
) -> Samples:
    """Render a scene and keep every sample.

    The samples of a chunk (a tile of pixels times a batch of samples) depend only on scene,
    backend, seed, tile and batch. So a render that was stopped resumes, more `spp` append, any
    worker may render any chunk, and the result is the same to the bit.

    Parameters
    ----------
    scene
        Anything that `chdstat.load_scene` takes.
    spp
        Samples per pixel. Where `out` holds fewer, the missing ones are appended.
    size
        (width, height) in pixels; None takes that of `out`, else the scene's own.
    seed
        An integer from 0 to 2^31 - 1; another one gives independent samples.
    max_depth
        Longest path in segments; None takes the scene's own.
    sensor
        Which of the scene's sensors sees the image, counted from 0.
    integrator
        What draws the samples in place of the scene's own: Mitsuba's name of it, or a dict with its
        settings, such as ``{"type": "path", "rr_depth": 100}``. Of your own, the name that a plugin
        registers it by (see `chdstat.scenes.load_plugin`); `max_depth` applies to it. Or an object
        of Mitsuba's, such as one of a class of your own: it renders in this process, with the
        backend of its variant (with "scalar", which random numbers are a pixel's depends on how
        many threads Mitsuba has).
    crop
        (x, y, width, height): render this part of the image only, with random numbers of its own.
        Where `out` holds a crop, give the same `size` and `crop` again to go on.
    color
        "rgb", or how light is transported before it becomes linear sRGB: "spectral", each sample at
        four random wavelengths, or "mono", of one channel that all three are equal to. Mitsuba has
        the latter with llvm and cuda only.
    sampler
        "independent", whatever the scene names, or one of Mitsuba's that spread the samples of a
        pixel: "stratified", "multijitter", "orthogonal" or "ldsampler". Then samples depend on each
        other: `Samples.sequence_means` gives averages that do not.
    sequence
        Samples of a pixel that such a sampler spreads together; each sequence has random numbers of
        its own, and `spp` must be a multiple of it. None takes 16.
    direct
        Render every sample once more with no more than two segments, for what is emission and
        direct light of it: `Samples.direct`. The rest is indirect. This takes a tenth more time in
        rooms, and more where paths are short anyway. An `out` that has it goes on with it.
    by_depth
        Render every sample once more with no more than 2, 3, ... and so many segments:
        `Samples.depths`. Their differences are the light of each sample by the length of its path,
        which `chdstat.patterns.attribute` makes shares of the mean, the variance and the tail of.
    by_light
        Render every sample once more by some lights alone: `Samples.lights`. Each entry is the name
        of a light (of its shape, in most scenes) or a pattern such as ``"lamp-*"`` that names a
        group of them. What comes from each is a share of `chdstat.patterns.attribute`, too.
    out
        Where to store the samples, a path or a URL; None keeps them in memory.
    backend
        "auto" takes the fastest backend that has proved itself on this machine.
    client
        A Dask client; its workers render, one chunk a task.
    progress
        Show a progress bar; None shows it on a terminal.

    Returns
    -------
    Samples
        All samples, with first-hit features and provenance.

    Raises
    ------
    InputError
        If `spp`, `size` or `seed` is out of range, the sampler would round `sequence`, or light by
        depth or by lights is asked of one that spreads samples.
    SceneError, RenderError
        If the scene cannot be read, or not be rendered as asked.
    StoreError
        If `out` holds something else, or cannot be written to.

    Examples
    --------
    >>> import chdstat as chd
    >>> samples = chd.render("cornell-box", spp=2, size=(8, 8), backend="scalar")
    >>> samples
    <Samples 'cornell-box' 8 x 8 pixels, 3 channels, 2 spp, in memory>
    """
    loaded, spp = load_scene(scene), whole("spp", spp, least=1)
    deepest = DIRECT_DEPTH if by_depth is None else whole("by_depth", by_depth, least=DIRECT_DEPTH)
    depths = set(range(DIRECT_DEPTH, deepest + 1)) if direct or by_depth else set()
    existing = Store.open(place_of(out)) if out is not None and is_store(out) else None
    if existing is not None:
        held = existing.parts()  # parts of other samples are refused here
        depths |= {part for part in held if isinstance(part, int)}
        by_light = [*dict.fromkeys([*by_light, *(p for p in held if isinstance(p, str))])]
        if "scene_hash" not in existing.attrs:
            message = (
                f"{out} holds samples that were saved or imported, to which no render can be "
                "added; nothing was changed. Give another path"
            )
            raise StoreError(message)
        backend = existing.attrs["backend"] if backend == "auto" else backend
        size = size or (None if crop else tuple(existing.attrs["size"]))
    job = Job.of(
        loaded,
        size=size,
        seed=seed,
        max_depth=max_depth,
        sensor=sensor,
        integrator=integrator,
        crop=crop,
        color=color,
        sampler=sampler,
        sequence=sequence,
        backend=backend,
    )
    if (depths or by_light) and job.sequences is not None:
        message = (
            "direct, by_depth and by_light draw the same samples again, which only independent "
            f"ones allow; leave them out, or the sampler {job.sampler!r}"
        )
        raise InputError(message)
    if by_light and isinstance(loaded.source, LiveScene):
        message = (
            "by_light switches lights off, which would change the scene that Mitsuba has built; "
            "give the file or dict that it was made of"
        )
        raise InputError(message)
    if client is not None:
        _check_portable(job)
    with activate(job.verdict):
        renderer = renderer_of(job, spp, kept=spp * (1 + len(depths) + len(by_light)), out=out)
        renderer.check_lights(by_light)
        partial = _cut_paths(job, renderer, depths) | {n: replace(job, light=n) for n in by_light}
        if existing is not None and spp < existing.complete_spp() == existing.shape[3]:
            message = "nothing to render: %s holds %d samples per pixel, %d were asked for"
            _log.warning(message, out, existing.shape[3], spp)
        with _writer(job, renderer, spp, out) as writer:
            with features_restored(job, renderer, client, writer):
                _fill(job, renderer, writer, client, progress)
            parts = {}
            for which, of_part in partial.items():
                del renderer  # kernels are frozen where one scene is alive only
                renderer = Renderer(of_part)
                folder = None if out is None else place_of(out) / part_folder(which)
                with _writer(of_part, renderer, spp, folder) as part:
                    _fill(of_part, renderer, part, client, progress)
                    parts[which] = part.finish()
            return writer.finish(parts)


def render_pixels(
    scene: SceneLike,
    pixels: npt.ArrayLike,
    *,
    spp: int = 2048,
    size: tuple[int, int] | None = None,
    seed: Seed = 0,
    max_depth: int | None = None,
    sensor: int = 0,
    integrator: IntegratorLike | None = None,
    crop: Crop | None = None,
    color: Color = "rgb",
    backend: Backend = "scalar",
) -> Image:
    """Draw samples of a few pixels, without rendering the rest of the image.

    Parameters
    ----------
    scene, size, seed, max_depth, sensor, integrator, crop, color, backend
        As for `render`. The samples are independent, also of those that `render` draws.
    pixels
        (y, x) of each pixel, shape (pixel, 2); a single pair is taken as one pixel.
    spp
        Samples per pixel.

    Returns
    -------
    ndarray
        Linear radiance, shape (pixel, channel, sample), float32.

    Raises
    ------
    InputError
        If a pixel lies outside the image, or `spp` or `seed` is out of range.

    Examples
    --------
    >>> import chdstat as chd
    >>> chd.rendering.render_pixels("cornell-box", [(4, 4)], spp=16, size=(8, 8)).shape
    (1, 3, 16)
    """
    spp = whole("spp", spp, least=1)
    job = Job.of(
        scene,
        size=size,
        seed=seed,
        max_depth=max_depth,
        sensor=sensor,
        integrator=integrator,
        crop=crop,
        color=color,
        backend=backend,
    )
    with activate(job.verdict):
        renderer = Renderer(job)
        return renderer.pixels(_checked_pixels(pixels, renderer.size), spp)


def refuse_render(source: object, settings: Mapping[str, Any]) -> None:
    """Refuse settings of a render, by name, where samples are there already.

    What is None, and the backend "auto", was not asked for.

    Raises
    ------
    InputError
        If any was.
    """
    asked = [name for name, value in settings.items() if value not in (None, "auto")]
    if asked:
        message = (
            f"{', '.join(asked)}: a setting of a render, but {source} holds finished samples; "
            "leave it out, or give the scene"
        )
        raise InputError(message)


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


def _cut_paths(job: Job, renderer: Renderer, depths: Collection[int]) -> dict[LightPart, Job]:
    """Return the same job with paths cut after each of some depths, where that cuts any.

    A sample of it is that of the whole but for the light that its path meets later: both draw the
    same random numbers in the same order.
    """
    longest = renderer.depth
    if depths and longest is None:
        message = (
            f"integrator {renderer.integrator['type']!r} has no max_depth that can be set, so that "
            "light cannot be told apart by depth; give one that has, by name or as a dict, such as "
            "'path', or neither direct nor by_depth"
        )
        raise RenderError(message)
    most = LONGEST if longest is None or longest < 0 else longest
    return {
        depth: replace(job, max_depth=min(depth, most))
        for depth in sorted(depths)
        if depth < most or depth == DIRECT_DEPTH
    }


@contextlib.contextmanager
def _writer(job: Job, renderer: Renderer, spp: int, out: str | Path | None) -> Iterator[Writer]:
    """Yield what keeps samples: a store, which may be there already, or memory."""
    attrs = provenance(job, renderer, spp)
    if out is None:
        yield MemoryWriter(attrs, renderer.size, spp)
        return
    place = place_of(out)
    is_new = not is_store(place)
    with opened_store(place, attrs, renderer.size, spp) as store:
        try:
            yield store
        except Exception:
            if is_new:
                store.discard()
            raise


def _fill(
    job: Job, renderer: Renderer, writer: Writer, client: Client | None, progress: bool | None
) -> None:
    """Render what is missing, writing each chunk as it arrives."""
    chunks = writer.pending()
    if not chunks:
        return
    start = time.monotonic()
    with track(
        f"rendering {job.scene.name}", sum(c.size for c in chunks), unit="S", show=progress
    ) as advance:
        store = writer if isinstance(writer, Store) else None
        try:
            for chunk, block in rendered(job, renderer, chunks, client, store):
                if block is not None:
                    writer.write(chunk, block)
                elif store is not None:
                    store.note(chunk)
                advance(chunk.size)
        finally:
            writer.spent(time.monotonic() - start)
