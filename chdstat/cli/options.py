"""Options that several commands take, and what their values mean."""

from __future__ import annotations

import re
import reprlib
from pathlib import Path
from typing import Annotated, Any

import typer

from chdstat.errors import InputError

__all__ = [
    "BackendName",
    "Defines",
    "Depth",
    "Iterations",
    "Json",
    "Quiet",
    "SceneName",
    "SceneOrStore",
    "Scheduler",
    "Seed",
    "Size",
    "Spp",
    "StoreKept",
    "StorePath",
    "batches_of",
    "client_of",
    "given",
    "pairs_of",
    "progress_of",
    "samples_of",
    "scene_of",
    "size_of",
    "source_of",
    "thresholds_of",
]

SceneName = Annotated[
    str,
    typer.Argument(metavar="SCENE", help="Built-in name or Mitsuba XML file.", show_default=False),
]
SceneOrStore = Annotated[
    str,
    typer.Argument(
        metavar="SCENE|STORE",
        help="Built-in name, Mitsuba XML file or finished store.",
        show_default=False,
    ),
]
StorePath = Annotated[
    Path, typer.Argument(metavar="STORE", help="A finished store.", show_default=False)
]
Spp = Annotated[int | None, typer.Option("--spp", help="Samples per pixel.", show_default=False)]
Size = Annotated[
    str | None,
    typer.Option("--size", metavar="WxH", help="Image size in pixels.", show_default=False),
]
Seed = Annotated[int | None, typer.Option("--seed", help="Any integer from 0.", show_default=False)]
Depth = Annotated[
    int | None, typer.Option("--max-depth", help="Longest path in segments.", show_default=False)
]
BackendName = Annotated[
    str, typer.Option("--backend", help="auto, scalar, llvm or cuda.", metavar="NAME")
]
Defines = Annotated[
    list[str] | None,
    typer.Option("-D", metavar="KEY=VALUE", help="Parameter of an XML scene; repeat for more."),
]
Json = Annotated[bool, typer.Option("--json", help="Print JSON for scripts.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="No progress bars.")]
Iterations = Annotated[
    int | None, typer.Option(help="Minibatches of the training.", show_default=False)
]
StoreKept = Annotated[
    Path | None,
    typer.Option(
        "--store", help="Keep the samples here, and resume from them.", show_default=False
    ),
]
Scheduler = Annotated[
    str | None,
    typer.Option(
        metavar="ADDRESS", help="Dask scheduler whose workers render.", show_default=False
    ),
]


_RENDERING = ("max_depth", "backend")


def scene_of(name: str, define: list[str] | None) -> Any:
    """Return a scene by name or file, with its parameters."""
    from chdstat.scenes import load_scene

    return load_scene(name, **pairs_of("-D", define))


def samples_of(
    source: str,
    *,
    define: list[str] | None,
    size: str | None,
    store: Path | None,
    quiet: bool,
    **settings: Any,
) -> Any:
    """Return the samples of a finished store, or render those of a scene."""
    import chdstat
    from chdstat.rendering.jobs import refuse_render

    found = source_of(source, define)
    if isinstance(found, Path):
        # A seed may be that of a training, and spp the number of first samples.
        other = {name: value for name, value in settings.items() if name in _RENDERING}
        refuse_render(source, {"size": size, "store": store, **other})
        return chdstat.open(found)
    return chdstat.render(
        found,
        progress=progress_of(quiet),
        **given(size=size_of(size), out=store, **settings),
    )


def batches_of(
    source: str,
    *,
    define: list[str] | None,
    size: str | None,
    store: Path | None,
    quiet: bool,
    **settings: Any,
) -> Any:
    """Return a rendering of a scene, batch by batch, of which no sample is kept."""
    from chdstat.rendering.live import render_batches
    from chdstat.samples import is_store

    if is_store(source) or store is not None:
        message = (
            "--while-rendering keeps no samples: it takes a scene, not a store such as "
            f"{source if store is None else store}"
        )
        raise InputError(message)
    return render_batches(
        scene_of(source, define),
        progress=progress_of(quiet),
        **given(size=size_of(size), **settings),
    )


def source_of(source: str, define: list[str] | None) -> Any:
    """Return the path of a finished store, or a scene by name or file, with its parameters."""
    from chdstat.rendering.jobs import refuse_render
    from chdstat.samples import is_store

    if not is_store(source):
        return scene_of(source, define)
    refuse_render(source, {"-D": define or None})
    return Path(source)


def thresholds_of(given: list[str] | None) -> Any:
    """Return thresholds of patterns from ``NAME=VALUE``."""
    from dataclasses import fields

    from chdstat.patterns import Thresholds

    pairs = pairs_of("--threshold", given)
    known = [field.name for field in fields(Thresholds)]
    for name, value in pairs.items():
        if name not in known:
            message = f"--threshold takes one of {', '.join(known)}, got {name!r}"
            raise InputError(message)
        try:
            float(value)
        except ValueError:
            message = f"--threshold {name} takes a number, got {value!r}"
            raise InputError(message) from None
    return Thresholds(**{name: float(value) for name, value in pairs.items()})


def pairs_of(option: str, given: list[str] | None) -> dict[str, str]:
    """Return what was given as ``KEY=VALUE``."""
    pairs = {}
    for text in given or []:
        key, equals, value = text.partition("=")
        if not equals or not key:
            message = f"{option} takes KEY=VALUE, got {text!r}"
            raise InputError(message)
        pairs[key] = value
    return pairs


def size_of(text: str | None) -> tuple[int, int] | None:
    """Return width and height from ``WxH``."""
    if text is None:
        return None
    width, x, height = text.lower().partition("x")
    if not (x and re.fullmatch("[0-9]{1,9}", width) and re.fullmatch("[0-9]{1,9}", height)):
        message = f"--size takes WIDTHxHEIGHT such as 128x128, got {reprlib.repr(text)}"
        raise InputError(message)
    return int(width), int(height)


def given(**options: Any) -> dict[str, Any]:
    """Return the options that were given: the library has the defaults."""
    return {name: value for name, value in options.items() if value is not None}


def progress_of(quiet: bool) -> bool | None:
    """Return whether to show progress: None leaves it to the terminal."""
    return False if quiet else None


def client_of(address: str | None) -> Any:
    """Return a context with a Dask client, or with None."""
    import contextlib

    if address is None:
        return contextlib.nullcontext()
    from distributed import Client

    try:
        return Client(address, timeout="10s")
    except (OSError, ValueError) as error:
        message = f"cannot reach a Dask scheduler at {address}: {error}"
        raise InputError(message) from error
