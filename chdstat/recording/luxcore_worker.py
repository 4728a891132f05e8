"""LuxCore's side of `chdstat.recording.luxcore`: it reads a scene and draws passes of it.

It runs in a Python that has pyluxcore (see `chdstat.recording.worker_loop`); no file is written.

**One sample of every pixel.** The engines of LuxCore stop some time after they have the samples
that they are to draw, so that pixels of PATHCPU with ``batch.haltspp = 1`` hold 1 to 6 samples. Its
interactive engine, RTPATHCPU, traces the same paths with independent random numbers, and draws a
first frame with one sample of every pixel, which has a weight of its own. With a weight of 2^80,
later samples of a pixel vanish in the rounding of the sum, and dividing by the weight returns the
first one to the bit. Where the first sample is null, the later ones leave less than `_NULL`.
"""

from __future__ import annotations

import fnmatch
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np  # before pyluxcore, which otherwise ends with a fault of its memory

if TYPE_CHECKING or __name__ == "chdstat_worker":  # not where the package is only imported
    import pyluxcore as lux

    if not TYPE_CHECKING:
        lux.Init()

if TYPE_CHECKING:
    from chdstat.recording.worker_loop import SceneFault

_WEIGHT = 2.0**80
_NULL = np.float32(2.0**-48)
"""What is less is null: as much as other samples below 2^32 leave of a sample that is null."""
_FEATURE_SAMPLES = 16
_FEATURE_SEED = 2**30
"""Seeds from here on draw features; passes have those below."""
_REFUSED = ("BAKECPU", "FILESAVER")
_FEATURES = {
    "albedo": ("ALBEDO", 3),
    "normal": ("AVG_SHADING_NORMAL", 3),
    "position": ("POSITION", 3),
    "depth": ("DEPTH", 1),
}
_DEPTHS = {"total": 6, "diffuse": 4, "glossy": 4, "specular": 6}
"""Default longest paths of LuxCore's path engine; RTPATHCPU has others."""
_LEFT_OUT = (
    "renderengine.",
    "sampler.",
    "rtpathcpu.",
    "batch.",
    "periodicsave.",
    "resumerendering.",
    "native.",
    "opencl.",
    "cuda.",
    "context.",
    "film.filter.",
    "film.imagepipeline",
    "film.outputs.",
    "film.noiseestimation.",
    "film.subregion",
    "film.width",
    "film.height",
    "path.pathdepth.",
    "path.maxdepth",
    "path.clamping.",
    "path.photongi.",
    "path.hybridbackforward.",
    "lightstrategy.type",
    "screen.",
    "tile.",
    "tilepath.",
    "path.aa.",
)
"""Begins of the properties that the file's settings are not taken from."""

_opened: dict[str, Any] = {}


def version() -> dict[str, Any]:
    """Return what renders."""
    return {"version": lux.Version()}


# --- the scene ------------------------------------------------------------------------------------


def load(path: str) -> dict[str, Any]:
    """Read a scene or the settings of a render with its scene; return what is to be said of it."""
    file = Path(path)
    config = _read(file) if file.suffix.lower() == ".cfg" else lux.Properties()
    scene_file = _scene_file(config, file)
    described = _read(scene_file)
    notes = [*(_notes(config) if config.GetAllNames() else ()), *_caches(described)]
    os.chdir(_root(described, scene_file, file))
    for folder in dict.fromkeys((file.parent, scene_file.parent)):
        lux.AddFileNameResolverPath(str(folder))
    if not any(name.startswith("scene.camera.") for name in described.GetAllNames()):
        message = f"{scene_file} has no camera; give it scene.camera.type and a view"
        raise SceneFault(message)
    files = _files(described, scene_file.parent)
    try:
        scene = lux.Scene()
        scene.Parse(described)
    except RuntimeError as error:
        message = f"LuxCore {lux.Version()} cannot read {scene_file}: {error}"
        raise SceneFault(message) from error
    _opened.clear()
    _opened.update(config=config, scene=scene, groups=_groups(described))
    return {
        "notes": notes,
        "files": [str(scene_file), *files],
        "version": lux.Version(),
    }


def _read(path: Path) -> Any:
    try:
        found = lux.Properties(str(path))
    except RuntimeError as error:
        message = f"{path} is no list of LuxCore's properties (name = values): {error}"
        raise SceneFault(message) from error
    if not found.GetAllNames():
        message = f"{path} holds no property of LuxCore (name = values)"
        raise SceneFault(message)
    return found


def _text(settings: Any, name: str, default: str = "") -> str:
    return str(settings.Get(name).GetString()) if settings.IsDefined(name) else default


def _is_on(settings: Any, name: str) -> bool:
    return _text(settings, name, "0").lower() not in ("0", "0.0", "false", "none", "")


def _scene_file(config: Any, file: Path) -> Path:
    """Return the scene that settings name: a path from their folder, or from one above it."""
    if file.suffix.lower() != ".cfg":
        return file
    if not (name := _text(config, "scene.file")):
        message = f"{file} names no scene; give it scene.file = NAME.scn"
        raise SceneFault(message)
    for folder in file.parents:
        if (found := folder / name).is_file():
            return found
    message = f"{file} names the scene {name!r}, which is neither beside it nor in a folder above"
    raise SceneFault(message)


def _named_files(described: Any) -> list[str]:
    """Return texts of properties that may be paths."""
    names = (n for n in described.GetAllNames() if n.startswith("scene."))
    kinds = (".ply", ".file", ".iesfile", ".mapfile", ".filename")
    return [_text(described, name) for name in names if name.endswith(kinds)]


def _root(described: Any, scene_file: Path, file: Path) -> Path:
    """Return the folder from which most files of a scene are found."""
    named = _named_files(described)
    folders = [scene_file.parent, *file.parents]
    return max(folders, key=lambda folder: sum((folder / name).is_file() for name in named))


def _files(described: Any, beside: Path) -> list[str]:
    """Return the files that a scene reads, apart from itself."""
    found = []
    for name in _named_files(described):
        path = next((p for p in (Path(name).absolute(), beside / name) if p.is_file()), None)
        if path is None:
            message = f"the scene names the file {name!r}, which is not there"
            raise SceneFault(message)
        found.append(str(path))
    return sorted(set(found))


def _notes(config: Any) -> list[str]:
    """Return what of the settings is set otherwise, in words."""
    engine = _text(config, "renderengine.type", "PATHCPU").upper()
    if engine in _REFUSED:
        message = f"{engine} draws no image of samples; set renderengine.type = PATHCPU"
        raise SceneFault(message)
    notes = []
    if engine not in ("PATHCPU", "RTPATHCPU"):
        notes.append(f"the path engine on the CPU renders, not {engine}")
    if (sampler := _text(config, "sampler.type", "SOBOL").upper()) != "RANDOM":
        notes.append(f"the sampler {sampler} is off: samples are independent")
    kernel = _text(config, "film.filter.type", "BLACKMANHARRIS").upper()
    if kernel != "NONE":
        notes.append(f"the pixel filter is a box of one pixel, not {kernel}")
    notes += [
        f"clamping of variance ({_text(config, name)}) is off"
        for name in ("path.clamping.variance.maxvalue", "path.clamping.radiance.maxvalue")
        if _is_on(config, name)
    ]
    notes += [
        f"the photon cache of {kind} light is off: all light is traced"
        for kind in ("indirect", "caustic")
        if _is_on(config, f"path.photongi.{kind}.enabled")
    ]
    if _is_on(config, "path.hybridbackforward.enable"):
        notes.append("light tracing (path.hybridbackforward) is off: all paths begin at the camera")
    strategy = _text(config, "lightstrategy.type").upper()
    if strategy == "DLS_CACHE":
        notes.append("the light strategy DLS_CACHE, which learns, is replaced by LOG_POWER")
    names = config.GetAllNames()
    if any(n.startswith("film.imagepipeline") for n in names):
        notes.append("image pipelines are off, with tone mapping and denoisers: samples are linear")
    if _is_on(config, "batch.haltthreshold") or _is_on(config, "batch.haltnoisethreshold"):
        notes.append("stopping by noise is off: pixels have equal samples")
    return notes


def _caches(described: Any) -> list[str]:
    """Switch off what lights learn of the scene, and note it."""
    notes = []
    for name in described.GetAllNames():
        if name.endswith(".visibilitymapcache.enable") and _is_on(described, name):
            described.Set(lux.Property(name, False))
            notes.append(f"the visibility cache of {name.split('.')[2]} is off: it learns")
    return notes


def _groups(described: Any) -> dict[int, list[str]]:
    """Return the names of lights by the number of their light group."""
    groups: dict[int, list[str]] = {}
    names = described.GetAllNames()
    for prefix, end in (("scene.lights.", ".type"), ("scene.materials.", ".emission")):
        for name in names:
            if name.startswith(prefix) and name.endswith(end):
                light = name.removeprefix(prefix).removesuffix(end)
                key = f"{prefix}{light}" + (".id" if end == ".type" else ".emission.id")
                groups.setdefault(int(_text(described, key, "0")), []).append(light)
    return groups


# --- the image ------------------------------------------------------------------------------------


def frame(
    size: list[int] | None,
    crop: list[int] | None,
    max_depth: int | None,
    direct: bool,
    by_light: list[str],
) -> dict[str, Any]:
    """Set the image and the parts of its light; return its size and what samples depend on."""
    if direct:
        message = (
            "LuxCore cannot tell direct light apart: it counts what a path finds by chance at its "
            "second point as indirect; leave direct out, or render with max_depth=2"
        )
        raise SceneFault(message)
    config = _opened["config"]
    if size is None:
        size = [
            int(_text(config, f"film.{n}", d)) for n, d in (("width", "640"), ("height", "480"))
        ]
    _opened.update(size=size, crop=crop, parts=_parts(by_light))
    depths = {
        name: int(_text(config, f"path.pathdepth.{name}", _text(config, "path.maxdepth", str(n))))
        for name, n in _DEPTHS.items()
    }
    if max_depth is not None:
        depths = {name: min(n, max_depth) for name, n in depths.items()}
    _opened["depths"] = depths
    kept = {n: _text(config, n) for n in config.GetAllNames() if n.startswith("path.russian")}
    strategy = _strategy(config)
    return {"size": size, "integrator": {**depths, **kept, "lightstrategy": strategy}}


def _strategy(config: Any) -> str:
    strategy = _text(config, "lightstrategy.type", "LOG_POWER").upper()
    return "LOG_POWER" if strategy == "DLS_CACHE" else strategy


def _parts(wanted: list[str]) -> dict[str, list[int]]:
    """Return the light groups of each part: ``group-N``, or a pattern of lights' names."""
    groups, parts = _opened["groups"], dict[str, list[int]]()
    for name in wanted:
        own = [n for n in groups if f"group-{n}" == name]
        meant = [n for n, held in groups.items() if fnmatch.filter(held, name)]
        mixed = [n for n in meant if not all(fnmatch.fnmatchcase(one, name) for one in groups[n])]
        if mixed and not own:
            others = ", ".join(groups[mixed[0]])
            message = (
                f"lights {others} share the light group {mixed[0]}, and LuxCore tells groups apart "
                f"only: ask for 'group-{mixed[0]}', or give {name!r} an id of its own in the scene"
            )
            raise SceneFault(message)
        if not (own or meant):
            names = ", ".join(
                [
                    *(f"group-{n}" for n in groups),
                    *[one for held in groups.values() for one in held][:20],
                ]
            )
            message = f"there is no light or light group {name!r}; there is {names or 'none'}"
            raise SceneFault(message)
        parts[name] = own or meant
    return parts


def _settings(seed: int, outputs: list[tuple[str, int | None]]) -> Any:
    """Return the settings of one pass."""
    config, (width, height) = _opened["config"], _opened["size"]
    names = [n for n in config.GetAllNames() if not n.startswith(_LEFT_OUT)]
    settings = lux.Properties()
    for name in names:
        settings.Set(config.Get(name))
    lines = [
        "renderengine.type = RTPATHCPU",
        f"renderengine.seed = {seed + 1}",  # LuxCore takes 0 for 1
        "sampler.type = RTPATHCPUSAMPLER",
        "rtpathcpu.zoomphase.size = 1",
        f"rtpathcpu.zoomphase.weight = {_WEIGHT:.0f}",
        # Threads add samples to the same pixels without a lock, and share a stream of numbers.
        "native.threads.count = 1",
        f"lightstrategy.type = {_strategy(config)}",
        "film.filter.type = NONE",
        "path.clamping.variance.maxvalue = 0",
        f"film.width = {width}",
        f"film.height = {height}",
        *(f"path.pathdepth.{name} = {depth}" for name, depth in _opened["depths"].items()),
    ]
    if (crop := _opened["crop"]) is not None:
        x, y, w, h = crop
        bottom = height - y - h
        lines.append(f"film.subregion = {x} {x + w - 1} {bottom} {bottom + h - 1}")
    for number, (kind, index) in enumerate(outputs):
        lines += [f"film.outputs.{number}.type = {kind}", f"film.outputs.{number}.filename = o.exr"]
        lines += [f"film.outputs.{number}.id = {index}"] if index is not None else []
    settings.SetFromString("\n".join(lines))
    return settings


def _passed(seed: int, outputs: list[tuple[str, int | None]]) -> Any:
    """Return the film of one pass, and its session, which must outlive it."""
    config = lux.RenderConfig(_settings(seed, outputs), _opened["scene"])
    session = lux.RenderSession(config)
    session.Start()
    session.WaitNewFrame()
    session.Stop()
    return session.GetFilm(), session, config


def _image(film: Any, kind: str, channels: int, index: int = 0) -> Any:
    """Return an output of a film, cut to the crop; row 0 at the top."""
    width, height = film.GetWidth(), film.GetHeight()
    image = np.empty((height, width, channels), np.float32)
    film.GetOutputFloat(getattr(lux.FilmOutputType, kind), image, index, False)
    image = image[::-1]
    crop = _opened["crop"]
    if crop is not None and [width, height] != list(crop[2:]):
        x, y, w, h = crop
        image = image[y : y + h, x : x + w]
    return image


def _nulls(image: Any) -> Any:
    image = image.copy()
    image[np.abs(image) < _NULL] = 0
    return image


def draw(seed: int) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return one sample of every pixel, and its parts by light."""
    parts = _opened["parts"]
    count = max(_opened["groups"], default=0) + 1
    wanted = sorted({n for held in parts.values() for n in held})
    groups: list[tuple[str, int | None]] = [("RADIANCE_GROUP", n) for n in wanted]
    film, *_kept = _passed(seed, [("RGB", None), *groups])
    arrays = {"image": _nulls(_image(film, "RGB", 3))}
    lights = {n: _nulls(_image(film, "RADIANCE_GROUP", 3, n)) for n in wanted if n < count}
    for name, held in parts.items():
        arrays[f"light {name}"] = sum(lights[n] for n in held)
    return {}, arrays


def features() -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the means of first-hit features; misses count as 0."""
    sums: dict[str, Any] = {}
    outputs: list[tuple[str, int | None]] = [(kind, None) for kind, _ in _FEATURES.values()]
    for number in range(_FEATURE_SAMPLES):
        film, *_kept = _passed(_FEATURE_SEED + number, [("RGB", None), *outputs])
        for name, (kind, channels) in _FEATURES.items():
            image = _image(film, kind, channels)
            image = np.where(np.isfinite(image), image, 0)
            sums[name] = sums.get(name, 0) + image / _FEATURE_SAMPLES
    sums["depth"] = sums["depth"][..., 0]
    return {}, sums
