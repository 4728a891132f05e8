"""The renderer: one scene in one Mitsuba variant, giving single samples instead of averages.

A scalar variant draws a chunk in passes of one sample per pixel; llvm and cuda draw it as one
wavefront. Module `chdstat.rendering.seeds` decides which random numbers each sample owns.
"""

from __future__ import annotations

import contextlib
import gc
import threading
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from chdstat._core.executor import Interrupted
from chdstat.errors import InputError, RenderError, SceneError, brief
from chdstat.rendering.backend import activate, one_thread
from chdstat.rendering.instances import IntegratorObject
from chdstat.rendering.job import Job
from chdstat.rendering.lights import darken, flush, light_names
from chdstat.rendering.rays import drawn
from chdstat.rendering.seeds import Streams
from chdstat.rendering.sequences import Sequences
from chdstat.samples.layout import TILE, Chunk, Image
from chdstat.scenes.files import code_of, plugins_made
from chdstat.scenes.plugins import failure, used

__all__ = ["Renderer"]

_BLOCK = 32
_RUN = 16
"""Independent samples of a pixel in neighbouring lanes: their paths begin alike, which saves a
tenth."""
_FEATURE_SPP = 16
_FEATURES = {"albedo": "albedo", "normal": "sh_normal", "depth": "depth", "position": "position"}


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
            asked = job.asked()
            self.notes = list(asked.notes)
            self._sensor_properties = asked.sensor
            self.film, note = asked.film.resized(job.size)
            self.notes += note
            if job.crop is not None:
                self.film = self.film.cropped(job.crop)
            self.size = self.film.crop_size
            properties = mi.Properties(asked.integrator)
            for name in ("samples_per_pass", "timeout", "block_size"):
                if name in properties:
                    del properties[name]
            if job.max_depth is not None:
                properties["max_depth"] = job.max_depth
            self.integrator: dict[str, Any] = {"type": properties.plugin_name(), **properties}
            properties["block_size"] = _BLOCK  # the default depends on the number of cores
            self._integrator_properties = properties
            self._given = job.integrator if isinstance(job.integrator, IntegratorObject) else None
            if self._given is not None:
                self.integrator = self._given.description
            self._streams, self._sequences = Streams(self.size, job.seed), job.sequences
            self._local = threading.local()
            with self._telling(), plugins_made(mi, asked.plugins) as made:
                _ = self._integrator  # one that cannot be used is refused before any work
                if isinstance(job.integrator, Mapping):
                    self._refuse_unknown(job.integrator)
                self._scene = job.scene.build(asked.state)
            if job.light is not None:
                darken(mi, self._scene, job.light)
            self._darkened = job.light is not None
            self.code = code_of(made)
            if self._given is not None:
                self.code |= self._given.code
                made.append(self._given.value)
            self.plugins = used(job.plugins, str(mi.variant()), asked.plugins, made)
            self._sensor_medium = self._scene.sensors()[job.sensor].get_medium()
            if job.scene.files() != self.files:
                message = f"files of scene {job.scene.name!r} changed while they were read; again"
                raise SceneError(message)
            sensor = self._sensor((0, 0), (1, 1))
            if self._scalar:  # one sample costs nothing: what cannot be drawn is refused at once
                with self._telling():
                    self._integrator.render(self._scene, sensor, seed=0, spp=1)

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
            return self._chunk_of_sequences(chunk, self._sequences, before_pass)
        if self._scalar:
            return self._chunk_scalar(chunk, before_pass)
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

    @property
    def lights(self) -> list[str]:
        """Names of the scene's lights."""
        return light_names(self._scene)

    @property
    def depth(self) -> int | None:
        """Longest path in segments, below 0 for no limit; None where the integrator has none.

        Of an integrator that is an object, it cannot be changed.
        """
        if self._given is not None:
            return None
        properties = self._mi.Properties(self._integrator_properties)
        properties["max_depth"] = longest = int(properties.get("max_depth", -1))
        self._mi.PluginManager.instance().create_object(properties)
        return longest if properties.was_queried("max_depth") else None

    def features(self) -> dict[str, Image]:
        """Render the first-hit features: albedo, shading normal, depth and position."""
        aovs = ",".join(f"{name}:{kind}" for name, kind in _FEATURES.items())
        integrator = self._mi.load_dict({"type": "aov", "aovs": aovs, "block_size": _BLOCK})
        sensor = self._sensor((0, 0), self.size)
        # For each sample the integrator copies the list of shapes: threads wait for its counters.
        with one_thread() if self._scalar else contextlib.nullcontext():
            stack = np.array(integrator.render(self._scene, sensor, seed=0, spp=_FEATURE_SPP))
        parts = dict(zip(_FEATURES, np.split(stack, (3, 6, 7), axis=-1), strict=True))
        images = {name: p.astype(np.float32) for name, p in parts.items()}
        return {name: p[..., 0] if p.shape[-1] == 1 else p for name, p in images.items()}

    @contextlib.contextmanager
    def _telling(self) -> Iterator[None]:
        """Turn what Mitsuba says of samples that it cannot draw into an error that names why."""
        try:
            yield
        except Exception as error:
            told = failure(self._plugins, error)
            if isinstance(error, RuntimeError) and told is error:
                told = _unusable(self.integrator["type"], error)
            if told is error:
                raise
            raise told from error

    # --- Mitsuba objects ------------------------------------------------------------------------

    def _sensor(self, offset: tuple[int, int], extent: tuple[int, int], scale: float = 1.0) -> Any:
        """Return the scene's sensor with a film that covers a part of the image, maybe coarser."""
        mi = self._mi
        properties = mi.Properties(self._sensor_properties)
        kinds = mi.Properties.Type
        for name in list(properties.keys()):
            if properties.type(name) in (kinds.Object, kinds.Reference, kinds.ResolvedReference):
                del properties[name]
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
        properties["film"] = mi.load_dict(film)
        properties["sampler"] = mi.load_dict({"type": "independent"})
        if self._sensor_medium is not None:
            properties["medium"] = self._sensor_medium
        try:
            return mi.PluginManager.instance().create_object(properties)
        except RuntimeError as error:
            message = f"sensor {properties.plugin_name()!r} cannot be used: {brief(error)}"
            raise RenderError(message) from error

    @property
    def _integrator(self) -> Any:
        """The integrator of the calling thread; it keeps state while it renders."""
        if not hasattr(self._local, "integrator"):
            create = self._mi.PluginManager.instance().create_object
            name = self.integrator["type"]
            try:
                properties = self._mi.Properties(self._integrator_properties)
                integrator = self._given.value if self._given else create(properties)
            except RuntimeError as error:
                raise _unusable(name, error) from error
            if not isinstance(integrator, self._mi.SamplingIntegrator):
                raise _unusable(name, "does not sample pixel by pixel")
            self._local.integrator = integrator
        return self._local.integrator

    def _refuse_unknown(self, given: Mapping[str, Any]) -> None:
        """Refuse settings that the integrator given for the scene's own does not look at."""
        properties = self._mi.Properties(given["type"])  # of which nothing was looked at yet
        for name, value in given.items():
            if name != "type":
                properties[name] = value
        self._mi.PluginManager.instance().create_object(properties)
        if unknown := properties.unqueried():
            message = (
                f"integrator {self.integrator['type']!r} has no setting {', '.join(unknown)}; "
                "leave it out, or correct its name"
            )
            raise InputError(message)

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

    def _chunk_of_sequences(
        self, chunk: Chunk, sequences: Sequences, before_pass: Callable[[], None]
    ) -> Image:
        """Draw whole sequences, and keep those samples of them that belong to the chunk."""
        (height, width, _), corner = chunk.shape, (chunk.xs.start, chunk.ys.start)
        step = sequences.length if self._scalar else sequences.drawn_together
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
        sample = self._sampling_scalar(sampler)
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

    def _pixel_scalar(self, number: int, y: int, x: int, spp: int) -> Image:
        sampler = self._mi.load_dict({"type": "independent"})
        sampler.seed(number, 1)
        sample = self._sampling_scalar(sampler)
        return np.stack([sample(x, y) for _ in range(spp)], axis=-1)

    def _sampling_scalar(self, sampler: Any) -> Callable[[int, int], Any]:
        """Return a function that draws the next sample of the pixel at (x, y)."""
        mi, (width, height), sensor = self._mi, self.size, self._sensor((0, 0), self.size)
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


def _unusable(integrator: str, why: str | Exception) -> RenderError:
    reason = why if isinstance(why, str) else f"cannot sample this scene here ({brief(why)})"
    return RenderError(
        f"integrator {integrator!r} {reason}; "
        "use one that samples pixel by pixel, such as path, volpath or direct"
    )
