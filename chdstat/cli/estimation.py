"""Estimation: the commands that train, estimate and compare estimators, or renders."""

from __future__ import annotations

import json
import time
from contextlib import closing, nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from chdstat._core.arrays import warn_caller
from chdstat._core.display import number, percent
from chdstat._core.files import is_remote, place_of
from chdstat.cli import output
from chdstat.cli.arguments import (
    OUTPUT,
    VIEW,
    CommonOptions,
    OptionalWords,
    SceneOrStore,
    StorePath,
    Words,
    pairs_of,
)
from chdstat.cli.program import command
from chdstat.errors import InputError

if TYPE_CHECKING:
    from chdstat._core.arrays import Image
    from chdstat.comparison import Comparison, ErrorCurve
    from chdstat.inference import Contrast, Contrasts, Reference
    from chdstat.recording import PassSource
    from chdstat.rendering import Rendering
    from chdstat.samples import Samples
    from chdstat.scenes import Scene

_UNKNOWN_SPP = 512
"""Most samples of a scene to draw if those of the reference are unknown."""
_CONTRASTED = {
    "render": "render",
    "outcome": "outcome",
    "p": "p",
    "loss": "B darker by",
    "smallest_loss_image": "finds in the image",
    "smallest_loss_tenth": "in a tenth",
}
"""Columns of the table of contrasts."""
_ENDLESS = 2**20
"""Samples per pixel of a render that is stopped by time or error."""
_COMPARED = {
    "name": "estimator",
    "mse_ratio": "MSE / mean's",
    "relmse_ratio": "relMSE / mean's",
    "improved": "improved",
    "bias": "bias",
    "fireflies": "fireflies left",
    "estimator": "-e",
}
"""Columns of the tables of estimators; the last says what one types."""


@command(
    "train bathroom.zarr -o bathroom.safetensors",
    *("iterations", *VIEW, "store", "overwrite", *OUTPUT),
)
def train(
    source: SceneOrStore, out: Path, asked: CommonOptions, estimator: str = "elek2019"
) -> None:
    """Train an estimator on a scene and write it to a file.

    Parameters
    ----------
    out : path
        The model to write, .safetensors.
    estimator : NAME
        The learned estimator to train.
    """
    from chdstat.estimators.training import check_choice, train_model

    target = asked.target(out, ".safetensors")  # refused before the work, not after
    check_choice(estimator)
    trained = train_model(
        asked.samples(source, seed=None),
        estimator,
        spp=asked.spp,
        seed=asked.seed or 0,
        iterations=asked.iterations,
        progress=asked.progress,
    )
    trained.save(target)
    about = {"estimator": estimator, "iterations": int(trained.history.iteration[-1])}
    output.say_written(target, as_json=asked.as_json, **(about if asked.as_json else {}))
    image = target.with_suffix(".exr")
    taken = () if trained.inputs is None else ("--spp", trained.inputs)
    output.say_next(asked.quiet, ("estimate", source, "--model", target, *taken, "-o", image))


@command(
    "estimate bathroom.zarr -o bathroom.exr --denoise",
    *VIEW,
    *("error", "store", "scheduler", "workers", "overwrite"),
    *OUTPUT,
    error="all samples",
)
def estimate(
    source: SceneOrStore,
    out: Path,
    asked: CommonOptions,
    model: Path | None = None,
    level: float = 0.9,
    denoise: bool = False,
    while_rendering: bool = False,
    time: float | None = None,
) -> None:
    """Estimate the radiance of every pixel, with its certainty and its interval.

    Combines the mean and denoised images, pixel by pixel, by their errors on held-out samples, or
    applies a trained model. An EXR file has the estimate, and layers for its certainty, the ends of
    its interval, and the mean of the samples. .npy and .pfm files have its linear radiance; a .png
    is tone-mapped. With --while-rendering, the file is written at each doubling of the number of
    samples, and a line says the relative error and the samples that a smaller one takes; --time and
    --error stop it.

    Parameters
    ----------
    out : path
        The image to write: .exr, .npy, .pfm or .png.
    model : FILE, default candidates are combined
        A trained model, written by 'train'.
    level : float
        Probability of the interval.
    denoise : bool
        Denoise the estimate with Open Image Denoise.
    while_rendering : bool
        Estimate from a render; keep no samples.
    time : float, default all samples
        While rendering: stop after this many seconds.
    """
    from chdstat._core.files import kept_until_written
    from chdstat.estimators.training import load_model
    from chdstat.io import write_estimates
    from chdstat.io.writing import IMAGES

    target = asked.target(out, *IMAGES)  # refused before the work, not after
    trained = None if model is None else load_model(model)
    endless = (time, asked.error) != (None, None)
    samples = (
        _drawn(source, asked, endless=endless)
        if while_rendering
        else asked.samples(source, seed=asked.seed)
    )
    saying = output.saying_passes(quiet=asked.quiet)
    with asked.client() as client, kept_until_written(out) as checkpoint, saying:
        path = write_estimates(
            target,
            samples,
            trained,
            spp=None if while_rendering else asked.spp,
            level=level,
            denoise=denoise,
            progress=asked.progress,
            client=client,
            checkpoint=checkpoint,
            seconds=time,
            relative_error=asked.error,
        )
    about = IMAGES[path.suffix.lower()]
    if asked.as_json:
        output.print_json({"path": str(path), "content": about})
    else:
        typer.echo(f"wrote {path}: {about}")


def _drawn(source: str, asked: CommonOptions, *, endless: bool) -> Samples | Rendering:
    """Return a rendering of a scene that keeps no samples."""
    from chdstat.rendering import render_batches
    from chdstat.samples import is_store

    if is_store(source) or asked.store is not None:
        message = (
            "--while-rendering keeps no samples: it takes a scene, not a store such as "
            f"{source if asked.store is None else asked.store}"
        )
        raise InputError(message)
    settings = ({"spp": _ENDLESS} if endless else {}) | asked.settings
    return render_batches(asked.scene(source), progress=asked.progress, **settings)


@command(
    "compare bathroom.zarr -e mean -e catoni --patterns -o found",
    *("estimator", "spp", "seed", "plugin", "scheduler", "workers", "overwrite"),
    *OUTPUT,
    spp="all of the store",
)
def compare(
    store: StorePath,
    asked: CommonOptions,
    n: int = 32,
    max_batches: int = 16,
    patterns: bool = False,
    denoise: bool = False,
    curve: bool = False,
    out: Path | None = None,
) -> None:
    """Compare estimators on held-out pixels: errors, bias and fireflies.

    Parameters
    ----------
    n : int
        Number of samples per estimate.
    max_batches : int
        Largest number of batches per pixel to estimate from.
    patterns : bool
        Also compare for each pattern of pixels.
    denoise : bool
        Also compare after Open Image Denoise.
    curve : bool
        Also measure errors against the number of samples.
    out : path
        New folder for figures and numbers.
    """
    import chdstat
    from chdstat.estimators.training import first_samples
    from chdstat.reporting.figures import save_comparison

    target = None if out is None else asked.target(out)  # refused before the work, not after
    samples = first_samples(chdstat.open(store), asked.spp)
    estimators = asked.estimator or None
    sizes = chdstat.comparison.curve_sizes(samples, estimators) if curve else None
    errors = None
    with asked.client() as client:
        common: dict[str, Any] = {
            "seed": asked.seed or 0,
            "max_batches": max_batches,
            "progress": asked.progress,
            "client": client,
        }
        labels = "classify" if patterns else None
        found = chdstat.compare(samples, estimators, n=n, denoise=denoise, labels=labels, **common)
        if curve:
            errors = chdstat.comparison.error_curve(
                samples, estimators, sizes=sizes, model=found.reusable_models, **common
            )
    if target is not None:
        save_comparison(found, asked.replaced(target), curve=errors)
    if asked.as_json:
        curves = {} if errors is None else {"curve": errors.to_dict()}
        output.print_json(found.to_dict() | curves)
    else:
        _print_comparison(found, errors)
    output.say_next(asked.quiet, ("estimate", store, "-o", store.with_suffix(".exr")))


@command(
    "contrast path.zarr changed.zarr reference.exr --junit found.xml",
    *("spp", "seed", "max_depth", "backend", "define", "plugin", "overwrite", *OUTPUT),
    spp="a third of the reference's, or 512",
)
def contrast(
    sources: Words,
    asked: CommonOptions,
    variance: Path | None = None,
    reference_spp: int | None = None,
    render_spp: int | None = None,
    alpha: float = 0.05,
    finds: float | None = None,
    seconds: float | None = None,
    junit: Path | None = None,
    out: Path | None = None,
    distributions: bool = False,
) -> None:
    """Test whether renders have the same mean as another one, and rank them by their noise.

    A render is a finished store, an EXR or PFM image, a folder of EXR passes, or a scene. A scene
    is drawn at the size of the reference until its samples tell, or --spp of them are drawn.

    Finished stores, the last one too, are ranked by their noise, at equal spp and at equal time;
    the ranking says where in the image each is the least noisy. 'chdstat report' of several stores
    says why, too.

    The exit code is 0 if no difference was found, 3 if one was, and 4 if the samples cannot tell,
    for example because they are too few; of several renders, the worst counts. An error ends with
    2.

    Parameters
    ----------
    sources : RENDER... REFERENCE
        Renders, and what to contrast them with: a store, an image, or what 'chdstat export' wrote.
    variance : path, default as the files say
        Variances of a sample of the reference, an image.
    reference_spp : int, default as the files say
        Samples per pixel of the reference.
    render_spp : int, default as the files say
        Samples per pixel of renders that are images.
    alpha : float
        Probability of any difference found where there is none.
    finds : float, default --spp decides
        Stop drawing a scene that does not differ when a loss of this share of its light would have
        been found, .01 for 1 %.
    seconds : float, default all samples
        Contrast what each renders in this time.
    junit : FILE
        Results as JUnit XML for continuous integration, .xml.
    out : path
        A page with maps to write, .pdf, for one render or several stores.
    distributions : bool
        Test variances and distributions of pixels, too.
    """
    import chdstat
    from chdstat.inference import Contrasts
    from chdstat.inference.contrasts import with_noise
    from chdstat.reporting.figures import save_figure

    *names, last = sources
    page = None if out is None else asked.target(out, ".pdf")  # refused before the work
    table = None if junit is None else output.junit_target(junit, asked)
    renders, unranked = _stores_of_one_view(sources)
    _check_renders(names, page, ranked=bool(renders), why=unranked)
    other = _reference_of(last, variance, reference_spp)
    options: dict[str, Any] = {
        "alpha": alpha / len(names),
        "seconds": seconds,
        "distributions": distributions,
        "progress": asked.progress,
    }
    contrasts: dict[str, Contrast] = {}
    times: dict[str, float] = {}
    for name, (a, drawn) in _renders_of(names, other, asked, finds, render_spp).items():
        begin = time.monotonic()
        with closing(a) if isinstance(a, _SceneDraws) else nullcontext():
            found = chdstat.contrast(a, other, **options, **drawn)
        contrasts[name] = (
            replace(found, names=(name, found.names[1])) if isinstance(a, _SceneDraws) else found
        )
        times[name] = time.monotonic() - begin
    together = Contrasts(contrasts, alpha)
    if renders:
        together = with_noise(together, renders, patterns=False, progress=asked.progress)
    if page is not None:
        save_figure((together if len(names) > 1 else found).plot(), page)
    if table is not None:
        output.write_junit(table, contrasts, times)
    _print_contrasts(together, asked, last, unranked)
    more = [("report", *sources, "-o", "renders.pdf")] if renders else []
    output.say_next(asked.quiet, *more, ("explore", *names, last))
    if code := _CODES[together.outcome]:
        raise typer.Exit(code)


def _stores_of_one_view(sources: list[str]) -> tuple[dict[str, Samples], str]:
    """Return the samples of all renders by name, none if they cannot be ranked by their noise.

    Return why, too, if all are stores.
    """
    from chdstat.inference.noise_rankings import check_one_view
    from chdstat.inference.render_pairs import independent
    from chdstat.samples import is_store

    if len({*sources}) < max(2, len(sources)) or not all(map(is_store, sources)):
        return {}, ""
    found = {name: independent(name) for name in sources}
    try:
        check_one_view(found)
    except InputError as error:
        return {}, str(error)
    return found, ""


def _check_renders(names: list[str], page: Path | None, *, ranked: bool, why: str) -> None:
    """Refuse renders that cannot be contrasted together."""
    if not names:
        message = "contrast needs a render and what to contrast it with, got one path"
        raise InputError(message)
    if twice := next((name for name in names if names.count(name) > 1), ""):
        message = f"expected several renders, got {twice} twice"
        raise InputError(message)
    if page is not None and len(names) > 1 and not ranked:
        got = why.partition(", got ")[2].partition(": ")[0] or f"{len(names)} renders"
        message = (
            f"-o writes a page about one render or several stores of one view, got {got}; leave it "
            "out, or --junit"
        )
        raise InputError(message)


def _reference_of(name: str, variance: Path | None, spp: int | None) -> Path | Reference:
    """Return what renders are contrasted with: an image, or the place of a store."""
    from chdstat.inference import Reference

    given = variance is not None or spp is not None
    if given or _is_folder_of_passes(name):
        return Reference.read(name, variance=variance, spp=spp)
    place = place_of(name)
    return Reference.of(place) or place


def _is_folder_of_passes(name: str) -> bool:
    from chdstat.samples import is_store

    return not is_store(name) and Path(name).is_dir() and Path(name).suffix != ".zarr"


def _renders_of(
    names: list[str],
    other: Path | Reference,
    asked: CommonOptions,
    finds: float | None,
    spp: int | None,
) -> dict[str, tuple[Any, dict[str, Any]]]:
    """Return renders by name, each with the options of `contrast` that it takes."""
    from chdstat.inference import Reference
    from chdstat.inference.references import IMAGES
    from chdstat.rendering import refuse_render
    from chdstat.samples import is_store

    found: dict[str, tuple[Any, dict[str, Any]]] = {}
    seed = {"seed": asked.seed or 0}
    for name in names:
        place = place_of(name)
        if _is_folder_of_passes(name) or place.suffix.lower() in IMAGES:
            found[name] = Reference.read(name, spp=spp), seed
        elif is_store(name) or is_remote(place) or place.suffix == ".zarr":
            found[name] = place, seed
        else:
            found[name] = _draws(asked.scene(name), other, asked, finds)
    if spp is not None and not any(isinstance(a, Reference) for a, _ in found.values()):
        message = f"--render-spp is for images, got {', '.join(names)}; leave it out"
        raise InputError(message)
    if not any(isinstance(a, _SceneDraws) for a, _ in found.values()):
        settings = {n: v for n, v in asked.settings.items() if n != "seed"}
        refuse_render(names[0], settings | {"-D": asked.define or None, "--finds": finds})
    return found


def _draws(
    scene: Scene, other: Path | Reference, asked: CommonOptions, finds: float | None
) -> tuple[_SceneDraws, dict[str, Any]]:
    """Return what draws samples of a scene at the size of a reference, and the options for it."""
    import chdstat
    from chdstat.inference.references import OF_TEST, Reference
    from chdstat.recording.renderers import source_of
    from chdstat.rendering import render_batches
    from chdstat.samples.tiles import BATCH
    from chdstat.scenes.scene import MITSUBA

    held = other if isinstance(other, Reference) else chdstat.open(other)
    height, width = held.shape[:2]
    seed = held.attrs.get("seed") if asked.seed is None else asked.seed
    seed = (seed or 0) + (asked.seed is None)
    if seed == held.attrs.get("seed"):
        message = (
            f"the reference has the seed {seed}, so that its samples are those of {scene.name}: "
            "give another --seed"
        )
        raise InputError(message)
    spp = asked.spp or (held.spp // OF_TEST if held.spp else _UNKNOWN_SPP)
    settings = asked.settings | {"size": (width, height), "spp": spp, "seed": seed}
    drawn: Rendering | PassSource
    if scene.renderer == MITSUBA:
        batch = min(BATCH, max(1, spp // 4))  # so that it can be looked at after a quarter
        drawn = render_batches(scene, batch=batch, progress=asked.progress, **settings)
    else:
        drawn = source_of(scene, **{n: v for n, v in settings.items() if n not in ("spp", "seed")})
    one, their = (attrs.get("integrator") for attrs in (drawn.attrs, held.attrs))
    if their and one != their:
        told = partial(json.dumps, sort_keys=True)
        warn_caller(
            f"{scene.name} is drawn by the integrator {told(one)}, and the reference was by "
            f"{told(their)}: their means differ if these do"
        )
    return _SceneDraws(drawn), {"spp": spp, "seed": seed, "finds": finds}


class _SceneDraws:
    """Draws passes of another renderer, or the batches of a render by Mitsuba.

    A render has its own seed, and its batches follow each other.
    """

    def __init__(self, drawn: Rendering | PassSource) -> None:
        self._drawn: Any = drawn if callable(drawn) else iter(drawn)

    def __call__(self, seed: int) -> Image:
        image: Image = self._drawn(seed).image if callable(self._drawn) else next(self._drawn)
        return image

    def close(self) -> None:
        """End the render, and its progress bar or process."""
        self._drawn.close()


def _print_contrasts(found: Contrasts, asked: CommonOptions, last: str, unranked: str) -> None:
    """Print one contrast in full, or several as a table and what is not in order."""
    contrasts = list(found.contrasts.values())
    one = contrasts[0] if len(contrasts) == 1 else None
    if asked.as_json:
        noise = {} if found.noise is None else {"noise": found.noise.to_dict()}
        output.print_json(found.to_dict() if one is None else one.to_dict() | noise)
        return
    output.print_sentences([found.means if one is None else one.conclusion])
    typer.echo()
    if one is None:
        _print_means(found, last)
    else:
        output.print_table(one.table())
    if found.noise is not None:
        typer.echo()
        output.print_rows(rows := found.noise.in_words(), {name: name for name in rows[0]})
        output.print_notes(found.noise.facts())
    elif unranked:
        output.print_notes({"no ranking by noise": unranked})


def _print_means(found: Contrasts, last: str) -> None:
    """Print contrasts of means as a table, and what is not in order."""
    shares = ("loss", "smallest_loss_image", "smallest_loss_tenth")
    rows = [
        row | {"p": number(row["p"])} | {name: percent(row[name]) for name in shares}
        for row in found.mean_rows()
    ]
    output.print_rows(rows, _CONTRASTED)
    unequal = {
        name: of.conclusion
        for name, of in found.contrasts.items()
        if of.outcome != "no difference found"
    }
    output.print_notes({"A and B": f"each render is A, and {last} is B"} | unequal)


@command(
    "bench cornell-box bathroom --spp 16 -o table.csv",
    *("estimator", "seed", "size", "plugin", "overwrite"),
    *OUTPUT,
)
def bench(
    asked: CommonOptions,
    scenes: OptionalWords = None,
    spp: list[int] | None = None,
    seeds: int = 1,
    reference: list[str] | None = None,
    reference_spp: int | None = None,
    image: list[str] | None = None,
    folder: Path | None = None,
    certified: bool = False,
    out: Path | None = None,
) -> None:
    """Compare estimators on several scenes against converged references, as a paper would.

    With --certified, judge intervals, tails, modes and families that this library finds in 128, 512
    and 2048 samples. A million samples of each of 64 pixels certify the pixels of a scene.

    Parameters
    ----------
    scenes : SCENE|STORE...
        Built-in names, Mitsuba XML files, stores.
    spp : int, default 16 and 64; 128, 512 and 2048 if certified
        Samples per pixel to estimate from; repeat.
    seeds : int
        Number of renders of each scene to average over.
    reference : SCENE=FILE, default rendered with another seed
        A converged EXR file, or a store of other samples; can be repeated.
    reference_spp : int, default 2048; 2^20 to certify
        Samples per pixel of a rendered reference.
    image : NAME@SCENE=FILE
        A finished image of another program, EXR; can be repeated.
    folder : path
        Folder that keeps renders, references and certified pixels.
    certified : bool
        Judge this library's own statistics instead, on pixels with certified answers: those of the
        built-in scenes, or of each SCENE, which is certified first (minutes).
    out : path
        Table to write: .csv, .json.
    """
    import chdstat
    from chdstat.studies import Bench

    if certified:
        refused = {
            "-e": asked.estimator,
            "--seeds": seeds > 1,
            "--reference": reference,
            "--image": image,
        }
        _bench_certified(scenes or [], asked, spp, reference_spp, folder, out, refused)
        return
    if not scenes:
        message = "bench needs a scene or a store, got none; add one, or --certified"
        raise InputError(message)
    if out is not None:
        asked.target(out, *Bench.FORMATS)  # refused before the work
    images: dict[str, dict[str, str]] = {}
    for key, file in pairs_of("--image", image).items():
        name, _, scene = key.partition("@")
        images.setdefault(name, {})[scene] = file
    found = chdstat.bench(
        scenes,
        asked.estimator or None,
        spp=spp or (16, 64),
        seeds=seeds,
        references=pairs_of("--reference", reference),
        reference_spp=reference_spp or 2048,
        images=images,
        folder=folder,
        progress=asked.progress,
        **asked.settings,
    )
    if out is not None:
        found.save(out)
    if asked.as_json:
        output.print_json(found.to_dict())
    else:
        typer.echo(found)
    output.say_next(asked.quiet, ("compare", "STORE", "--patterns"))


def _bench_certified(
    scenes: list[str],
    asked: CommonOptions,
    spp: list[int] | None,
    reference_spp: int | None,
    folder: Path | None,
    out: Path | None,
    refused: dict[str, Any],
) -> None:
    """Judge this library's own answers on certified pixels."""
    from chdstat import certification

    if given := [name for name, value in refused.items() if value]:
        message = f"--certified judges this library's statistics and takes no {', '.join(given)}"
        raise InputError(message)
    if out is not None:
        asked.target(out, *certification.CertifiedBench.FORMATS)  # refused before the work
    truth = certification.of_scenes(
        scenes,
        spp=reference_spp,
        size=asked.settings.get("size"),
        folder=folder,
        progress=asked.progress,
    )
    seed: dict[str, Any] = {} if asked.seed is None else {"seed": asked.seed}
    counts = spp or certification.COUNTS
    found = certification.bench(truth, n=counts, progress=asked.progress, **seed)
    if out is not None:
        found.save(out)
    if asked.as_json:
        output.print_json(found.to_dict())
    else:
        where = f"{found.pixels} certified pixels of {', '.join(found.scenes)}"
        output.print_sentences([f"{where}; ± half of the 95 % interval over pixels"])
        typer.echo()
        titles = {name: name if name == "question" else f"n = {name}" for name in found.rows()[0]}
        output.print_rows(found.rows(), titles)
    output.say_next(asked.quiet, ("bench", "--certified", "SCENE.xml", "--folder", "certified"))


_CODES = {"no difference found": 0, "differ": 3, "cannot tell": 4}
"""Exit codes by the outcome of `chdstat contrast`."""


def _print_comparison(found: Comparison, curve: ErrorCurve | None) -> None:
    """Print the tables of a comparison, with 95 % intervals in brackets."""
    typer.echo(
        f"{len(found.estimators)} estimators from {found.n} samples, on "
        f"{found.test_pixels.sum()} test pixels; 95 % intervals in brackets\n"
    )
    output.print_rows(_in_words(found.table()), _COMPARED, text=["estimator"])
    of_patterns = found.breakdown, {"label": "pattern", "pixels": "pixels"}
    notes = found.notes
    for more, columns in (of_patterns, (curve, {"n": "N"})):
        if more is not None:
            typer.echo()
            output.print_rows(
                _in_words(more.table()), columns | _COMPARED, text=["name", "estimator"]
            )
            notes = notes | more.marks
    output.print_notes(notes)


def _in_words(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return rows of measures as in a report, with what one types for each estimator."""
    from chdstat.comparison.metrics import in_words

    return [row | in_words(row) for row in rows]
