"""Mitsuba as a renderer of single samples: one scene in one variant.

A scalar variant draws a chunk in passes of one sample per pixel. llvm and cuda draw it as one
wavefront. `chdstat.rendering.seeds` decides which random numbers each sample owns.
"""

from __future__ import annotations

import contextlib
import copy
import gc
import hashlib
import importlib.metadata
import math
import re
import threading
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, Self

import numpy as np
import numpy.typing as npt

import chdstat
from chdstat._core.arrays import Image, say_once, seed_number
from chdstat._core.work import Interrupted
from chdstat.errors import (
    ChdstatError,
    InputError,
    RenderError,
    SceneError,
    brief,
    did_you_mean,
)
from chdstat.rendering.backend import activate
from chdstat.rendering.jobs import OF_INTEGRATOR, Job, built_kind, in_python
from chdstat.rendering.sample_clock import SampleClock, now, uninterrupted
from chdstat.rendering.seeds import STREAMS, Streams
from chdstat.samples.costs import SampleCosts
from chdstat.samples.film_steps import OF_FILM
from chdstat.samples.tiles import BATCH, TILE, Chunk
from chdstat.scenes.plugins import code_of, failure, plugins_made, used
from chdstat.scenes.scene import LiveScene
from chdstat.scenes.settings import check_variant

_LIBRARIES = tuple(str(Path(file).parent) for file in (chdstat.__file__, np.__file__))
"""Folders with functions that are not part of a scene."""
_RUN = 16
"""Independent samples of a pixel in neighbouring lanes: their paths begin alike, which saves a
tenth of the time."""


class MitsubaRenderer:
    """Renders chunks of samples of one job; safe to call from several threads.

    Attributes
    ----------
    job
        The job to render.
    size
        (width, height) of the image in pixels.
    film
        The film; the image may be a crop of it.
    files, code, plugins
        Digests of the files that the scene reads, of the code of its Python classes, and of the
        files of its plugins, by name.
    notes
        Requests of the scene that are not met.
    """

    def __init__(self, job: Job) -> None:
        with activate(job.backend) as mi:
            self.job, self._mi = job, mi
            self._scalar = job.backend.name == "scalar"
            self.files, self.scene_hash = job.scene.files(), job.scene.hash
            self._asked = asked = job.asked()
            options = job.options
            live = job.scene.source if isinstance(job.scene.source, LiveScene) else None
            self.film, note = asked.film.resized(options["size"])
            self.notes = [*asked.notes, *note]
            if options["crop"] is not None:
                self.film = self.film.cropped(options["crop"])
            self.size = self.film.crop_size
            self._built = built = job.built_integrator
            kind = asked.integrator.plugin(0) if built is None else built_kind(built)
            self.integrator: dict[str, Any] = {"type": kind}
            self._streams = Streams(self.size, seed_number(options["seed"]))
            self._sequences = job.sequences
            self._local = threading.local()
            self._orders = dict[tuple[int, int], npt.NDArray[np.int64]]()
            with self._telling(), plugins_made(mi, asked.plugins) as made:
                _ = self._integrator  # one that cannot be used is refused before any work
                self._scene = live.value if live else asked.scene.make(parallel=True)
            # Only now, since Mitsuba records which settings were read.
            props = asked.integrator.node(0).props
            self.integrator |= _told(dict(props) if built is None else _settings_of(mi, built))
            self._loaded_sensor = self._scene.sensors()[options["sensor"]]
            self._sensor_medium = self._loaded_sensor.get_medium()
            self._as_it_is = live is not None and not live.is_described(options["sensor"])
            self._refuse_view()
            if job.light is not None:
                _darken(mi, self._scene, job.light)
            self.code = code_of(made)
            if built is not None:
                self.code |= code_of([built]) if in_python(built) else {}
                made.append(built)
            self.plugins = used(job.plugins, str(mi.variant()), asked.plugins, made)
            if job.scene.files() != self.files:
                message = f"files of scene {job.scene.name!r} changed while they were read; again"
                raise SceneError(message)
            sensor = self._sensor((0, 0), self.size)  # Mitsuba refuses what a sensor cannot be
            if job.guided:
                from chdstat.rendering.guiding import put_to_use

                with self._telling():
                    guide = put_to_use(job, mi, self._scene, sensor, self._streams)
                self.job = replace(job, guide=guide)
            if self._scalar:  # one sample costs nothing: what cannot be drawn is refused at once
                with self._telling():
                    self._pixel_scalar(0, 0, 0, 1)

    @property
    def channels(self) -> int:
        """Numbers that are drawn for each sample: its light, or its place in its pixel."""
        return 2 if self.job.film else 3

    def for_film(self) -> Self:
        """Return a renderer of the same samples that draws where in their pixels they fall.

        Raises
        ------
        RenderError
            If an integrator that is there already draws scalar passes, as it may number the pixels
            in an order of its own.
        """
        if self._built is not None and self._scalar:
            message = (
                "film is for an integrator that is described, since one that Mitsuba has built may "
                "draw the pixels in any order; give it by name or as a dict (integrator='path')"
            )
            raise RenderError(message)
        found = copy.copy(self)
        found.job = replace(self.job, film=True, cost=False)
        found._local = threading.local()
        return found

    @property
    def identity(self) -> dict[str, Any]:
        """Attributes that identify the scene, as stores keep them."""
        return {
            "scene_hash": self.scene_hash,
            "scene_files": {name: digest[:16] for name, digest in self.files.items()},
            "scene_code": self.code,
            "plugins": self.plugins,
        }

    @property
    def provenance(self) -> dict[str, Any]:
        """Origin of the samples, ready for JSON."""
        job, sequences = self.job, self._sequences
        return {
            "scene": job.scene.name,
            **self.identity,
            "scene_source": job.scene.origin,
            "scene_parameters": dict(job.scene.parameters),
            **{n: v for n, v in job.options.items() if n not in {*OF_INTEGRATOR, "sequence"}},
            **({"sequence": sequences.length} if sequences else {}),
            "integrator": self.integrator,
            "guide": job.guide.digest if job.guide else None,
            "size": list(self.size),
            "crop": self.film.crop,
            "light": job.light,
            "backend": job.backend.name,
            "mitsuba_version": importlib.metadata.version("mitsuba"),
            "chdstat_version": importlib.metadata.version("chdstat"),
            "filter": "box",
            "streams": STREAMS,
            "units": "linear radiance",
            **(OF_FILM if job.film else {}),
            "notes": self.notes,
            "render_seconds": 0.0,
        }

    def chunk(self, chunk: Chunk, *, before_pass: Callable[[], None] = lambda: None) -> Image:
        """Draw the samples of one chunk, shape (y, x, channel, sample), NaN where none is missing.

        In a wavefront, each sample has the same random numbers as in a whole chunk. A scalar
        variant uses other random numbers for chunks with missing samples. `before_pass` is called
        just before each pass, and may end the chunk by an exception. Raises `Interrupted` if
        Mitsuba cancelled a pass.
        """
        if chunk.missing is not None and not chunk.missing.any():
            height, width, samples = chunk.shape
            return np.full((height, width, self.channels, samples), np.nan, np.float32)
        self._local.costs = None
        with self._telling():
            block = self._drawn(chunk, before_pass)
        if chunk.missing is not None:
            block = np.where(chunk.missing[:, :, np.newaxis], block, np.float32(np.nan))
        if self.job.light is None:
            return block
        return np.where(np.abs(block) < _FLUSHED, np.float32(0), block)

    @property
    def costs(self) -> SampleCosts | None:
        """What samples took in the last chunk of this thread; None if none was timed."""
        return getattr(self._local, "costs", None)

    def _drawn(self, chunk: Chunk, before_pass: Callable[[], None]) -> Image:
        if self._sequences is not None:
            step = self._sequences.length if self._scalar else self._sequences.drawn_together
            return self._chunk_of_sequences(chunk, step, before_pass)
        whole = self._crops or chunk.shape[1::-1] == self.size
        if self._scalar and whole and chunk.missing is None:
            return self._chunk_scalar(chunk, before_pass)
        if self._scalar:
            return self._chunk_of_sequences(chunk, BATCH, before_pass)
        before_pass()
        (height, width, samples), corner = chunk.shape, (chunk.xs.start, chunk.ys.start)
        number = self._streams.of_chunk(chunk)
        return self._wavefront(number, corner, (width, height), samples, chunk.missing)

    def preview(
        self, longest: int, spp: int, *, seed: int = 0, band: tuple[int, int] = (0, 1)
    ) -> Image:
        """Render the image with at most `longest` pixels a side, shape (y, x, channel).

        `band` (i, n) renders the i-th of n bands of rows; some bands may be empty.
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
        """Draw samples of single pixels (n, 2), (y, x) each; shape (pixel, channel, sample).

        Another seed than the job's draws independent samples.
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
        """Refuse name patterns of lights that cannot be drawn alone."""
        check_lights(_light_names(self._scene), patterns)
        for pattern in patterns:
            _switched_off(self._mi, self._scene, pattern)

    @property
    def depth(self) -> int | None:
        """Longest path in segments, below 0 for no limit; None if the integrator has none.

        It cannot be changed for the integrator of a scene that Mitsuba has built.
        """
        if self._built is not None:
            return None
        properties = self._mi.Properties(self._asked.integrator.node(0).props)
        properties["max_depth"] = longest = int(properties.get("max_depth", -1))
        self._mi.PluginManager.instance().create_object(properties)
        return longest if properties.was_queried("max_depth") else None

    def features(self) -> tuple[dict[str, Image], str]:
        """Return the first-hit features, and the reason if they cannot be drawn.

        They include the arrays of the guide, if there is one.
        """
        from chdstat.rendering.rays import FirstHits

        kept = self.job.guide.arrays if self.job.guide else {}
        try:
            with self._telling():
                objects = self._scene, self._sensor((0, 0), self.size), self._sensor_medium
                hides = bool(getattr(self._integrator, "hide_emitters", False))
                kind = self.integrator["type"]
                hits = FirstHits(self._mi, *objects, integrator=kind, hides=hides)
                found = hits.features(*self.size, as_it_is=self._as_it_is)
        except ChdstatError as error:
            say_once(f"{self.job.scene.name}: no first-hit features: {brief(error)}")
            return kept, brief(error)
        return kept | found, ""

    @contextlib.contextmanager
    def _telling(self) -> Iterator[None]:
        """Turn errors of Mitsuba and of Python classes into an error that says why."""
        try:
            yield
        except (Interrupted, MemoryError):
            raise
        except ChdstatError as error:  # of Mitsuba's loader, it may quote the line of a plugin
            if failure(self.job.plugins, error) is error:
                raise
            raise failure(self.job.plugins, error) from error
        except Exception as error:
            # No variable holds the new error: its traceback would hold the scene in a circle.
            raise self._error(error) from error

    def _error(self, error: Exception) -> Exception:
        told = failure(self.job.plugins, error)
        if told is not error and isinstance(told, InputError):
            return told
        why = brief(error)
        if not isinstance(error, RuntimeError):
            why = f"{type(error).__name__}: {why}"
        frames = [frame for frame, _ in traceback.walk_tb(error.__traceback__)]
        code = frames[-1].f_code
        if not code.co_filename.startswith(_LIBRARIES):
            why += f" (in {code.co_qualname} of {code.co_filename})"
        name = self.integrator["type"]
        return RenderError(f"Mitsuba cannot sample this scene by integrator {name!r}: {why}")

    # --- Mitsuba objects ------------------------------------------------------------------------

    def _refuse_view(self) -> None:
        """Refuse a view that the sensor cannot show."""
        kind, crop = self._asked.sensor.plugin(0), self.job.options["crop"]
        if crop is not None and self.film.crop is not None and not self._asked.crops:
            message = (
                f"a {kind} sensor cannot be cropped, as Mitsuba shows all of it in any crop; leave "
                "out the crop"
            )
            raise InputError(message)
        own = self._asked.film.crop_size
        if self._as_it_is and (self.size != own or crop is not None):
            message = (
                f"the {self._loaded_sensor.class_name()} of a scene that Mitsuba has built shows "
                f"{own[0]} x {own[1]} pixels only; give the file or dict that it was made of"
            )
            raise RenderError(message)

    def _sensor(self, offset: tuple[int, int], extent: tuple[int, int], scale: float = 1.0) -> Any:
        """Return the scene's sensor with a film of a part of the image, at full or coarser size."""
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
    def _crops(self) -> bool:
        """Whether the sensor can show only a part of the image."""
        return self._asked.crops and not self._as_it_is

    @property
    def _integrator(self) -> Any:
        """The integrator of the calling thread; it keeps state while it renders."""
        if not hasattr(self._local, "integrator"):
            described = self._asked.integrator.branch(0)
            check_variant(described)
            made = described.make() if self._built is None else self._built
            if not isinstance(made, self._mi.SamplingIntegrator) or made.aov_names():
                name = self.integrator["type"]
                message = (
                    f"integrator {name!r} does not sample pixel by pixel, or not radiance alone; "
                    "use one that does, such as path, volpath or direct"
                )
                raise RenderError(message)
            if self._built is None:
                from chdstat.rendering.rays import BLOCK

                described.node(0).props["block_size"] = BLOCK
                made = described.make()
            self._local.integrator = made
        return self._local.integrator

    # --- sequences of dependent samples ---------------------------------------------------------

    def _sampler(self) -> Any:
        """Return a sampler of single samples: independent ones, or those of sequences."""
        if self._sequences is None:
            return self._mi.load_dict({"type": "independent"})
        kind, length = self._sequences.sampler, self._sequences.length
        seed = {} if self._scalar else {"seed": self._streams.of_sampler}
        sampler = self._mi.load_dict({"type": kind, "sample_count": length, **seed})
        if not self._scalar:
            sampler.set_samples_per_wavefront(length)
        return sampler

    def _chunk_of_sequences(
        self, chunk: Chunk, step: int, before_pass: Callable[[], None]
    ) -> Image:
        """Draw whole sequences of `step` samples; keep the samples of the chunk."""
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

        Python draws them one by one, since Mitsuba only keeps the average of a sequence. A part of
        a sequence cannot be drawn alone, since the random numbers of a sample continue those of the
        one before.
        """
        number = self._streams.of_sequence(chunk, sequence)
        sampler = self._sampler()
        sample = self._sampling_scalar(sampler)
        height, width, _ = chunk.shape
        block = np.empty((height, width, self.channels, samples), np.float32)
        ends = np.full((height, width), samples)
        if chunk.missing is not None:  # the numbers of a sample go on from those of the one before
            ends = (chunk.missing * np.arange(1, samples + 1)).max(axis=-1)
        times = np.full((height, width, samples), np.nan)
        for y in range(height):
            before_pass()
            for x in range(width):
                sampler.seed(number + y * width + x, 1)
                for i in range(ends[y, x]):
                    begun = now() if self.job.cost else np.nan
                    block[y, x, :, i] = sample(chunk.xs.start + x, chunk.ys.start + y)
                    times[y, x, i] = now() - begun if self.job.cost else np.nan
                    sampler.advance()
        if self.job.cost:
            costs, before = SampleCosts.of(uninterrupted(times)), self.costs
            self._local.costs = costs if before is None else before.merge(costs)
        return block

    # --- scalar ---------------------------------------------------------------------------------

    def _chunk_scalar(self, chunk: Chunk, before_pass: Callable[[], None]) -> Image:
        height, width, samples = chunk.shape
        numbers = range(chunk.ss.start, chunk.ss.stop)
        if self.job.film:
            from chdstat.rendering.film_places import of_passes

            firsts = [self._streams.of_pass(chunk, i) * width * height for i in numbers]
            return of_passes(self._stream_numbers((width, height)), firsts)
        sensor = self._sensor((chunk.xs.start, chunk.ys.start), (width, height))
        block = np.empty((samples, height, width, 3), np.float32)
        integrator, clock = self._integrator, None
        if self.job.cost:
            clock = SampleClock(self._mi, sensor, self._sensor_medium, (height, width))
        for i, sample in enumerate(numbers):
            seed = self._streams.of_pass(chunk, sample)
            before_pass()
            with clock.of_pass(sample) if clock else contextlib.nullcontext(sensor) as used:
                block[i] = integrator.render(self._scene, used, seed=seed, spp=1)
            if integrator.should_stop():
                raise Interrupted
        self._local.costs = clock and clock.costs
        return np.ascontiguousarray(block.transpose(1, 2, 3, 0))

    def _stream_numbers(self, extent: tuple[int, int]) -> npt.NDArray[np.int64]:
        """Return the order in which scalar passes number the pixels of a tile."""
        from chdstat.rendering.film_places import stream_numbers

        if extent not in self._orders:
            self._orders[extent] = stream_numbers(self._mi, extent)
        return self._orders[extent]

    def _pixel_scalar(self, number: int, y: int, x: int, count: int) -> Image:
        sampler = self._mi.load_dict({"type": "independent"})
        sampler.seed(number, 1)
        sample = self._sampling_scalar(sampler)
        return np.stack([sample(x, y) for _ in range(count)], axis=-1)

    def _sampling_scalar(self, sampler: Any) -> Callable[[int, int], Any]:
        """Return a function that draws the next sample of the pixel at (x, y)."""
        from chdstat.rendering.rays import drawn

        mi, (width, height), sensor = self._mi, self.size, self._sensor((0, 0), self.size)
        objects = self._scene, sensor, self._integrator, sampler, self._sensor_medium

        def sample(x: int, y: int) -> Any:
            dx, dy = sampler.next_2d()
            position = mi.Point2f((x + dx) / width, (y + dy) / height)
            light = drawn(mi, position, objects)  # also advances the sampler to the next sample
            return (dx, dy) if self.job.film else light

        return sample

    # --- wavefront (llvm, cuda) -----------------------------------------------------------------

    def _wavefront(
        self,
        number: int,
        corner: tuple[int, int],
        extent: tuple[int, int],
        samples: int,
        missing: npt.NDArray[np.bool_] | None = None,
    ) -> Image:
        """Draw samples of a rectangle of pixels in one wavefront, shape (y, x, channel, sample).

        Lanes run over the samples of a run, then pixels, then runs. Whole runs are drawn, so that
        fewer samples are a prefix of more; a sequence of dependent samples is a run. Lanes of
        samples that are not `missing`, shape (y, x, sample), end at once.
        """
        import drjit as dr

        width, height = extent
        run = self._run
        runs = -(-samples // run)
        inputs = (number, *corner, width, width * height)
        opaque = [dr.opaque(self._mi.UInt32, value) for value in inputs]
        lanes = width * height * runs * run
        active = []
        if missing is not None:
            padded = np.zeros((height, width, runs * run), bool)
            padded[..., :samples] = missing
            by_lane = padded.reshape(height, width, runs, run).transpose(2, 0, 1, 3).ravel()
            active.append(self._mi.Bool(np.ascontiguousarray(by_lane)))
        found, channels = self._launch(*opaque, lanes, *active), self.channels
        found = np.asarray(found, dtype=np.float32)
        found = np.broadcast_to(found, (channels, lanes))  # of one value for all, there is one
        block = found.reshape(channels, runs, height, width, run).transpose(2, 3, 0, 1, 4)
        return np.ascontiguousarray(block.reshape(height, width, channels, -1)[..., :samples])

    @property
    def _run(self) -> int:
        """Samples of a pixel in neighbouring lanes."""
        return _RUN if self._sequences is None else self._sequences.length

    def _launch(self, *inputs: Any) -> Any:
        """Launch the kernel, frozen if possible: tracing costs up to a third of a launch.

        Dr.Jit refuses to freeze it while other scenes are alive in the process, since virtual calls
        then reach objects outside this scene. The plain kernel gives the same result.
        """
        if not hasattr(self._local, "kernel"):
            import drjit as dr

            from chdstat.rendering.rays import wavefront

            sensor, sampler = self._sensor((0, 0), self.size), self._sampler()
            integrator = None if self.job.film else self._integrator
            held = [self._scene, sensor, integrator, sampler, self._sensor_medium]
            mi, size, run = self._mi, self.size, self._run

            def kernel(*inputs: Any) -> Any:
                return wavefront(mi, held, size, run, *inputs)

            self._local.held, self._local.kernel = held, kernel
            self._local.frozen = dr.freeze(kernel, state_fn=lambda *_, **__: held)
        try:
            with _uncollected():
                return self._local.frozen(*inputs)
        except RuntimeError:
            self._local.frozen = self._local.kernel
        try:
            return self._local.kernel(*inputs)
        except Exception:
            self._local.held.clear()  # a traceback holds the kernel, and would hold the scene
            raise


@contextlib.contextmanager
def _uncollected() -> Iterator[None]:
    """Suspend garbage collection: freeing arrays while a kernel is recorded ends the process."""
    collects = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if collects:
            gc.enable()


# --- settings of integrators --------------------------------------------------------------------

_UNLIMITED = 2**32 - 1
"""Mitsuba's integrators print a max_depth of -1 as this number."""
_WRITTEN = 16
"""Numbers of an array that are written out; longer arrays are written as a digest."""


def _settings_of(mi: Any, built: Any) -> dict[str, Any]:
    """Return the settings of an integrator object: those that it prints, traverses and holds."""
    settings: dict[str, Any] = {}
    if in_python(built):
        settings |= vars(built)
    else:
        printed = re.findall(r"^\s*(\w+) = (.*?),?$", str(built), re.MULTILINE)
        settings |= {name: _number(text) for name, text in printed}
    with contextlib.suppress(RuntimeError, TypeError):  # a class that does not say
        settings |= dict(mi.traverse(built))
    return settings


def _number(text: str) -> str | int | float:
    if text.isdecimal():
        return -1 if int(text) == _UNLIMITED else int(text)
    with contextlib.suppress(ValueError):
        return float(text)
    return text


def _told(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return settings ready for JSON: texts, numbers and arrays; parts with others are left out."""
    found = {name: _value_told(value) for name, value in settings.items()}
    return {name: value for name, value in found.items() if value is not None}


def _value_told(value: Any) -> Any:
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    if isinstance(value, str | int | float):
        return value
    with contextlib.suppress(TypeError, ValueError, RuntimeError):
        array = np.asarray(value.matrix if "Transform" in type(value).__name__ else value)
        if array.dtype.kind in "biuf":
            if array.size <= _WRITTEN and np.isfinite(array).all():
                return array.tolist()
            return "SHA-256 " + hashlib.sha256(array.tobytes()).hexdigest()[:16]
    return None


# --- lights -------------------------------------------------------------------------------------
#
# Paths do not depend on how bright a light is: next-event estimation chooses lights by their number
# or sampling weights, and Russian roulette looks at the throughput. So the light of a sample is the
# sum of its light from each light alone.

_DARK = 2.0**-100
"""Factor of a light that is off. It is not 0, since a texture or environment map of 0 could not be
sampled, but a power of two, which leaves all probabilities as they are."""
_FLUSHED = 2.0**-60
"""Less radiance than this comes from lights that are off."""
_LISTED = 20
_RADIANCE = ("value", "values", "data", "scale", "sun_scale", "sky_scale")


def check_lights(names: Sequence[str], patterns: Sequence[str]) -> None:
    """Refuse name patterns that match no light, or a light that another pattern matches, too.

    Raises
    ------
    InputError
        If a pattern does.

    Examples
    --------
    >>> check_lights(["lamp-0", "lamp-1", "sky"], ["lamp-*", "sky"])
    """
    if isinstance(patterns, str | Path):
        message = f"by_light must be a sequence of names, such as [{str(patterns)!r}]"
        raise InputError(message)
    for pattern in patterns:
        if not any(fnmatchcase(name, pattern) for name in names):
            there = ", ".join(names[:_LISTED]) or "none"
            more = f" and {len(names) - _LISTED} more" if len(names) > _LISTED else ""
            near = did_you_mean(pattern, names)
            message = f"no light {pattern!r}; the scene has {there}{more}{near}"
            raise InputError(message)
    for name in names:
        matching = [pattern for pattern in patterns if fnmatchcase(name, pattern)]
        if len(matching) > 1:
            message = f"light {name!r} is of several groups: {', '.join(matching)}"
            raise InputError(message)


def _light_names(scene: Any) -> list[str]:
    """Return the names of the lights of a Mitsuba scene: ids of their shapes, or their own ids.

    Lights without an id are named by their kind; lights with the same name are numbered.
    """
    names: list[str] = []
    for light in scene.emitters():
        shape = light.get_shape()
        name = (shape.id() if shape is not None else light.id()) or type(light).__name__
        names.append(name)
    return [
        name if names.count(name) == 1 else f"{name}-{names[:i].count(name)}"
        for i, name in enumerate(names)
    ]


def _switched_off(mi: Any, scene: Any, kept: str) -> list[tuple[Any, list[str]]]:
    """Return the parameters of all lights but those of a pattern, and their radiance's names.

    Raises
    ------
    RenderError
        If a light has no radiance that can be changed.
    """
    found = []
    for light, name in zip(scene.emitters(), _light_names(scene), strict=True):
        if fnmatchcase(name, kept):
            continue
        parameters = mi.traverse(light)
        keys = ["scale"] if "scale" in parameters else []
        keys = keys or [key for key in parameters.keys() if key.split(".")[-1] in _RADIANCE]  # noqa: SIM118
        if not keys:
            message = f"light {name!r} ({type(light).__name__}) cannot be switched off"
            raise RenderError(message)
        found.append((parameters, keys))
    return found


def _darken(mi: Any, scene: Any, kept: str) -> None:
    """Switch off all lights of a Mitsuba scene except those that match a pattern."""
    for parameters, keys in _switched_off(mi, scene, kept):
        for key in keys:
            parameters[key] = parameters[key] * _DARK
        parameters.update()
