"""Options that commands share: how each is declared, and what the call makes of it."""

from __future__ import annotations

import contextlib
import json
import re
import reprlib
from collections.abc import Iterator
from dataclasses import dataclass
from inspect import signature
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_args

import typer

from chdstat._core.files import checked_target, is_path, local, place_of, remove
from chdstat.errors import InputError, StoreError
from chdstat.rendering import RenderOptions
from chdstat.rendering.backend import Color
from chdstat.rendering.options import RenderSettings
from chdstat.rendering.seeds import SamplerName

if TYPE_CHECKING:
    from distributed import Client

    from chdstat.samples import Samples
    from chdstat.scenes import Scene


def option(about: str, *names: str, unset: str | None = None, **more: Any) -> Any:
    """Return an option of a command; the help shows `unset` as its default.

    Without `unset`, a default None is shown as "none".
    """
    return typer.Option(*names, help=about, show_default=unset or True, **more)


def _scene_names(begun: str) -> list[tuple[str, str]]:
    """Return the built-in scenes that begin so, with what each shows, for the shell."""
    from chdstat.scenes import BUILTIN

    return [row for row in BUILTIN.items() if row[0].startswith(begun)]


def _estimator_names(begun: str) -> list[str]:
    """Return the estimators that begin so, for the shell."""
    from chdstat.estimators.registry import names

    return [name for name in names() if name.startswith(begun)]


SceneName = Annotated[
    str,
    typer.Argument(
        metavar="SCENE", help="Built-in name or Mitsuba XML file.", autocompletion=_scene_names
    ),
]
SceneOrStore = Annotated[
    str,
    typer.Argument(
        metavar="SCENE|STORE",
        help="Built-in name, Mitsuba XML file or finished store.",
        autocompletion=_scene_names,
    ),
]
StorePath = Annotated[
    Path, typer.Argument(metavar="STORE", help="A finished store, or its URL.", parser=place_of)
]

VIEW = ("spp", "size", "seed", "max_depth", "backend", "define", "plugin")
"""Options of commands that render a scene."""
OUTPUT = ("quiet", "as_json")
"""Options of commands that print."""


@dataclass(frozen=True, kw_only=True)
class CommonOptions:
    """Options that several commands share, with their values in this call; None if not given.

    Each command names the options that it takes: fields of `RenderOptions`, and others.
    """

    estimator: Annotated[
        list[str] | None,
        option(
            "An estimator to compare, trained here if it learns; can be repeated. "
            '" + OIDN" after a name denoises its estimate.',
            "-e",
            "--estimator",
            metavar="NAME",
            unset="the default estimate, the mean and a few more",
            autocompletion=_estimator_names,
        ),
    ] = None
    iterations: Annotated[
        int | None, option("Number of training minibatches.", unset="as many as help")
    ] = None
    # The fields of `RenderOptions`.
    spp: Annotated[
        int | None,
        option(
            "Number of samples per pixel; from a store, the first ones.",
            "--spp",
            unset=f"{RenderOptions.spp} of a scene, all of a store",
        ),
    ] = None
    error: Annotated[
        float | None,
        option(
            "Relative error of the image at which to stop: the root of its relMSE, .02 for 2 %.",
            "--error",
            metavar="ERROR",
        ),
    ] = None
    size: Annotated[
        str | None, option("Image size in pixels.", metavar="WxH", unset="the scene's own")
    ] = None
    seed: Annotated[
        int | None, option("Random seed, a non-negative integer.", unset=f"{RenderOptions.seed}")
    ] = None
    max_depth: Annotated[
        int | None, option("Maximum path length in segments.", unset="the scene's own")
    ] = None
    sensor: Annotated[
        int | None,
        option("Number of the scene's sensor, from 0.", unset=f"{RenderOptions.sensor}"),
    ] = None
    integrator: Annotated[
        str | None,
        option(
            "Integrator in place of the scene's: its name, or JSON with its settings, such as "
            '{"type": "path", "rr_depth": 100}.',
            metavar="NAME|JSON",
            unset="the scene's own",
        ),
    ] = None
    crop: Annotated[
        str | None,
        option("Part of the image to render, in pixels.", metavar="X,Y,WxH", unset="all of it"),
    ] = None
    color: Annotated[
        Color | None,
        option("How light is transported; samples are linear sRGB.", unset=RenderOptions.color),
    ] = None
    sampler: Annotated[
        SamplerName | None,
        option(
            f"Mitsuba's sampler: {', '.join(get_args(SamplerName))}. With any but independent, "
            "samples of a sequence depend on each other: only averages of sequences have standard "
            "errors.",
            metavar="NAME",
            unset=RenderOptions.sampler,
        ),
    ] = None
    sequence: Annotated[
        int | None,
        option(
            "Samples that such a sampler spreads together; --spp is a multiple of it.",
            metavar="N",
            unset="16",
        ),
    ] = None
    backend: Annotated[
        str | None,
        option("auto, scalar, llvm or cuda.", metavar="NAME", unset=RenderOptions.backend),
    ] = None
    # Scenes, stores, workers and output.
    define: Annotated[
        list[str] | None,
        option("Parameter of an XML scene; can be repeated.", "-D", metavar="KEY=VALUE"),
    ] = None
    plugin: Annotated[
        list[Path] | None,
        option(
            "Python file that registers integrators or materials with Mitsuba, or estimators; can "
            "be repeated.",
            "--plugin",
            metavar="FILE",
        ),
    ] = None
    store: Annotated[
        Path | None,
        option(
            "Store that keeps the samples, and from which a stopped render resumes.",
            "--store",
            metavar="PATH",
            parser=place_of,
            unset="none: in memory",
        ),
    ] = None
    scheduler: Annotated[
        str | None,
        option(
            "Dask scheduler whose workers do the work.",
            metavar="ADDRESS",
            unset="none: this process",
        ),
    ] = None
    workers: Annotated[
        int | None,
        option(
            "Worker processes of this machine that do the work.",
            min=1,
            metavar="N",
            unset="none: threads",
        ),
    ] = None
    overwrite: Annotated[bool, option("Replace an output that is there already.")] = False
    quiet: Annotated[bool, option("Show neither progress nor next steps.", "--quiet", "-q")] = False
    as_json: Annotated[bool, option("Print JSON for scripts.", "--json")] = False

    @property
    def settings(self) -> dict[str, Any]:
        """The given settings of a render."""
        parsed = {
            "size": _numbers_in("--size", self.size, "WxH", "128x128"),
            "crop": _numbers_in("--crop", self.crop, "X,Y,WxH", "16,8,64x32"),
            "integrator": _integrator_of(self.integrator),
        }
        fields = vars(self) | parsed
        return {n: fields[n] for n in RenderSettings.__annotations__ if fields[n] is not None}

    @property
    def progress(self) -> bool:
        """Whether to show progress bars."""
        return not self.quiet

    def scene(self, name: str) -> Scene:
        """Return a scene by name or file, with its parameters."""
        from chdstat.scenes import load_scene

        return load_scene(name, **pairs_of("-D", self.define))

    def source(self, name: str) -> Path | Scene:
        """Return the path of a finished store, or a scene by name or file."""
        from chdstat.rendering import refuse_render
        from chdstat.samples import is_store

        if not is_store(name):
            return self.scene(name)
        refuse_render(name, {"-D": self.define or None})
        return place_of(name)

    def samples(self, name: str, *, seed: int | None) -> Samples:
        """Return the samples of a finished store, or render those of a scene.

        `seed` is the seed of the render; None if the seed is also used for the work on a store.
        """
        from chdstat.rendering import refuse_render, render
        from chdstat.samples import open as open_store

        found = self.source(name)
        if is_path(found):
            # spp is the number of first samples.
            settings = {**self.settings, "spp": None, "seed": seed, "store": self.store}
            refuse_render(name, settings)
            return open_store(found)
        return render(found, **self.settings, out=self.store, progress=self.progress)

    def target(self, out: Path, *suffixes: str) -> Path:
        """Return a file to write, with one of the suffixes; without suffixes, a folder.

        Raises
        ------
        InputError, StoreError
            If it cannot be written, or exists and may not be replaced.
        """
        path = checked_target(out, *suffixes) if suffixes else local(out)
        if not path.exists():
            return path
        if not self.overwrite:
            message = f"{path} exists; nothing was overwritten. Give another path, or --overwrite"
            raise StoreError(message)
        written = any((path / name).exists() for name in ("zarr.json", "comparison.json"))
        if path.is_dir() and (not written or (path / "radiance").exists()):  # others', or samples
            message = f"{path} is no output of this command; remove it yourself, or give another"
            raise StoreError(message)
        return path

    def replaced(self, folder: Path) -> Path:
        """Return a folder that `target` allows to write, after removing an existing one."""
        if self.overwrite:
            remove(folder)
        return folder

    @contextlib.contextmanager
    def client(self) -> Iterator[Client | None]:
        """Yield a client of the requested workers, None for threads."""
        from chdstat._core.work import client_of

        with client_of(self.scheduler, self.workers) as client:
            yield client


SHARED = signature(CommonOptions, eval_str=True).parameters
"""The shared options by name, with their annotations: evaluated once, not for each command."""


def pairs_of(option: str, given: list[str] | None) -> dict[str, str]:
    """Return options of the form ``KEY=VALUE``."""
    pairs = {}
    for text in given or []:
        key, equals, value = text.partition("=")
        if not equals or not key:
            message = f"{option} takes KEY=VALUE, got {text!r}"
            raise InputError(message)
        pairs[key] = value
    return pairs


def _numbers_in(option: str, text: str | None, form: str, example: str) -> tuple[int, ...] | None:
    """Return the numbers in a text; each capital letter of the form is one number."""
    if text is None:
        return None
    found = re.fullmatch(re.sub("[A-Z]", "([0-9]{1,9})", form), text.lower())
    if found is None:
        named = form.replace("WxH", "WIDTHxHEIGHT")
        message = f"{option} takes {named} such as {example}, got {reprlib.repr(text)}"
        raise InputError(message)
    return tuple(map(int, found.groups()))


def _integrator_of(text: str | None) -> str | dict[str, Any] | None:
    """Return an integrator by name, or its settings from JSON."""
    if text is None or not text.lstrip().startswith("{"):
        return text
    try:
        return dict(json.loads(text))
    except ValueError as error:
        message = f"--integrator takes a name or JSON, got {reprlib.repr(text)}: {error}"
        raise InputError(message) from error
