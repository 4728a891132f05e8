"""The renderer: one scene in one Mitsuba variant, giving single samples instead of averages.

A scalar variant draws a chunk in passes of one sample per pixel; llvm and cuda draw it as one
wavefront. Module `chdstat.rendering.seeds` decides which random numbers each sample owns.
"""

from __future__ import annotations

import contextlib
import gc
import logging
import threading
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Image
from chdstat._core.work import Interrupted
from chdstat.errors import ChdstatError, InputError, RenderError, SceneError, brief
from chdstat.rendering.backend import activate, one_thread
from chdstat.rendering.instances import IntegratorObject, told
from chdstat.rendering.job import Job
from chdstat.rendering.lights import check_lights, darken, flush, light_names, switched_off
from chdstat.rendering.rays import drawn, sensed
from chdstat.rendering.seeds import Streams
from chdstat.samples.tiles import BATCH, TILE, Chunk
from chdstat.scenes.plugins import code_of, failure, plugins_made, used
from chdstat.scenes.scene import LiveScene
from chdstat.scenes.settings import check_variant

__all__ = ["Renderer"]

_log = logging.getLogger("chdstat")
_FAILING = (ChdstatError, RuntimeError, TypeError, ValueError, AttributeError, LookupError)
"""What materials of one's own may raise that were written for radiance only."""
_BLOCK = 32
_RUN = 16
"""Independent samples of a pixel in neighbouring lanes: their paths begin alike, which saves a
tenth."""
_FEATURE_SPP = 16


class Renderer:
    """Renders chunks of samples of one job; safe to call from several threads.

    Attributes
    ----------
    size
        (width, height) of the image in pixels.
    film
        The film, of which the image may be a crop.
    files, code, plugins
        Digests of the files that the scene reads, of the code of its classes in Python, and of the
        files of plugins that it uses, by name.
    notes
        What the scene asks for and does not get.
    """

    def __init__(self, job: Job) -> None:
        with activate(job.verdict) as mi:
            self._mi = mi
            self._scalar, self._plugins = job.verdict.backend == "scalar", job.plugins
            self.files, self.scene_hash = job.scene.files(), job.scene.hash
            self._asked = asked = job.asked()
            self.notes = list(asked.notes)
            live = job.scene.source if isinstance(job.scene.source, LiveScene) else None
            self.film, note = asked.film.resized(job.size)
            self.notes += note
            if job.crop is not None:
                self.film = self.film.cropped(job.crop)
            self.size = self.film.crop_size
            if job.max_depth is not None:
                asked.integrator.node(0).props["max_depth"] = job.max_depth
            self._given = job.integrator if isinstance(job.integrator, IntegratorObject) else None
            self.integrator: dict[str, Any] = {"type": asked.integrator.plugin(0)}
            self._streams, self._sequences = Streams(self.size, job.seed), job.sequences
            self._local = threading.local()
            with self._telling(), plugins_made(mi, asked.plugins) as made:
                _ = self._integrator  # one that cannot be used is refused before any work
                self._scene = live.value if live else asked.scene.make(parallel=True)
            # Only now, for Mitsuba takes note of which settings were looked at.
            given = self._given.description if self._given else asked.integrator.node(0).props
            self.integrator |= told(dict(given))
            self._loaded_sensor = self._scene.sensors()[job.sensor]
            self._sensor_medium = self._loaded_sensor.get_medium()
            self._as_it_is = live is not None and not live.is_described(job.sensor)
            self._refuse_view(job)
            if job.light is not None:
                darken(mi, self._scene, job.light)
            self._darkened = job.light is not None
            self.code = code_of(made)
            if self._given is not None:
                self.code |= self._given.code
                made.append(self._given.value)
            self.plugins = used(job.plugins, str(mi.variant()), asked.plugins, made)
            if job.scene.files() != self.files:
                message = f"files of scene {job.scene.name!r} changed while they were read; again"
                raise SceneError(message)
            self._sensor((0, 0), self.size)  # Mitsuba refuses what a sensor cannot be
            if self._scalar:  # one sample costs nothing: what cannot be drawn is refused at once
                with self._telling():
                    self._pixel_scalar(0, 0, 0, 1)

    @property
    def identity(self) -> dict[str, Any]:
        """What tells the scene from another one, as stores keep it."""
        return {
            "scene_hash": self.scene_hash,
            "scene_files": {name: digest[:16] for name, digest in self.files.items()},
            "scene_code": self.code,
            "plugins": self.plugins,
        }

    def chunk(self, chunk: Chunk, *, before_pass: Callable[[], None] = lambda: None) -> Image:
        """Draw the samples of one chunk, shape (y, x, channel, sample).

        `before_pass` is called just before each pass, to end the chunk by an exception. Raises
        `Interrupted` if Mitsuba cancelled a pass.
        """
        with self._telling():
            block = self._drawn(chunk, before_pass)
        return flush(block) if self._darkened else block

    def _drawn(self, chunk: Chunk, before_pass: Callable[[], None]) -> Image:
        if self._sequences is not None:
            step = self._sequences.length if self._scalar else self._sequences.drawn_together
            return self._chunk_of_sequences(chunk, step, before_pass)
        if self._scalar and (self._crops or chunk.shape[1::-1] == self.size):
            return self._chunk_scalar(chunk, before_pass)
        if self._scalar:
            return self._chunk_of_sequences(chunk, BATCH, before_pass)
        before_pass()
        (height, width, samples), corner = chunk.shape, (chunk.xs.start, chunk.ys.start)
        number = self._streams.of_chunk(chunk)
        return self._wavefront(number, corner, (width, height), samples)

    def preview(
        self, longest: int, spp: int, *, seed: int = 0, band: tuple[int, int] = (0, 1)
    ) -> Image:
        """Render the image with at most `longest` pixels a side, shape (y, x, channel).

        `band` (i, n) renders the i-th of n bands of its rows, of which some may be empty.
        """
        scale = min(1.0, longest / max(self.size))
        width, height = (max(1, round(scale * length)) for length in self.size)
        top, bottom = (height * i // band[1] for i in (band[0], band[0] + 1))
        if top == bottom:
            return np.empty((0, width, 3), np.float32)
        if not self._crops:
            rows, columns = np.arange(top, bottom) / height, np.arange(width) / width
            places = np.stack(np.meshgrid(rows, columns, indexing="ij"), axis=-1)
            pixels = (places * self.size[::-1]).astype(np.intp)
            means = self.pixels(pixels.reshape(-1, 2), spp, seed=seed).mean(axis=-1)
            return np.asarray(means.reshape(*pixels.shape[:2], 3), np.float32)
        with self._telling():
            sensor = self._sensor((0, top), (width, bottom - top), scale)
            drawn = self._integrator.render(self._scene, sensor, seed=seed, spp=spp)
            return np.array(drawn, np.float32)

    def pixels(self, pixels: npt.NDArray[np.intp], spp: int, *, seed: int | None = None) -> Image:
        """Draw samples of single pixels (n, 2) of (y, x); shape (pixel, channel, sample).

        Another seed than that of the job draws other samples, independent of these.
        """
        streams = self._streams if seed is None else Streams(self.size, seed)
        drawn = []
        with self._telling():
            for y, x in pixels.tolist():
                number = streams.of_pixel(y, x)
                if self._scalar:
                    drawn.append(self._pixel_scalar(number, y, x, spp))
                else:
                    drawn.append(self._wavefront(number, (x, y), (1, 1), spp)[0, 0])
        return np.stack(drawn)

    def check_lights(self, patterns: Sequence[str]) -> None:
        """Refuse patterns of names of which the lights cannot be drawn alone."""
        check_lights(light_names(self._scene), patterns)
        for pattern in patterns:
            switched_off(self._mi, self._scene, pattern)

    @property
    def depth(self) -> int | None:
        """Longest path in segments, below 0 for no limit; None where the integrator has none.

        Of an integrator that is an object, it cannot be changed.
        """
        if self._given is not None:
            return None
        properties = self._mi.Properties(self._asked.integrator.node(0).props)
        properties["max_depth"] = longest = int(properties.get("max_depth", -1))
        self._mi.PluginManager.instance().create_object(properties)
        return longest if properties.was_queried("max_depth") else None

    def features(self) -> tuple[dict[str, Image], str]:
        """Return the first-hit features, and why there are none where they cannot be drawn."""
        try:
            with self._telling():
                return self._first_hits(), ""
        except _FAILING as error:
            _log.warning("no first-hit features: %s", brief(error))
            return {}, brief(error)

    def _first_hits(self) -> dict[str, Image]:
        from chdstat.rendering.features import AOVS, FEATURES, first_hit, is_plain

        aov = self._mi.load_dict({"type": "aov", "aovs": AOVS, "block_size": _BLOCK})
        hides = bool(getattr(self._integrator, "hide_emitters", False))
        name, sensor = self.integrator["type"], self._sensor((0, 0), self.size)
        if self._as_it_is or not is_plain(self._mi, self._scene, sensor, name, hides=hides):

            def hit(ray: Any, sampler: Any) -> list[Any]:
                mi, scene, medium = self._mi, self._scene, self._sensor_medium
                return first_hit(mi, scene, aov, ray, sampler, medium, name, hides=hides)

            stack = self._followed(hit, sensor)
        else:
            # For each sample, it copies the list of shapes: threads wait for its counters.
            with one_thread() if self._scalar else contextlib.nullcontext():
                drawn = aov.render(self._scene, sensor, seed=0, spp=_FEATURE_SPP)
                stack = np.array(drawn, np.float32)[..., -sum(FEATURES.values()) :]
        ends = np.cumsum(list(FEATURES.values()))[:-1]
        parts = zip(FEATURES, np.split(stack, ends, axis=-1), strict=True)
        return {name: p[..., 0] if p.shape[-1] == 1 else p for name, p in parts}

    def _followed(self, hit: Callable[[Any, Any], list[Any]], sensor: Any) -> Image:
        """Return the mean of what many rays of each pixel hit, shape (y, x, number)."""
        mi, (width, height) = self._mi, self.size
        sampler = mi.load_dict({"type": "independent"})
        if not self._scalar:
            import drjit as dr

            lanes = width * height * _FEATURE_SPP
            sampler.seed(0, lanes)
            index = dr.arange(mi.UInt32, lanes) // _FEATURE_SPP
            pixel = mi.Point2f(mi.Float(index % width), mi.Float(index // width))
            position = (pixel + sampler.next_2d()) / mi.Point2f(width, height)
            found = hit(sensed(mi, position, sensor, sampler)[0], sampler)
            stack = np.stack([np.broadcast_to(np.array(v), lanes) for v in found], axis=-1)
            stack = stack.reshape(height, width, _FEATURE_SPP, -1)
            return np.asarray(stack.mean(axis=2), np.float32)
        sampler.seed(0, 1)
        means = []
        for y, x in np.ndindex(height, width):
            hits = []
            for _ in range(_FEATURE_SPP):
                dx, dy = sampler.next_2d()
                position = mi.Point2f((x + dx) / width, (y + dy) / height)
                hits.append(hit(sensed(mi, position, sensor, sampler)[0], sampler))
            means.append(np.mean(hits, axis=0))
        return np.array(means, np.float32).reshape(height, width, -1)

    @contextlib.contextmanager
    def _telling(self) -> Iterator[None]:
        """Turn what Mitsuba says of samples that it cannot draw into an error that names why."""
        try:
            yield
        except Exception as error:
            told = failure(self._plugins, error)
            if isinstance(error, RuntimeError) and told is error:
                told = RenderError(
                    f"Mitsuba cannot sample this scene by integrator {self.integrator['type']!r}: "
                    f"{brief(error)}"
                )
            if told is error:
                raise
            raise told from error

    # --- Mitsuba objects ------------------------------------------------------------------------

    def _refuse_view(self, job: Job) -> None:
        """Refuse a view that the sensor cannot show."""
        kind = self._asked.sensor.plugin(0)
        if job.crop is not None and self.film.crop is not None and not self._asked.crops:
            message = (
                f"a {kind} sensor cannot be cropped, as Mitsuba shows all of it in any crop; leave "
                "out the crop"
            )
            raise InputError(message)
        own = self._asked.film.crop_size
        if self._as_it_is and (self.size != own or job.crop is not None):
            message = (
                f"the {self._loaded_sensor.class_name()} of a scene that Mitsuba has built shows "
                f"{own[0]} x {own[1]} pixels only; give the file or dict that it was made of"
            )
            raise RenderError(message)

    def _sensor(self, offset: tuple[int, int], extent: tuple[int, int], scale: float = 1.0) -> Any:
        """Return the scene's sensor with a film that covers a part of the image, maybe coarser."""
        if self._as_it_is:
            return self._loaded_sensor
        film = {
            "type": "hdrfilm",
            "width": max(round(scale * self.film.size[0]), extent[0]),
            "height": max(round(scale * self.film.size[1]), extent[1]),
            "crop_offset_x": int(scale * self.film.corner[0]) + offset[0],
            "crop_offset_y": int(scale * self.film.corner[1]) + offset[1],
            "crop_width": extent[0],
            "crop_height": extent[1],
            "pixel_format": "rgb",
            "component_format": "float32",
            "rfilter": {"type": "box"},
        }
        described = self._asked.sensor.branch(0)
        described.put(0, "film", film)
        described.put(0, "sampler", {"type": "independent"})
        if self._sensor_medium is not None:
            described.node(0).props["medium"] = self._sensor_medium
        sensor = described.make()
        sensor.set_scene(self._scene)
        if (shape := self._loaded_sensor.get_shape()) is not None:
            sensor.set_shape(shape)
        return sensor

    @property
    def _integrator(self) -> Any:
        """The integrator of the calling thread; it keeps state while it renders."""
        if not hasattr(self._local, "integrator"):
            described = self._asked.integrator.branch(0)
            check_variant(described)
            made = self._given.value if self._given else described.make()
            if not isinstance(made, self._mi.SamplingIntegrator):
                message = (
                    f"integrator {self.integrator['type']!r} does not sample pixel by pixel; use "
                    "one that does, such as path, volpath or direct"
                )
                raise RenderError(message)
            if self._given is None:
                described.node(0).props["block_size"] = _BLOCK  # the default depends on the cores
                made = described.make()
            self._local.integrator = made
        return self._local.integrator

    # --- sequences of dependent samples ---------------------------------------------------------

    def _sampler(self) -> Any:
        """Return a sampler that draws single samples: independent ones, or those of sequences."""
        if self._sequences is None:
            return self._mi.load_dict({"type": "independent"})
        kind, length = self._sequences.sampler, self._sequences.length
        seed = {} if self._scalar else {"seed": self._streams.of_sampler}
        sampler = self._mi.load_dict({"type": kind, "sample_count": length, **seed})
        if not self._scalar:
            sampler.set_samples_per_wavefront(length)
        return sampler

    @property
    def _crops(self) -> bool:
        """Whether the sensor can show a part of the image alone."""
        return self._asked.crops and not self._as_it_is

    def _chunk_of_sequences(
        self, chunk: Chunk, step: int, before_pass: Callable[[], None]
    ) -> Image:
        """Draw whole sequences of `step` samples, and keep those that belong to the chunk."""
        (height, width, _), corner = chunk.shape, (chunk.xs.start, chunk.ys.start)
        first, drawn = chunk.ss.start // step, list[Image]()
        for i in range(first, -(-chunk.ss.stop // step)):
            samples = min(step, chunk.ss.stop - i * step)
            if self._scalar:
                drawn.append(self._sequence_scalar(chunk, i, samples, before_pass))
                continue
            before_pass()
            number = self._streams.of_wavefront(chunk, i, TILE**2 * step)
            drawn.append(self._wavefront(number, corner, (width, height), samples))
        start = chunk.ss.start - first * step
        return np.ascontiguousarray(np.concatenate(drawn, axis=-1)[..., start:])

    def _sequence_scalar(
        self, chunk: Chunk, sequence: int, samples: int, before_pass: Callable[[], None]
    ) -> Image:
        """Draw the first samples of one sequence for each pixel of a tile.

        One by one in Python, for Mitsuba keeps the average of what it draws of a sequence; parts of
        one cannot be drawn by themselves, as the random numbers of a sample go on from those of the
        one before.
        """
        number = self._streams.of_sequence(chunk, sequence)
        sampler = self._sampler()
        sample = self._sampling_scalar(sampler, self.size)
        height, width, _ = chunk.shape
        block = np.empty((height, width, 3, samples), np.float32)
        for y in range(height):
            before_pass()
            for x in range(width):
                sampler.seed(number + y * width + x, 1)
                for i in range(samples):
                    block[y, x, :, i] = sample(chunk.xs.start + x, chunk.ys.start + y)
                    sampler.advance()
        return block

    # --- scalar ---------------------------------------------------------------------------------

    def _chunk_scalar(self, chunk: Chunk, before_pass: Callable[[], None]) -> Image:
        height, width, samples = chunk.shape
        sensor = self._sensor((chunk.xs.start, chunk.ys.start), (width, height))
        block = np.empty((samples, height, width, 3), np.float32)
        integrator = self._integrator
        for i, sample in enumerate(range(chunk.ss.start, chunk.ss.stop)):
            seed = self._streams.of_pass(chunk, sample)
            before_pass()
            block[i] = integrator.render(self._scene, sensor, seed=seed, spp=1)
            if integrator.should_stop():
                raise Interrupted
        return np.ascontiguousarray(block.transpose(1, 2, 3, 0))

    def _pixel_scalar(self, number: int, y: int, x: int, count: int) -> Image:
        sampler = self._mi.load_dict({"type": "independent"})
        sampler.seed(number, 1)
        sample = self._sampling_scalar(sampler, self.size)
        return np.stack([sample(x, y) for _ in range(count)], axis=-1)

    def _sampling_scalar(self, sampler: Any, size: tuple[int, int]) -> Callable[[int, int], Any]:
        """Return a function that draws the next sample of the pixel at (x, y) of so many."""
        mi, (width, height), sensor = self._mi, size, self._sensor((0, 0), self.size)
        objects = self._scene, sensor, self._integrator, sampler, self._sensor_medium

        def sample(x: int, y: int) -> Any:
            dx, dy = sampler.next_2d()
            position = mi.Point2f((x + dx) / width, (y + dy) / height)
            return drawn(mi, position, *objects)

        return sample

    # --- wavefront (llvm, cuda) -----------------------------------------------------------------

    def _wavefront(
        self, number: int, corner: tuple[int, int], extent: tuple[int, int], samples: int
    ) -> Image:
        """Draw samples of a rectangle of pixels in one wavefront, shape (y, x, channel, sample).

        Lanes run over the samples of a run, then pixels, then runs. Whole runs are drawn, so that
        fewer samples are a prefix of more; a sequence of dependent samples is a run.
        """
        import drjit as dr

        width, height = extent
        run = self._run
        runs = -(-samples // run)
        inputs = (number, *corner, width, width * height)
        opaque = [dr.opaque(self._mi.UInt32, value) for value in inputs]
        lanes = width * height * runs * run
        colors = np.asarray(self._launch(*opaque, lanes), dtype=np.float32)
        colors = np.broadcast_to(colors, (3, lanes))  # of one value for all lanes, there is one
        block = colors.reshape(3, runs, height, width, run).transpose(2, 3, 0, 1, 4)
        return np.ascontiguousarray(block.reshape(height, width, 3, -1)[..., :samples])

    @property
    def _run(self) -> int:
        """Samples of a pixel in neighbouring lanes."""
        return _RUN if self._sequences is None else self._sequences.length

    def _launch(self, *inputs: Any) -> Any:
        """Launch the kernel, frozen where it can be: tracing costs up to a third of a launch.

        Dr.Jit refuses to freeze it while other scenes are alive in the process, since virtual
        calls then reach objects that are not part of this one; the plain kernel gives the same.
        """
        if not hasattr(self._local, "kernel"):
            import drjit as dr

            sensor, sampler = self._sensor((0, 0), self.size), self._sampler()
            objects = (self._scene, sensor, self._integrator, sampler)
            self._local.kernel = self._wavefront_kernel(dr, sensor, sampler)
            self._local.frozen = dr.freeze(self._local.kernel, state_fn=lambda *_, **__: objects)
        try:
            with _uncollected():
                return self._local.frozen(*inputs)
        except RuntimeError:
            self._local.frozen = self._local.kernel
            return self._local.kernel(*inputs)

    def _wavefront_kernel(self, dr: Any, sensor: Any, source: Any) -> Callable[..., Any]:
        mi, scene, integrator, medium = self._mi, self._scene, self._integrator, self._sensor_medium
        size, run = tuple(map(float, self.size)), self._run

        def kernel(number: Any, left: Any, top: Any, width: Any, pixels: Any, lanes: int) -> Any:
            sampler = source.clone()
            sampler.seed(number, lanes)
            index = dr.arange(mi.UInt32, lanes) // run % pixels
            pixel = mi.Point2f(mi.Float(index % width + left), mi.Float(index // width + top))
            position = (pixel + sampler.next_2d()) / mi.Point2f(*size)
            return drawn(mi, position, scene, sensor, integrator, sampler, medium)

        return kernel


@contextlib.contextmanager
def _uncollected() -> Iterator[None]:
    """Collect no garbage: arrays that are freed while a kernel is recorded end the process."""
    collects = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if collects:
            gc.enable()
